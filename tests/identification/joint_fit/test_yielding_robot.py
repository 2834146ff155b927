"""A robot that is held back by dry friction: stepped finely by other code, and no friction where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from identification.joint_fit.data import HeldCommand, JointData, usual_coupling
from identification.joint_fit.free_motion import fit_robot
from identification.joint_fit.path import given_way
from identification.joint_fit.yielding_robot import rubbing_of
from identification.signals.segments import Span
from problems.arrays import FloatArray
from problems.model.robot import RobotModel

PERIOD_S, FINER = 2e-3, 80
OMEGA, ZETA, DELAY_S, MASS_KG = 38.0, 0.9, 3.25e-3, 16.0
ROBOT = RobotModel(
    numerator=np.array([OMEGA**2]), denominator=np.array([1.0, 2.0 * ZETA * OMEGA, OMEGA**2]), delay_s=DELAY_S
)


def sweep(duration_s: float = 9.0, rest_s: float = 2.0) -> FloatArray:
    """Return a command of 12 mm/s from 0.5 to 30 Hz between two rests, one value a sample."""
    t = np.arange(0.0, duration_s, PERIOD_S)
    rate = np.log(60.0) / duration_s
    edge = np.clip(np.minimum(t, duration_s - t) / 0.4, 0.0, 1.0)
    way = 0.012 / (np.pi * np.exp(rate * t)) * edge**2 * (3.0 - 2.0 * edge)
    rest = np.zeros(round(rest_s / PERIOD_S))
    return np.concatenate([rest, way * np.sin(np.pi * (np.exp(rate * t) - 1.0) / rate), rest])


def answer(command: FloatArray, held_back_m: float) -> FloatArray:
    """Return the flange (n,) of a servo with Coulomb friction behind the held, late command: steps of 25 µs."""
    dt, x, v = PERIOD_S / FINER, 0.0, 0.0
    late = round(DELAY_S / dt)
    acting = np.concatenate([np.zeros(late), np.repeat(command, FINER)])[: len(command) * FINER]
    out = np.empty(len(command))
    for i, u in enumerate(acting.tolist()):
        if i % FINER == 0:
            out[i // FINER] = x
        pulled = v + dt * (OMEGA**2 * (u - x) - 2.0 * ZETA * OMEGA * v)
        most = dt * OMEGA**2 * held_back_m
        v = pulled - min(max(pulled, -most), most)
        x += dt * v
    return out


def logged(held_back_m: float) -> JointData:
    rng, command = np.random.default_rng(2), sweep()
    count, rest = len(command), round(2.0 / PERIOD_S)
    moving = (Span(start=rest, stop=count - rest),)
    return JointData(
        period_s=PERIOD_S,
        position_m=answer(command, held_back_m) + 2e-6 * rng.standard_normal(count),
        force_n=0.1 * rng.standard_normal(count),
        command=HeldCommand(command_m=command, shift_s=0.0),
        rests=(Span(start=0, stop=rest - 150), Span(start=count - rest + 250, stop=count)),
        moving=moving,
        free=moving,
        holds=(),
        coupling=usual_coupling(MASS_KG),
        robot=replace(ROBOT, delay_s=0.9 * DELAY_S),
        mass_kg=MASS_KG,
    )


def test_the_robot_behind_dry_friction_is_found_with_its_delay() -> None:
    """Without the friction the delay is 0.2 ms short here."""
    problem, start = fit_robot(logged(9e-6))
    omega, zeta, delay_s = start[problem.layout.robot].tolist()
    assert problem.signals.yielded is not None
    assert float(np.max(np.abs(problem.signals.yielded[:, 0]))) == pytest.approx(9e-6, rel=0.15)
    assert delay_s == pytest.approx(DELAY_S, abs=3e-5)
    assert (omega, zeta) == pytest.approx((OMEGA, ZETA), rel=0.004)


def test_a_robot_without_friction_is_left_as_it_is() -> None:
    problem, start = fit_robot(logged(0.0))
    assert problem.signals.yielded is None
    assert start[problem.layout.robot][-1] == pytest.approx(DELAY_S, abs=1e-5)


def test_a_long_log_gives_way_as_one_spline_through_all_of_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, force = np.array([OMEGA, ZETA, DELAY_S]), np.random.default_rng(3).standard_normal(5000)
    whole = given_way(robot, force, PERIOD_S)
    monkeypatch.setattr("identification.joint_fit.path._PART", 700)
    assert given_way(robot, force, PERIOD_S).tobytes() == whole.tobytes()


@pytest.mark.parametrize("robot", [np.array([25.0, DELAY_S]), np.array([OMEGA, ZETA, DELAY_S])])
def test_friction_opposes_a_sliding_robot_and_lets_go_of_none_at_rest(robot: FloatArray) -> None:
    speed = 1e-4 * np.sin(0.05 * np.arange(400))
    friction = rubbing_of(robot, speed, 1e-6, PERIOD_S)
    sliding = np.abs(speed) > 5e-5
    assert friction[sliding] == pytest.approx(-1e-6 * np.sign(speed[sliding]))
    assert not np.any(rubbing_of(robot, np.zeros(50), 1e-6, PERIOD_S))
