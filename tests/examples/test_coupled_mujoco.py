"""A payload off its sensor in MuJoCo swings after a knock as the coupled model says, free and under control."""

from dataclasses import replace

import numpy as np
import pytest

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController, controller_blocks
from problems.model.coupled import (
    CoupledPlant,
    Law,
    RigidPayload,
    build_coupled_loop,
    build_coupled_sampled_plant,
    coupled_poles,
)
from problems.model.difference import controller_step
from problems.model.plant import Coupling, PayloadDynamics, Plant
from problems.model.robot import RobotModel

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

from examples.mujoco.cell import MujocoCell, Running, Wall

COM_M, KNOCK_N, KNOCK_TICKS, TICKS = 0.15, 200.0, 10, 400
CELL = replace(
    MujocoCell(),
    com_S_m=(0.0, 0.0, COM_M),
    turning_n_m_per_rad=2.3e4,
    turning_n_m_s_per_rad=3.0,
    force_noise_n=0.0,
    torque_noise_n_m=0.0,
    resolution_n=0.0,
    position_noise_m=0.0,
    bias=(0.0,) * 6,
)
PLACES = (0, 4)  # x and ry
CALM = (
    AdmittanceController(mass_kg=40.0, damping_n_s_per_m=6000.0),
    AdmittanceController(mass_kg=1.6, damping_n_s_per_m=240.0),
)
LIVELY = (
    AdmittanceController(mass_kg=16.0, damping_n_s_per_m=1200.0),
    AdmittanceController(mass_kg=0.64, damping_n_s_per_m=48.0),
)


def model() -> CoupledPlant:
    turn = 2.0 * np.pi * CELL.servo_hz
    robot = RobotModel(
        numerator=np.array([turn**2]),
        denominator=np.array([1.0, 2.0 * CELL.servo_damping_ratio * turn, turn**2]),
        delay_s=CELL.delay_s,
    )
    inertia = CELL.inertia_kg_m2[1] + CELL.mass_kg * COM_M**2
    payload = RigidPayload(
        mass_kg=CELL.mass_kg, com_S_m=np.array([0.0, 0.0, COM_M]), inertia_S_kg_m2=np.diag([inertia] * 3)
    )
    couplings = (
        (CELL.stiffness_n_per_m, CELL.damping_n_s_per_m),
        (CELL.turning_n_m_per_rad, CELL.turning_n_m_s_per_rad),
    )
    plants = tuple(
        Plant(
            robot=robot,
            coupling=Coupling(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping),
            payload=PayloadDynamics(mass_kg=1.0, drag_n_s_per_m=0.0),
        )
        for stiffness, damping in couplings
    )
    return CoupledPlant(plants=plants, mass_matrix=payload.mass_matrix[np.ix_(PLACES, PLACES)])


def in_mujoco(laws: tuple[Law, ...]) -> FloatArray:
    """Return force along x and torque about y (n, 2) after a knock at the centre of mass, under these laws."""
    running = Running(CELL, Wall(distance_m=10.0))
    weight, seen = np.array(running.read().wrench_S), []
    blocks = [None if law is None else controller_blocks(law, CELL.period_s) for law in laws]
    rest = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    states, command = [rest] * 2, [0.0, 0.0]
    for tick in range(TICKS):
        wrench = np.array(running.read().wrench_S) - weight
        seen.append(wrench[list(PLACES)])
        for i, block in enumerate(blocks):
            if block is not None:
                command[i], states[i] = controller_step(block, states[i], float(seen[-1][i]), 0.0)
        running.push((KNOCK_N if tick < KNOCK_TICKS else 0.0, 0.0, 0.0))
        running.send((command[0], 0.0, 0.0), (0.0, command[1], 0.0))
    return np.array(seen)


def in_the_model(laws: tuple[Law, ...]) -> FloatArray:
    loop = build_coupled_loop(build_coupled_sampled_plant(model(), CELL.period_s), laws)
    state, seen = np.zeros(len(loop.a)), []
    for tick in range(TICKS):
        seen.append(loop.c_force @ state)
        push = KNOCK_N if tick < KNOCK_TICKS else 0.0
        state = loop.a @ state + loop.b_push @ np.array([push, COM_M * push])
    return np.array(seen)


@pytest.mark.parametrize("laws", [(None, None), (CALM[0], None), CALM])
def test_a_knock_swings_as_the_model_says(laws: tuple[Law, ...]) -> None:
    seen, expected = in_mujoco(laws), in_the_model(laws)
    # The servo yields to the payload (4 MN/m), gravity turns back (24 N·m/rad), and angles are not small ones there.
    for column in range(2):
        assert np.ptp(seen[:50, column]) == pytest.approx(np.ptp(expected[:50, column]), rel=0.02)
        assert np.ptp(seen[300:, column]) == pytest.approx(np.ptp(expected[300:, column]), rel=0.15)


def test_the_held_payload_swings_at_19_hz() -> None:
    seen = in_mujoco((None, None))[:, 0]
    ups = np.flatnonzero((seen[:-1] < 0.0) & (seen[1:] >= 0.0))
    moments = ups - seen[ups] / (seen[ups + 1] - seen[ups])
    # The last crossings: the other mode, at 39 Hz, has died away by then.
    found = 1.0 / (np.mean(np.diff(moments[-4:])) * CELL.period_s)
    poles = coupled_poles(build_coupled_loop(build_coupled_sampled_plant(model(), CELL.period_s), (None, None)))[0]
    slowest = poles[np.argmax(np.abs(poles) * (poles.imag > 0.0))]
    assert found == pytest.approx(float(np.angle(slowest)) / (2.0 * np.pi * CELL.period_s), rel=0.01)
    assert 18.0 < found < 20.0


def test_axes_that_the_model_calls_unstable_together_swing_up() -> None:
    poles = coupled_poles(build_coupled_loop(build_coupled_sampled_plant(model(), CELL.period_s), LIVELY))[0]
    assert np.max(np.abs(poles)) > 1.0
    seen = in_mujoco(LIVELY)[:, 0]
    assert np.ptp(seen[300:]) > 1.5 * np.ptp(seen[100:200])
