"""What is claimed of a number follows from its deviation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.result import Status
from identification.verdicts import judged, judged_damping, unidentifiable, unidentifiable_vector, vector


@pytest.mark.parametrize(
    ("std", "status"),
    [
        (0.0, Status.IDENTIFIED),
        (5.0, Status.IDENTIFIED),
        (5.1, Status.WEAK),
        (20.0, Status.WEAK),
        (20.1, Status.UNIDENTIFIABLE),
        (float("inf"), Status.UNIDENTIFIABLE),
        (float("nan"), Status.UNIDENTIFIABLE),
    ],
)
def test_the_share_of_the_deviation_decides(std: float, status: Status) -> None:
    assert judged(100.0, std, method="m").status is status
    assert judged(-100.0, std, method="m").status is status


@given(st.floats(-1e6, 1e6), st.floats(0.0, 1e6), st.floats(0.0, 1e6))
def test_no_number_is_reported_that_is_not_trusted(value: float, std: float, floor: float) -> None:
    estimate = judged(value, std, method="m", floor=floor)
    trusted = estimate.status in {Status.IDENTIFIED, Status.WEAK}
    assert (estimate.value is not None) == trusted
    assert (estimate.std is not None) == trusted
    if trusted:
        assert std <= 0.2 * max(abs(value), floor)


@given(st.floats(0.1, 1e6), st.floats(1e-6, 1.0))
def test_a_larger_deviation_never_earns_a_better_verdict(value: float, share: float) -> None:
    order = [Status.IDENTIFIED, Status.WEAK, Status.UNIDENTIFIABLE]
    smaller, larger = (order.index(judged(value, s * value, method="").status) for s in (share, 1.5 * share))
    assert smaller <= larger


def test_a_value_near_zero_is_measured_by_what_matters() -> None:
    assert judged(0.0, 1.0, method="").status is Status.UNIDENTIFIABLE
    assert judged(0.0, 1.0, method="", floor=100.0).status is Status.IDENTIFIED


def test_a_refused_number_says_why() -> None:
    refused = judged(38.8, 13.3, method="how", note="seen")
    assert refused.note == "seen; standard deviation 13.3 for a value of 38.8"
    assert refused.method == "how"
    assert unidentifiable(note="why").note == "why"


def test_vectors_carry_plain_numbers() -> None:
    estimate = vector(np.array([1.0, 2.0]), np.array([0.1, 0.2]), method="m")
    assert estimate.value == (1.0, 2.0)
    assert estimate.std == (0.1, 0.2)
    assert all(type(number) is float for number in (*estimate.value, *estimate.std))
    assert unidentifiable_vector("why").value is None


@pytest.mark.parametrize(
    ("std", "status"), [(4.0, Status.IDENTIFIED), (15.0, Status.WEAK), (40.0, Status.UNIDENTIFIABLE)]
)
def test_a_damping_is_judged_by_itself(std: float, status: Status) -> None:
    """However small it is beside the critical one: 100 ± 40 is no value."""
    assert judged_damping(100.0, std, 1e6, method="m").status is status


def test_a_small_damping_that_is_no_value_is_an_interval() -> None:
    reported = judged_damping(30.0, 20.0, 100.0, method="m")
    assert (reported.value, reported.std) == (None, None)
    assert reported.ci95 == pytest.approx((0.0, 30.0 + 1.96 * 20.0))
    assert judged_damping(-5.0, 20.0, 100.0, method="m").ci95 == pytest.approx((0.0, 1.96 * 20.0))
    assert judged_damping(30.0, 20.0, 100.0, method="m", ci95=(3.0, 80.0)).ci95 == (3.0, 80.0)
    assert judged_damping(30.0, 25.1, 100.0, method="m").ci95 is None
