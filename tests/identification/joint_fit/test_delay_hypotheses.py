"""A robot of two poles beside one pole and a longer delay."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from identification.joint_fit import latency
from identification.joint_fit.model import ParameterLayout, robot_model
from problems.arrays import FloatArray

PERIOD_S = 8e-4


@dataclass(frozen=True, kw_only=True)
class _Problem:
    layout: ParameterLayout
    signals: Any
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Point:
    values: FloatArray


@pytest.mark.parametrize(("second_rad_per_s", "is_compared"), [(4000.0, True), (60.0, False)])
def test_a_fast_second_pole_is_held_against_a_delay_of_its_time_constant(
    second_rad_per_s: float, is_compared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1/((s/p_1 + 1)(s/p_2 + 1)) is 1/(s/p_1 + 1) with a delay 1/p_2, where p_2 is far above p_1."""
    first, delay = 25.0, 2.4e-3
    omega = (first * second_rad_per_s) ** 0.5
    zeta = 0.5 * (first + second_rad_per_s) / omega
    layout = ParameterLayout(robot_order=2, surfaces=0)
    values = np.ones(layout.robot.stop)
    values[layout.robot] = omega, zeta, delay
    # The fit itself is not what is tested: what it begins with comes back, as likely as the two poles.
    monkeypatch.setattr(latency, "minimise", lambda _problem, point, _steps: (point, 0.0))
    monkeypatch.setattr(latency, "cost", lambda *_: 0.0)
    problem: Any = _Problem(layout=layout, signals=SimpleNamespace(period_s=PERIOD_S))
    point: Any = _Point(values=values)
    found = latency._one_pole(problem, point)
    assert (found is not None) == is_compared
    if found is not None:
        robot = robot_model(found.point.values[layout.robot])
        slow, fast = np.sort(np.abs(np.roots(robot.denominator)))
        assert slow == pytest.approx(first, rel=1e-6)
        assert fast > 6.0 * second_rad_per_s
        assert robot.delay_s == pytest.approx(delay + 1.0 / second_rad_per_s, rel=1e-6)
        assert found.share == 0.5
