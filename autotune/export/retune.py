"""Find the best that another controller's structure can do: the least worst peak force with the same requirements.

Few numbers are free, so the whole box is looked at: a grid, then ever finer grids around its best point. A design is
judged quickly, on some plants and frequencies; the certificate (`autotune.validation.law`) decides, and what it finds
worse joins the plants.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.certificate_record import Requirement
from autotune.formats.controller_record import AxisGains
from autotune.plugins import find_requirement
from autotune.validation.law import AxisTask, LawCertificate, certify_law
from autotune.validation.validation_samples import scenario_of
from problems.arrays import FloatArray
from problems.contact.linear_controller_contact import simulate_linear_contact
from problems.contact.transient import SampledContact, build_sampled_contact
from problems.design.requirements import AdmittanceTarget, DecayRate, LoopRequirement, Margin, PassivityTarget
from problems.design.uncertainty import Scenario
from problems.errors import AutotuneError
from problems.model.linear_controllers import LinearController
from problems.model.plant import FREE_SPACE
from problems.model.response import PlantResponse, loop_at, plant_response, rendered_admittance
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from problems.model.third_party_controllers import alternates
from problems.stability.margins import frequency_grid, margins_on_grid
from problems.stability.passivity import passive_below_hz

Values = tuple[float, ...]

_FIRST_GRID, _FINER_GRID, _LEVELS = 13, 5, 9
_ROUNDS = 5
_GRID_POINTS = 300
_BAND_POINTS = 9
_CORNER_POINTS = 3
_MOST_FURTHER = 6
# Coarse frequencies flatter a margin by less than this.
_RESERVE = 0.004
_MISSED, _UNSTABLE = 1e9, 1e15


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A free number of a structure and its bounds; a search goes by equal ratios, or by equal steps without `ratio`."""

    name: str
    low: float
    high: float
    ratio: bool = True
    unit: str = ""


class ControllerStructure(Protocol):
    """One axis of another controller, a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def task(self) -> AxisTask:
        """What the axis was certified for."""

    @property
    def variables(self) -> tuple[Variable, ...]:
        """What a search may choose."""

    @property
    def translated(self) -> Values:
        """The numbers that come nearest to the gains of the file."""

    def written(self, values: Values) -> Mapping[str, float]:
        """Return the axis' numbers as they are written into the file, in its own terms."""

    def law(self, values: Values) -> LinearController:
        """Return the law that runs with the numbers as they are written."""

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains the structure cannot express."""

    def notes(self, values: Values) -> Iterator[str]:
        """Say what the numbers mean for who runs them."""


def lost_gains(task: AxisTask, gains: AxisGains, expressed: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Say which gains of an axis have no place in a structure that expresses but the named ones beside M_a and B_a."""
    known = {
        "lead_s": ("lead K_l", 1e3 * gains.lead_s, "ms"),
        "feedback_damping_s": ("feedback damping B_fb", 1e3 * gains.feedback_damping_s, "ms"),
        "deadband": ("deadband", gains.deadband, "N·m" if task.axis.startswith("r") else "N"),
    }
    return tuple(
        f"axis {task.axis}: {what} = {value:g} {unit}"
        for name, (what, value, unit) in known.items()
        if name not in expressed and value != 0.0
    )


class QuickJudge:
    """The plants of a search, prepared once; `cost` is what is minimised.

    With a `goal`, that is required/achieved of this requirement, all others being met. `missed` holds required/achieved
    by name of the last law that missed something.
    """

    def __init__(
        self, task: AxisTask, scenarios: tuple[Scenario, ...], reserve: float, goal: str | None = None
    ) -> None:
        self.task, self.reserve, self.goal, h = task, reserve, goal, task.sample_time_s
        self.missed: dict[str, float] = {}
        nominal = task.domain.plants.nominal
        contacts = [build_sampled_plant(each.plant(nominal), h) for each in scenarios]
        # What a payload touches does not matter in free space.
        free = dict.fromkeys(each.plant.in_contact_with(FREE_SPACE) for each in contacts)
        self.pairs: list[SampledContact] = [build_sampled_contact(each) for each in contacts]
        self.plants: list[SampledPlant] = [*(build_sampled_plant(each, h) for each in free), *contacts]
        self.omega = np.unique(np.concatenate([frequency_grid(each, _GRID_POINTS) for each in self.plants]))
        seen = [plant_response(each, self.omega) for each in self.plants]
        self.seen = PlantResponse(
            frequency_rad_per_s=self.omega,
            z=seen[0].z,
            force=np.array([each.force for each in seen]),
            position=np.array([each.position for each in seen]),
        )
        self.bands = {
            name: [plant_response(robot, _band(each)) for robot in self.plants[: len(free)]]
            for name, each in task.asked.items()
            if isinstance(each, AdmittanceTarget)
        }

    def cost(self, law: LinearController) -> float:
        """Return the worst peak contact force [N], or far more for a law that misses something or is unstable."""
        if alternates(law):
            return math.inf
        radii = []
        for plant in self.plants:
            radii.append(spectral_radius(build_loop(plant, law)))
            if not radii[-1] < 1.0:
                return _UNSTABLE * min(radii[-1], 1e3)
        # A spring's return in free space is no decay that is asked for.
        free = len(self.plants) - len(self.pairs)
        found = self.ratios(law, max(radii[free if law.holds_position else 0 :]))
        sought = found.pop(self.goal, 1.0) if self.goal is not None else 1.0
        missed = max(found.values(), default=0.0)
        if missed > 1.0:
            self.missed = {name: ratio for name, ratio in found.items() if ratio > 1.0}
            return _MISSED * min(missed, 1e3)
        approach, limit = self.task.approach(), self.task.asked.get("max_peak_force_n")
        peak = max(simulate_linear_contact(pair, law, approach).peak_contact_force_n for pair in self.pairs)
        if isinstance(limit, float) and peak > limit:
            self.missed = {"max_peak_force_n": peak / limit}
            return _MISSED * peak / limit
        return peak if self.goal is None else sought

    def ratios(self, law: LinearController, radius: float) -> dict[str, float]:
        """Return required/achieved by name of a stable law whose largest |z| in contact is `radius`; no peak yet."""
        h, names = law.sample_time_s, self.task.asked
        response = loop_at(self.seen, law, h)
        both = np.concatenate([response.at_force, response.at_command])
        if not np.all(np.isfinite(both)):
            return dict.fromkeys(names, math.inf)
        margins = margins_on_grid(self.omega, both)
        found = {}
        for name, asked in names.items():
            requirement = find_requirement(name)
            if isinstance(requirement, Margin) and isinstance(asked, int | float):
                reached = float(np.min(getattr(margins, requirement.margin)))
                found[name] = (1.0 + self.reserve) * float(asked) / max(reached, 1e-12)
            elif isinstance(asked, AdmittanceTarget):
                least = min(float(np.min(np.abs(rendered_admittance(each, law, h)))) for each in self.bands[name])
                found[name] = (1.0 + 0.1 * self.reserve) * asked.min_m_s_per_n / max(least, 1e-300)
            else:
                found[name] = self._other_ratio(name, asked, law, radius)
        return found

    def _other_ratio(self, name: str, asked: Requirement, law: LinearController, radius: float) -> float:
        """Return required/achieved of what is asked rarely; 0 for what no loop and no robot says."""
        requirement = find_requirement(name)
        if isinstance(requirement, DecayRate) and isinstance(asked, float):
            return asked * law.sample_time_s / max(-math.log(radius), 1e-300) if radius > 0.0 else 0.0
        if isinstance(requirement, LoopRequirement):
            found = (requirement.ratio(asked, requirement.verified(asked, plant, law)) for plant in self.plants)
            return (1.0 + self.reserve) * max(found)
        if isinstance(asked, PassivityTarget):
            return asked.passive_below_hz / max(passive_below_hz(self.plants[0], law), 1e-300)
        return 0.0


def _band(asked: AdmittanceTarget) -> FloatArray:
    low, high = asked.band_hz
    return 2.0 * np.pi * np.unique(np.clip(np.geomspace(low, high, _BAND_POINTS), low, high))


def retune(task: AxisTask, structure: ControllerStructure) -> tuple[Values, LawCertificate]:
    """Return the numbers of least worst peak force whose certificate holds, and that certificate.

    Deterministic. Raises InfeasibleError where the structure has nothing that meets the requirements, CertificateError
    where what it has cannot be proved.
    """
    scenarios, reserve = _first_scenarios(task), _RESERVE
    for _ in range(_ROUNDS):
        judge = QuickJudge(task, scenarios, reserve)
        values, cost = _zoom(structure, judge)
        if cost >= _MISSED:
            raise InfeasibleError(_nearest(structure, judge, values))
        certificate = certify_law(task, structure.law(values))
        if certificate.holds:
            return values, certificate
        if certificate.is_unproved:
            raise CertificateError(
                f"Axis {task.axis}: the numbers that were tuned for that controller cannot be proved stable over the "
                "whole domain, though no unstable plant was found; narrower ranges can be."
            )
        scenarios, reserve = _joined(task, scenarios, certificate), 2.0 * reserve
    raise InfeasibleError(
        f"within {_ROUNDS} rounds nothing was found whose certificate holds; the last one: {certificate.missed[0]}"
    )


def nearest_design(structure: ControllerStructure, goal: str | None = None) -> dict[str, float] | None:
    """Return required/achieved of what the nearest design misses; of `goal` alone, where one is given.

    The largest of the ratios is the least there is, or that of the goal where all others are met. None where nothing is
    stable, or the others cannot be met.
    """
    judge = QuickJudge(structure.task, _first_scenarios(structure.task), _RESERVE, goal)
    values, cost = _zoom(structure, judge)
    if cost >= (_MISSED if goal is not None else _UNSTABLE):
        return None
    if goal is not None:
        return {goal: cost}
    judge.cost(structure.law(values))
    return dict(judge.missed)


def _first_scenarios(task: AxisTask) -> tuple[Scenario, ...]:
    low, high = task.domain.environment_stiffness_n_per_m
    grid = itertools.product(
        sorted(set(task.domain.payload_mass_kg)),
        sorted({float(k) for k in np.clip(np.geomspace(low, high, _CORNER_POINTS), low, high)}),
    )
    corners = (Scenario(environment_stiffness_n_per_m=k, payload_mass_kg=m) for m, k in grid)
    return tuple(dict.fromkeys((*corners, *task.others().scenarios[:_MOST_FURTHER])))


def _joined(task: AxisTask, scenarios: tuple[Scenario, ...], found: LawCertificate) -> tuple[Scenario, ...]:
    """Add the plants at which a certificate was worst."""
    worst = {} if found.margins is None else found.margins.worst
    more = [scenario_of(plant, task.domain.plants) for plant in worst.values()]
    if found.worst is not None:
        more.append(found.worst.scenario())
    return tuple(dict.fromkeys((*scenarios, *more, *task.others().scenarios)))


def _zoom(structure: ControllerStructure, judge: QuickJudge) -> tuple[Values, float]:
    """Search the box, then ever smaller boxes around the best point so far."""
    box = structure.variables
    free = [each for each in box if each.high > each.low]

    def cost(unit: tuple[float, ...]) -> float:
        try:
            return judge.cost(structure.law(_values(structure, unit)))
        except AutotuneError:
            return math.inf

    def best_of(centre: tuple[float, ...], width: float, count: int, known: float) -> tuple[tuple[float, ...], float]:
        offsets = np.linspace(-width, width, count)
        points = itertools.product(*(np.unique(np.clip(c + offsets, 0.0, 1.0)).tolist() for c in centre))
        found = min(((cost(point), point) for point in points), key=lambda each: each[0])
        return (found[1], found[0]) if found[0] < known else (centre, known)

    unit = _unit(structure)
    value = cost(unit)
    unit, value = best_of(unit, 1.0, 2 * _FIRST_GRID - 1, value)
    width = 1.0 / (_FIRST_GRID - 1)
    for _ in range(_LEVELS if free else 0):
        unit, value = best_of(unit, width, _FINER_GRID, value)
        width *= 0.5
    return _values(structure, unit), value


def _values(structure: ControllerStructure, unit: tuple[float, ...]) -> Values:
    """Return the numbers of a point of the unit cube, which has a side per number that is free."""
    left = iter(unit)
    found = []
    for each in structure.variables:
        if not each.high > each.low:
            found.append(each.low)
            continue
        share = next(left)
        if share in (0.0, 1.0):
            found.append(each.low if share == 0.0 else each.high)
        elif each.ratio:
            found.append(each.low * (each.high / each.low) ** share)
        else:
            found.append(each.low + share * (each.high - each.low))
    return tuple(found)


def _unit(structure: ControllerStructure) -> tuple[float, ...]:
    """Return the translated numbers as a point of the unit cube."""
    found = []
    for each, value in zip(structure.variables, structure.translated, strict=True):
        if each.high > each.low:
            way: Callable[[float], float] = math.log if each.ratio else float
            share = (way(min(max(value, each.low), each.high)) - way(each.low)) / (way(each.high) - way(each.low))
            found.append(min(max(share, 0.0), 1.0))
    return tuple(found)


def _nearest(structure: ControllerStructure, judge: QuickJudge, values: Values) -> str:
    """Say how near the best that was found came."""
    numbers = ", ".join(f"{name} {value:.4g}" for name, value in structure.written(values).items())
    if judge.cost(structure.law(values)) >= _UNSTABLE:
        return f"no numbers were found that make a stable loop over the whole domain (the last ones: {numbers})"
    each = ", ".join(f"{name} by {100.0 * (ratio - 1.0):.3g} %" for name, ratio in judge.missed.items())
    return f"no numbers were found that meet the requirements (the nearest that was found: {numbers}; it misses {each})"
