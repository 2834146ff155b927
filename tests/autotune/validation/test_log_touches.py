"""Touches of a log beside the certified plants: at their own speed, or at the one to which their force drives."""

import pytest

from autotune.validation.log_touches import _compared
from identification.result import Touch, TouchCause
from tests.autotune.tuning.cases import small_controller

TOUCH = Touch(axis="x", sign=1, cause=TouchCause.WALL, peak_s=2.0, onset_s=1.9, peak_force=40.0)


def with_drive(speed: float | None, force: float | None) -> Touch:
    return Touch(**{**vars(TOUCH), "approach_speed": speed, "desired_force": force})


def test_a_touch_of_known_speed_stands_beside_the_peaks_of_all_certified_plants() -> None:
    slow, fast = (next(iter(_compared(small_controller(), with_drive(speed, None)))) for speed in (0.01, 0.02))
    for each, speed in ((slow, 0.01), (fast, 0.02)):
        low, high = each.band_peaks_n
        assert each.speed_m_s == pytest.approx(speed, rel=1e-9)
        assert 0.0 < low <= each.predicted_peak_n <= high
        assert (each.axis, each.onset_s, each.measured_peak_n) == ("x", 1.9, 40.0)
    # With what drives to the speed behind it, too.
    assert fast.predicted_peak_n > 1.5 * slow.predicted_peak_n


def test_a_force_stands_for_the_speed_to_which_it_drives_and_without_either_there_is_nothing() -> None:
    controller = small_controller()
    (driven,) = _compared(controller, with_drive(None, -30.0))
    assert driven.desired_force_n == 30.0
    (same,) = _compared(controller, with_drive(driven.speed_m_s, 30.0))
    assert same.predicted_peak_n == pytest.approx(driven.predicted_peak_n, rel=1e-6)
    assert list(_compared(controller, with_drive(None, None))) == []
