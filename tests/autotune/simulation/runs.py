"""Simulated cells that several tests share, each simulated once."""

from functools import cache

import numpy as np
import pytest

from autotune.simulation.phases import Program
from autotune.simulation.simulate import CellRun, simulate_cell
from autotune.simulation.truth import SimulatedCell
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment
from problems.model.robot import RobotModel

SHORT = Program(pose_count=3, pose_hold_s=0.4, jogging_s=6.0, sweep_s=3.0, contact_count=2)
SHORT_LOG = Program(pose_count=6, pose_hold_s=0.7, pose_move_s=0.6, jogging_s=0.0, sweep_s=5.0, contact_count=2)
"""20 s: enough to identify all that the usual program shows."""
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3)


def silent(cell: SimulatedCell) -> SimulatedCell:
    """The same cell with perfect sensors."""
    return SimulatedCell(
        **{
            **cell.__dict__,
            "force_noise_rms_n": 0.0,
            "torque_noise_rms_n_m": 0.0,
            "position_noise_rms_m": 0.0,
            "orientation_noise_rms_rad": 0.0,
        }
    )


def heavy_cell() -> SimulatedCell:
    """Another axis, a heavier payload, a softer gripper and wall, a robot of two poles."""
    return SimulatedCell(
        payload_mass_kg=25.0,
        com_S_m=(-0.03, 0.015, 0.19),
        coupling=Coupling(stiffness_n_per_m=2.2e5, damping_n_s_per_m=260.0),
        drag_n_s_per_m=500.0,
        environment=Environment(stiffness_n_per_m=4.0e4, damping_n_s_per_m=60.0),
        robot=TWO_POLES,
        controller=AdmittanceController(mass_kg=25.0, damping_n_s_per_m=2200.0, lead_s=0.012),
        sample_time_s=1e-3,
        approach_axis="z",
        force_bias_S_n=(-12.0, 3.0, 6.0),
    )


@cache
def demo_run() -> CellRun:
    """The default cell through the default program."""
    return simulate_cell(SimulatedCell(), Program(), seed=1)


@cache
def silent_demo_run() -> CellRun:
    """The default cell with perfect sensors."""
    return simulate_cell(silent(SimulatedCell()), Program(), seed=1)


@cache
def heavy_run() -> CellRun:
    """`heavy_cell` through the default program."""
    return simulate_cell(heavy_cell(), Program(), seed=7)


@cache
def silent_short_run(axis: str) -> CellRun:
    """The default cell with perfect sensors on `axis`, through a short program."""
    return simulate_cell(silent(SimulatedCell(**{**SimulatedCell().__dict__, "approach_axis": axis})), SHORT, seed=3)


def shorten_logs(patch: pytest.MonkeyPatch) -> None:
    """Leave the program of `simulate_log` its short form."""
    patch.setattr("autotune.simulation.phases.Program", lambda: SHORT_LOG)
