"""Simulate a whole cell: the approach axis with its compliance, everything else rigid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.recording import PoseSignal, Recording, WrenchSignal

from .axis import AxisRun, run_axis
from .phases import Program, Script, build_script
from .truth import Cell

FloatArray = NDArray[np.float64]

GRAVITY_B_M_S2 = np.array([0.0, 0.0, -9.81])
FIRST_STAMP_NS = 1_700_000_000_000_000_000
# The tool points down, turned a little about the vertical so that no sensor axis is a base axis by accident.
WORKING_ORIENTATION = Rotation.from_euler("xz", [np.pi, 0.4])


@dataclass(frozen=True, kw_only=True)
class CellRun:
    """A simulated log: what a logger would have seen, and the signals behind it."""

    cell: Cell
    script: Script
    axis: AxisRun
    recording: Recording


def simulate_cell(cell: Cell, program: Program, *, seed: int = 0) -> CellRun:
    """Run `program` on `cell`; the same seed gives the same run.

    The wrench is what the payload puts on the flange, expressed in S, with gravity, inertia, bias and noise; the
    poses are base from flange, with encoder noise on the measured one.
    """
    rng = np.random.default_rng(seed)
    script = build_script(program, cell.sample_time_s, rng)
    n = len(script)
    force_noise = cell.force_noise_rms_n * rng.standard_normal((n, 3))
    torque_noise = cell.torque_noise_rms_n_m * rng.standard_normal((n, 3))
    axis = run_axis(cell, script, np.ascontiguousarray(force_noise[:, cell.axis_index]))

    orientation = WORKING_ORIENTATION * Rotation.from_rotvec(script.rotation_rad)
    force, torque = _rigid_wrench(cell, script, orientation)
    direction_S = np.eye(3)[cell.axis_index]
    force += axis.force_n[:, None] * direction_S
    com, point = np.array(cell.com_S_m), np.array(cell.contact_point_S_m)
    # On the payload: −F + hand − drag − contact = M a; hand, drag and inertia act at the centre of mass.
    torque += (axis.force_n + axis.contact_force_n)[:, None] * np.cross(com, direction_S)
    torque -= axis.contact_force_n[:, None] * np.cross(point, direction_S)

    direction_B = WORKING_ORIENTATION.apply(direction_S)
    stamps = FIRST_STAMP_NS + np.round(np.arange(n) * cell.sample_time_s * 1e9).astype(np.int64)
    wobble = Rotation.from_rotvec(cell.orientation_noise_rms_rad * rng.standard_normal((n, 3)))
    measured = axis.flange_m[:, None] * direction_B + cell.position_noise_rms_m * rng.standard_normal((n, 3))
    base = np.array(cell.base_position_m)
    recording = Recording(
        wrench=WrenchSignal(
            topic="/ft_sensor/wrench",
            frame_id="ft_sensor",
            stamp_ns=stamps,
            force_n=force + np.array(cell.force_bias_S_n) + force_noise,
            torque_n_m=torque + np.array(cell.torque_bias_S_n_m) + torque_noise,
        ),
        pose=_pose("/flange/pose", stamps, base + measured, orientation * wobble),
        command=_pose("/flange/command", stamps, base + axis.command_m[:, None] * direction_B, orientation),
    )
    return CellRun(cell=cell, script=script, axis=axis, recording=recording)


def _pose(topic: str, stamps: NDArray[np.int64], position: FloatArray, orientation: Rotation) -> PoseSignal:
    return PoseSignal(
        topic=topic,
        frame_id="base",
        stamp_ns=stamps,
        position_m=position,
        quaternion_xyzw=orientation.as_quat(canonical=True),
    )


def _rigid_wrench(cell: Cell, script: Script, orientation: Rotation) -> tuple[FloatArray, FloatArray]:
    """Return gravity and the inertia of turning about the sensor origin, (n, 3) each, in S.

    Every move turns about one fixed axis, so the rotation vector's derivatives are the body's rates.
    """
    h, mass, com = cell.sample_time_s, cell.payload_mass_kg, np.array(cell.com_S_m)
    rate = np.gradient(script.rotation_rad, h, axis=0)
    acceleration = np.gradient(rate, h, axis=0)
    inertia = np.array(cell.inertia_S_kg_m2)
    weight = mass * orientation.inv().apply(GRAVITY_B_M_S2)
    force = weight - mass * (np.cross(acceleration, com) + np.cross(rate, np.cross(rate, com)))
    torque = np.cross(com, weight) - (inertia * acceleration + np.cross(rate, inertia * rate))
    return force, torque
