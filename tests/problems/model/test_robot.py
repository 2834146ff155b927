import cmath
import math

import numpy as np
import pytest
from hypothesis import given

from problems.errors import ParameterError
from problems.model.robot import RobotModel, cancel_common_factors
from tests.problems.axes import LAW, between, one_pole

# np.roots returns simple roots to a few units in the last place.
ROUNDING = 1e-12


def robot(numerator: list[float], denominator: list[float], delay_s: float = 0.0) -> RobotModel:
    return RobotModel(numerator=np.array(numerator), denominator=np.array(denominator), delay_s=delay_s)


def test_the_printed_example_loses_its_common_factor() -> None:
    """docs/method.md, erratum 1: (100 s + 400)/(5 s² + 120 s + 400) = 20/(s + 20)."""
    printed = robot([100.0, 400.0], [5.0, 120.0, 400.0], 2.4e-3)
    assert printed.order == 1
    np.testing.assert_allclose(printed.numerator, [20.0], rtol=ROUNDING)
    np.testing.assert_allclose(printed.denominator, [1.0, 20.0], rtol=ROUNDING)
    assert printed.delay_s == 2.4e-3


@LAW
@given(between(150.0, 500.0), between(5.0, 60.0), between(0.3, 1.3))
def test_whatever_is_multiplied_to_both_sides_is_removed(factor: float, omega: float, zeta: float) -> None:
    """A single root: where three coincide, rounding spreads them further than printed coefficients would."""
    kept = [1.0, 2.0 * zeta * omega, omega**2]
    found = robot([omega**2, factor * omega**2], list(np.polymul(kept, [1.0, factor])))
    assert found.order == 2
    # Two kept roots that lie close together are found to about the square root of the rounding, 1e-8.
    np.testing.assert_allclose(found.denominator, kept, rtol=1e-7)
    np.testing.assert_allclose(found.numerator, [omega**2], rtol=1e-7)


def test_a_complex_pair_is_removed_as_a_pair() -> None:
    pair = [1.0, 6.0, 100.0]
    found = robot([20.0 * c for c in pair], list(np.polymul(pair, [1.0, 20.0])))
    np.testing.assert_allclose(found.denominator, [1.0, 20.0], rtol=1e-10)


def test_factors_that_merely_lie_near_each_other_stay() -> None:
    numerator, denominator = cancel_common_factors(np.array([100.0, 400.4]), np.array([5.0, 120.0, 400.0]))
    assert (len(numerator), len(denominator)) == (2, 3)


def test_leading_zeros_are_no_degree() -> None:
    assert robot([0.0, 0.0, 20.0], [0.0, 1.0, 20.0]).order == 1


@pytest.mark.parametrize(
    ("numerator", "denominator", "must"),
    [
        pytest.param([-20.0], [1.0, -20.0], "stable", id="unstable pole"),
        pytest.param([20.0], [1.0, 0.0], "stable", id="integrator"),
        pytest.param([100.0], [1.0, 0.0, 100.0], "stable", id="undamped"),
        pytest.param([1.0, 20.0], [2.0, 20.0], "strictly proper", id="direct path"),
        pytest.param([1.0, 1.0, 20.0], [1.0, 20.0], "strictly proper", id="improper"),
        pytest.param([20.002], [1.0, 20.0], "without offset", id="gain 1.0001"),
        pytest.param([2e4], [1.0, 20.0], "without offset", id="millimetres"),
        pytest.param([-20.0], [1.0, 20.0], "without offset", id="flipped sign"),
        pytest.param([math.nan], [1.0, 20.0], "finite numbers", id="NaN above"),
        pytest.param([20.0], [math.inf, 20.0], "finite numbers", id="infinity below"),
        pytest.param([], [1.0, 20.0], "non-empty", id="nothing"),
        pytest.param([0.0], [1.0, 20.0], "non-zero", id="zero above"),
        pytest.param([20.0], [0.0, 0.0], "non-zero", id="zero below"),
    ],
)
def test_a_robot_that_cannot_be_is_refused(numerator: list[float], denominator: list[float], must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        robot(numerator, denominator)


@pytest.mark.parametrize("delay_s", [-1e-9, math.nan, math.inf])
def test_a_delay_that_cannot_be_is_refused(delay_s: float) -> None:
    with pytest.raises(ParameterError, match="delay_s"):
        one_pole(delay_s)


def test_the_position_response_is_the_polynomials_and_the_delay() -> None:
    model, omega = robot([3.0, 50.0], [1.0, 9.0, 50.0], 3e-3), 37.0
    s = 1j * omega
    expected = (3.0 * s + 50.0) / (s * s + 9.0 * s + 50.0) * cmath.exp(-s * 3e-3)
    np.testing.assert_allclose(model.position_response(np.array([omega])), [expected], rtol=ROUNDING)


def test_the_coefficients_cannot_be_changed_afterwards() -> None:
    source = np.array([20.0])
    model = RobotModel(numerator=source, denominator=np.array([1.0, 20.0]), delay_s=0.0)
    source[0] = 1.0
    assert model.numerator[0] == 20.0
    with pytest.raises(ValueError, match="read-only"):
        model.numerator[0] = 1.0
