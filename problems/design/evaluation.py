"""Evaluate a design over a set of scenarios: stability first, then every requirement as a number that must be ≤ 1."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..contact.transient import SampledContact, build_sampled_contact, transient_from
from ..model.controller import AdmittanceController
from ..model.plant import Plant
from ..model.response import PlantResponse, free_space_admittance, join_wrench, plant_response, rendered_admittance
from ..model.robot import RobotModel
from ..model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from ..stability.margins import Margins, PreparedMargins, UnstableLoopError, prepare_margins
from ..stability.noise import command_speed_gain
from ..stability.passivity import PreparedPort, prepare_port
from .problem import DesignProblem
from .requirements import PassivityTarget, Requirements
from .uncertainty import Scenario

FloatArray = NDArray[np.float64]

_ADMITTANCE_POINTS = 40
_AROUND_A_DIP = np.linspace(-2.0, 2.0, 17)


@dataclass(frozen=True, kw_only=True)
class Peak:
    """The contact forces of one scenario."""

    scenario: Scenario
    peak_sensor_force_n: float
    peak_contact_force_n: float
    time_of_peak_s: float


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A design against its problem.

    `requirements` maps each requirement to required/achieved (≤ 1 is met), worst over the scenarios; it is empty
    and `peaks` too when the loop is unstable. `peaks` is also empty when a margin is missed, unless the peaks were
    asked for all the same. `soft` is the same of requirements that need not be met, `soft_cost_n` what each of them
    adds to the peak in `objective_n`.
    """

    controller: AdmittanceController
    spectral_radius: float
    requirements: Mapping[str, float]
    peaks: tuple[Peak, ...]
    objective_n: float
    soft: Mapping[str, float] = field(default_factory=dict)
    soft_cost_n: Mapping[str, float] = field(default_factory=dict)

    @property
    def penalty_n(self) -> float:
        """What missed soft requirements add to the peak."""
        return sum(self.soft_cost_n.values())

    @property
    def peak_n(self) -> float:
        """The largest peak of the objective's force."""
        return self.objective_n - self.penalty_n

    @property
    def is_stable(self) -> bool:
        """Whether every scenario is stable in contact and in free space."""
        return not self.spectral_radius >= 1.0

    @property
    def is_feasible(self) -> bool:
        """Whether the design is stable and meets every requirement."""
        return self.is_stable and all(value <= 1.0 for value in self.requirements.values())

    @property
    def violation(self) -> float:
        """How far the worst requirement is missed: 0 when feasible."""
        if not self.is_stable:
            return math.inf
        return max((value - 1.0 for value in self.requirements.values()), default=0.0)


@dataclass(frozen=True, kw_only=True)
class PlantMargins:
    """The margins of one plant of the uncertainty: that of `scenario`, or with `free_space` before it touches.

    `speed_gain_m_s_per_n` is the commanded speed's RMS per force noise, where the command's noise is limited.
    """

    scenario: Scenario
    free_space: bool
    margins: Margins
    speed_gain_m_s_per_n: float | None = None

    @property
    def payload_mass_kg(self) -> float:
        """M_p."""
        return self.scenario.payload_mass_kg

    @property
    def environment_stiffness_n_per_m(self) -> float:
        """K_e, 0 in free space."""
        return 0.0 if self.free_space else self.scenario.environment_stiffness_n_per_m


@dataclass(frozen=True, kw_only=True)
class ExactEvaluation:
    """An evaluation and the margins behind it, plant by plant."""

    evaluation: Evaluation
    margins: tuple[PlantMargins, ...]

    def together_with(self, other: "ExactEvaluation") -> "ExactEvaluation":
        """Return the evaluation of the same design over the scenarios of both."""
        own, more = self.evaluation, other.evaluation
        cost = _larger(own.soft_cost_n, more.soft_cost_n)
        return ExactEvaluation(
            evaluation=replace(
                own,
                spectral_radius=max(own.spectral_radius, more.spectral_radius),
                requirements=_larger(own.requirements, more.requirements),
                peaks=own.peaks + more.peaks,
                objective_n=max(own.peak_n, more.peak_n) + sum(cost.values()),
                soft=_larger(own.soft, more.soft),
                soft_cost_n=cost,
            ),
            margins=self.margins + other.margins,
        )


def _larger(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    return {name: max(one.get(name, 0.0), other.get(name, 0.0)) for name in (*one, *other)}


@dataclass(frozen=True, kw_only=True)
class PreparedScenarios:
    """Scenarios with everything that does not depend on the design already computed.

    `ports` are those of all different robots, where passivity is asked.
    `plants` are those of the scenarios in contact, then every different one in free space, the lightest first;
    `free_of` are scenarios that those belong to. `target_response` is that of all different robots, one after the
    other.
    """

    problem: DesignProblem
    scenarios: tuple[Scenario, ...]
    pairs: tuple[SampledContact, ...]
    plants: tuple[PreparedMargins, ...]
    free_of: tuple[Scenario, ...]
    target_response: PlantResponse | None
    ports: tuple[PreparedPort, ...]

    @property
    def free(self) -> tuple[SampledPlant, ...]:
        """The different plants in free space, the lightest first."""
        return tuple(plant.sampled for plant in self.plants[len(self.pairs) :])

    def evaluate(self, design: Sequence[float] | FloatArray, *, peaks_if_missed: bool = False) -> Evaluation:
        """Evaluate a design, the values of `problem.variables`, over the scenarios.

        `peaks_if_missed` asks for the peaks of a stable design that misses a requirement as well (a solver that walks
        along the boundary needs them).
        """
        controller = self.problem.controller(design)
        radii = self.radii(controller)
        if not np.max(radii) < 1.0:
            return Evaluation(
                controller=controller,
                # A radius that is not a number is no smaller than 1 either.
                spectral_radius=float(np.nan_to_num(np.max(radii), nan=math.inf)),
                requirements={},
                peaks=(),
                objective_n=math.inf,
            )
        return self._evaluated(controller, float(np.max(radii)), self.margins(controller, radii), peaks_if_missed)

    def evaluate_exactly(self, controller: AdmittanceController) -> ExactEvaluation:
        """Evaluate a stable controller with its margins plant by plant.

        Raises UnstableLoopError when any scenario is unstable.
        """
        radii = self.radii(controller)
        if not np.max(radii) < 1.0:
            raise UnstableLoopError(float(np.max(radii)))
        margins = self.margins(controller, radii)
        return ExactEvaluation(
            evaluation=self._evaluated(controller, float(np.max(radii)), margins, True), margins=margins
        )

    def radii(self, controller: AdmittanceController) -> FloatArray:
        """Return the spectral radius of every plant's loop."""
        return np.array([spectral_radius(build_loop(plant.sampled, controller)) for plant in self.plants])

    def margins(self, controller: AdmittanceController, radii: FloatArray) -> tuple[PlantMargins, ...]:
        """Find the margins of every plant's loop, all of them stable."""
        limited = self.problem.requirements.command_noise is not None
        of_plant = zip(self.plants, (*self.scenarios, *self.free_of), radii, strict=True)
        return tuple(
            PlantMargins(
                scenario=scenario,
                free_space=i >= len(self.scenarios),
                margins=plant.find(controller, float(radius)),
                speed_gain_m_s_per_n=command_speed_gain(plant.sampled, controller) if limited else None,
            )
            for i, (plant, scenario, radius) in enumerate(of_plant)
        )

    def _evaluated(
        self,
        controller: AdmittanceController,
        radius: float,
        margins: tuple[PlantMargins, ...],
        peaks_if_missed: bool,
    ) -> Evaluation:
        asked, h = self.problem.requirements, self.problem.sample_time_s
        values = [normalise_plant(asked, each, h) for each in margins]
        ratios = {name: max(value[name] for value in values) for name in values[0]}
        ratios |= self.achieved_alone(controller)
        hard, soft = asked.split(ratios)
        if not peaks_if_missed and any(value > 1.0 for value in hard.values()):
            return Evaluation(
                controller=controller,
                spectral_radius=radius,
                requirements=hard,
                peaks=(),
                objective_n=math.inf,
                soft=soft,
            )
        return finish_evaluation(self.problem, controller, radius, ratios, self.peaks(controller))

    def achieved_alone(self, controller: AdmittanceController) -> dict[str, float]:
        """Return required/achieved of what robot and controller do alone, whatever the payload: |G| and passivity."""
        target = self.problem.requirements.passivity
        if target is None:
            return self.achieved_admittance(controller)
        passive = np.max(passivity_ratios(target, self.ports, controller))
        return {**self.achieved_admittance(controller), "passivity": float(passive)}

    def achieved_admittance(self, controller: AdmittanceController) -> dict[str, float]:
        """Return required/achieved of the free-space admittance target, if there is one."""
        target = self.problem.requirements.free_space_admittance
        if target is None or self.target_response is None:
            return {}
        gain = np.abs(rendered_admittance(self.target_response, controller, self.problem.sample_time_s))
        return {"free_space_admittance": target.min_m_s_per_n / float(np.min(gain))}

    def peaks(self, controller: AdmittanceController) -> tuple[Peak, ...]:
        """Simulate the contact of every scenario; the loops must be stable."""
        found = []
        for scenario, pair in zip(self.scenarios, self.pairs, strict=True):
            run = transient_from(pair, controller, self.problem.approach)
            found.append(
                Peak(
                    scenario=scenario,
                    peak_sensor_force_n=run.peak_sensor_force_n,
                    peak_contact_force_n=run.peak_contact_force_n,
                    time_of_peak_s=run.time_of_peak_s,
                )
            )
        return tuple(found)


def build_scenarios(problem: DesignProblem, scenarios: Sequence[Scenario]) -> PreparedScenarios:
    """Sample every scenario's plant, and every different one in free space, once."""
    h = problem.sample_time_s
    nominal = problem.nominal_plant()
    pairs = tuple(build_sampled_contact(build_sampled_plant(s.plant(nominal), h)) for s in scenarios)
    # The first scenario of every different plant in free space stands for it.
    different: dict[Plant, tuple[SampledPlant, Scenario]] = {}
    for scenario, pair in zip(scenarios, pairs, strict=True):
        different.setdefault(pair.free.plant, (pair.free, scenario))
    free = sorted(different.values(), key=lambda each: each[1].payload_mass_kg)
    plants = tuple(prepare_margins(plant) for plant in (*(pair.contact for pair in pairs), *(f for f, _ in free)))
    return PreparedScenarios(
        problem=problem,
        scenarios=tuple(scenarios),
        pairs=pairs,
        plants=plants,
        free_of=tuple(scenario for _, scenario in free),
        target_response=_target_response(problem, [plant for plant, _ in free]),
        ports=() if problem.requirements.passivity is None else _ports([plant for plant, _ in free]),
    )


def _ports(free: Sequence[SampledPlant]) -> tuple[PreparedPort, ...]:
    """Prepare the port of every different robot and wrench filter: it does not feel the payload."""
    return tuple(prepare_port(plant) for plant in {plant.plant.port: plant for plant in free}.values())


def _target_response(problem: DesignProblem, free: Sequence[SampledPlant]) -> PlantResponse | None:
    """Return the responses of all different robots over the band that is asked: G does not hang on the payload."""
    target = problem.requirements.free_space_admittance
    if target is None:
        return None
    ports = {plant.plant.port: plant for plant in free}
    found = [plant_response(plant, band_frequencies(robot, target.band_hz)) for (robot, _), plant in ports.items()]
    if len(found) == 1:
        return found[0]
    return PlantResponse(
        frequency_rad_per_s=np.concatenate([each.frequency_rad_per_s for each in found]),
        z=np.concatenate([each.z for each in found]),
        force=np.concatenate([each.force for each in found]),
        position=np.concatenate([each.position for each in found]),
        wrench=join_wrench(found),
    )


def normalise_margins(requirements: Requirements, margins: Margins, sample_time_s: float) -> dict[str, float]:
    """Return required/achieved for every margin that is asked; ≤ 1 is met, an unlimited margin gives 0."""
    decay = decay_rate(margins.spectral_radius, sample_time_s)
    asked = {
        "modulus_margin": (requirements.modulus_margin, margins.modulus),
        "gain_margin_db": (requirements.gain_margin_db, margins.gain_db),
        "phase_margin_deg": (requirements.phase_margin_deg, margins.phase_deg),
        "delay_margin_s": (requirements.delay_margin_s, margins.delay_s),
        "decay_rate_per_s": (requirements.decay_rate_per_s, decay),
    }
    return {
        name: required / achieved if achieved > 0.0 else math.inf
        for name, (required, achieved) in asked.items()
        if required is not None
    }


def decay_rate(spectral_radius: float, sample_time_s: float) -> float:
    """Return −ln ρ/h [1/s], infinite for a deadbeat loop."""
    return -math.log(spectral_radius) / sample_time_s if spectral_radius != 0.0 else math.inf


def decay_ratios(problem: DesignProblem, radii: FloatArray) -> FloatArray:
    """Return required/achieved of the decay rate (p,) of stable loops with these spectral radii."""
    required = problem.requirements.decay_rate_per_s or 0.0
    return np.array([required / decay_rate(float(radius), problem.sample_time_s) for radius in radii])


def normalise_plant(requirements: Requirements, plant: PlantMargins, sample_time_s: float) -> dict[str, float]:
    """Return required/achieved of everything that is asked of one plant: its margins and the command's noise."""
    found, limit = normalise_margins(requirements, plant.margins, sample_time_s), requirements.command_noise
    if limit is not None and plant.speed_gain_m_s_per_n is not None:
        found["command_noise"] = limit.ratio(plant.speed_gain_m_s_per_n)
    return found


def passivity_ratios(
    target: PassivityTarget, ports: Sequence[PreparedPort], controller: AdmittanceController
) -> FloatArray:
    """Return required/achieved of the passive band (k,) for each port; infinite for one that is never passive."""
    with np.errstate(divide="ignore"):
        return target.passive_below_hz / np.array([port.passive_below_hz(controller) for port in ports])


def smallest_admittance(sampled: SampledPlant, controller: AdmittanceController, band_hz: tuple[float, float]) -> float:
    """Return min |G| [m/s/N] over the band (ends included)."""
    omega = band_frequencies(sampled.plant.robot, band_hz)
    return float(np.min(np.abs(free_space_admittance(sampled, controller, omega))))


def band_frequencies(robot: RobotModel, band_hz: tuple[float, float]) -> FloatArray:
    """Return the frequencies [rad/s] at which a band is looked at: evenly, ends included, and around dips of r(s)."""
    low, high = 2.0 * np.pi * band_hz[0], 2.0 * np.pi * band_hz[1]
    # |G| is smooth but for lightly damped zeros of the robot.
    zeros = [zero for zero in np.roots(robot.numerator) if low <= zero.imag <= high]
    dips = [zero.imag + max(abs(zero.real), 1e-4 * zero.imag) * _AROUND_A_DIP for zero in zeros]
    omega = np.concatenate([np.geomspace(low, high, _ADMITTANCE_POINTS), *dips])
    return np.unique(np.clip(omega, low, high))


def finish_evaluation(
    problem: DesignProblem,
    controller: AdmittanceController,
    radius: float,
    ratios: Mapping[str, float],
    peaks: tuple[Peak, ...],
) -> Evaluation:
    """Add the objective, and the limit on it, to an evaluation of a stable design; `ratios` are hard and soft."""
    contact, asked = problem.objective == "contact_force", problem.requirements
    peak = max(p.peak_contact_force_n if contact else p.peak_sensor_force_n for p in peaks)
    limit = asked.max_peak_force_n
    extra = {} if limit is None else {"max_peak_force_n": max(p.peak_contact_force_n for p in peaks) / limit}
    hard, soft = asked.split({**ratios, **extra})
    cost = {name: asked.cost_n(name, ratio) for name, ratio in soft.items()}
    return Evaluation(
        controller=controller,
        spectral_radius=radius,
        requirements=hard,
        peaks=peaks,
        objective_n=peak + sum(cost.values()),
        soft=soft,
        soft_cost_n=cost,
    )
