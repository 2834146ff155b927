"""What is known from elsewhere, entered as a prior."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import EstimateError
from identification.given import Given, check_names, settle_axis, settle_cell
from identification.result import Status
from tests.identification.merging.test_combine import UNDECIDED, known, reported
from tests.problems.axes import LAW

VALUES, STDS = st.floats(15.0, 17.0), st.floats(0.01, 1.0)


@LAW
@given(VALUES, STDS, VALUES, STDS)
def test_the_posterior_is_where_the_product_of_both_densities_is_largest(
    seen: float, std: float, prior: float, prior_std: float
) -> None:
    found = settle_cell(reported(known(seen, std)), {"mass_kg": Given(value=prior, std=prior_std)}).payload.mass_kg
    assert found.value is not None
    assert found.std is not None

    def deviance(at: float) -> float:
        return ((at - seen) / std) ** 2 + ((at - prior) / prior_std) ** 2

    # A parabola: its minimum from three points, its curvature is 2/σ².
    step = min(std, prior_std)
    low, middle, high = (deviance(found.value + k * step) for k in (-1.0, 0.0, 1.0))
    assert low == pytest.approx(high, rel=1e-6)
    assert (low + high - 2.0 * middle) / step**2 == pytest.approx(2.0 / found.std**2, rel=1e-6)
    assert found.status is (Status.GIVEN if prior_std <= std else Status.IDENTIFIED)


def test_what_the_log_does_not_show_is_the_given_value() -> None:
    axis = reported(delay=UNDECIDED).axes["x"]
    found, _ = settle_axis("x", axis, None, {"x.delay_s": Given(value=2.5e-3, std=1e-4)})
    delay = found.robot.delay_s
    assert (delay.value, delay.std, delay.status) == (2.5e-3, 1e-4, Status.GIVEN)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x.coupling_stiffness_n_per_m", 3.01e5),
        ("x.coupling_damping_n_s_per_m", 152.0),
        ("x.drag_n_s_per_m", 331.0),
        ("x.delay_s", 2.4e-3),
    ],
)
def test_without_a_fit_each_name_moves_its_own_number_alone(name: str, value: float) -> None:
    before = reported().axes["x"]
    after, findings = settle_axis("x", before, None, {name: Given(value=value, std=0.0)})
    flat = [
        (axis.coupling.stiffness_n_per_m, axis.coupling.damping_n_s_per_m, axis.drag_n_s_per_m, axis.robot.delay_s)
        for axis in (before, after)
    ]
    moved = [one != other for one, other in zip(*flat, strict=True)]
    assert np.count_nonzero(moved) == 1
    assert flat[1][moved.index(True)].value == value
    assert [finding.code for finding in findings] == ["given-used"]


def test_a_fit_with_the_prior_in_it_decides_and_the_log_alone_is_what_it_is_compared_with() -> None:
    alone = reported().axes["x"]
    both = dataclasses.replace(alone, drag_n_s_per_m=known(341.0, 2.0))
    near, findings = settle_axis("x", alone, both, {"x.drag_n_s_per_m": Given(value=342.0, std=2.5)})
    assert (near.drag_n_s_per_m.value, near.drag_n_s_per_m.std) == (341.0, 2.0)
    assert "the log shows 330" in near.drag_n_s_per_m.note
    assert [finding.code for finding in findings] == ["given-used"]
    _, findings = settle_axis("x", alone, both, {"x.drag_n_s_per_m": Given(value=900.0, std=0.1)})
    assert [finding.code for finding in findings] == ["given-contradicts"]


def test_a_prior_that_contradicts_the_log_is_an_error() -> None:
    found = settle_cell(reported(known(16.2, 0.02)), {"mass_kg": Given(value=22.0, std=0.1)})
    (finding,) = (f for f in found.findings if f.code == "given-contradicts")
    assert (finding.severity, "16.2 ± 0.02, given is 22 ± 0.1" in finding.message) == ("error", True)
    near = settle_cell(reported(known(16.2, 0.02)), {"mass_kg": Given(value=16.25, std=0.1)})
    assert [finding.code for finding in near.findings] == ["given-used"]
    assert "the log alone shows" in near.findings[0].message


def test_a_period_that_differs_by_the_rounding_of_stamps_contradicts_nothing() -> None:
    seen = dataclasses.replace(reported(), sample_time_s=known(0.0020000000001, 1e-15))
    near = settle_cell(seen, {"sample_time_s": Given(value=0.002, std=0.0)})
    assert [finding.code for finding in near.findings] == ["given-used"]
    assert near.sample_time_s.value == 0.002


@pytest.mark.parametrize(
    ("given_s", "code"), [(0.001, "given-used"), (0.005, "given-contradicts"), (2e-6, "given-contradicts")]
)
def test_a_log_may_be_slower_than_the_controller_and_not_faster(given_s: float, code: str) -> None:
    seen = dataclasses.replace(reported(), sample_time_s=known(0.002, 1e-15))
    found = settle_cell(seen, {"sample_time_s": Given(value=given_s, std=0.0)})
    assert [finding.code for finding in found.findings] == [code]
    assert found.sample_time_s.value == given_s


@pytest.mark.parametrize("name", ["mass", "y.delay_s", "x.mass_kg"])
def test_an_unknown_name_is_refused_with_those_that_are_known(name: str) -> None:
    with pytest.raises(EstimateError, match=rf"Nothing called {name} can be given.*mass_kg, sample_time_s, x\.coup"):
        check_names({name: Given(value=1.0, std=0.1)}, ["x"])


@pytest.mark.parametrize(
    ("std", "prior_std", "expected"),
    [
        # The fit with a prior decides, however sharp the prior is; an exact one is what is taken.
        (2.0, 0.4, (341.0, 1.5)),
        (2.0, 1.0, (341.0, 1.5)),
        (2.0, 0.0, (335.0, 0.0)),
        (0.0, 0.4, (341.0, 1.5)),
    ],
)
def test_a_fit_decides_beside_any_prior_but_an_exact_one(
    std: float, prior_std: float, expected: tuple[float, float]
) -> None:
    alone = dataclasses.replace(reported().axes["x"], drag_n_s_per_m=known(334.0, std))
    both = dataclasses.replace(alone, drag_n_s_per_m=known(341.0, 1.5))
    given_drag = {"x.drag_n_s_per_m": Given(value=335.0, std=prior_std)}
    found = settle_axis("x", alone, both, given_drag)[0].drag_n_s_per_m
    assert (found.value, found.std) == expected
    assert found.status is (Status.GIVEN if prior_std <= std else Status.IDENTIFIED)
    # Without a fit that shows the number, log and prior are weighed.
    blind = dataclasses.replace(alone, drag_n_s_per_m=UNDECIDED)
    weighed = settle_axis("x", alone, blind, given_drag)[0].drag_n_s_per_m
    assert weighed == dataclasses.replace(settle_axis("x", alone, None, given_drag)[0].drag_n_s_per_m)
    if 0.0 in (std, prior_std):
        assert weighed.value == (335.0 if prior_std == 0.0 else 334.0)
        assert weighed.std == 0.0
