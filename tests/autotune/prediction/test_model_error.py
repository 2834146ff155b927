"""The model's own error: what a closed form says of it, and how it shrinks with contacts that took no part."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from autotune.prediction.contact import PeakInterval
from autotune.prediction.model_error import ModelError, model_error
from autotune.prediction.result import interval_notes
from identification.fit_quality import HeldOutPeak


def held(ratio: float, without: str = "contact") -> HeldOutPeak:
    return HeldOutPeak(without=without, surface="x1", time_s=1.0, measured_peak=50.0, predicted_peak=50.0 * ratio)  # type: ignore[arg-type]


def test_without_contacts_it_is_that_of_two_other_surfaces() -> None:
    found = model_error(())
    assert (found.dof, found.contacts, found.logs) == (2, 0, 0)
    assert found.share == pytest.approx(math.sqrt((0.08**2 + 0.06**2) / 2.0))
    # The factors are equally likely: their logarithms follow Student's t.
    logs = np.log(found.factors(2001)) / found.share
    assert np.quantile(logs, [0.25, 0.5, 0.9]) == pytest.approx(stats.t(2).ppf([0.25, 0.5, 0.9]), abs=0.02)


def test_no_factor_is_beyond_e_squared() -> None:
    # Student's t with 2 degrees of freedom has no deviation: its ends would be factors of 10^13.
    factors = ModelError(share=1.0, dof=2).factors(1000)
    assert (factors[0], factors[-1]) == pytest.approx((math.exp(-2.0), math.exp(2.0)))


@given(st.lists(st.floats(0.97, 1.03), min_size=3, max_size=30))
def test_good_contacts_narrow_it_and_never_to_nothing(ratios: list[float]) -> None:
    found, alone = model_error([held(each) for each in ratios]), model_error(())
    assert 0.0 < found.share < alone.share
    assert found.dof == 2 + len(ratios)
    assert np.max(found.factors(100)) < np.max(alone.factors(100))


def test_other_logs_count_before_other_contacts() -> None:
    both = [held(1.001), held(1.3, "log"), held(0.8, "log")]
    assert model_error(both) == model_error(both[1:])
    assert model_error(both).logs == 2


def test_the_note_says_whose_the_two_other_surfaces_are() -> None:
    interval = PeakInterval(sensor=(40.0, 60.0), contact=(40.0, 60.0), level=0.95, unstable_share=0.0)
    (note,) = interval_notes(interval, model_error([held(1.01)] * 4))
    assert "4 contacts that took no part" in note
    assert "8 % and 6 % missed on 2 surfaces of another cell" in note
