"""What one design does on one plant, and the way back to one that meets everything: what the page shows, as numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.tuning.bounds import Box, presentable
from problems.arrays import ComplexArray, FloatArray
from problems.contact.transient import ContactTransient, SampledContact, transient_from
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.evaluation import Evaluation, build_scenarios
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario
from problems.frozen import FrozenDict
from problems.model.response import PlantResponse, loop_at, plant_response, rendered_admittance
from problems.model.sampled import build_loop, spectral_radius
from problems.stability.margins import Margins, PreparedMargins, frequency_grid

from .design_map import DesignMap

_POINTS = 300
_LOWEST_HZ, _HIGHEST_HZ = 0.02, 100.0
# How long an unstable contact is followed.
_DIVERGES_S = 0.5

_STEPS = 40


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A problem and the plant that is looked at, with everything that no gain changes already computed.

    `screen` judges designs on `scenario` and on the plants around it; `own` is the place of `scenario` among those.
    """

    problem: DesignProblem
    scenario: Scenario
    screen: BatchEvaluator
    own: int

    @cached_property
    def response(self) -> PlantResponse:
        """The plant that is looked at, over the frequencies of the loops: a map may be begun before it is needed."""
        contact = self.pair.contact
        return plant_response(contact, frequency_grid(contact, _POINTS))

    @cached_property
    def band(self) -> PlantResponse:
        """The same in free space, over the frequencies of |G|."""
        highest = min(_HIGHEST_HZ, 0.45 / self.problem.sample_time_s)
        return plant_response(self.pair.free, 2.0 * np.pi * np.geomspace(_LOWEST_HZ, highest, _POINTS))

    @property
    def pair(self) -> SampledContact:
        """The plant that is looked at, sampled in contact and in free space."""
        return self.screen.prepared.pairs[self.own]

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The plants on which a design is judged."""
        return self.screen.prepared.scenarios


@dataclass(frozen=True, kw_only=True)
class View:
    """One design (n,), the values of `variables`, on one plant: forces, loops, margins, requirements.

    `admittance_m_s_per_n` (k,), |G|, at `admittance_hz`; `at_force`, `at_command` (l,) at `frequency_hz`. `radius` is
    the largest |z| of the plant that is looked at; `transient` and `margins` are None where that is unstable. `margins`
    are the smaller ones of contact and free space. `diverging` is the contact's beginning where the loop in contact is
    unstable: it has no peak. `evaluation` is over all plants on which designs are judged.
    """

    design: FloatArray
    variables: tuple[str, ...]
    scenario: Scenario
    radius: float
    transient: ContactTransient | None
    diverging: ContactTransient | None
    margins: Margins | None
    admittance_hz: FloatArray
    admittance_m_s_per_n: FloatArray
    frequency_hz: FloatArray
    at_force: ComplexArray
    at_command: ComplexArray
    evaluation: Evaluation

    @property
    def ratios(self) -> Mapping[str, float]:
        """Required/achieved of everything asked, hard and soft, worst over the plants; empty where unstable."""
        return FrozenDict({**self.evaluation.requirements, **self.evaluation.soft})

    @property
    def missed(self) -> Mapping[str, float]:
        """Required/achieved of what must be met and is not."""
        return FrozenDict({name: value for name, value in self.evaluation.requirements.items() if value > 1.0})


def prepare_view(problem: DesignProblem, scenario: Scenario, around: Sequence[Scenario]) -> PreparedView:
    """Sample the plant that is looked at and those around it.

    Of a plant that is not nominal beyond K_e and M_p the ones around are so too: the map is then that of a cell of
    which this would be true. Raises ParameterError for a plant that cannot be sampled.
    """
    further = scenario.further()
    if further:
        around = tuple(
            Scenario(
                environment_stiffness_n_per_m=each.environment_stiffness_n_per_m,
                payload_mass_kg=each.payload_mass_kg,
                **further,
            )
            for each in around
        )
    scenarios = tuple(dict.fromkeys((*around, scenario)))
    prepared = build_scenarios(problem, scenarios)
    return PreparedView(
        problem=problem,
        scenario=scenario,
        screen=build_batch_evaluator(prepared),
        own=scenarios.index(scenario),
    )


def compute_view(prepared: PreparedView, design: FloatArray) -> View:
    """Compute what a design (n,), the values of `problem.variables`, does on the prepared plants."""
    problem, pair = prepared.problem, prepared.pair
    law, h = problem.controller(design), problem.sample_time_s
    loop = loop_at(prepared.response, law, h)
    plants = _own_plants(prepared)
    radii = [spectral_radius(build_loop(plant.sampled, law)) for plant in plants]
    is_stable = max(radii) < 1.0
    margins = [plant.find(law, radius) for plant, radius in zip(plants, radii, strict=True)] if is_stable else []
    samples = max(2, round(_DIVERGES_S / h))
    return View(
        design=np.array(design),
        variables=problem.variables,
        scenario=prepared.scenario,
        radius=max(radii),
        transient=transient_from(pair, law, problem.approach) if is_stable else None,
        diverging=None if radii[0] < 1.0 else transient_from(pair, law, problem.approach, samples=samples),
        margins=_smaller(margins) if margins else None,
        admittance_hz=prepared.band.frequency_rad_per_s / (2.0 * np.pi),
        admittance_m_s_per_n=np.abs(rendered_admittance(prepared.band, law, h)),
        frequency_hz=loop.frequency_rad_per_s / (2.0 * np.pi),
        at_force=loop.at_force,
        at_command=loop.at_command,
        evaluation=prepared.screen.prepared.evaluate(design, peaks_if_missed=True),
    )


def _own_plants(prepared: PreparedView) -> tuple[PreparedMargins, PreparedMargins]:
    """Return the plant that is looked at in contact, and in free space."""
    found = prepared.screen.prepared
    free = prepared.pair.free.plant
    in_free_space = next(each for each in found.plants[len(found.pairs) :] if each.sampled.plant == free)
    return found.plants[prepared.own], in_free_space


def _smaller(margins: Sequence[Margins]) -> Margins:
    worst = min(margins, key=lambda each: each.modulus)
    return replace(
        worst,
        disk=min(each.disk for each in margins),
        gain_db=min(each.gain_db for each in margins),
        phase_deg=min(each.phase_deg for each in margins),
        delay_s=min(each.delay_s for each in margins),
        spectral_radius=max(each.spectral_radius for each in margins),
    )


@dataclass(frozen=True, kw_only=True)
class WayBack:
    """A design (n,) that meets every requirement on the plants of the view, and `found`, where it was found."""

    design: FloatArray
    found: str


def find_way_back(
    prepared: PreparedView, design: FloatArray, start: FloatArray, around: DesignMap | None
) -> WayBack | None:
    """Return the feasible design nearest to `design` (n,), None where neither the line nor the map has one.

    Sought on the straight line to `start` (n,), in the bounds as a unit cube, and among the middles of the cells of
    `around`. Nearest by the distance in that cube.
    """
    box, problem = Box(prepared.problem), prepared.problem
    here, there = box.unit(design), box.unit(start)
    shares = np.linspace(0.0, 1.0, _STEPS + 1)[1:]
    found = [(here + share * (there - here), f"{share:.0%} of the way to the start") for share in shares]
    if around is not None:
        found += [(box.unit(each), "the nearest feasible cell of the map") for each in _cells(prepared, design, around)]
    for unit, where in sorted(found, key=lambda each: float(np.linalg.norm(each[0] - here))):
        candidate = presentable(problem, box.design(unit))
        if prepared.screen.prepared.evaluate(candidate).is_feasible:
            return WayBack(design=candidate, found=where)
    return None


def _cells(prepared: PreparedView, design: FloatArray, around: DesignMap) -> list[FloatArray]:
    """Return the designs at the middles of the feasible cells."""
    window, names = around.window, prepared.problem.variables
    x, y = np.meshgrid(window.x_values(), window.y_values())
    cells = []
    for at_x, at_y in zip(x[around.is_feasible], y[around.is_feasible], strict=True):
        cell = np.array(design)
        cell[names.index(window.x)], cell[names.index(window.y)] = at_x, at_y
        cells.append(cell)
    return cells
