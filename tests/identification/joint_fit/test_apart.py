"""When dry friction and a part that swings are both reported."""

from types import SimpleNamespace
from typing import Any

import pytest

from identification.joint_fit import extension


@pytest.mark.parametrize(("left", "gain", "is_apart"), [(1.4, 60.0, True), (1.6, 60.0, False), (1.4, 59.0, False)])
def test_part_and_friction_are_told_apart_where_noise_is_left_and_friction_shows(
    left: float, gain: float, is_apart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left is compared with the noise as an amplitude, of 0.2 N here."""
    of: Any = SimpleNamespace(quiet_rms_n=0.2)
    both: Any = SimpleNamespace()
    monkeypatch.setattr(extension, "without", lambda *_: both)
    monkeypatch.setattr(extension, "mean_square", lambda *_: (0.2 * left) ** 2)
    monkeypatch.setattr(extension, "gained", lambda *_: gain)
    assert extension._is_apart(of, both) is is_apart
