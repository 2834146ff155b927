"""What a file gives to explore: a design problem per axis, a design to start from, and what a saved file must carry."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller import ControllerFile, read_controller
from autotune.formats.controller_record import AxisGains, Controller, RuntimePayload, admittance_controller, is_linear
from autotune.formats.kinds import unknown_file
from autotune.formats.plant_file import read_plant
from autotune.formats.problem import ProblemSpec, read_problem
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.schema import head_of
from autotune.formats.units import ROTATIONAL_AXES
from autotune.formats.yaml12 import kind_of_file
from autotune.prediction.as_run_by import designed_for, own_law_notes
from autotune.tuning.bounds import Box
from autotune.tuning.compare import start_design
from autotune.tuning.coupled import TogetherAsked
from autotune.tuning.noise_limit import find_noise_spectrum
from autotune.tuning.optimize import carried_payload
from autotune.tuning.problems import build_problems, within_domain
from autotune.tuning.provenance import make_provenance
from autotune.tuning.search import SearchResult, solve_design
from autotune.tuning.strategies import StrategySettings, strategy_settings
from autotune.validation.axis_proof import ProofOptions
from autotune.validation.certified_requirements import certified_problem_requirements
from autotune.version import __version__
from problems.arrays import FloatArray
from problems.design.evaluation import build_scenarios
from problems.design.objectives import force_of
from problems.design.problem import (
    CONTROLLER_VARIABLES,
    DEFAULT_BOUNDS,
    FURTHER_VARIABLES,
    VARIABLES,
    DesignProblem,
    biquad_bounds,
)
from problems.design.requirements import Requirements
from problems.design.uncertainty import Scenario
from problems.frozen import freeze
from problems.model.controller import AdmittanceController
from problems.progress import Progress, no_progress
from problems.stability.noise_spectrum import RelativeSpectrum

_GRID = (3, 2)
_MOST_TIGHT, _MOST_HARD = 3, 1
# Bounds of the gains about a rotational axis, as a factor on those of the file.
# The slowest corner of a biquad that a slider reaches.
_SLOWEST_RAD_PER_S = 12.0
_GAIN_FACTOR = 10.0
ASKED_BY_HAND = "asked_by_hand"
"""The option of a provenance that says which requirements were set in the page, as lines of `problem.yaml`."""


@dataclass(frozen=True, kw_only=True)
class AxisStart:
    """One axis: its problem, the design (n,) to start from, and the plants that designs are judged on while exploring.

    `note` says why the start is not the best design, where it is not; `noise_spectrum` is that of the sensor's noise
    where the log shows that it is not white.
    """

    problem: DesignProblem
    design: FloatArray
    scenarios: tuple[Scenario, ...]
    note: str = ""
    noise_spectrum: RelativeSpectrum | None = None

    def __post_init__(self) -> None:
        design = np.array(self.design, dtype=np.float64)
        design.setflags(write=False)
        object.__setattr__(self, "design", design)


@dataclass(frozen=True, kw_only=True)
class Exploration:
    """All axes of a file, by name, and what a controller that is saved takes over: `payload`, `provenance`, `gains`.

    `gains` are those of an explored controller, of which the deadband is kept; `strategies` asks for what is chosen
    for the gains that are saved, and `together` says on which payload all axes are checked, None where none is known.
    """

    path: Path
    axes: Mapping[str, AxisStart]
    payload: RuntimePayload
    provenance: Mapping[str, Any]
    gains: Mapping[str, AxisGains] = field(default_factory=dict)
    strategies: StrategySettings | None = None
    together: TogetherAsked | None = None

    def __post_init__(self) -> None:
        freeze(self, "axes", "provenance", "gains")


def read_exploration(path: Path, problem: Path | None = None, progress: Progress | None = None) -> Exploration:
    """Read `identified.yaml`, or `controller.yaml` with the plant and the requirements of its certificate.

    An identified plant starts at the best design, which is searched; where there is none, in the middle of the bounds.
    `progress` receives the share of the work done since the last call. Raises UsageError for another file, or a problem
    beside a controller; what `optimize` raises for a plant that cannot be tuned; CertificateError for an altered
    controller.
    """
    kind = kind_of_file(path)
    if kind in {"identified", "plant"}:
        return _from_identified(path, problem, progress or no_progress)
    if kind != "controller":
        raise unknown_file(
            path,
            f"{path} is neither a plant nor a controller; give what identify or optimize wrote, or a plant.yaml.",
            without_format=f" A plant.yaml begins with {head_of('plant')}.",
        )
    if problem is not None:
        raise UsageError(f"{path} contains its requirements; use --problem with an identified plant.")
    return _from_controller(read_controller(path))


def _from_identified(path: Path, problem_path: Path | None, progress: Progress) -> Exploration:
    identified = read_plant(path)
    spec = within_domain(ProblemSpec() if problem_path is None else read_problem(problem_path), identified.domain)
    problems = build_problems(identified.result, spec)
    payload = carried_payload(identified.result, problems, spec)
    provenance = make_provenance(identified, problems, spec, 0, problem_path, None, ProofOptions())
    return Exploration(
        path=path,
        axes={
            name: replace(
                _searched(each, lambda done: progress(done / len(problems))),
                noise_spectrum=find_noise_spectrum(identified.result, name),
            )
            for name, each in problems.items()
        },
        payload=payload,
        provenance=_by_hand(provenance),
        strategies=strategy_settings(identified.result, spec),
        together=TogetherAsked.of(identified.result, spec),
    )


def with_requirements(exploration: Exploration, asked: Mapping[str, Requirements]) -> Exploration:
    """Return the same with other requirements of each axis; the provenance says what is asked otherwise by hand."""
    axes = {
        name: replace(start, problem=replace(start.problem, requirements=asked[name]))
        for name, start in exploration.axes.items()
        if asked[name] != start.problem.requirements
    }
    if not axes:
        return exploration
    tree: dict[str, Any] = {}
    for name, start in axes.items():
        changed = _changed(exploration.axes[name].problem.requirements, start.problem.requirements)
        renamed = rename_axis_keys(name, {"requirements": changed}, reading=False)
        tree |= {"rotational": renamed} if name in ROTATIONAL_AXES else renamed
    options = {**exploration.provenance.get("options", {}), ASKED_BY_HAND: tree}
    return replace(
        exploration, axes={**exploration.axes, **axes}, provenance={**exploration.provenance, "options": options}
    )


def _changed(before: Requirements, now: Requirements) -> dict[str, Any]:
    """Return what is asked otherwise than before, as `problem.yaml` has it."""
    old, changed = before.asked(), {}
    for name, value in now.asked().items():
        if value != old.get(name):
            tree = record_tree(value, name)
            if name in now.soft_n:
                tree = {**(tree if isinstance(tree, dict) else {"value": tree}), "soft_n": now.soft_n[name]}
            changed[name] = tree
    return changed


def _by_hand(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return a provenance that says that nobody searched these gains."""
    return {**provenance, "options": {**provenance["options"], "gains": "chosen by hand in autotune explore"}}


def _searched(problem: DesignProblem, progress: Progress) -> AxisStart:
    grid = problem.scenarios(*_GRID)
    # Whatever is searched, the page shows a peak force.
    shown = replace(problem, objective=force_of(problem.objective))
    try:
        found = solve_design(problem, progress=progress)
    except InfeasibleError as error:
        middle = Box(problem).design(np.full(len(problem.variables), 0.5))
        return AxisStart(problem=shown, design=middle, scenarios=grid, note=str(error))
    # What the search found worst belongs to what is looked at, or designs that fail there would look good.
    return AxisStart(problem=shown, design=found.design, scenarios=tuple(dict.fromkeys((*grid, *worst_few(found)))))


def worst_few(found: SearchResult) -> list[Scenario]:
    """Return the plants beyond K_e and M_p that hold the best design back most; few, for each costs time at a turn."""
    further = [each for each in found.active.scenarios if each.further()]
    judged = [build_scenarios(found.problem, [each]).evaluate(found.design, peaks_if_missed=True) for each in further]
    tight = sorted(zip(judged, further, strict=True), key=lambda pair: -max(pair[0].requirements.values(), default=0.0))
    hard = sorted(zip(judged, further, strict=True), key=lambda pair: -pair[0].cost)
    return [each for _, each in (*tight[:_MOST_TIGHT], *hard[:_MOST_HARD])]


def _from_controller(read: ControllerFile) -> Exploration:
    controller = read.controller
    axes = {}
    for name in controller.axes:
        problem = problem_of(controller, name)
        design = start_design(admittance_controller(controller, name), problem)
        if design is None:
            raise UsageError(f"{read.path}: the gains of axis {name} cannot be led from where they are.")
        further = (each.scenario() for each in controller.predicted[name].scenarios if each.further)
        seen = tuple(dict.fromkeys((*problem.scenarios(*_GRID), *further)))
        axes[name] = AxisStart(problem=problem, design=design, scenarios=seen, note=_dropped(controller))
    before = {"path": str(read.path), "checksum": read.checksum}
    coupled = controller.certificate.coupled
    origin = {"identified": controller.provenance["identified"]} if "identified" in controller.provenance else {}
    return Exploration(
        path=read.path,
        axes=axes,
        payload=controller.payload,
        provenance=_by_hand({"tool": f"autotune {__version__}", **origin, "options": {"controller": before}}),
        gains=controller.axes,
        together=None if coupled is None else TogetherAsked(body=coupled.body, least_modulus=coupled.min_modulus),
    )


def _dropped(controller: Controller) -> str:
    if designed_for(controller):
        return " ".join(f"{each[0].upper()}{each[1:]}." for each in own_law_notes(controller))
    if is_linear(controller):
        return ""
    return "Collision response and variable damping of the file were chosen for its gains; what is saved here has none."


def problem_of(controller: Controller, name: str) -> DesignProblem:
    """Return the design problem whose answer a certificate is: its plants, approach and requirements.

    The bounds are the usual ones, widened to the gains of the file; filters and compensation stay as they are.
    """
    domain, law = controller.certificate.domain[name], admittance_controller(controller, name)
    return DesignProblem(
        plants=domain.plants,
        sample_time_s=controller.sample_time_s,
        approach=domain.approach,
        bounds=_bounds(law, name, controller.sample_time_s, reads_position=not is_late(domain)),
        requirements=certified_problem_requirements(controller, name),
        velocity_filter_rad_per_s=law.velocity_filter_rad_per_s,
    )


def is_late(domain: AxisDomain) -> bool:
    """Whether the wrench comes with a pure delay, beside which nothing may read the position."""
    return domain.plants.range_of("wrench_delay_s")[1] > 0.0


def _bounds(
    law: AdmittanceController, name: str, sample_time_s: float, *, reads_position: bool
) -> dict[str, tuple[float, float]]:
    values = dict(zip(CONTROLLER_VARIABLES, law.numbers(), strict=False))
    bounds = {}
    for key in VARIABLES:
        low, high = DEFAULT_BOUNDS[key]
        if name in ROTATIONAL_AXES and key in {"mass", "damping"}:
            low, high = values[key] / _GAIN_FACTOR, values[key] * _GAIN_FACTOR
        bounds[key] = min(low, values[key]), max(high, values[key])
    if not reads_position:
        bounds["feedback_damping_s"] = (0.0, 0.0)
    if law.compensates:
        bounds |= {key: (values[key], values[key]) for key in FURTHER_VARIABLES}
    if law.has_biquad:
        usual = biquad_bounds(sample_time_s, _SLOWEST_RAD_PER_S)
        bounds |= {key: (min(low, values[key]), max(high, values[key])) for key, (low, high) in usual.items()}
    return bounds


def keep_deadband(exploration: Exploration, controller: Controller) -> Controller:
    """Return a controller with the deadbands of the one that was explored, which no certificate speaks of."""
    axes = {
        name: replace(gains, deadband=old.deadband, deadband_type=old.deadband_type)
        if (old := exploration.gains.get(name)) is not None
        else gains
        for name, gains in controller.axes.items()
    }
    return replace(controller, axes=axes)
