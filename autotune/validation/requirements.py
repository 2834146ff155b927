"""Margins, requirements, admittance, noise and passivity: what was asked of a controller, found again."""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np

from autotune.formats.certificate_record import AxisMargins
from autotune.formats.controller_record import Controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.plugins import find_requirement
from autotune.text import margins_text
from problems.arrays import FloatArray
from problems.design.evaluation import build_scenarios
from problems.design.problem import DesignProblem
from problems.design.requirements import (
    AdmittanceRequirement,
    AdmittanceTarget,
    DecayRate,
    LoopRequirement,
    Margin,
    NoiseLimit,
    PassivityTarget,
    PeakForceLimit,
    Requirement,
)
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.hold import hold
from problems.model.plant import FREE_SPACE, Plant, WrenchFilter, build_plant_matrices
from problems.model.robot import RobotModel
from problems.model.sampled import Controller as LoopController
from problems.model.sampled import build_sampled_plant
from problems.stability.noise_spectrum import RelativeSpectrum

from .certified_requirements import asked_of, certified_problem_requirements, describe_soft
from .margins import SweptMargins
from .replay import equation_gains, robot_alone, settling_samples
from .replay_kernel import difference_step, follow_forces, rest_at
from .report import Check
from .validation_samples import ValidationSamples, scenario_of

MARGINS_CHECK = "margins"
_FREQUENCIES = 5
_SETTLE_S = 2.0
_PERIODS = 2.0
_MASS_POINTS, _NOISE_STIFFNESS_POINTS = 3, 9
# Two roads to the same margin differ by their frequency grids (measured: 1e-4); what differs by more is another margin.
_SAME_MARGIN = 0.01
_GRID = 5, 2


def check_margins(name: str, claimed: AxisMargins, swept: SweptMargins) -> Check:
    """Hold the margins that a file claims against those of a sweep: less may be claimed, more may not."""
    wrong = []
    for key in ("modulus", "gain_db", "phase_deg", "delay_s"):
        said = getattr(claimed, key)
        found = swept.values[key]
        said = math.inf if said is None else float(said)
        if said > found * (1.0 + _SAME_MARGIN) and not (math.isinf(said) and math.isinf(found)):
            wrong.append(f"{key} is claimed as {said:.6g}, found {found:.6g}")
    return Check(
        axis=name,
        name=MARGINS_CHECK,
        passed=not wrong and swept.largest_radius < 1.0,
        message="; ".join(wrong) or f"confirmed on {swept.plants} plants: {margins_text(swept.values)}",
    )


def check_requirements(controller: Controller, name: str, swept: SweptMargins) -> Check:
    """Check that the margins and the decay of a sweep meet what was asked of the axis."""
    missed, known, asked = [], 0, dict[str, Any](asked_of(controller, name))
    refuted_at = None
    for key, required in asked.items():
        requirement = find_requirement(key)
        if requirement is None:
            missed.append(f"{key} cannot be verified: no requirement of that name is installed")
            continue
        if isinstance(required, bool):
            missed.append(f"{key} cannot be verified by this release, which asks for its number, found {required}")
            continue
        if isinstance(requirement, Margin):
            reached = swept.values[requirement.margin]
        elif isinstance(requirement, DecayRate):
            reached = -math.log(swept.largest_radius) / controller.sample_time_s
        else:
            continue
        known += 1
        if requirement.ratio(required, reached) * (1.0 - 0.1 * _SAME_MARGIN) > 1.0:
            missed.append(f"{key} must be at least {required:.6g}, found {reached:.6g}")
            if isinstance(requirement, Margin) and refuted_at is None:
                refuted_at = scenario_of(swept.worst[requirement.margin], controller.certificate.domain[name].plants)
    return Check(
        axis=name,
        name="requirements",
        passed=not missed,
        refuted_at=refuted_at,
        message="; ".join(missed) or f"all {known} margins that were asked are met{describe_soft(controller, name)}",
    )


def check_admittance(
    controller: Controller, name: str, plants: PlantSet, others: ValidationSamples, law: AdmittanceController
) -> Check:
    """Check the steady hand force and |G| in free space against what is claimed and what was asked."""
    predicted = controller.predicted[name].free_space_admittance
    found = sampled_admittance(plants.nominal.port, law, controller.sample_time_s, predicted.band_hz)
    wrong = []
    units = axis_units(name)
    hand = law.damping_n_s_per_m + plants.nominal.payload.drag_n_s_per_m
    if abs(predicted.hand_force_n_per_m_s / hand - 1.0) > _SAME_MARGIN:
        said = f"{predicted.hand_force_n_per_m_s:.6g} {units.hand}"
        wrong.append(f"the hand {units.force_name} is claimed as {said}, found {hand:.6g}")
    if abs(found / predicted.min_m_s_per_n - 1.0) > _SAME_MARGIN:
        wrong.append(f"|G| is claimed as {predicted.min_m_s_per_n:.6g} {units.admittance}, found {found:.6g}")
    for required in asked_of(controller, name).values():
        if isinstance(required, AdmittanceTarget):
            # G does not hang on the payload; among the robots the slowest and the fastest cover all.
            reached = min(
                sampled_admittance(port, law, controller.sample_time_s, required.band_hz)
                for port in (plants.nominal.port, *others.extreme_ports())
            )
            if reached < required.min_m_s_per_n * (1.0 - 0.1 * _SAME_MARGIN):
                wrong.append(
                    f"|G| must be at least {required.min_m_s_per_n:.6g} {units.admittance}, found {reached:.6g}"
                )
    band = f"{predicted.band_hz[0]:g} to {predicted.band_hz[1]:g} Hz"
    return Check(
        axis=name,
        name="free-space admittance",
        passed=not wrong,
        message="; ".join(wrong) or f"at least {found:.4g} {units.admittance} from {band}",
    )


def check_further(
    controller: Controller, name: str, plants: PlantSet, others: ValidationSamples, law: AdmittanceController
) -> Iterator[Check]:
    """Check the command's noise, the passive band and every other requirement, where they were asked."""
    h = controller.sample_time_s
    for key, required in asked_of(controller, name).items():
        requirement = find_requirement(key)
        if isinstance(required, bool):
            continue  # refused by `check_requirements`
        if isinstance(requirement, Margin | DecayRate | PeakForceLimit | AdmittanceRequirement | None):
            continue  # margins are swept, peaks and the admittance have checks of their own
        if isinstance(required, NoiseLimit):
            reached = worst_noise(required, _loop_plants(plants, others), law, h)
        elif isinstance(required, PassivityTarget):
            ports = (plants.nominal.port, *others.extreme_ports())
            reached = min(passive_band_hz(port, law, h, required.passive_below_hz) for port in ports)
        elif isinstance(requirement, LoopRequirement):
            reached = worst_of_loops(requirement, required, _loop_plants(plants, others), law, h)
        else:
            reached = _worst_of_scenarios(controller, name, requirement, required, others, law)
        yield _compared(name, requirement, required, reached)


def _compared(name: str, requirement: Requirement[Any], required: Any, reached: float) -> Check:
    ratio = requirement.ratio(required, reached)
    met = ratio * (1.0 - 0.1 * _SAME_MARGIN) <= 1.0
    turning = name in ROTATIONAL_AXES
    found = f"{requirement.shown_scale * reached:.4g} {requirement.unit_on(turning=turning)}".strip()
    asked = requirement.describe(required, turning=turning)
    message = f"found {found}, required: {asked}{', met within 0.1 %' if met and ratio > 1.0 else ''}"
    return Check(axis=name, name=requirement.title, passed=met, message=message)


def worst_of_loops(
    requirement: LoopRequirement[Any], required: Any, plants: Sequence[Plant], law: LoopController, h: float
) -> float:
    """Return what is achieved by the worst of the loops of these plants, in contact and in free space."""
    both = dict.fromkeys((*plants, *(plant.in_contact_with(FREE_SPACE) for plant in plants)))
    found = [requirement.verified(required, build_sampled_plant(plant, h), law) for plant in both]
    return max(found) if requirement.is_upper_limit else min(found)


def _worst_of_scenarios(
    controller: Controller,
    name: str,
    requirement: Requirement[Any],
    required: Any,
    others: ValidationSamples,
    law: AdmittanceController,
) -> float:
    """Return what is achieved on a grid of the domain, by the requirement's own code."""
    domain = controller.certificate.domain[name]
    late = domain.plants.range_of("wrench_delay_s")[1] > 0.0
    problem = DesignProblem(
        plants=domain.plants,
        bounds={"feedback_damping_s": (0.0, 0.0)} if late else {},
        sample_time_s=controller.sample_time_s,
        approach=domain.approach,
        requirements=certified_problem_requirements(controller, name),
    )
    named = (each.scenario() for each in controller.predicted[name].scenarios)
    scenarios = dict.fromkeys((*problem.scenarios(*_GRID), *named, *others.scenarios))
    design = build_scenarios(problem, tuple(scenarios)).stable(law)
    ratio = float(np.max(requirement.ratios(required, design)))
    return requirement.achieved_at(required, ratio)


def _loop_plants(plants: PlantSet, others: ValidationSamples) -> tuple[Plant, ...]:
    """Return a grid of the set, ends included, and the further plants, all in contact."""
    masses = np.linspace(*plants.payload_mass_kg, _MASS_POINTS)
    low, high = plants.environment_stiffness_n_per_m
    stiffnesses = np.clip(np.geomspace(low, high, _NOISE_STIFFNESS_POINTS), low, high)
    grid = dict.fromkeys((float(m), float(k)) for m in masses for k in stiffnesses)
    return tuple(dict.fromkeys((*(plants.at(m, k) for m, k in grid), *others.plants)))


def sampled_admittance(
    port: tuple[RobotModel, WrenchFilter],
    controller: AdmittanceController,
    sample_time_s: float,
    band_hz: tuple[float, float],
) -> float:
    """Return the smallest |V/F| [m/s/N] at five frequencies of the band, ends included, from simulated sines.

    A sine that passes the wrench's filter is a smaller sine.
    """
    robot, wrench = port
    frequencies = np.unique(np.geomspace(*band_hz, _FREQUENCIES))
    passed = np.abs(wrench.response(2.0 * np.pi * frequencies))
    found = [
        float(share) * _gain(robot, controller, sample_time_s, float(f))
        for f, share in zip(frequencies, passed, strict=True)
    ]
    return min(found)


@lru_cache(maxsize=64)
def _gain(robot: RobotModel, controller: AdmittanceController, h: float, frequency_hz: float) -> float:
    samples = round((_SETTLE_S + _PERIODS / frequency_hz) / h)
    omega = 2.0 * np.pi * frequency_hz
    force = np.sin(omega * h * np.arange(samples))
    position = follow_forces(robot_alone(robot, h), equation_gains(controller, h), force)
    # Least squares on the steady part: sine, cosine, drift and offset of the position.
    used = slice(round(_SETTLE_S / h), samples)
    t = h * np.arange(samples)[used]
    columns = np.column_stack([np.sin(omega * t), np.cos(omega * t), t, np.ones_like(t)])
    sine, cosine, _, _ = np.linalg.lstsq(columns, position[used], rcond=None)[0]
    return float(omega * np.hypot(sine, cosine))


_SHORTEST_S = 0.8
_PORT_S = 10.0
_RESOLUTION_HZ = 0.005
_NOT_SETTLED = 1e-6
# A real part this small beside |G| is rounding.
_NOTHING = 1e-9


def worst_noise(asked: NoiseLimit, plants: Sequence[Plant], law: AdmittanceController, sample_time_s: float) -> float:
    """Return the largest RMS of the commanded speed [m/s] under the noise that is asked for, in contact and free."""
    both = tuple(dict.fromkeys((*plants, *(plant.in_contact_with(FREE_SPACE) for plant in plants))))
    # What is not asked is not followed: a noise of zero.
    count = len(both) if asked.position_noise_rms_m else 0
    found = speed_rms(
        (*both, *both[:count]),
        law,
        sample_time_s,
        on_position=np.repeat([0.0, 1.0], [len(both), count]),
        spectrum=asked.noise_spectrum,
    )
    return float(np.max(asked.speed_rms_m_s(found[: len(both)], found[len(both) :] if count else 0.0)))


def speed_rms(
    plants: Sequence[Plant],
    law: AdmittanceController,
    sample_time_s: float,
    *,
    on_position: FloatArray | float = 0.0,
    spectrum: RelativeSpectrum | None = None,
) -> FloatArray:
    """Return the RMS of the commanded speed (p,) per RMS of white noise on the force, or the position that is read.

    It is on the position where `on_position` (p,) is 1. The squares of the response to a single tick of it add up to
    the variance under noise; where the force's has a `spectrum`, those of its transform do, weighed by that. Each
    plant touches all the time if it touches at all; the loops must be stable.
    """
    h, of_force, of_position = sample_time_s, 1.0 - np.asarray(on_position), on_position
    plant = _Plants(plants, h)
    # The difference equation adds and multiplies only: what it does to a number it does to each plant's.
    past: Any = rest_at(0.0)
    gains, step = equation_gains(law, h), cast(Any, difference_step)
    direct = gains.gain * gains.now_weight / gains.new * gains.b_0
    last = squares = np.zeros(len(plants))
    moves = list[FloatArray]()
    for k in range(max(settling_samples(each, law, h, _SHORTEST_S) for each in dict.fromkeys(plants))):
        tick = 1.0 if k == 0 else 0.0
        force, position = plant.force() + of_force * tick, plant.position() + of_position * tick
        if np.any(plant.direct != 0.0):
            tried = step(gains, past, force, position, False).sent
            force = force + plant.direct * tried / (1.0 - direct * plant.direct)
        past = step(gains, past, force, position, False)
        if spectrum is not None:
            moves.append(past.sent - last)
        squares, last = squares + (past.sent - last) ** 2, past.sent
        plant.advance(past.sent)
    if spectrum is not None:
        squares = np.where(of_force > 0.0, _weighed_squares(np.array(moves), spectrum, h), squares)
    return np.sqrt(squares) / h


def _weighed_squares(moves: FloatArray, spectrum: RelativeSpectrum, h: float) -> FloatArray:
    """Return the variance (p,) of the responses (n, p) to a tick of noise under noise of a spectrum, by Parseval."""
    # So long that what the noise remembers beyond it is nothing.
    count = 2 ** math.ceil(math.log2(2.0 * len(moves)))
    frequency = np.fft.rfftfreq(count, h).astype(np.float64)
    power = np.abs(np.fft.rfft(moves, count, axis=0)) ** 2
    # Each frequency but the first and the last stands for that below zero too.
    power[1:-1] *= 2.0
    return np.asarray(spectrum.beside_white(frequency, h) @ power / count)


class _Plants:
    """Plants of one robot order (p,), advanced together by a sample at a time, each with its own delay.

    The plants are the last axis, along which numpy is fast.
    """

    def __init__(self, plants: Sequence[Plant], h: float) -> None:
        matrices = [build_plant_matrices(plant, h) for plant in plants]
        late = [plant.loop_delay_s / h for plant in plants]
        self.whole = np.array([math.floor(each + _NOTHING) for each in late])
        fraction = [max(each - whole, 0.0) for each, whole in zip(late, self.whole, strict=True)]
        self.is_split = np.array(fraction) > _NOTHING
        before = [hold(m.a, m.b, share) for m, share in zip(matrices, fraction, strict=True)]
        after = [hold(m.a, m.b, 1.0 - share) for m, share in zip(matrices, fraction, strict=True)]
        both = list(zip(before, after, strict=True))
        # What a sample makes of the state, of the older command and of the newer one.
        self.step = np.stack([late_phi @ early_phi for (early_phi, _), (late_phi, _) in both], axis=-1)
        self.older = np.stack([late_phi @ early_gamma for (_, early_gamma), (late_phi, _) in both], axis=-1)
        self.newer = np.stack([gamma for _, gamma in after], axis=-1)
        self.c_force = np.stack([m.c_force for m in matrices], axis=-1)
        self.c_position = np.stack([m.c_position for m in matrices], axis=-1)
        self.d_force = np.array([m.d_force for m in matrices])
        # Without any delay the force at a tick depends on the command of that tick, which depends on it.
        self.direct = np.where((self.whole == 0) & ~self.is_split, self.d_force, 0.0)
        self.state = np.zeros(self.c_force.shape)
        self.columns = np.arange(len(plants))
        # The newest command first.
        self.commands = np.zeros((int(np.max(self.whole)) + 2, len(plants)))

    def force(self) -> FloatArray:
        """Return F, where the delay ends at a tick that of right after it; what the next command adds is `direct`."""
        age = np.where(self.is_split, self.whole, np.maximum(self.whole - 1, 0))
        held = (self.d_force - self.direct) * self.commands[age, self.columns]
        return np.asarray(np.einsum("np,np->p", self.c_force, self.state) + held)

    def position(self) -> FloatArray:
        """Return the flange's position."""
        return np.asarray(np.einsum("np,np->p", self.c_position, self.state))

    def advance(self, command: FloatArray) -> None:
        """Send a command and advance by a sample."""
        self.commands = np.vstack([command, self.commands[:-1]])
        older = np.where(self.is_split, self.commands[self.whole + 1, self.columns], 0.0)
        newer = self.commands[self.whole, self.columns]
        self.state = np.einsum("mnp,np->mp", self.step, self.state) + self.older * older + self.newer * newer


def passive_band_hz(
    port: tuple[RobotModel, WrenchFilter], law: AdmittanceController, sample_time_s: float, up_to_hz: float
) -> float:
    """Return up to where Re G ≥ 0, at most `up_to_hz`, G = V/F being the transform of the answer to a tick of force.

    The wrench's filter lies before that tick. 0 for a port that does not come to rest.
    """
    h = sample_time_s
    robot, wrench = port
    force = np.zeros(math.ceil(_PORT_S / h))
    force[0] = 1.0
    position = follow_forces(robot_alone(robot, h), equation_gains(law, h), force)
    moved = np.diff(position, prepend=0.0)
    if not np.max(np.abs(moved[-len(moved) // 10 :])) <= _NOT_SETTLED * np.max(np.abs(moved)):
        return 0.0
    count = 2 ** math.ceil(math.log2(max(1.0 / (_RESOLUTION_HZ * h), len(moved))))
    omega = 2.0 * np.pi * np.fft.rfftfreq(count, h)[1:]
    # The position is the sum of its moves, and the velocity its derivative below the Nyquist frequency.
    admittance = 1j * omega * np.fft.rfft(moved, count)[1:] / (1.0 - np.exp(-1j * omega * h))
    if not wrench.is_none:
        admittance = admittance * wrench.response(np.asarray(omega, dtype=np.float64))
    negative = np.flatnonzero(admittance.real < -_NOTHING * np.abs(admittance))
    fails = math.inf if not negative.size else float(omega[negative[0]]) / (2.0 * np.pi)
    return min(fails, up_to_hz)
