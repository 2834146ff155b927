"""A cell, its design problems and their solutions that several tests share, each solved once."""

import functools
import hashlib
import importlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile, read_identified, write_identified
from autotune.formats.problem import ProblemSpec
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.search import SearchResult, solve_design
from autotune.validation.axis_proof import ProofOptions
from identification.result import (
    AxisEstimate,
    CouplingEstimate,
    EnvironmentEstimate,
    Estimate,
    Identified,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
    VectorEstimate,
)
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from problems.design.uncertainty import PlantSet
from problems.model.robot import RobotModel

STIFFNESS = (8e4, 1.6e5)
MASS = (15.5, 16.5)
# A corner of the default bounds that holds the default optimum; less room makes for a shorter search.
ROOM: Mapping[str, tuple[float, float]] = {
    "mass": (5.0, 8.0),
    "damping": (900.0, 1600.0),
    "lead_s": (0.01, 0.03),
    "feedback_damping_s": (0.0, 0.02),
}
# A band that starts at 1 Hz is measured in a tenth of the simulated time that 0.1 Hz needs.
FAST_REQUIREMENTS = Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=6.5e-4, band_hz=(1.0, 2.0)))
BARE_SPEC = ProblemSpec(
    bounds={**ROOM, "mass": (6.0, 6.0), "feedback_damping_s": (0.005, 0.005)}, requirements=FAST_REQUIREMENTS
)
FAST_SPEC = BARE_SPEC.with_options(payload_mass=(16.0, 16.0), environment_stiffness=(1e5, 1.2e5))


def design_problem(
    *,
    bounds: Mapping[str, tuple[float, float]] = ROOM,
    requirements: Requirements | None = None,
    mass: tuple[float, float] = MASS,
    stiffness: tuple[float, float] = STIFFNESS,
) -> DesignProblem:
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
            coupling_stiffness_n_per_m=3e5,
            coupling_damping_n_s_per_m=150.0,
            drag_n_s_per_m=330.0,
            environment_stiffness_n_per_m=stiffness,
            payload_mass_kg=mass,
        ),
        sample_time_s=8e-4,
        bounds=bounds,
        requirements=requirements if requirements is not None else Requirements(),
    )


@cache
def solved() -> SearchResult:
    """The problem over two ranges, solved."""
    return solve_design(design_problem())


def known(value: float, std: float | None = None) -> Estimate:
    return Estimate(value=value, std=std, status=Status.IDENTIFIED, method="by hand")


def absent(note: str = "") -> Estimate:
    return Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE, note=note)


def known_vector(*values: float) -> VectorEstimate:
    return VectorEstimate(value=values, std=tuple(1e-3 for _ in values), status=Status.IDENTIFIED, method="by hand")


def identified_axis() -> AxisEstimate:
    surface = EnvironmentEstimate(
        name="x1",
        stiffness_n_per_m=known(1.1e5, 500.0),
        secant_stiffness_n_per_m=known(8.05e4, 300.0),
        damping_n_s_per_m=known(20.0, 10.0),
        mass_kg=absent(),
        contacts=3,
        peak_force_n=(60.0, 61.0, 60.5),
    )
    return AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=known(3e5, 900.0), damping_n_s_per_m=known(150.0, 2.0)),
        drag_n_s_per_m=known(330.0, 1.0),
        environments=(surface,),
        robot=RobotEstimate(
            numerator=known_vector(20.0),
            denominator=known_vector(1.0, 20.0),
            delay_s=known(2.4e-3, 1e-5),
            bandwidth_hz=known(3.183, 0.01),
        ),
    )


def identified_plant() -> Identified:
    """Return what `identify` would say of the cell of `design_problem`."""
    return Identified(
        sample_time_s=known(8e-4, 1e-9),
        payload=PayloadEstimate(mass_kg=known(16.0, 0.02), com_m=known_vector(0.01, -0.02, 0.15)),
        axes={"x": identified_axis()},
        sensor=SensorEstimate(
            force_bias_n=known_vector(1.5, -0.25, 3.0),
            torque_bias_n_m=known_vector(0.1, 0.2, -0.1),
            force_noise_rms_n=known(0.14),
            gravity_residual_rms_n=known(0.05),
            deadband_n=known(0.0),
        ),
        findings=(),
    )


def with_axis(axis: AxisEstimate) -> Identified:
    return replace(identified_plant(), axes={"x": axis})


def write_plant(folder: Path) -> IdentifiedFile:
    """Write the plant to `identified.yaml` and read it again."""
    path = folder / "identified.yaml"
    write_identified(path, identified_plant(), {"tool": "by hand"})
    return read_identified(path)


def in_memory_plant() -> IdentifiedFile:
    """Return the plant as a file that nobody has written."""
    return IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)


@cache
def fast_optimized() -> Optimized:
    """A small problem taken all the way to a validated controller."""
    return optimize(in_memory_plant(), FAST_SPEC, seed=1)


@cache
def small_controller() -> Controller:
    """The controller of `fast_optimized` with two of its predicted contacts, which is quick to validate."""
    controller = fast_optimized().controller
    predicted = controller.predicted["x"]
    fewer = replace(predicted, scenarios=(predicted.scenarios[0], predicted.scenarios[-1]))
    return replace(controller, predicted={"x": fewer})


FAST_PROBLEM_YAML = """\
bounds:
  mass: [6, 6]
  damping: [900, 1600]
  lead_s: [0.01, 0.03]
  feedback_damping_s: [0.005, 0.005]
payload_mass_kg: [16, 16]
environment_stiffness_n_per_m: [1.0e5, 1.2e5]
requirements:
  free_space_admittance: {min_m_s_per_n: 6.5e-4, band_hz: [1, 2]}
"""


# Wide enough that the nominal optimum is not safe everywhere in it.
FURTHER: Mapping[str, tuple[float, float]] = {
    "coupling_stiffness_n_per_m": (2.85e5, 3.15e5),
    "coupling_damping_n_s_per_m": (130.0, 170.0),
    "delay_s": (2.35e-3, 2.6e-3),
    "robot_bandwidth_hz": (3.1, 3.27),
}
FURTHER_SPEC = replace(
    FAST_SPEC,
    uncertain=FURTHER,
    requirements=Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=5.5e-4, band_hz=(1.0, 2.0))),
)


@cache
def uncertain_optimized() -> Optimized:
    """The problem of `fast_optimized` with more of the plant uncertain, and less freedom of motion asked."""
    # A second of proof is enough to show that it is there, and is done again wherever the file is validated.
    return optimize(in_memory_plant(), FURTHER_SPEC, seed=1, proof=ProofOptions(further_s=1.0))


_LESS_WORK = {
    "autotune.tuning.structure.DEFAULT": "gains",
    "autotune.studies.front._GENERATIONS": 5,
    "autotune.limit.limit._TAPS": 75,
    "autotune.validation.bouncing.RUNS": 64,
    "autotune.validation.bouncing._FEWEST_RUNS": 1,
    "autotune.validation.validation_samples._SAMPLES": 8,
    "autotune.validation.validate._STIFFNESS_POINTS": 7,
    "autotune.validation.law._STIFFNESS_POINTS": 7,
    "autotune.export.easing._EASIER": (0.2,),
    "autotune.export.retune._FIRST_GRID": 7,
    "autotune.export.retune._LEVELS": 5,
}


def shorten_proofs(patch: pytest.MonkeyPatch) -> None:
    """Leave a proof over everything that is uncertain one second instead of ten: enough to show that it is there."""
    defaults = ProofOptions.__init__.__kwdefaults__
    assert defaults is not None
    patch.setitem(defaults, "further_s", 1.0)


def shorten_checks(patch: pytest.MonkeyPatch) -> None:
    """Also look at fewer plants, impacts and designs, where the files that are verified are made in the same test.

    A search is of four gains in their bounds; tests/autotune/tuning/test_structure.py has those without.
    """
    shorten_proofs(patch)
    for name, value in _LESS_WORK.items():
        patch.setattr(name, value)


OF_TARGETS = (
    *("autotune.export.third_party.certify_law", "autotune.export.retune.certify_law"),
    *("autotune.export.third_party.retune", "autotune.export.easing.retune"),
    "autotune.export.third_party.search_bouncing",
)
"""What the laws of export targets are found and certified by."""
PURE = (
    *("autotune.pipeline.identify_with_evidence", "autotune.tuning.optimize.solve_design"),
    *("autotune.tuning.settle.settle", "autotune.studies.front.trace_front"),
    *("autotune.validation.contacts.replay_contact", "autotune.validation.requirements.sampled_admittance"),
    *("autotune.validation.validate.sweep_margins", "autotune.validation.law.sweep_margins"),
    "autotune.validation.bouncing_proof.search_bouncing",
    *("autotune.validation.bouncing_proof.prove_rest", "autotune.validation.peak_proof.prove_peak"),
    *("autotune.certificate.certify.certify", "autotune.validation.contacts.find_driven"),
    *("autotune.validation.law.certify_law", "autotune.validation.dwell.prove_dwell", *OF_TARGETS),
)
"""What takes long in a command and depends on nothing but its arguments."""


# The results of one process, the latest used last; what has not been asked for longest goes first.
_KEPT: dict[bytes, Any] = {}
_MOST_KEPT = 400


def share_results(patch: pytest.MonkeyPatch, names: Sequence[str] = PURE) -> None:
    """Compute what takes long once for the same arguments, where much is done to the same files."""
    for name in names:
        module, _, function = name.rpartition(".")
        patch.setattr(name, _remembered(getattr(importlib.import_module(module), function)))


def _remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a pure function that keeps its results by the content of its arguments; functions hear of progress."""

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        kept = [each for each in arguments if not callable(each)], {k: v for k, v in options.items() if not callable(v)}
        given = function.__module__, function.__qualname__, *kept, _amount_of_work()
        key = hashlib.sha256(pickle.dumps(given)).digest()
        result = _KEPT.pop(key) if key in _KEPT else function(*arguments, **options)
        _KEPT[key] = result
        if len(_KEPT) > _MOST_KEPT:
            del _KEPT[next(iter(_KEPT))]
        return result

    return call


def _amount_of_work() -> list[object]:
    """Return what `shorten_checks` changes: a result of less work is none of more."""
    defaults = ProofOptions.__init__.__kwdefaults__ or {}
    homes = [name.rpartition(".") for name in _LESS_WORK]
    return [defaults.get("further_s"), *(getattr(importlib.import_module(home), name) for home, _, name in homes)]


def relaxed(problem: DesignProblem, requirement: str, share: float) -> DesignProblem:
    """Return the problem with one requirement asked for less by `share`."""
    if requirement not in problem.requirements.asked():
        return problem
    return replace(problem, requirements=problem.requirements.relaxed(requirement, share))
