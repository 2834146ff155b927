"""What a user should know beside a design: sentences about the plant, the payload and the limits."""

from collections.abc import Iterator, Mapping

from autotune.formats.controller_record import Controller
from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from autotune.formats.plant import TAKEN_AS_EXACT, exact_message, exact_within
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.design.problem import DesignProblem

from .plausible import doubtful_ranges, left_out_contacts
from .problems import is_identified_mass, payload_word


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
