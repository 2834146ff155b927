"""Simulate a whole cell: the approach axis, along or about which it moves, with its compliance; the rest is rigid."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.logs.roles.orientation import make_continuous
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray
from problems.compiled import compiled
from problems.contact.events import advance_surface, contact_force, is_in_contact
from problems.contact.kernel import switch_within
from problems.contact.kernel_types import APART, IN_CONTACT, NEWEST, POSITION, SENSED, Contact, HeldInputs, Inputs
from problems.contact.transient import build_sampled_contact
from problems.model.controller import control_tuple, controller_blocks, controller_step, keep_control
from problems.model.sampled import build_sampled_plant, controller_rest

from .phases import Program, Script, build_script
from .truth import SimulatedCell

# Rows of the signals, and the first state of the robot's chain.
FLANGE, COMMAND, PAYLOAD, VELOCITY, FORCE, CONTACT, HAND, SIGNALS = 0, 1, 2, 3, 4, 5, 6, 7
CHAIN = 0
GRAVITY_B_M_S2 = np.array([0.0, 0.0, -9.81])
FIRST_STAMP_NS = 1_700_000_000_000_000_000
# The tool points down, turned a little about the vertical so that no sensor axis is a base axis by accident.
WORKING_ORIENTATION = Rotation.from_euler("xz", [np.pi, 0.4])


@dataclass(frozen=True, kw_only=True)
class AxisRun:
    """Signals at the ticks of the controller, (n,) each, relative to the start; the wall is at `wall_distance_m`.

    On a rotational axis angles [rad] and torques [N·m].
    """

    flange_m: FloatArray
    command_m: FloatArray
    payload_m: FloatArray
    payload_velocity_m_s: FloatArray
    force_n: FloatArray
    contact_force_n: FloatArray
    hand_force_n: FloatArray


def run_axis(cell: SimulatedCell, script: Script, measured_noise_n: FloatArray) -> AxisRun:
    """Step controller, robot, payload and wall through the script; the controller sees the noisy force."""
    h = cell.sample_time_s
    pair = build_sampled_contact(build_sampled_plant(cell.contact_plant(), h))
    blocks = controller_blocks(cell.controller, h)
    signals = _step_axis(
        pair.arguments,
        blocks,
        controller_rest(blocks),
        (cell.wall_distance_m, cell.deadband_n),
        (script.admittance, script.command_m, script.desired_force_n, script.hand_force_n, script.homing_n_per_m),
        measured_noise_n,
    )
    flange, command, payload, velocity, force, contact_force, hand_force = signals
    return AxisRun(
        flange_m=flange + cell.wall_distance_m,
        command_m=command + cell.wall_distance_m,
        payload_m=payload + cell.wall_distance_m,
        payload_velocity_m_s=velocity / h,
        force_n=force,
        contact_force_n=contact_force,
        hand_force_n=hand_force,
    )


@compiled
def _advance(
    plant: Contact,
    state: FloatArray,
    surface_state: FloatArray,
    inputs: Inputs,
    touching: bool,
) -> bool:
    """Step payload and environment over one sample and return whether they touch."""
    step, flow, rows, _, delay, wall = plant
    (older, newer, push), n, mode = inputs, step.shape[1], IN_CONTACT if touching else APART
    phi = step[mode, :, :n].copy()
    following = phi @ state + step[mode, :, n] * newer + step[mode, :, n + 1] * older + step[mode, :, n + 2] * push
    swung = surface_state.copy()
    if not touching:
        # An environment with mass swings back on its own.
        advance_surface(swung, wall, 1.0)
    if is_in_contact(following, swung, wall, rows, HeldInputs(newer, push), touching) != touching:
        return switch_within(flow, state, surface_state, wall, rows, inputs, delay.fraction, touching, 1).touching
    state[:], surface_state[:] = following, swung
    return touching


@compiled
def _step_axis(
    plant: Contact,
    blocks: FloatArray,
    rest: FloatArray,
    limits: tuple[float, float],
    script: tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray, FloatArray],
    noise: FloatArray,
) -> FloatArray:
    """Return rows flange, command, payload, payload velocity·h, F, F_e, hand force over the ticks; the wall is at 0."""
    (whole, chain, _), rows, (distance, deadband) = plant.delay, plant.rows, limits
    admittance, script_command, desired, hand_force, homing = script
    n, samples = plant.step.shape[1], len(admittance)
    state, past, control, surface_state = np.zeros(n), np.full(max(chain, 1), -distance), rest.copy(), np.zeros(2)
    # The robot chain's first state has unit gain at rest; then x_p.
    state[CHAIN] = state[n - 2] = -distance
    out = np.empty((SIGNALS, samples))
    base, was_running, touching = -distance, False, False
    for k in range(samples):
        held = past[chain - 1]
        position = float(np.sum(rows[POSITION, :n] * state))
        sensed = float(np.sum(rows[SENSED, :n] * state) + rows[SENSED, n] * held)
        seen = sensed + noise[k]
        drive_force = float(desired[k] + (seen if abs(seen) > deadband else 0.0))
        if admittance[k]:
            if not was_running:
                control = rest * past[NEWEST]
            law = control_tuple(control)
            command, law = controller_step(blocks, law, drive_force, position)
            keep_control(control, law)
        else:
            if was_running or k == 0:
                base = past[NEWEST] - script_command[k]
            command = base + script_command[k]
        was_running = admittance[k]
        push = hand_force[k] - homing[k] * (state[n - 2] + distance)
        out[FLANGE, k], out[COMMAND, k] = position, command
        out[PAYLOAD, k], out[VELOCITY, k] = state[n - 2], state[n - 1]
        out[FORCE, k], out[HAND, k] = sensed, push
        out[CONTACT, k] = max(0.0, contact_force(state, rows, HeldInputs(held, push))) if touching else 0.0
        newer = command if whole == 0 else past[whole - 1]
        older = held if chain > whole else newer
        touching = _advance(plant, state, surface_state, Inputs(older, newer, push), touching)
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        past[NEWEST] = command
    return out


@dataclass(frozen=True, kw_only=True)
class CellRun:
    """A simulated log: what a logger would have seen, and the signals behind it."""

    cell: SimulatedCell
    script: Script
    axis: AxisRun
    recording: Recording


def simulate_cell(cell: SimulatedCell, program: Program, *, seed: int = 0) -> CellRun:
    """Run `program` on `cell`; the same seed gives the same run.

    The wrench is what the payload puts on the flange, expressed in S, with gravity, inertia, bias and noise; the
    poses are base from flange, with encoder noise on the measured one.
    """
    rng = np.random.default_rng(seed)
    script = build_script(program, cell.sample_time_s, rng)
    n = len(script)
    force_noise = cell.force_noise_rms_n * rng.standard_normal((n, 3))
    torque_noise = cell.torque_noise_rms_n_m * rng.standard_normal((n, 3))
    noise = torque_noise if cell.is_turning else force_noise
    axis = run_axis(cell, script, np.ascontiguousarray(noise[:, cell.axis_index]))
    place, orientation = _placed(cell, script, axis.flange_m)
    commanded_place, commanded = _placed(cell, script, axis.command_m)
    force, torque = _rigid_wrench(cell, script, orientation)
    (_add_turning if cell.is_turning else _add_pushing)(cell, axis, force, torque)
    stamps = FIRST_STAMP_NS + np.round(np.arange(n) * cell.sample_time_s * 1e9).astype(np.int64)
    wobble = Rotation.from_rotvec(cell.orientation_noise_rms_rad * rng.standard_normal((n, 3)))
    measured = place + cell.position_noise_rms_m * rng.standard_normal((n, 3))
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
        command=_pose("/flange/command", stamps, base + commanded_place, commanded),
    )
    return CellRun(cell=cell, script=script, axis=axis, recording=recording)


def made_later(recording: Recording, hours: float) -> Recording:
    """Return the recording as if it had been made some hours later: a log of its own beside the first."""
    shift_ns = round(hours * 3600e9)
    command = recording.command
    return replace(
        recording,
        wrench=replace(recording.wrench, stamp_ns=recording.wrench.stamp_ns + shift_ns),
        pose=replace(recording.pose, stamp_ns=recording.pose.stamp_ns + shift_ns),
        command=None if command is None else replace(command, stamp_ns=command.stamp_ns + shift_ns),
    )


def _placed(cell: SimulatedCell, script: Script, along: FloatArray) -> tuple[FloatArray, Rotation]:
    """Return where the flange is from the start (n, 3) in the base, and how it is turned, `along` (n,) its axis."""
    direction_S = np.eye(3)[cell.axis_index]
    posed = WORKING_ORIENTATION * Rotation.from_rotvec(script.rotation_rad)
    if cell.is_turning:
        return np.zeros((len(along), 3)), posed * Rotation.from_rotvec(along[:, None] * direction_S)
    return along[:, None] * WORKING_ORIENTATION.apply(direction_S), posed


def _pose(topic: str, stamps: NDArray[np.int64], position: FloatArray, orientation: Rotation) -> PoseSignal:
    return PoseSignal(
        topic=topic,
        frame_id="base",
        stamp_ns=stamps,
        position_m=position,
        quaternion_xyzw=make_continuous(orientation.as_quat(canonical=True)),
    )


def _add_pushing(cell: SimulatedCell, axis: AxisRun, force: FloatArray, torque: FloatArray) -> None:
    """Add to force and torque (n, 3) in S what moving along the approach axis and pressing on the wall does."""
    direction_S = np.eye(3)[cell.axis_index]
    com, point = np.array(cell.com_S_m), np.array(cell.contact_point_S_m)
    force += axis.force_n[:, None] * direction_S
    # On the payload: −F + hand − drag − contact = M a; hand, drag and inertia act at the centre of mass.
    torque += (axis.force_n + axis.contact_force_n)[:, None] * np.cross(com, direction_S)
    torque -= axis.contact_force_n[:, None] * np.cross(point, direction_S)


def _add_turning(cell: SimulatedCell, axis: AxisRun, force: FloatArray, torque: FloatArray) -> None:
    """Add to force and torque (n, 3) in S what turning about the approach axis and pressing on the wall does.

    Hand and drag are torques about the axis. The wall pushes at the contact point, square to the axis and the lever;
    the centre of mass moves on its arc with the payload. The few milliradians that the coupling gives leave the weight
    as it is.
    """
    direction_S = np.eye(3)[cell.axis_index]
    com, point = np.array(cell.com_S_m), np.array(cell.contact_point_S_m)
    across = np.cross(direction_S, point)
    wall = -axis.contact_force_n[:, None] * across / (across @ across)
    rate = axis.payload_velocity_m_s[:, None] * direction_S
    acceleration = np.gradient(rate, cell.sample_time_s, axis=0)
    force += wall - cell.payload_mass_kg * (np.cross(acceleration, com) + np.cross(rate, np.cross(rate, com)))
    aside = np.cross(point, wall)
    torque += axis.force_n[:, None] * direction_S + aside - (aside @ direction_S)[:, None] * direction_S


def _rigid_wrench(cell: SimulatedCell, script: Script, orientation: Rotation) -> tuple[FloatArray, FloatArray]:
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
