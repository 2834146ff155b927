"""The limits of the runtime: what follows from a controller and its contacts, and whether a file's limits do."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import MOST_REST_SAMPLES, AxisLimits, Limits, LimitsNoise
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.runtime.law import STANDARD_GRAVITY_M_S2
from autotune.runtime.load import LEVER_M, REDUCED_SPEED_M_S
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController, controller_blocks
from problems.model.difference import BIQUAD_0, INTEGRATOR_DIRECT, LAG_DIRECT
from problems.text import rounded_down

from .contacts import Replays
from .followed_speed import NOISE_DEVIATIONS, largest_share, safe_speed
from .replay import Strategy

SAID = "said in problem.yaml"
"""The reason of a limit that does not follow from the controller."""
# Room above what the certified contacts command, and what weight, bias and contact put on the sensor.
_ROOM = 2.0
_POSE_ABOVE_COMMAND, _LEAST_POSE_SPEED_M_S, _LEAST_POSE_SPEED_RAD_S = 4.0, 1.0, 5.0
_STALE_WRENCH_S, _STALE_POSE_S, _STALE_PERIODS = 0.02, 0.1, 10
_REST_S, _REST_SHARE, _REST_DEVIATIONS = 0.1, 0.2, 3.0
_LEAST_REST_N, _LEAST_REST_N_M, _COM_OFF_M = 1.0, 0.2, 0.02
# Peaks of a replayed contact are products of those in the file.
_PEAKS = ("peak_sensor_force_n", "peak_contact_force_n")
_SAME_NUMBER = 1e-6
# Replayed commands differ by up to 2 % from those that were simulated, and twice that is the limit's.
_SAME_LIMIT = 0.05
# What depends on the noise that was identified, which older files do not say.
_NOISY = ("pose_speed_m_s", "pose_speed_rad_s", "rest_force_n")


def choose_limits(
    controller: Controller, noise: LimitsNoise, axes: Mapping[str, AxisLimits], reasons: Mapping[str, str]
) -> Limits:
    """Return the limits that follow from the controller and from those of its axes, each with its reason."""
    said, h = dict(reasons), controller.sample_time_s
    straight = [axes[name].speed for name in axes if name not in ROTATIONAL_AXES]
    turning = [axes[name].speed for name in axes if name in ROTATIONAL_AXES]
    force, torque = _ranges(controller, said)
    pose = max([_LEAST_POSE_SPEED_M_S, *(_POSE_ABOVE_COMMAND * each for each in straight)])
    turn = max([_LEAST_POSE_SPEED_RAD_S, *(_POSE_ABOVE_COMMAND * each for each in turning)])
    shaken = NOISE_DEVIATIONS * math.sqrt(2.0) * noise.position_m / h
    least = f"{_POSE_ABOVE_COMMAND:g} times the limit of the command, at least"
    said["pose_speed_m_s"] = f"{least} {_LEAST_POSE_SPEED_M_S:g} m/s, and the noise of the pose"
    said["pose_speed_rad_s"] = f"{least} {_LEAST_POSE_SPEED_RAD_S:g} rad/s, and the noise of the pose"
    said["stale_wrench_s"] = f"noise changes a wrench in every period; {_STALE_PERIODS} periods and 20 ms at least"
    said["stale_pose_s"] = f"a coarse pose follows a slow command late; {_STALE_PERIODS} periods and 0.1 s at least"
    said["rest_samples"] = f"{_REST_S:g} s, over which noise is averaged"
    rest_force, rest_torque = _rest(controller, noise, said)
    return Limits(
        force_n=force,
        torque_n_m=torque,
        axes=axes,
        pose_speed_m_s=rounded_up(pose + shaken),
        pose_speed_rad_s=rounded_up(turn + shaken / LEVER_M),
        stale_wrench_s=max(_STALE_WRENCH_S, _STALE_PERIODS * h),
        stale_pose_s=max(_STALE_POSE_S, _STALE_PERIODS * h),
        rest_samples=max(1, min(MOST_REST_SAMPLES, round(_REST_S / h))),
        rest_force_n=rest_force,
        rest_torque_n_m=rest_torque,
        noise=noise,
        reasons=said,
    )


def choose_axis_limits(
    controller: Controller, name: str, noise: LimitsNoise, motion: tuple[float, float], reasons: dict[str, str]
) -> AxisLimits:
    """Return the limits of the command of one axis, and note their reasons.

    They leave room above `motion`, the largest speed and acceleration that the certified contacts command, and noise.
    """
    units, turns = axis_units(name), name in ROTATIONAL_AXES
    speed, acceleration = motion
    noisy_speed, noisy_acceleration = _noisy_motion(controller, name, noise)
    least = REDUCED_SPEED_M_S / LEVER_M if turns else REDUCED_SPEED_M_S
    said = f"{_ROOM:g} times what the certified contacts command"
    shaken = f"{NOISE_DEVIATIONS:g} deviations of the noise"
    reasons[f"axes.{name}.speed"] = (
        f"{said}, {speed:.3g} {units.speed}, and {shaken}, {noisy_speed:.2g}; at least {least:g} {units.speed}, the "
        "speed at which a robot is led by hand"
    )
    reasons[f"axes.{name}.acceleration"] = (
        f"{said}, {acceleration:.3g} {units.speed}², and {shaken}, {noisy_acceleration:.2g}"
    )
    return AxisLimits(
        speed=rounded_up(max(_ROOM * speed + noisy_speed, least)),
        acceleration=rounded_up(_ROOM * acceleration + noisy_acceleration),
    )


def unsafe_speed(controller: Controller, name: str) -> str:
    """Say that the limits let a led payload touch faster than `contact_at_speed` allows; empty if not."""
    limits, units, found = controller.limits, axis_units(name), safe_speed(controller, name)
    if found is None or limits is None:
        return ""
    (speed, asked), each = found, limits.axes[name]
    safe, limit, key = rounded_down(speed, 3), each.speed, "speed"
    if each.followed_speed is not None and each.followed_lag_s is not None:
        goes = each.followed_speed * largest_share(controller, name, each.followed_lag_s)
        limit, key = (goes, "followed_speed") if goes < limit else (limit, key)
    if limit <= speed * (1.0 + _SAME_NUMBER):
        return ""
    force = limit * asked.max_force_n / speed
    return (
        f"up to {safe:g} {units.speed} no contact exceeds {asked.max_force_n:g} {units.force} (contact_at_speed), and "
        f"limits.axes.{name}.{key} lets the robot go at {limit:.3g}, at which it may be {force:.3g} {units.force}"
    )


def step_motion(controller: Controller, name: str, force: float) -> tuple[float, float]:
    """Return the speed and acceleration of a command from rest at which a force [N, N·m] comes at once."""
    h = controller.sample_time_s
    step = _force_gain(controller, name) * force
    return step / h, step / h**2


def _force_gain(controller: Controller, name: str) -> float:
    blocks = controller_blocks(admittance_controller(controller, name), controller.sample_time_s)
    return float((blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT]) * blocks[BIQUAD_0])


def _noisy_motion(controller: Controller, name: str, noise: LimitsNoise) -> tuple[float, float]:
    """Return six deviations of the command's speed and acceleration under white noise of wrench and pose.

    Noise n at the input changes the command by its direct gain d: d √2 n/h of speed, d √6 n/h² of acceleration.
    """
    turns, h = name in ROTATIONAL_AXES, controller.sample_time_s
    blocks = controller_blocks(admittance_controller(controller, name), h)
    force = _force_gain(controller, name)
    pose = float(blocks[4, 0] * blocks[2, 0]) + force * float(blocks[4, 1] * blocks[3, 0] * blocks[2, 0])
    each = math.hypot(
        force * (noise.torque_n_m if turns else noise.force_n), pose * noise.position_m / (LEVER_M if turns else 1.0)
    )
    return NOISE_DEVIATIONS * math.sqrt(2.0) * each / h, NOISE_DEVIATIONS * math.sqrt(6.0) * each / h**2


def _ranges(controller: Controller, reasons: dict[str, str]) -> tuple[float, float]:
    """Return the ranges of force and torque: twice what weight, bias and the worst contact put on the sensor."""
    payload, domains = controller.payload, controller.certificate.domain
    masses = [domains[name].payload_mass_kg[1] for name in controller.axes if name not in ROTATIONAL_AXES]
    weight = STANDARD_GRAVITY_M_S2 * max([payload.mass_kg, *masses])
    peak, turning = _worst(controller, turning=False), _worst(controller, turning=True)
    force = weight + math.hypot(*payload.force_bias_n) + peak
    torque = weight * math.hypot(*payload.com_m) + math.hypot(*payload.torque_bias_n_m) + turning + LEVER_M * peak
    reasons["force_n"] = (
        f"{_ROOM:g} times the {force:.4g} N of weight, bias and the worst predicted peak at the sensor; a smaller "
        "range of the sensor belongs into problem.yaml"
    )
    reasons["torque_n_m"] = (
        f"{_ROOM:g} times the {torque:.4g} N·m of weight, bias and the worst predicted peaks, a force at {LEVER_M:g} m"
    )
    if payload.set_in_cell:
        reasons["torque_n_m"] += "; centre of mass and bias are not known and count as 0, so a heavy tool needs more"
    return rounded_up(_ROOM * force), rounded_up(max(_ROOM * torque, _LEAST_REST_N_M))


def _worst(controller: Controller, *, turning: bool) -> float:
    names = [name for name in controller.axes if (name in ROTATIONAL_AXES) == turning]
    peaks = [each.peak_sensor_force_n for name in names for each in controller.predicted[name].scenarios]
    return max([0.0, *peaks])


def _rest(controller: Controller, noise: LimitsNoise, reasons: dict[str, str]) -> tuple[float, float]:
    """Return what the compensation may leave at the start: a share of the deadband, or what it left in the log."""
    identified = _REST_DEVIATIONS * noise.gravity_residual_n
    force = _within_deadband(controller, max(_LEAST_REST_N, identified), turning=False)
    reasons["rest_force_n"] = (
        f"{_REST_SHARE:g} of the deadband, or {_REST_DEVIATIONS:g} times the {noise.gravity_residual_n:.2g} N RMS "
        f"that the compensation left in the log, at least {_LEAST_REST_N:g} N; it adds to F^d in with_residual_weight"
    )
    if any(name in ROTATIONAL_AXES for name in controller.axes):
        reasons["rest_torque_n_m"] = f"{_REST_SHARE:g} of the deadband; it adds to the desired torque"
        return force, _within_deadband(controller, _LEAST_REST_N_M, turning=True)
    weight = STANDARD_GRAVITY_M_S2 * controller.payload.mass_kg
    reasons["rest_torque_n_m"] = f"no axis turns; the weight at {_COM_OFF_M:g} m from its centre, at least 1 N·m"
    return force, rounded_up(max(1.0, _COM_OFF_M * weight))


def _within_deadband(controller: Controller, least: float, *, turning: bool) -> float:
    widths = [each.deadband for name, each in controller.axes.items() if (name in ROTATIONAL_AXES) == turning]
    width = min(widths, default=0.0)
    wanted = max(_REST_SHARE * width, least)
    return rounded_up(min(wanted, width) if width > 0.0 else wanted)


def rounded_up(value: float) -> float:
    """Return a number of two digits that is not below `value`."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / scale * (1.0 - 1e-9)) * scale:.2g}")


def commanded_motion(command: FloatArray, sample_time_s: float) -> tuple[float, float]:
    """Return the largest speed and acceleration of a command (n,) at the ticks, as the runtime counts them."""
    speed = np.diff(command) / sample_time_s
    changes = np.diff(speed) / sample_time_s
    return float(np.max(np.abs(speed), initial=0.0)), float(np.max(np.abs(changes), initial=0.0))


def with_residual(controller: Controller, name: str) -> tuple[float, float]:
    """Return the residual that the start check allows along one axis, and by how much it raises every peak.

    The contact is linear while it lasts and one-sided, so its forces scale with what drives it: (F^d + r)/F^d.
    """
    limits = controller.limits
    if limits is None:
        return 0.0, 1.0
    domain = controller.certificate.domain[name]
    residual = limits.rest_torque_n_m if name in ROTATIONAL_AXES else limits.rest_force_n
    speed = domain.approach_speed_m_s or 0.0
    force = domain.approach_force_n or speed * (controller.axes[name].damping + domain.drag_n_s_per_m)
    return residual, 1.0 + residual / force if force > 0.0 else 1.0


def verify_limits(
    controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController
) -> tuple[str, list[str]]:
    """Return what was confirmed of the limits on one axis, and what is wrong; the contacts are replayed from rest."""
    limits, units = controller.limits, axis_units(name)
    if limits is None:
        return "the file has no limits (an earlier release); the runtime takes its defaults", []
    scenarios = controller.predicted[name].scenarios
    if not scenarios:
        return "", []
    wrong = [*_sensor(controller), *_residual(controller, name)]
    h, asked = controller.sample_time_s, limits.axes[name]
    watched = Strategy(variable=controller.damping_of(name), followed_weight=asked.followed_weight(h))
    replays = Replays(domain, law, h, watched)
    seen = [replays.play(each) for each in dict.fromkeys(each.scenario() for each in scenarios)]
    speed = max(each.largest_speed_m_s for each in seen)
    acceleration = max(each.largest_acceleration_m_s2 for each in seen)
    followed = max(each.largest_followed_m_s for each in seen)
    wrong += [
        f"limits.axes.{name}.{what} is {limit:.4g} {unit}, and certified contacts command {found:.4g}"
        for what, limit, found, unit in (
            ("speed", asked.speed, speed, units.speed),
            ("acceleration", asked.acceleration, acceleration, f"{units.speed}²"),
            ("followed_speed", asked.followed_speed or math.inf, followed, units.speed),
        )
        if found >= limit
    ]
    wrong += _too_wide(controller, name, (speed, acceleration))
    force, share = with_residual(controller, name)
    worst = share * max(each.peak_contact_force_n for each in scenarios)
    robot = ""
    if asked.followed_speed is not None:
        robot = f", {followed:.3g} of {asked.followed_speed:g} {units.speed} behind the lag"
    return (
        f"certified contacts command {speed:.3g} of {asked.speed:g} {units.speed}{robot} and {acceleration:.3g} of "
        f"{asked.acceleration:g} {units.speed}²; with {force:g} {units.force} of weight left over the worst peak is "
        f"{worst:.1f} {units.force}{_not_recomputed(limits)}"
    ), wrong


def _too_wide(controller: Controller, name: str, replayed: tuple[float, float]) -> Iterator[str]:
    """Say which limits let more through than follows from the file; of all axes together with the first of them."""
    limits = controller.limits
    if limits is None:
        return
    noise, skipped = limits.noise or LimitsNoise(), () if limits.noise else _NOISY
    stated: dict[str, float] = {}
    follows: dict[str, float] = {}
    if limits.noise is not None:
        jump = step_motion(controller, name, controller.axes[name].deadband)
        speed = max(replayed[0], jump[0])
        # From rest no speed comes sooner than in one period.
        motion = speed, max(replayed[1], speed / controller.sample_time_s)
        chosen, place = choose_axis_limits(controller, name, noise, motion, {}), f"axes.{name}"
        for what in ("speed", "acceleration"):
            stated[f"{place}.{what}"] = getattr(limits.axes[name], what)
            follows[f"{place}.{what}"] = getattr(chosen, what)
    safe, lag = safe_speed(controller, name), limits.axes[name].followed_lag_s
    if safe is not None and lag is not None:
        key = f"axes.{name}.followed_speed"
        stated[key] = limits.axes[name].followed_speed or 0.0
        follows[key] = safe[0] / largest_share(controller, name, lag)
    if name == next(iter(controller.axes)):
        whole = choose_limits(controller, noise, limits.axes, {})
        for key, value in vars(whole).items():
            if isinstance(value, int | float) and key not in skipped:
                stated[key], follows[key] = getattr(limits, key), value
    for key, value in follows.items():
        if limits.reasons.get(key) != SAID and stated[key] > rounded_up((1.0 + _SAME_LIMIT) * value):
            yield f"limits.{key} is {stated[key]:.4g}, and what the file holds makes it {value:.4g}"


def _not_recomputed(limits: Limits) -> str:
    """Say which limits were taken as they are."""
    said = [key for key, reason in limits.reasons.items() if reason == SAID]
    parts = [f"{', '.join(said)}: {SAID}"] if said else []
    if limits.noise is None:
        parts.append("the file does not say for which noise (an earlier release), so speeds were not computed again")
    return "".join(f"; {part}" for part in parts)


def _sensor(controller: Controller) -> list[str]:
    """Say where the range of the sensor is less than weight, bias and the predicted peaks need."""
    limits, payload = controller.limits, controller.payload
    straight = [name for name in controller.axes if name not in ROTATIONAL_AXES]
    if limits is None or not straight:
        return []
    weight = payload.mass_kg * STANDARD_GRAVITY_M_S2 + max(abs(each) for each in payload.force_bias_n)
    needed = weight + max(
        share * each.peak_sensor_force_n
        for name in straight
        for share in (with_residual(controller, name)[1],)
        for each in controller.predicted[name].scenarios
    )
    if needed < limits.force_n:
        return []
    return [
        f"limits.force_n is {limits.force_n:g} N, and weight, bias and the worst predicted peak make {needed:.4g} N"
    ]


def _residual(controller: Controller, name: str) -> list[str]:
    """Say where the peaks with the residual are not what the others make them, or the residual moves by itself."""
    limits, gains, predicted = controller.limits, controller.axes[name], controller.predicted[name]
    stated, units = predicted.with_residual_weight, axis_units(name)
    residual, share = with_residual(controller, name)
    if limits is None:
        return []
    wrong = []
    if residual > gains.deadband > 0.0:
        wrong.append(
            f"at the start {residual:g} {units.force} may be left over, more than the deadband of {gains.deadband:g}"
        )
    if stated is None:
        return [*wrong, "the file predicts no peak with the weight that may be left over (with_residual_weight)"]
    for kind in _PEAKS:
        expected = share * max(float(getattr(each, kind)) for each in predicted.scenarios)
        if float(getattr(stated, kind)) < (1.0 - _SAME_NUMBER) * expected or stated.force_n < residual:
            must = f"at least {expected:.4g} {units.force} with {residual:g} left over"
            wrong.append(f"with_residual_weight.{kind} must be {must}")
    return wrong
