"""Where a controller comes from, what was chosen for it, and what a user should know beside it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from autotune.formats.controller_record import Controller
from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from autotune.formats.plant import TAKEN_AS_EXACT, exact_message, exact_within
from autotune.formats.problem import ProblemSpec
from autotune.formats.records import rename_axis_keys
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.prediction.before_after import BeforeAndAfter
from autotune.prediction.law import PresentGains
from autotune.validation.axis_proof import ProofOptions
from autotune.version import __version__
from identification.result import Identified
from problems.design.problem import DesignProblem
from problems.design.uncertainty import MASS, STIFFNESS

from .compliance import Compliance, compliance_tree
from .defaults import DefaultAdmittance
from .noise_limit import jitter_notes, spectrum_notes
from .optimality_report import optimality_tree
from .plausible import doubtful_ranges, left_out_contacts, left_out_tree
from .problems import has_no_weight, is_identified_mass, payload_word
from .settle import Settled


def exact_names(plant: IdentifiedFile, problems: Mapping[str, DesignProblem]) -> tuple[str, ...]:
    """Return what a controller takes as exact of a plant that a person wrote; nothing of an identified one."""
    if "exact" not in plant.provenance:
        return ()
    (problem,) = problems.values()
    return exact_within(plant.provenance["exact"], problem.plants.ranges)


def design_notes(
    plant: IdentifiedFile,
    controller: Controller,
    problems: Mapping[str, DesignProblem],
    spec: ProblemSpec,
    *,
    has_compliance: bool,
) -> Iterator[str]:
    """Yield what the user should know beside a controller; `has_compliance`: the surface is still to be built."""
    exact, source = exact_names(plant, problems), "" if plant.path == IN_MEMORY else f"{plant.path}: "
    for finding in plant.result.findings:
        message = exact_message(exact) if finding.code == TAKEN_AS_EXACT else finding.message
        if finding.severity != "info" and message:
            yield f"{source}{finding.severity}: {message}" if source else message
    if controller.payload.set_in_cell and has_no_weight(plant.result):
        yield (
            "The runtime reads the raw wrench, and centre of mass and bias are not known (set_in_cell): it does not "
            "start until the whole payload is given there, payload= in Python, a cell_payload of your own in C."
        )
    if not is_identified_mass(plant.result, controller.payload.mass_kg):
        yield (
            f"The runtime will compensate {controller.payload.mass_kg:g} kg with the centre of mass of the "
            f"{payload_word(plant.result)} payload; identify the new payload before it is led by hand."
        )
    if any(problem.plants.nominal.wrench_filter.delay_s > 0.0 for problem in problems.values()):
        yield (
            "The wrench comes late by a pure delay, so B_fb is held at 0: the loop of a late wrench beside a position "
            "that is not late is not computed by this release."
        )
    yield from jitter_notes(problems, plant.result, spec)
    yield from spectrum_notes(controller, problems)
    yield from residual_notes(controller, problems)
    for name, problem in problems.items():
        yield from doubtful_ranges(problem, plant.result.axes[name], name)
        if not has_compliance:
            yield from left_out_contacts(problem, plant.result, name)
    turning = [name for name in controller.axes if name in ROTATIONAL_AXES]
    if turning and "environment_stiffness" in spec.options:
        yield (
            f"The range of environment stiffness is in N/m and says nothing of {', '.join(turning)}; the range "
            "certified there is the identified one, or that of problem.yaml."
        )


def residual_notes(controller: Controller, problems: Mapping[str, DesignProblem]) -> Iterator[str]:
    """Yield for each axis that a limit of the peak is met only by a payload whose weight is fully compensated."""
    for name, prediction in controller.predicted.items():
        limit = problems[name].requirements.max_peak_force_n
        left, unit = prediction.with_residual_weight, axis_units(name).force
        if limit is not None and left is not None and left.peak_contact_force_n > limit:
            worst = max(each.peak_contact_force_n for each in prediction.scenarios)
            yield (
                f"Axis {name}: with the {left.force_n:g} {unit} that the start check lets pass, the worst "
                f"peak is {left.peak_contact_force_n:.1f} {unit}, above max_peak_force_n of {limit:g}; ask for "
                f"{limit * worst / left.peak_contact_force_n:.3g} to hold it then too."
            )


def make_provenance(
    identified: IdentifiedFile,
    problems: Mapping[str, DesignProblem],
    spec: ProblemSpec,
    seed: int,
    problem_path: Path | None,
    present: PresentGains | None,
    proof: ProofOptions,
) -> dict[str, Any]:
    """Return where a controller comes from: the tool, the identified file, and what was asked."""
    plant = identified.provenance.get("plant")
    ranges = {MASS: spec.options.get("payload_mass"), STIFFNESS: spec.options.get("environment_stiffness")}
    said = {name: None if each is None else list(each) for name, each in ranges.items()}
    return {
        "tool": f"autotune {__version__}",
        "identified": {
            "path": str(identified.path),
            "sha256": identified.sha256,
            # Of a plant that a person wrote, what was written and what of it was taken as exact.
            **({} if plant is None else {"plant": plant, "exact": list(exact_names(identified, problems))}),
        },
        "options": {
            "problem": None if problem_path is None else str(problem_path),
            **said,
            **({} if spec.structure is None else {"structure": spec.structure}),
            "seed": seed,
            "slack": proof.slack,
            "proof_budget_s": proof.further_s,
            "compare": None if present is None else present.tree(),
        },
    }


def result_trees(
    settled: Mapping[str, Settled],
    identified: Identified,
    defaults: Mapping[str, DefaultAdmittance],
    chosen: Mapping[str, Compliance],
) -> dict[str, Any]:
    """Return the optimality of the designs, what was asked by default where it followed the cell, and the surfaces.

    The compliance that was chosen takes the place of the surfaces that the ranges leave out.
    """
    optimality = {
        name: optimality_tree(each.optimality, rotational=name in ROTATIONAL_AXES) for name, each in settled.items()
    }
    asked = {name: rename_axis_keys(name, each.tree(), reading=False) for name, each in defaults.items()}
    problems = {name: each.search.problem for name, each in settled.items()}
    compliance = {name: compliance_tree(each) for name, each in chosen.items()}
    surfaces = {"compliance": compliance} if chosen else dict(left_out_tree(problems, identified))
    return {"optimality": optimality} | ({"defaults": asked} if asked else {}) | surfaces


def with_notes(controller: Controller, notes: Sequence[str], before_after: Mapping[str, BeforeAndAfter]) -> Controller:
    """Return the controller with what the user should know in its provenance, and what it changes."""
    trees = {name: each.to_dict() for name, each in before_after.items() if not each.is_empty}
    said: dict[str, Any] = ({"notes": list(notes)} if notes else {}) | ({"before_after": trees} if trees else {})
    return replace(controller, provenance={**controller.provenance, **said})
