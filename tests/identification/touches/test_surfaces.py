"""What the growth of a force shows of when it began."""

import numpy as np
import pytest

from identification.touches.surfaces import _growth


@pytest.mark.parametrize("begins_s", [0.1, 0.1013, 0.1027])
@pytest.mark.parametrize("slope", [2e2, 5e4])
def test_a_straight_rise_may_have_begun_so_often_the_time_that_it_took(begins_s: float, slope: float) -> None:
    step_s, start = 4e-3, 30
    time = step_s * np.arange(80, dtype=np.float64)
    force = slope * np.maximum(time - begins_s, 0.0)
    longest_s, stop = _growth(time, force, start)
    # From half the force of `start` to the first sample of twice as much all lies on one line.
    assert longest_s == pytest.approx(3.5 * (time[start] - begins_s), rel=1e-9)
    assert stop == 1 + int(np.argmax(force > 2.0 * force[start]))


def test_a_force_that_falls_before_it_has_doubled_rises_no_further_than_its_first_sample() -> None:
    step_s, start = 4e-3, 20
    time = step_s * np.arange(60, dtype=np.float64)
    force = np.interp(np.arange(60), [start - 1, start, start + 2, 50], [0.0, 10.0, 5.0, 40.0])
    longest_s, stop = _growth(time, force, start)
    assert stop == start + 1
    assert longest_s == pytest.approx(3.5 * step_s, rel=1e-9)
    # A force that falls may have begun between two samples.
    assert _growth(time, np.linspace(10.0, 5.0, 60), start)[0] == pytest.approx(2.0 * step_s)
