"""What a user should know beside a design: sentences about the plant, the payload and the limits."""

from collections.abc import Iterator

from autotune.formats.identified import IdentifiedFile
from autotune.formats.units import ROTATIONAL_AXES, axis_units

from .optimize import Optimized
from .plausible import doubtful_ranges, left_out_contacts
from .problems import is_identified_mass


def design_notes(plant: IdentifiedFile, found: Optimized, *, has_stiffness: bool) -> Iterator[str]:
    """Yield what the user should know beside the result; `has_stiffness`: one was named for the straight axes."""
    for finding in plant.result.findings:
        if finding.severity != "info":
            yield f"{plant.path}: {finding.severity}: {finding.message}"
    if not is_identified_mass(plant.result, found.controller.payload.mass_kg):
        yield (
            f"The runtime will compensate {found.controller.payload.mass_kg:g} kg with the centre of mass of the "
            "identified payload; identify the new payload before it is led by hand."
        )
    if any(search.problem.plants.nominal.wrench_filter.delay_s > 0.0 for search in found.searches.values()):
        yield (
            "The wrench comes late by a pure delay, so B_fb is held at 0: the loop of a late wrench beside a position "
            "that is not late is not computed by this release."
        )
    yield from residual_notes(found)
    for name, search in found.searches.items():
        yield from doubtful_ranges(search.problem, plant.result.axes[name], name)
        if name not in found.compliance:
            yield from left_out_contacts(search.problem, plant.result, name)
    turning = [name for name in found.controller.axes if name in ROTATIONAL_AXES]
    if turning and has_stiffness:
        yield (
            f"--environment-stiffness is in N/m and says nothing of {', '.join(turning)}; the range certified there is "
            "the identified one, or that of problem.yaml."
        )


def residual_notes(found: Optimized) -> Iterator[str]:
    """Yield for each axis that a limit of the peak is met only by a payload whose weight is fully compensated."""
    for name, prediction in found.controller.predicted.items():
        limit = found.searches[name].problem.requirements.max_peak_force_n
        left, unit = prediction.with_residual_weight, axis_units(name).force
        if limit is not None and left is not None and left.peak_contact_force_n > limit:
            worst = max(each.peak_contact_force_n for each in prediction.scenarios)
            yield (
                f"Axis {name}: with the {left.force_n:g} {unit} that the start check lets pass, the worst "
                f"peak is {left.peak_contact_force_n:.1f} {unit}, above max_peak_force_n of {limit:g}; ask for "
                f"{limit * worst / left.peak_contact_force_n:.3g} to hold it then too."
            )
