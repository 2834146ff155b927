import math
from collections.abc import Callable

import numpy as np
import pytest

from problems._checks import finite, frozen_vector, interval, non_negative, positive
from problems.errors import ParameterError

NOT_FINITE = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("value", [*NOT_FINITE, 0.0, -0.0, -1e-300])
def test_positive_refuses(value: float) -> None:
    with pytest.raises(ParameterError, match="width must be finite and above 0"):
        positive("width", value)


@pytest.mark.parametrize("value", [*NOT_FINITE, -1e-300])
def test_non_negative_refuses(value: float) -> None:
    with pytest.raises(ParameterError, match="not below 0"):
        non_negative("width", value)


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("check", [positive, non_negative, finite])
def test_no_check_lets_what_is_not_finite_through(check: Callable[[str, float], float], value: float) -> None:
    with pytest.raises(ParameterError):
        check("width", value)


def test_what_is_good_comes_back_as_a_float() -> None:
    assert isinstance(positive("width", 3), float)
    assert non_negative("width", 0.0) == 0.0
    assert finite("width", -2.0) == -2.0


@pytest.mark.parametrize(
    "bounds", [(2.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (0.0, math.inf), (1.0,), (1.0, 2.0, 3.0), ()]
)
def test_interval_refuses(bounds: tuple[float, ...]) -> None:
    with pytest.raises(ParameterError, match=r"an interval (low\.\.high|from low to high)"):
        interval("range", bounds)


def test_interval_may_be_a_point_and_may_have_another_floor() -> None:
    assert interval("range", [2, 2]) == (2.0, 2.0)
    assert interval("range", (-3.0, 1.0), lowest=-5.0) == (-3.0, 1.0)


@pytest.mark.parametrize("values", [[], [math.nan], [1.0, math.inf], [[1.0, 2.0]]])
def test_frozen_vector_refuses(values: list[float]) -> None:
    with pytest.raises(ParameterError, match="a non-empty vector"):
        frozen_vector("coefficients", values)


def test_frozen_vector_is_a_read_only_copy() -> None:
    source = np.array([1.0, 2.0])
    frozen = frozen_vector("coefficients", source)
    source[0] = 5.0
    assert frozen.tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        frozen[0] = 7.0
