"""Fixtures of the tests of validation."""

import pytest


@pytest.fixture(autouse=True)
def _shared(shared_results: None) -> None:
    """Files that differ in one claim are many here; what belongs to the others is computed once."""
