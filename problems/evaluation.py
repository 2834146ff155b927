"""Evaluate a design over a set of scenarios: stability first, then every requirement as a number that must be ≤ 1."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contact import SampledContact, build_sampled_contact, transient_from
from .controller import AdmittanceController
from .design import DesignProblem, Requirements, Scenario
from .margins import Margins, RawMargins, find_margins, margins_on_grid
from .response import PlantResponse, controller_response, free_space_admittance, plant_response, rendered_admittance
from .sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_SCREENING_POINTS = 500
_SCREENING_LOWEST_HZ = 0.2
_ADMITTANCE_POINTS = 40


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
    asked for all the same.
    """

    controller: AdmittanceController
    spectral_radius: float
    requirements: Mapping[str, float]
    peaks: tuple[Peak, ...]
    objective_n: float

    @property
    def is_stable(self) -> bool:
        """Whether every scenario is stable in contact and in free space."""
        return self.spectral_radius < 1.0

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
class PreparedScenarios:
    """Scenarios with everything that does not depend on the design already computed."""

    problem: DesignProblem
    scenarios: tuple[Scenario, ...]
    pairs: tuple[SampledContact, ...]
    free: tuple[SampledPlant, ...]
    frequency_rad_per_s: FloatArray
    z: ComplexArray
    force: ComplexArray
    position: ComplexArray
    target_response: PlantResponse | None

    def evaluate(self, design: Sequence[float] | FloatArray, *, peaks_if_missed: bool = False) -> Evaluation:
        """Evaluate the design vector (M_a, B_a, K_l, B_fb) over the scenarios on a fixed frequency grid.

        `peaks_if_missed` asks for the peaks of a stable design that misses a requirement as well (a solver that walks
        along the boundary needs them).
        """
        controller = self.problem.controller(design)
        radius = self._radius(controller)
        if not radius < 1.0:
            return Evaluation(
                controller=controller, spectral_radius=radius, requirements={}, peaks=(), objective_n=math.inf
            )
        requirements = self._requirements(controller, radius)
        if not peaks_if_missed and any(value > 1.0 for value in requirements.values()):
            return Evaluation(
                controller=controller, spectral_radius=radius, requirements=requirements, peaks=(), objective_n=math.inf
            )
        peaks = self.peaks(controller)
        return finish_evaluation(self.problem, controller, radius, requirements, peaks)

    def _radius(self, controller: AdmittanceController) -> float:
        return max(
            spectral_radius(build_loop(plant, controller))
            for plant in (*(pair.contact for pair in self.pairs), *self.free)
        )

    def _requirements(self, controller: AdmittanceController, radius: float) -> dict[str, float]:
        forward, feedback = controller_response(controller, self.z, self.problem.sample_time_s)
        damped = feedback * self.position
        at_force = -self.force * forward / (1.0 + damped)
        at_command = damped - self.force * forward
        both = margins_on_grid(self.frequency_rad_per_s, np.concatenate([at_force, at_command]))
        worst = RawMargins(*(np.asarray(np.min(values)) for values in both))
        return normalise_margins(
            self.problem.requirements,
            Margins(
                modulus=float(worst.modulus),
                modulus_hz=math.nan,
                gain_db=float(worst.gain_db),
                phase_deg=float(worst.phase_deg),
                delay_s=float(worst.delay_s),
                spectral_radius=radius,
            ),
            self.problem.sample_time_s,
        ) | self.achieved_admittance(controller)

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
    """Sample every scenario's plant, and the free-space plant of every payload mass, once."""
    h = problem.sample_time_s
    pairs = tuple(build_sampled_contact(build_sampled_plant(problem.plant(s), h)) for s in scenarios)
    by_mass = {s.payload_mass_kg: pair.free for s, pair in zip(scenarios, pairs, strict=True)}
    free = tuple(by_mass[mass] for mass in sorted(by_mass))
    grid = np.geomspace(2.0 * np.pi * _SCREENING_LOWEST_HZ, np.pi / h, _SCREENING_POINTS)
    target = problem.requirements.free_space_admittance
    responses = [plant_response(plant, grid) for plant in (*(pair.contact for pair in pairs), *free)]
    return PreparedScenarios(
        problem=problem,
        scenarios=tuple(scenarios),
        pairs=pairs,
        free=free,
        frequency_rad_per_s=grid,
        z=responses[0].z,
        force=np.array([r.force for r in responses]),
        position=np.array([r.position for r in responses]),
        target_response=None if target is None else plant_response(free[0], band_frequencies(target.band_hz)),
    )


def normalise_margins(requirements: Requirements, margins: Margins, sample_time_s: float) -> dict[str, float]:
    """Return required/achieved for every margin that is asked; ≤ 1 is met, an unlimited margin gives 0."""
    decay = -math.log(margins.spectral_radius) / sample_time_s if margins.spectral_radius > 0.0 else math.inf
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


def smallest_admittance(sampled: SampledPlant, controller: AdmittanceController, band_hz: tuple[float, float]) -> float:
    """Return min |G| [m/s/N] over the band (ends included)."""
    return float(np.min(np.abs(free_space_admittance(sampled, controller, band_frequencies(band_hz)))))


def band_frequencies(band_hz: tuple[float, float]) -> FloatArray:
    """Return the frequencies [rad/s] at which a band is looked at, ends included."""
    return np.asarray(2.0 * np.pi * np.geomspace(band_hz[0], band_hz[1], _ADMITTANCE_POINTS))


def finish_evaluation(
    problem: DesignProblem,
    controller: AdmittanceController,
    radius: float,
    requirements: Mapping[str, float],
    peaks: tuple[Peak, ...],
) -> Evaluation:
    """Add the objective, and the limit on it, to an evaluation of a stable design."""
    contact = problem.objective == "contact_force"
    objective = max(p.peak_contact_force_n if contact else p.peak_sensor_force_n for p in peaks)
    limit = problem.requirements.max_peak_force_n
    extra = {} if limit is None else {"max_peak_force_n": max(p.peak_contact_force_n for p in peaks) / limit}
    return Evaluation(
        controller=controller,
        spectral_radius=radius,
        requirements={**requirements, **extra},
        peaks=peaks,
        objective_n=objective,
    )


@dataclass(frozen=True, kw_only=True)
class PlantMargins:
    """The margins of one plant of the uncertainty; stiffness 0 is free space."""

    payload_mass_kg: float
    environment_stiffness_n_per_m: float
    margins: Margins


@dataclass(frozen=True, kw_only=True)
class ExactEvaluation:
    """An evaluation with margins refined around every minimum, and those margins plant by plant."""

    evaluation: Evaluation
    margins: tuple[PlantMargins, ...]


def evaluate_exactly(prepared: PreparedScenarios, controller: AdmittanceController) -> ExactEvaluation:
    """Evaluate a stable design with margins refined around every minimum, scenario by scenario.

    Raises UnstableLoopError when any scenario is unstable.
    """
    problem = prepared.problem
    plants = [*(pair.contact for pair in prepared.pairs), *prepared.free]
    found = tuple(
        PlantMargins(
            payload_mass_kg=sampled.plant.payload.mass_kg,
            environment_stiffness_n_per_m=sampled.plant.environment.stiffness_n_per_m,
            margins=find_margins(sampled, controller),
        )
        for sampled in plants
    )
    values = [normalise_margins(problem.requirements, f.margins, problem.sample_time_s) for f in found]
    requirements = {name: max(value[name] for value in values) for name in values[0]}
    requirements |= prepared.achieved_admittance(controller)
    radius = max(f.margins.spectral_radius for f in found)
    evaluation = finish_evaluation(problem, controller, radius, requirements, prepared.peaks(controller))
    return ExactEvaluation(evaluation=evaluation, margins=found)
