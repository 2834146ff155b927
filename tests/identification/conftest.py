"""Recordings that several tests of identification share."""

import pytest

from identification.signals.recording import Recording
from tests.autotune.simulation.runs import demo_run


@pytest.fixture(scope="session")
def demo_recording() -> Recording:
    """The log of the demo cell."""
    return demo_run().recording
