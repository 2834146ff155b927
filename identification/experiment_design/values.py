"""Values of the cell that an experiment design starts from, their uncertainty, and the worst plausible cell."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.robot import RobotModel

from ..merging.values import merged_std, shared_std
from ..payload.static_poses import GRAVITY_B_M_S2
from ..result import AxisEstimate, EnvironmentEstimate, Estimate, Identified, SensorEstimate, VectorEstimate
from ..robot.coupling import felt_impedance

_POSE_MISFIT_SHARE = 0.007  # of the weight: 1.1 N at 16 kg, what the paper's sensor leaves at rest
_LEVER_M = 0.1
_DAMPING_RATIO = 0.05
_SMALLEST_MISFIT_SHARE = 0.002  # less does not stand out of the noise of one recording
# Known exactly would be infinite information; a millionth is exact enough and keeps matrices regular.
_EXACT_SHARE = 1e-6
SMALLEST_DAMPING_RATIO = 0.01
"""A bare steel gripper; less is taken only where less was identified."""
_POINTS = 400
_STIFFNESSES = 41
_DEVIATIONS = 3.0
# How far off a usual value may be, and one that a person guessed.
_STIFFNESS_FACTOR = 2.5
_ROBOT_FACTOR = 4.0  # a bandwidth of 13 Hz
_USUAL_MASS_FACTOR, _GUESSED_MASS_FACTOR = 1.5, 1.1
_DRAG_FACTOR = 3.0
_SMALLEST_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class Known:
    """A value with its standard deviation, None where nothing is known of it; `is_assumed`: a usual value."""

    value: float
    std: float | None = None
    is_assumed: bool = True

    def information(self, beside: float = 0.0) -> float:
        """Return 1/σ², 0 where nothing is known; `beside` is a part of σ that no further recording takes away."""
        if self.std is None:
            return 0.0
        floor = _EXACT_SHARE * max(abs(self.value), 1e-9)
        return float(1.0 / max(self.std**2 - beside**2, floor**2))

    def std_after(self, recording_std: float, symbol: str = "") -> float:
        """Return σ once a recording that by itself shows `recording_std` is merged (`merging.merged_std`).

        `symbol` names the parameter for what all recordings share of it (`merging.shared_std`); infinite where neither
        shows anything.
        """
        if self.std is None or not np.isfinite(recording_std):
            return recording_std if self.std is None else self.std
        return merged_std([self.std, recording_std], shared_std(symbol, self.value) if symbol else 0.0)


@dataclass(frozen=True, kw_only=True)
class PlanValues:
    """One axis of a cell as far as it is known, and the noise with which it will be measured.

    `com_m` is the distance of the centre of mass from the sensor with the deviation of its worst component;
    `motion_mass_kg` is M_p as motion shows it. `pose_force_std_n`, `pose_torque_std_n_m`: what one pose at rest misses
    by, beyond noise; `misfit_share` is what the model of motion and contact misses of the force, beyond noise.
    `surface` is the one that is to be touched, where the file knows some.
    """

    mass_kg: Known
    com_m: Known
    motion_mass_kg: Known
    stiffness_n_per_m: Known
    damping_n_s_per_m: Known
    drag_n_s_per_m: Known
    bandwidth_hz: Known
    delay_s: Known
    environment_stiffness_n_per_m: Known
    environment_damping_n_s_per_m: Known
    force_noise_rms_n: Known
    torque_noise_rms_n_m: Known
    pose_force_std_n: Known
    pose_torque_std_n_m: Known
    misfit_share: Known = field(default_factory=lambda: Known(value=0.01))
    position_noise_rms_m: Known = field(default_factory=lambda: Known(value=5e-6))
    sample_time_s: Known = field(default_factory=lambda: Known(value=1e-3))
    robot: RobotModel
    surface: str = ""

    def __post_init__(self) -> None:
        for name, known in self.known().items():
            if not (np.isfinite(known.value) and (known.value > 0.0 or (known.value == 0.0 and name in _MAY_VANISH))):
                raise ParameterError(name, known.value, "finite and above 0")
            if known.std is not None and not (np.isfinite(known.std) and known.std >= 0.0):
                raise ParameterError(f"{name}.std", known.std, "finite and not below 0")

    def known(self) -> dict[str, Known]:
        """Return every scalar by its name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Known)}

    @property
    def assumed(self) -> dict[str, float]:
        """Return the values that are usual ones and no results."""
        return {name: known.value for name, known in self.known().items() if known.is_assumed}

    @property
    def theta(self) -> FloatArray:
        """K_s, B_s, B_p, M_p (4,) in SI."""
        coupling = self.stiffness_n_per_m.value, self.damping_n_s_per_m.value
        return np.array([*coupling, self.drag_n_s_per_m.value, self.mass_kg.value])

    @property
    def critical_damping_n_s_per_m(self) -> float:
        """2 sqrt(K_s M_p)."""
        return float(2.0 * np.sqrt(self.stiffness_n_per_m.value * self.mass_kg.value))

    @property
    def payload_frequency_hz(self) -> float:
        """sqrt(K_s/M_p)/2π, where the payload swings on its coupling."""
        return float(np.sqrt(self.stiffness_n_per_m.value / self.mass_kg.value) / (2.0 * np.pi))


_STRAIGHT = ("x", "y", "z")
_MAY_VANISH = {
    "misfit_share",
    "com_m",
    "damping_n_s_per_m",
    "drag_n_s_per_m",
    "environment_damping_n_s_per_m",
    "delay_s",
}


def usual_values(*, mass_kg: float | None = None, stiffness_n_per_m: float | None = None) -> PlanValues:
    """Return values of a usual cell, nothing of it known; what is known counts as a value, not as a result."""
    mass = 16.0 if mass_kg is None else mass_kg
    stiffness = 3e5 if stiffness_n_per_m is None else stiffness_n_per_m
    if not (0.0 < mass < np.inf and 0.0 < stiffness < np.inf):
        raise ParameterError("mass and stiffness", (mass, stiffness), "finite and above 0")
    weight = mass * float(np.linalg.norm(GRAVITY_B_M_S2))
    light = 2.0 * _DAMPING_RATIO * float(np.sqrt(stiffness * mass))
    return PlanValues(
        mass_kg=Known(value=mass, is_assumed=mass_kg is None),
        com_m=Known(value=0.15),
        motion_mass_kg=Known(value=mass, is_assumed=mass_kg is None),
        stiffness_n_per_m=Known(value=stiffness, is_assumed=stiffness_n_per_m is None),
        damping_n_s_per_m=Known(value=light),
        drag_n_s_per_m=Known(value=light),
        bandwidth_hz=Known(value=20.0 / (2.0 * np.pi)),
        delay_s=Known(value=2.4e-3),
        environment_stiffness_n_per_m=Known(value=1e5),
        environment_damping_n_s_per_m=Known(value=100.0),
        force_noise_rms_n=Known(value=0.2),
        torque_noise_rms_n_m=Known(value=0.02),
        pose_force_std_n=Known(value=_POSE_MISFIT_SHARE * weight),
        pose_torque_std_n_m=Known(value=_POSE_MISFIT_SHARE * weight * _LEVER_M),
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
    )


def values_of(result: Identified, axis: str | None = None) -> tuple[str, PlanValues]:
    """Return the name of the axis and what `result` says of it; what is null there gets its usual value.

    Raises ParameterError when there is no such axis, or several and none was named.
    """
    name = _choose(result, axis)
    mass, mass_kg = result.payload.mass_kg, result.payload.mass_kg.value
    estimate = result.axes.get(name)
    stiffness = None if estimate is None else estimate.coupling.stiffness_n_per_m.value
    values = usual_values(mass_kg=mass_kg, stiffness_n_per_m=stiffness)
    values = replace(
        values,
        mass_kg=_known(mass, values.mass_kg),
        com_m=_distance(result.payload.com_m, values.com_m),
        sample_time_s=_known(result.sample_time_s, values.sample_time_s),
    )
    values = _with_sensor(values, result.sensor)
    return name, values if estimate is None else _with_axis(values, estimate)


def _choose(result: Identified, axis: str | None) -> str:
    found = [name for name in result.axes if name in _STRAIGHT]
    if axis is not None:
        return axis
    if result.axes and not found:
        raise ParameterError(
            "axis",
            ", ".join(result.axes),
            "x, y or z: a recording about a turning axis is not planned. Name a straight axis (--axis) to plan one "
            "from usual values, or record the turning axis as docs/recording.md says",
        )
    if len(found) > 1:
        raise ParameterError("axis", ", ".join(found), "named (--axis), since the file holds several")
    return found[0] if found else "x"


def _known(estimate: Estimate, usual: Known, *, may_vanish: bool = False) -> Known:
    """Return what an estimate shows; `given` without a deviation is exact."""
    if estimate.value is None or estimate.value < 0.0 or (estimate.value == 0.0 and not may_vanish):
        return usual
    return Known(value=estimate.value, std=estimate.std if estimate.std is not None else 0.0, is_assumed=False)


def _distance(com: VectorEstimate, usual: Known) -> Known:
    if com.value is None:
        return usual
    return Known(
        value=float(np.linalg.norm(com.value)), std=0.0 if com.std is None else float(max(com.std)), is_assumed=False
    )


def _with_sensor(values: PlanValues, sensor: SensorEstimate) -> PlanValues:
    noise = _known(sensor.force_noise_rms_n, values.force_noise_rms_n)
    stated = sensor.torque_noise_rms_n_m
    torque = values.torque_noise_rms_n_m
    if stated is not None and stated.value is not None and max(stated.value) > 0.0:
        torque = Known(value=float(max(stated.value)), std=0.0, is_assumed=False)
    residual = _known(sensor.gravity_residual_rms_n, values.pose_force_std_n)
    stated_position = sensor.position_noise_rms_m
    position = (
        values.position_noise_rms_m if stated_position is None else _known(stated_position, values.position_noise_rms_m)
    )
    # The file shows no residual of the torque: it is taken to exceed its noise as that of the force does.
    share = min(torque.value / noise.value, _LEVER_M)
    return replace(
        values,
        force_noise_rms_n=noise,
        torque_noise_rms_n_m=torque,
        position_noise_rms_m=position,
        pose_force_std_n=residual,
        pose_torque_std_n_m=Known(value=residual.value * share, is_assumed=residual.is_assumed or torque.is_assumed),
    )


def _with_axis(values: PlanValues, axis: AxisEstimate) -> PlanValues:
    robot = _robot(axis)
    surface = _worst_known(axis.environments)
    values = replace(
        values,
        motion_mass_kg=values.motion_mass_kg if axis.mass_kg is None else _known(axis.mass_kg, values.motion_mass_kg),
        stiffness_n_per_m=_known(axis.coupling.stiffness_n_per_m, values.stiffness_n_per_m),
        damping_n_s_per_m=_known(axis.coupling.damping_n_s_per_m, values.damping_n_s_per_m, may_vanish=True),
        drag_n_s_per_m=_known(axis.drag_n_s_per_m, values.drag_n_s_per_m, may_vanish=True),
        misfit_share=_misfit(axis, values.misfit_share),
    )
    if robot is not None:
        values = replace(
            values,
            robot=robot,
            bandwidth_hz=_known(axis.robot.bandwidth_hz, values.bandwidth_hz),
            delay_s=_known(axis.robot.delay_s, values.delay_s, may_vanish=True),
        )
    if surface is not None:
        stated = surface.damping_n_s_per_m
        values = replace(
            values,
            environment_stiffness_n_per_m=_known(surface.stiffness_n_per_m, values.environment_stiffness_n_per_m),
            environment_damping_n_s_per_m=_known(stated, values.environment_damping_n_s_per_m, may_vanish=True),
            surface=surface.name
            if len(axis.environments) == 1
            else f"{surface.name}, the least well known of {len(axis.environments)}",
        )
    return values


def _misfit(axis: AxisEstimate, usual: Known) -> Known:
    """Return the share of the force that the worst fit leaves beyond noise."""
    shares = [
        (1.0 - fit.explained_free) * max(1.0 - 1.0 / fit.noise_ratio_free**2, 0.0)
        for fit in axis.fits
        if fit.noise_ratio_free > 0.0
    ]
    if not shares:
        return usual
    return Known(value=max(float(np.sqrt(max(shares))), _SMALLEST_MISFIT_SHARE), std=0.0, is_assumed=False)


def _robot(axis: AxisEstimate) -> RobotModel | None:
    stated = axis.robot
    if stated.numerator.value is None or stated.denominator.value is None or stated.delay_s.value is None:
        return None
    return RobotModel(
        numerator=np.array(stated.numerator.value),
        denominator=np.array(stated.denominator.value),
        delay_s=stated.delay_s.value,
    )


def _worst_known(surfaces: Sequence[EnvironmentEstimate]) -> EnvironmentEstimate | None:
    def share(surface: EnvironmentEstimate) -> float:
        stiffness = surface.stiffness_n_per_m
        if stiffness.value is None:
            return float("inf")
        return (stiffness.std or 0.0) / stiffness.value

    return max(surfaces, key=share, default=None)


@dataclass(frozen=True, kw_only=True)
class WorstCase:
    """The plausible cell on which a sweep makes the most force, and that force per speed of the flange [N/(m/s)].

    The flange's speed is what the command was made for; a robot of `bandwidth_hz`, faster than that, moves more.
    `damping_ratio` is (B_s + B_p)/(2 sqrt(K_s M_p)).
    """

    force_per_speed_n_s_per_m: float
    frequency_hz: float
    stiffness_n_per_m: float
    mass_kg: float
    damping_ratio: float
    bandwidth_hz: float


def worst_case(values: PlanValues, low_hz: float, high_hz: float) -> WorstCase:
    """Return the cell within what is known that feels most force between two frequencies.

    K_s, M_p and the robot's bandwidth run over three standard deviations, or over factors of 2.5, 1.1 (1.5 where nobody
    guessed a mass) and 4 where nothing was measured. The damping is the least of three deviations, at least 1 % of the
    critical one; beside resonances more drag makes more force, so that the most (a factor of 3) counts too, and the
    plan's own values. The force is that of a sine that lasts: a sweep passes through a resonance and stays below.
    """
    frequency = np.geomspace(low_hz, high_hz, _POINTS)
    factor = _robot_factor(values.bandwidth_hz)
    best: WorstCase | None = None
    for theta in _cells(values):
        stiffness, mass = float(theta[0]), float(theta[3])
        own = np.sqrt(stiffness / mass) / (2.0 * np.pi)
        # The grid is coarser than the resonance of the least damped cell is wide.
        at = np.append(frequency, np.clip(own, low_hz, high_hz))
        s = np.asarray(2j * np.pi * at, dtype=np.complex128)
        felt = np.abs(felt_impedance(theta, s) / s)
        for speedup in (1.0, factor):
            force = felt * _speedup(values.robot, at, speedup)
            i = int(np.argmax(force))
            if best is None or force[i] > best.force_per_speed_n_s_per_m:
                best = WorstCase(
                    force_per_speed_n_s_per_m=float(force[i]),
                    frequency_hz=float(at[i]),
                    stiffness_n_per_m=stiffness,
                    mass_kg=mass,
                    damping_ratio=float((theta[1] + theta[2]) / (2.0 * np.sqrt(stiffness * mass))),
                    bandwidth_hz=float(values.bandwidth_hz.value * speedup),
                )
    if best is None:
        raise AssertionError("unreachable: there is always a stiffness and a mass")
    return best


def _cells(values: PlanValues) -> Iterator[FloatArray]:
    """Yield K_s, B_s, B_p, M_p (4,) of the plan's own values and of the ends of what is plausible."""
    yield values.theta
    drag = values.drag_n_s_per_m
    most = drag.value * _DRAG_FACTOR if drag.std is None else drag.value + _DEVIATIONS * drag.std
    for stiffness, mass in product(_stiffnesses(values.stiffness_n_per_m), _masses(values.mass_kg)):
        yield _least_damped(values, stiffness, mass)
        yield np.array([stiffness, values.damping_n_s_per_m.value, most, mass])


def _stiffnesses(known: Known) -> FloatArray:
    low, high = _range(known, _STIFFNESS_FACTOR)
    return np.geomspace(low, high, _STIFFNESSES) if high > low else np.array([low])


def _masses(known: Known) -> tuple[float, ...]:
    return tuple(dict.fromkeys(_range(known, _USUAL_MASS_FACTOR if known.is_assumed else _GUESSED_MASS_FACTOR)))


def _range(known: Known, factor: float) -> tuple[float, float]:
    if known.std is None:
        return known.value / factor, known.value * factor
    spread = _DEVIATIONS * known.std
    return max(known.value - spread, _SMALLEST_SHARE * known.value), known.value + spread


def _robot_factor(bandwidth: Known) -> float:
    return _ROBOT_FACTOR if bandwidth.std is None else 1.0 + _DEVIATIONS * bandwidth.std / bandwidth.value


def _least_damped(values: PlanValues, stiffness: float, mass: float) -> FloatArray:
    """Return K_s, B_s, B_p, M_p (4,) with the least damping that is plausible."""
    critical = float(2.0 * np.sqrt(stiffness * mass))
    stated = values.damping_n_s_per_m, values.drag_n_s_per_m
    least = [0.0 if each.std is None else max(each.value - _DEVIATIONS * each.std, 0.0) for each in stated]
    floor = SMALLEST_DAMPING_RATIO * critical
    if all(each.std is not None for each in stated):
        floor = min(floor, stated[0].value + stated[1].value)
    missing = max(floor - sum(least), 0.0)
    return np.array([stiffness, least[0] + missing, least[1], mass])


def _speedup(robot: RobotModel, frequency_hz: FloatArray, factor: float) -> FloatArray:
    """Return |r(s/factor)|/|r(s)|: what a robot faster by a factor makes of a command that was made for this one."""
    omega = 2.0 * np.pi * frequency_hz
    return np.asarray(np.abs(robot.position_response(omega / factor)) / np.abs(robot.position_response(omega)))
