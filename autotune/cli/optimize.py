"""`autotune optimize`: a validated controller from identified parameters."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.export.targets import TARGETS
from autotune.formats.kinds import PLANTS

from ._common import Output, output_options
from ._limits import how_far_lines, limit_blocks, limit_option, limit_tree, limits_of
from ._optimized import (
    active_lines,
    active_tree,
    compare_lines,
    compare_tree,
    contact_spark,
    damping_lines,
    default_lines,
    limit_lines,
    print_before_after,
    print_compliance,
    response_lines,
)
from ._options import SETTINGS, FilePath, GroupedCommand, PresentType, fields_with_unit, typed_range
from ._pareto import FrontWriter, pareto_options, proof_options
from ._proved import coupled_lines, held_lines, law_lines, led_lines, noise_lines, peak_lines, rest_lines
from ._report import check_report, print_report_path, report_option, report_refusal, write_report
from ._schedule import schedule_options
from ._terminal import detect_terminal, echo, print_message, print_table

if TYPE_CHECKING:
    from autotune.export.target import ExportTarget, Rendered
    from autotune.formats.controller_record import ScenarioPrediction
    from autotune.formats.identified import IdentifiedFile
    from autotune.formats.problem import ProblemSpec
    from autotune.limit.limit import LimitResult
    from autotune.prediction.law import PresentGains
    from autotune.report.page import Page
    from autotune.studies.front import FrontRequest
    from autotune.tuning.optimize import Optimized
    from autotune.validation.axis_proof import ProofOptions
    from problems.model.axis_kind import AxisKind

_EPILOG = """\b
Examples:
  autotune optimize identified.yaml -o controller.yaml
  autotune optimize identified.yaml --payload-mass 10,22 --environment-stiffness 2e4:5e5
  autotune optimize identified.yaml --problem problem.yaml --json
  autotune optimize identified.yaml --compare mass=10,damping=1500 --report controller.html
  autotune optimize identified.yaml --problem problem.yaml --for ros2_control
  autotune optimize identified.yaml --pareto 9 -o best.yaml
  autotune optimize identified.yaml --schedule payload=8,12,16.2,22 --schedule stiffness=2e4:1e5,1e5:5e5 -o cell
"""
_GROUPS = {
    "Ranges to certify": ("payload_mass", "environment_stiffness", "schedule"),
    "Proof": ("slack", "proof_budget", "axes"),
    "Pareto front": (*("pareto", "objectives", "require", "choose", "storage", "study", "trials", "sampler"),),
}


def _masses(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) > 2:
        raise click.BadParameter("give one mass, or two as LOW,HIGH in kg.")
    return typed_range(parts, "mass", "payload_mass")


def _stiffness(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    parts = text.split(":")
    if len(parts) != 2:
        raise click.BadParameter("give a range as LOW:HIGH in N/m, for example 2e4:5e5, or with its unit, 20:500N/mm.")
    return typed_range(parts, "stiffness", "environment_stiffness")


@click.command("optimize", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("identified", type=FilePath(*SETTINGS, kinds=PLANTS))
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(path_type=Path),
    show_default="controller.yaml, or the folder schedule",
    help="File to write; with --schedule the folder.",
)
@click.option(
    "--problem", type=FilePath(*SETTINGS, kinds=("problem",)), help="Requirements, bounds and ranges: problem.yaml."
)
@click.option(
    "--payload-mass",
    callback=_masses,
    metavar="KG[,KG]",
    help="Payload mass, or the range to certify: 16.2, 10,22 or 16200g.",
)
@click.option(
    "--environment-stiffness",
    callback=_stiffness,
    metavar="LO:HI",
    help="Range of stiffness to certify, in N/m or with its unit: 2e4:5e5, 20:500N/mm.",
)
@click.option(
    "--compare",
    "old",
    type=PresentType(*SETTINGS, kinds=("controller", "cell")),
    metavar="GAINS|log|FILE",
    help="What runs today: gains as in mass=10,damping=1500, those of the log, a controller or cell.yaml. The search "
    "starts from it too.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of the search.",
)
@click.option(
    "--for",
    "target",
    type=click.Choice([name for name, each in TARGETS.items() if not each.runs_same_law]),
    help="Design for this export target: its period, none of the gains that it lacks, and certified as it runs it.",
)
@click.option(
    "--structure",
    type=click.Choice(["gains", "noise", "biquad"]),
    show_default="as problem.yaml says, or noise",
    help="The law: four gains in their bounds (gains), limited by the noise of the command instead, to what those make "
    "or the robot's jitter at rest (noise), or with a biquad in the path of the "
    "force too (biquad).",
)
@pareto_options
@report_option
@limit_option
@proof_options
@output_options
@schedule_options
def command(
    output: Output,
    identified: Path,
    out: Path,
    problem: Path | None,
    old: Path | str | None,
    seed: int,
    pareto: "FrontRequest | None",
    report: Path | None,
    limit: bool,
    proof: "ProofOptions | None",
    target: str | None,
    **asked_here: Any,
) -> None:
    """Search the controller with the smallest contact peak that meets all requirements, and validate it.

    Tunes every identified axis, rotational ones in rad, N·m and kg·m². Peak force, stability and margins are those of
    the exact sampled loop over the whole range of payload mass and environment stiffness; stability and the modulus
    margin are proved there, not only swept. A stiffness that problem.yaml makes free is chosen too. A Pareto front does
    not change the controller. Exit code 5: no controller meets the requirements. 6: a claim could not be verified, or
    the compared file is altered. Nothing is written then.
    """
    from autotune.export.designing import example_export, plant_for, specs_for
    from autotune.formats.atomic import check_target
    from autotune.formats.canonical import short
    from autotune.formats.controller import write_controller
    from autotune.formats.plant_file import read_plant
    from autotune.formats.problem import ProblemSpec, read_problem
    from autotune.prediction.said_gains import present_gains
    from autotune.tuning.optimize import optimize

    wanted, sources = TARGETS.get(target or ""), [each for each in (identified, problem, old) if isinstance(each, Path)]
    check_target(out, [path for path in sources if path != old], kind="controller")
    check_report(report, [*sources, out])
    fronts, seen, rendered = FrontWriter(pareto, out), list["IdentifiedFile"](), None
    with report_refusal(output, report, sources, lambda error: _refused_page(error, seen)):
        seen.append(read_plant(identified))
        asked = ProblemSpec() if problem is None else read_problem(problem)
        plant = plant_for(wanted, seen[0])
        present = present_gains(old, plant, asked.axes)
        spec = asked.with_options(**asked_here, with_unit=fields_with_unit())
        fronts.check(spec)
        search = partial(optimize, plant, seed=seed, problem_path=problem, present=present, proof=proof)
        search = partial(search, replays=wanted is None)
        found = _searched(output, specs_for(wanted, spec), search)
        if wanted is not None:
            certify = partial(_certified_for, output, wanted, out=out, plant=plant, present=present)
            found, rendered = _designed_for(output, wanted, found, spec, search, certify)
        fronts.trace(output, found)
        with output.replacing(out, "controller"):
            checksum = write_controller(out, found.controller)
        fronts.write(found)
    for note in found.controller.provenance.get("notes", ()):
        output.note(note)
    limits = limits_of(output, found, with_trade=True) if limit else {}
    tree = _tree(found, present, fronts, rendered) | limit_tree(limits)
    tree |= write_report(output, report, lambda: _page(found, checksum, present, fronts, limits))
    output.result(tree, lambda: _print_all(found, out, short(checksum), present, fronts, report, rendered, limits))
    # Ranges that were said may leave out what was identified, and a plant of a person has no estimates to hold against.
    is_said = plant.domain or found.compliance or spec.payload_mass or spec.environment_stiffness
    if wanted is None:
        output.next_command("validate", out, *(() if is_said else ("--identified", identified)))
    else:
        output.next_line(example_export(wanted, out))


def _searched(output: Output, specs: "Sequence[ProblemSpec]", search: "Callable[..., Optimized]") -> "Optimized":
    """Return the design of the first specification that has one, under a bar that names what is searched."""
    from autotune.export.designing import first_feasible

    with output.progress("searching", float(len(specs))) as advance:

        def name(doing: str) -> None:
            advance(0.0, f"searching {doing}".rstrip())

        return first_feasible(specs, partial(search, step=name, progress=advance))


def _tree(
    found: "Optimized", present: "PresentGains | None", fronts: FrontWriter, rendered: "Rendered | None"
) -> dict[str, Any]:
    """Return what `--json` says of the design."""
    from autotune.formats.controller import controller_tree

    tree = {**controller_tree(found.controller), "active": active_tree(found)}
    if present is not None:
        tree["compare"] = compare_tree(present, found.compared)
    tree["before_after"] = {name: each.to_dict() for name, each in found.before_after.items()}
    if rendered is not None:
        tree["for"] = {"target": found.controller.provenance["options"]["for"], **rendered.tree}
    return tree | ({"pareto": fronts.tree} if fronts.tree else {})


def _designed_for(
    output: Output,
    target: "ExportTarget",
    found: "Optimized",
    spec: "ProblemSpec",
    search: "Callable[[ProblemSpec], Optimized]",
    certify: "Callable[..., tuple[Optimized, Rendered]]",
) -> "tuple[Optimized, Rendered]":
    """Certify the design as the target runs it, that with the admittance that the target can have where it has one."""
    from autotune.errors import CertificateError, InfeasibleError
    from autotune.export.designing import first_feasible, lowered_default, raised_default, specs_for

    with output.progress(f"what {target.name} can have", 1.0) as advance:
        raised = raised_default(target, spec, found.controller, advance)

    def design(more: "ProblemSpec", note: str) -> "tuple[Optimized, Rendered]":
        with output.progress("searching with that", 1.0):
            again = first_feasible(specs_for(target, more), search)
        return certify(again, note=note)

    if raised is not None:
        with suppress(InfeasibleError, CertificateError):
            return design(*raised)
    try:
        return certify(found)
    except InfeasibleError as error:
        if (lowered := lowered_default(target, spec, found.controller, error)) is None:
            raise
        return design(*lowered)


def _certified_for(
    output: Output,
    target: "ExportTarget",
    found: "Optimized",
    *,
    out: Path,
    plant: "IdentifiedFile",
    present: "PresentGains | None",
    note: str = "",
) -> "tuple[Optimized, Rendered]":
    """Certify the design as the target runs it, note in its provenance what that is, and replay the log with it."""
    from autotune.export.designing import certify_for, lacking_gains
    from autotune.prediction.as_run_by import with_target
    from autotune.tuning.optimize import replay_log
    from autotune.tuning.provenance import with_notes
    from autotune.validation.law import axis_task, led_by_hand

    made, notes = found.controller, [*filter(None, [note]), *found.controller.provenance.get("notes", ())]
    options = {**made.provenance["options"], "for": target.name}
    noted = replace(made, provenance={**made.provenance, "options": options})
    if lacking := lacking_gains(target, made):
        notes.append(
            f"Our own law cannot do this without {' and '.join(lacking)}, so the gains of this file have what "
            f"{target.name} lacks; its law does it without."
        )
    with output.progress(f"certifying for {target.name}", 1.0) as advance:
        rendered = certify_for(target, noted, out, advance)
        led = {name: led_by_hand(axis_task(noted, name), law) for name, law in rendered.laws.items()}
    noted = with_target(noted, target.name, rendered.tree["axes"], rendered.laws, led)
    before_after = replay_log(plant, noted, present, found.compared)
    return replace(found, controller=with_notes(noted, notes, before_after), before_after=before_after), rendered


def _print_target(found: "Optimized", rendered: "Rendered") -> None:
    """Print what the target will run, axis by axis, and the head of what is our own law's."""
    print_message(f"As {found.controller.provenance['options']['for']} runs it, certified:")
    for line in rendered.lines:
        if line.startswith("axis "):
            print_message(line, indent="  ")
    print_message("Our own law, from which that was made, and which does not run there:")


def _print_all(
    found: "Optimized",
    out: Path,
    checksum: str,
    present: "PresentGains | None",
    fronts: FrontWriter,
    report: Path | None,
    rendered: "Rendered | None",
    limits: "Mapping[str, LimitResult]",
) -> None:
    print_optimized(found, out, checksum, present, rendered, limits)
    fronts.print()
    print_report_path(report)


def _page(
    found: "Optimized",
    checksum: str,
    present: "PresentGains | None",
    fronts: FrontWriter,
    limits: "Mapping[str, LimitResult]",
) -> "Page":
    from autotune.report.optimize_page import build_optimize_page

    return build_optimize_page(
        found.controller,
        checksum,
        steps={name: search.steps for name, search in found.searches.items()},
        old=present,
        before_after=found.before_after,
        fronts=fronts.tree.get("axes"),
        limits=limit_blocks(limits),
    )


def _refused_page(error: Exception, plants: "list[IdentifiedFile]") -> "Page":
    from autotune.report.refused_page import refused_search_page

    return refused_search_page(error, plants[0] if plants else None)


def print_optimized(
    found: "Optimized",
    out: Path,
    checksum: str,
    present: "PresentGains | None" = None,
    rendered: "Rendered | None" = None,
    limits: "Mapping[str, LimitResult] | None" = None,
) -> None:
    """Print what it changes, the chosen gains, the predicted peaks, what holds them up, and what was verified."""
    from autotune.formats.units import axis_units
    from autotune.text import speed_text

    controller = found.controller
    print_before_after(found.before_after)
    if rendered is not None:
        _print_target(found, rendered)
    for name, compliance in found.compliance.items():
        print_compliance(name, compliance, found.searches[name].problem)
    for name in controller.axes:
        units = axis_units(name)
        for line in law_lines(found, name):
            print_message(line)
        approach = controller.certificate.domain[name].approach
        if approach.speed_m_s is None:
            drive = f"with F^d = {approach.force_n:g} {units.force}"
        else:
            drive = f"at {speed_text(approach.speed_m_s, units.force)}"
        print_message(f"  predicted contacts, approached {drive}:")
        _print_peaks(controller.predicted[name].scenarios, units)
        _print_spark(found, name, units)
        said = [*default_lines(found, name), *active_lines(found, name)]
        said += [] if rendered else noise_lines(found, name)
        for line in (*said, *how_far_lines(limits or {}, name)):
            print_message(f"  {line}")
    for line in (
        *damping_lines(controller),
        *response_lines(controller),
        *peak_lines(controller),
        *rest_lines(controller),
        *held_lines(controller),
        *led_lines(controller),
        *coupled_lines(controller, found.unchecked_together),
        *limit_lines(controller),
    ):
        print_message(line)
    for check in found.report.checks:
        axis = f"{check.axis}: " if len(controller.axes) > 1 else ""
        verdict = f"{check.verdict:6} "
        print_message(f"{axis}{check.name}: {check.message}", verdict=verdict, indent="  ")
    for claim in controller.certificate.sampled:
        print_message(f"  sampled, not proved: {claim.claim}; over {claim.over_text()}")
    if present is not None:
        for line in compare_lines(present, found.compared):
            echo(line)
    print_message(f"written: {out}, checksum {checksum}")


def _print_spark(found: "Optimized", name: str, units: "AxisKind") -> None:
    """Draw the force of the predicted contact with the highest peak, where somebody sees it."""
    if not detect_terminal(sys.stdout).has_blocks:
        return
    search = found.searches[name]
    worst = max(found.controller.predicted[name].scenarios, key=lambda each: each.peak_contact_force_n)
    print_message(f"  {contact_spark(search.problem, search.problem.controller(search.design), worst, units)}")


def _print_peaks(scenarios: "Iterable[ScenarioPrediction]", units: "AxisKind") -> None:
    """Print the table of predicted contacts; lengths in mm along an axis, digits as its unit needs them."""
    from autotune.text import off_nominal

    straight = units.force == "N"
    scale, stiffness, digits = (1e-3, "N/mm", 1) if straight else (1.0, units.stiffness, 2)
    scenarios = tuple(scenarios)
    # The worst contacts of the whole uncertainty differ from the others beyond K_e and payload.
    beyond = [off_nominal(s.scenario(), units) for s in scenarios]
    has_other = any(beyond)
    rows = [
        (
            f"K_e [{stiffness}]",
            f"{'payload' if straight else units.mass_name} [{units.mass}]",
            f"peak at contact [{units.force}]",
            f"at sensor [{units.force}]",
            "after [ms]",
            *(("otherwise",) if has_other else ()),
        )
    ]
    rows += [
        (
            f"{s.environment_stiffness_n_per_m * scale:.1f}",
            f"{s.payload_mass_kg:.{digits if not straight else 2}f}",
            f"{s.peak_contact_force_n:.{digits}f}",
            f"{s.peak_sensor_force_n:.{digits}f}",
            f"{s.time_of_peak_s * 1e3:.0f}",
            *((other or "nominal",) if has_other else ()),
        )
        for s, other in zip(scenarios, beyond, strict=True)
    ]
    print_table(rows, left=(5,) if has_other else (), indent="  ", stacks=True)
