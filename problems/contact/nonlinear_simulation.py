"""The full simulation beside the exact transient (docs/method.md, "Contact"): `full_effects` included.

One axis; rotational axes use the same equations, as in `plant`.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .._checks import non_negative, positive
from ..arrays import BoolArray, FloatArray
from ..errors import ParameterError
from ..model.controller import AdmittanceController, control_tuple
from ..model.difference import rest_states
from ..model.plant import FREE_SPACE, Environment, Plant, build_plant_matrices
from ..model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from ..stability.margins import UnstableLoopError
from .events import rate_bound
from .kernel_types import APART, IN_CONTACT
from .leaps import EARLY, LATE, SLOW, Motion, write_part
from .nonlinear_kernel import (
    CLIPPED,
    COLLISION_TICK,
    CONTACT,
    DEAD,
    FOUND,
    IMPACT_SPEED,
    IMPACT_TIME,
    LIMITED,
    REPORTING,
    RESETTING,
    STOPPING,
    TOUCHING,
    TRACES,
    WATCHING,
    BeforeAfter,
    KernelOutputs,
    Memory,
    NonlinearController,
    blocks_at,
    damping_at,
    run_nonlinear,
)
from .nonlinearities import NO_NONLINEARITIES, CommandLimits, Deadband, Nonlinearities, Response, VariableDamping
from .steady_approach import CLIPPED_HAND, TOO_FAST, TOO_WEAK, Drive, begin_steadily, drag_of, find_drive
from .transient import Approach, SampledContact, build_sampled_contact, contact_wall

_RESPONSES: dict[Response, int] = {"none": REPORTING, "reset": RESETTING, "stop": STOPPING}
# Far inside the stability of the method (2.78 rad), where its error falls with the fourth power of the step.
_LARGEST_STEP_RAD = 1.0
FEWEST_SUBSTEPS = 10
# A duration this close to a whole number of samples is that number.
_WHOLE = 1e-9


@dataclass(frozen=True, kw_only=True)
class NonlinearRun:
    """One simulated run: values at the controller's ticks `time_s` (n,), positions from the wall.

    `sensor_force_n` is −F, `seen_force_n` −F as the controller sees it, both positive when pressing;
    `contact_force_n` is F_e; x, v are the flange's, x_p, v_p the payload's, `command_m` is x^d as sent,
    `damping_n_s_per_m` the B_a in use. `is_clipped`, `is_dead` (in the deadband) and `is_limited` (the command)
    say what was at work at each tick.

    The peak of the sensor force is that of the ticks, without noise and clipping, the peak of the contact force that
    of all substeps; for a loop that is not stable they are not a number. `impact_time_s` and `impact_speed_m_s` (v_p)
    belong to the first touch, None if there is none; `collision_time_s` to the detection.
    """

    time_s: FloatArray
    sensor_force_n: FloatArray
    seen_force_n: FloatArray
    contact_force_n: FloatArray
    flange_position_m: FloatArray
    flange_velocity_m_s: FloatArray
    payload_position_m: FloatArray
    payload_velocity_m_s: FloatArray
    command_m: FloatArray
    damping_n_s_per_m: FloatArray
    is_touching: BoolArray
    is_clipped: BoolArray
    is_dead: BoolArray
    is_limited: BoolArray
    driving_force_n: float
    impact_time_s: float | None
    impact_speed_m_s: float | None
    collision_time_s: float | None
    peak_sensor_force_n: float
    time_of_sensor_peak_s: float
    peak_contact_force_n: float
    time_of_peak_s: float


class DrawnNoise(NamedTuple):
    """What disturbs a run: `force_n` (n,) is added to F, and where `late` (n,) a command arrives a period late."""

    force_n: FloatArray
    late: BoolArray


def simulate_nonlinear(
    plant: Plant,
    controller: AdmittanceController,
    approach: Approach,
    *,
    sample_time_s: float,
    duration_s: float,
    effects: Nonlinearities = NO_NONLINEARITIES,
    start_distance_m: float | None = None,
    substeps: int = 10,
    noise: np.random.Generator | DrawnNoise | None = None,
    leaps: bool = False,
    even_if_unstable: bool = False,
) -> NonlinearRun:
    """Simulate an approach and contact with everything in `effects`, by Runge–Kutta steps of order 4.

    With `leaps` a sample in which no contact begins or ends is crossed by the plant's exponential instead, unless the
    plant turns too fast for that (`leaps.SLOW`); without, this is the second method that such a run is held against.

    Without `start_distance_m` the run begins at the impact, in the steady state of the approach (with deadband,
    clipping, speed limit and variable damping in it); with it, at rest at that distance from the wall, when the force
    is switched on. `substeps` per sample; those before and after the command changes inside a sample are counted
    apart. Without switching the error falls with the fourth power of the step; a kink of the contact force or a jump
    of it (B_e) inside a step costs the square, or the first power, of one step. `noise` draws the sensor noise
    and the late commands, or is what was drawn.

    Raises UnstableLoopError for a loop that is not stable in contact or in free space without the effects (at the
    ends of the variable damping), unless `even_if_unstable`; ParameterError for what this simulation cannot do.
    """
    h = positive("sample_time_s", sample_time_s)
    _check_plant(plant, h)
    pair = build_sampled_contact(build_sampled_plant(plant, h))
    radius = _largest_radius(pair, controller, effects)
    if not (radius < 1.0 or even_if_unstable):
        raise UnstableLoopError(radius)
    law, motion = build_controller(controller, effects, h), _motion(pair.contact, substeps)
    if leaps:
        motion = motion._replace(leap=_leaps(motion))
    drive = _drive(pair, law, approach)
    start = _steady(pair, law, drive) if start_distance_m is None else _rest(pair.free, law, start_distance_m)
    count = math.ceil(positive("duration_s", duration_s) / h - _WHOLE)
    recording = _recording(count)
    if start_distance_m is None:
        recording.found[IMPACT_TIME], recording.found[IMPACT_SPEED] = 0.0, drive.speed * h
    draws, pulls = _drawn(effects, noise, count), np.zeros(count + 1)
    run_nonlinear(motion, law, start, drive.desired, drive.push, draws.force_n, draws.late, pulls, recording)
    return _run(recording, h, drive, is_stable=radius < 1.0)


@dataclass(frozen=True, kw_only=True)
class Operator:
    """A person who holds the payload: M_h, B_h and K_h between it and the way that the hand wants to go.

    `path_m` (n + 1,) are the positions [m] of that way at the controller's ticks, from the wall.
    """

    mass_kg: float
    damping_n_s_per_m: float
    stiffness_n_per_m: float
    path_m: FloatArray

    def held(self, plant: Plant) -> Plant:
        """Return a plant with the hand on its payload and nothing else to touch."""
        payload = replace(
            plant.payload,
            mass_kg=plant.payload.mass_kg + self.mass_kg,
            drag_n_s_per_m=plant.payload.drag_n_s_per_m + self.damping_n_s_per_m,
        )
        return replace(plant, payload=payload, environment=Environment(stiffness_n_per_m=self.stiffness_n_per_m))

    def pull(self, sample_time_s: float) -> FloatArray:
        """Return the force [N] (n + 1,) by which the way moves the hand: K_h x_h + B_h v_h."""
        speed = np.gradient(self.path_m, sample_time_s)
        return np.asarray(self.stiffness_n_per_m * self.path_m + self.damping_n_s_per_m * speed)


def simulate_operator(
    plant: Plant,
    controller: AdmittanceController,
    operator: Operator,
    *,
    sample_time_s: float,
    effects: Nonlinearities = NO_NONLINEARITIES,
    substeps: int = 10,
    leaps: bool = False,
) -> NonlinearRun:
    """Simulate a payload that a person leads to the wall and holds there, from rest where the operator's way begins.

    The run lasts as long as the way. `simulate_nonlinear` says what is simulated, and what is raised; F^d is 0. With
    `leaps` the hand pulls with its mean over each sample.
    """
    h = positive("sample_time_s", sample_time_s)
    _check_plant(plant, h)
    if plant.environment.mass_kg > 0.0:
        raise ParameterError("environment.mass_kg", plant.environment.mass_kg, "0 where a person holds the payload")
    pair = build_sampled_contact(build_sampled_plant(plant, h))
    radius = _largest_radius(pair, controller, effects)
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    law, count, nothing = build_controller(controller, effects, h), len(operator.path_m) - 1, BeforeAfter(0.0, 0.0)
    motion, recording = _motion(pair.contact, substeps, operator.held(plant)), _recording(count)
    if leaps:
        motion = motion._replace(leap=_leaps(motion))
    start = _rest(pair.free, law, -float(operator.path_m[0]))
    draws = _drawn(effects, None, count)
    run_nonlinear(motion, law, start, nothing, nothing, draws.force_n, draws.late, operator.pull(h), recording)
    return _run(recording, h, Drive(0.0, 0.0, nothing, nothing), is_stable=True)


def _recording(count: int) -> KernelOutputs:
    out = KernelOutputs(np.empty((TRACES, count)), np.empty(count, dtype=np.int64), np.zeros(FOUND))
    out.found[IMPACT_TIME:] = math.nan
    return out


def needed_substeps(plant: Plant, sample_time_s: float) -> int:
    """Return how many steps follow the plant's fastest motion; the parts of a sample share them to within a half."""
    sides = (plant, plant.in_contact_with(FREE_SPACE))
    fastest = max(
        float(np.max(np.abs(np.linalg.eigvals(build_plant_matrices(side, sample_time_s).a)))) for side in sides
    )
    return max(FEWEST_SUBSTEPS, math.ceil(2.0 * fastest))


def _check_plant(plant: Plant, h: float) -> None:
    if plant.loop_delay_s == 0.0 and build_plant_matrices(plant, h).d_force != 0.0:
        raise ParameterError(
            "robot.delay_s", 0.0, "above 0 (with damping in the coupling F would hang on the command of the same tick)"
        )


def _largest_radius(pair: SampledContact, controller: AdmittanceController, effects: Nonlinearities) -> float:
    variable = effects.variable_damping
    dampings = (controller.damping_n_s_per_m,) if variable is None else variable.bounds_n_s_per_m
    return max(
        spectral_radius(build_loop(side, replace(controller, damping_n_s_per_m=damping)))
        for side in (pair.free, pair.contact)
        for damping in dampings
    )


def _motion(contact: SampledPlant, substeps: int, held: Plant | None = None) -> Motion:
    """Lay out the free plant, or one that is held, in the dimensionless time of one period.

    The wall acts on it as an outside force.
    """
    if substeps < 1:
        raise ParameterError("substeps", substeps, "at least 1")
    contact.plant.require_one_piece()
    h = contact.sample_time_s
    m = build_plant_matrices(contact.plant.in_contact_with(FREE_SPACE) if held is None else held, h)
    before = math.ceil(substeps * contact.fraction)
    steps = (before, max(1, substeps - before))
    longest = max((1.0 - contact.fraction) / steps[1], contact.fraction / max(1, before))
    fastest = max(float(np.max(np.abs(np.linalg.eigvals(rate)))) for rate in (m.a, contact.rate))
    if fastest * longest > _LARGEST_STEP_RAD:
        needed = math.ceil(substeps * fastest * longest / _LARGEST_STEP_RAD)
        raise ParameterError("substeps", substeps, f"at least {needed}, for steps below the plant's fastest motion")
    # v h is what c_position makes of the rate of the state.
    velocity = np.append(m.c_position @ m.a, m.c_position @ m.b)
    return Motion(
        flow=np.column_stack([m.a, m.b, m.push]),
        rows=np.array([[*m.c_position, 0.0], [*m.c_force, m.d_force], velocity]),
        wall=contact_wall(contact),
        whole=contact.whole_delay,
        chain=contact.chain_length,
        fraction=contact.fraction,
        steps=steps,
        leap=np.zeros((0, 2, len(m.a), len(m.a) + 2)),
    )


def _leaps(motion: Motion) -> FloatArray:
    """Return `Motion.leap` of a plant, in contact and apart; that of one that is crossed in steps where it is fast."""
    n = len(motion.flow)
    touching = motion.flow.copy()
    touching[:, n - 2] -= motion.wall.stiffness * motion.flow[:, n + 1]
    touching[:, n - 1] -= motion.wall.damping * motion.flow[:, n + 1]
    flows = {IN_CONTACT: touching, APART: motion.flow}
    turns = {mode: rate_bound(np.ascontiguousarray(flow[:, :n])) for mode, flow in flows.items()}
    if max(turns.values()) > SLOW:
        return motion.leap
    leap = np.zeros((2, *motion.leap.shape[1:]))
    for mode, flow in flows.items():
        write_part(flow, motion.fraction, turns[mode], leap[mode, EARLY])
        write_part(flow, 1.0 - motion.fraction, turns[mode], leap[mode, LATE])
    return leap


def build_controller(controller: AdmittanceController, effects: Nonlinearities, h: float) -> NonlinearController:
    """Return a controller with its effects as the kernel takes them at h [s]."""
    deadband, limits = effects.deadband or Deadband(width_n=0.0), effects.limits or CommandLimits()
    collision, variable = effects.collision, effects.variable_damping or VariableDamping()
    if effects.variable_damping is not None and variable.update_period_s < h:
        raise ParameterError("variable_damping.update_period_s", variable.update_period_s, f"at least h = {h:g} s")
    return NonlinearController(
        parameters=controller.parameters(),
        h=h,
        theta=controller.theta,
        ideal=controller.is_ideal,
        deadband=deadband.width_n,
        subtractive=deadband.kind == "subtractive",
        force_limit=_or_infinite(effects.force_limit_n),
        longest_step=_or_infinite(limits.speed_m_s) * h,
        largest_change=_or_infinite(limits.acceleration_m_s2) * h * h,
        response=REPORTING if collision is None else _RESPONSES[collision.response],
        threshold=math.inf if collision is None else collision.threshold_n,
        floor=variable.floor_n_s_per_m,
        scale=variable.scale_n_s_per_m,
        decay=variable.decay_s_per_m,
        period=math.inf if effects.variable_damping is None else variable.update_period_s / h,
        change=variable.largest_change_n_s_per_m,
    )


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def _drive(pair: SampledContact, law: NonlinearController, approach: Approach) -> Drive:
    """Find the steady speed of the approach's force, or the force of its speed, with the effects in the balance."""
    drag = drag_of(pair.ramp, law.h)
    drive, wrong = find_drive(law, drag, approach.numbers())
    if wrong == TOO_FAST:
        fastest = law.longest_step / law.h
        raise ParameterError("approach.speed_m_s", drive.speed, f"at most the limit on the command, {fastest:g} m/s")
    if wrong == CLIPPED_HAND:
        measured = drive.force - drag * drive.speed
        raise ParameterError(
            "approach.speed_m_s",
            drive.speed,
            f"reachable by a hand: it needs {measured:g} N at the sensor, which is clipped",
        )
    if wrong == TOO_WEAK:
        must = f"large enough to pass the deadband of {law.deadband:g} N"
        raise ParameterError("approach.force_n", drive.force, must)
    return drive


def _steady(pair: SampledContact, law: NonlinearController, drive: Drive) -> tuple[FloatArray, FloatArray, Memory]:
    """Return the steady approach at the impact, as if the same had gone on for ever."""
    start, seen = begin_steadily(law, drive, pair.ramp, pair.free.c_position, pair.free.chain_length)
    if -seen > law.threshold:
        raise ParameterError("collision.threshold_n", law.threshold, f"above the drag of the approach, {-seen:.4g} N")
    return start


def _rest(free: SampledPlant, law: NonlinearController, distance: float) -> tuple[FloatArray, FloatArray, Memory]:
    """Return everything at rest at a distance from the wall, no force applied yet."""
    place = -non_negative("start_distance_m", distance)
    damping, n = damping_at(law, 0.0), free.state_count
    state = np.zeros(n)
    # The robot chain's first state has unit gain at rest; then x_p.
    state[0] = state[n - 2] = place
    control = rest_states(blocks_at(law, damping))
    states = control_tuple(place * np.array(control))
    entry = (place, 0.0, place)
    past = np.full(max(1, free.chain_length), place)
    return state, past, Memory(states, entry, entry, place, 0.0, damping, law.period, WATCHING)


def _drawn(effects: Nonlinearities, noise: np.random.Generator | DrawnNoise | None, count: int) -> DrawnNoise:
    """Return the noise of a run, and which of its commands are late."""
    if isinstance(noise, DrawnNoise):
        return noise
    for name, value in (("force_noise_rms_n", effects.force_noise_rms_n), ("late_share", effects.late_share)):
        if noise is None and value > 0.0:
            raise ParameterError("noise", noise, f"a numpy Generator, for a {name} above 0")
    draws = DrawnNoise(np.zeros(count), np.zeros(count, dtype=np.bool_))
    if noise is not None and effects.force_noise_rms_n > 0.0:
        draws.force_n[:] = effects.force_noise_rms_n * noise.standard_normal(count)
    if noise is not None and effects.late_share > 0.0:
        draws.late[:] = noise.random(count) < effects.late_share
    return draws


def _run(recording: KernelOutputs, h: float, drive: Drive, *, is_stable: bool) -> NonlinearRun:
    traces, flags, found = recording.traces, recording.flags, recording.found
    traces[:CONTACT] *= -1.0
    time = np.asarray(np.arange(len(flags)) * h, dtype=np.float64)
    touching, clipped, dead, limited = ((flags & bit) != 0 for bit in (TOUCHING, CLIPPED, DEAD, LIMITED))
    for array in (time, traces, touching, clipped, dead, limited):
        array.setflags(write=False)
    force, seen, contact, flange, flange_speed, payload, payload_speed, command, damping = traces
    touched, detected = not math.isnan(found[IMPACT_TIME]), not math.isnan(found[COLLISION_TICK])
    peaks = found[:IMPACT_TIME] if is_stable else np.full(IMPACT_TIME, math.nan)
    sensor_peak, sensor_tick, contact_peak, contact_time = peaks
    return NonlinearRun(
        time_s=time,
        sensor_force_n=force,
        seen_force_n=seen,
        contact_force_n=contact,
        flange_position_m=flange,
        flange_velocity_m_s=flange_speed,
        payload_position_m=payload,
        payload_velocity_m_s=payload_speed,
        command_m=command,
        damping_n_s_per_m=damping,
        is_touching=touching,
        is_clipped=clipped,
        is_dead=dead,
        is_limited=limited,
        driving_force_n=drive.force,
        impact_time_s=float(found[IMPACT_TIME] * h) if touched else None,
        impact_speed_m_s=float(found[IMPACT_SPEED] / h) if touched else None,
        collision_time_s=float(found[COLLISION_TICK] * h) if detected else None,
        peak_sensor_force_n=float(sensor_peak),
        time_of_sensor_peak_s=float(sensor_tick * h),
        peak_contact_force_n=float(contact_peak),
        time_of_peak_s=float(contact_time * h),
    )
