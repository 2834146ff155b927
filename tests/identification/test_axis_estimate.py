"""What the stamps of force and pose exclude."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from identification.axis_estimate import _check_lag
from identification.errors import EstimateError


def refusal(found_ms: float, known_ms: tuple[float, float] | None) -> str:
    fit = SimpleNamespace(latency=SimpleNamespace(seconds=1e-3 * found_ms))
    try:
        _check_lag(cast(Any, fit), None if known_ms is None else (1e-3 * known_ms[0], 1e-3 * known_ms[1]))
    except EstimateError as refused:
        return str(refused)
    return ""


@pytest.mark.parametrize(("found_ms", "known_ms"), [(2.9, (0.0, 1.0)), (-1.9, (1.0, 1.0)), (90.0, None)])
def test_a_lag_within_three_deviations_of_the_stamps_is_taken(
    found_ms: float, known_ms: tuple[float, float] | None
) -> None:
    assert refusal(found_ms, known_ms) == ""


@pytest.mark.parametrize(
    ("found_ms", "known_ms", "said"),
    [
        (3.1, (0.0, 1.0), "stamped 3.1 ms late, and the stamps leave 3.0 ms"),
        (-2.1, (1.0, 1.0), "stamped -2.1 ms late, and the stamps leave 3.0 ms"),
        (8.0, (0.0, 2.5), "stamped 8.0 ms late, and the stamps leave 7.5 ms"),
    ],
)
def test_a_lag_beyond_is_refused_with_both_times(found_ms: float, known_ms: tuple[float, float], said: str) -> None:
    assert said in refusal(found_ms, known_ms)
