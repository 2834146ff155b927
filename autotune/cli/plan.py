"""`autotune plan`: what to record next."""

import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import PLANTS
from problems.text import significant

from ._common import Output, output_options
from ._options import SETTINGS, FilePath, FiniteRange, GroupedCommand, QuantityRange, output_option
from ._terminal import print_message, print_table, printable

if TYPE_CHECKING:
    from identification.experiment_design.contacts import ContactPlan, TapPlan
    from identification.experiment_design.poses import PosePlan
    from identification.experiment_design.result import ExperimentPlan, Prediction, Step
    from identification.experiment_design.sweep import SweepPlan
    from identification.experiment_design.values import PlanValues
    from problems.model.controller import AdmittanceController

_EPILOG = """\b
Examples:
  autotune plan identified.yaml -o plan.yaml
  autotune plan --mass 25 --max-tilt 30 --max-force 60
  autotune plan identified.yaml --poses 0 --max-speed 0.1 --json
"""
_GROUPS = {
    "Guesses for a first recording": ("mass", "stiffness"),
    "Limits of the cell": (
        *("max_tilt", "poses", "max_speed", "max_force", "max_stroke", "max_duration", "max_frequency"),
    ),
}
_NOISES = 4.0
_POSITIVE = FiniteRange(min=0.0, min_open=True)
_CONTRADICTIONS = frozenset({"mass-disagreement", "logs-disagree", "given-contradicts"})
# What a wrist carries, and what holds it: outside of this a unit is wrong.
_MASS = QuantityRange("mass", least=0.05, most=1000.0)
_STIFFNESS = QuantityRange("stiffness", least=1e3, most=1e8)


def _limit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    for name, kind, default, unit, text in reversed(
        (
            ("--max-tilt", _POSITIVE, 60.0, "DEG", "Largest tilt of a pose."),
            ("--max-speed", FiniteRange(min=1e-3), 0.25, "M/S", "Largest speed of the command."),
            ("--max-force", FiniteRange(min=5.0), 100.0, "N", "Largest force at the sensor."),
            ("--max-stroke", FiniteRange(min=1e-4), 0.02, "M", "Largest stroke to each side."),
            ("--max-duration", FiniteRange(min=2.0), 60.0, "S", "Duration of the sweep."),
            (
                "--max-frequency",
                FiniteRange(min=2.0),
                None,
                "HZ",
                "Highest of the sweep; default: of the robot.",
            ),
        )
    ):
        option = click.option(name, type=kind, default=default, show_default=True, metavar=unit, help=text)
        command = option(command)
    return command


@click.command("plan", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("identified", required=False, type=FilePath(*SETTINGS, kinds=PLANTS))
@output_option("plan.yaml")
@click.option("--axis", type=click.Choice(["x", "y", "z"]), help="Axis of sweep and contacts.")
@click.option(
    "--controller",
    "present",
    type=FilePath(*SETTINGS, kinds=("controller",)),
    help="Weigh uncertainties by the peak force with this controller.yaml (default: a usual one).",
)
@click.option("--mass", type=_MASS, metavar="KG", help="Guess of the payload mass, without a file.")
@click.option("--stiffness", type=_STIFFNESS, metavar="N/M", help="Guess of the coupling stiffness, without a file.")
@click.option("--poses", type=click.IntRange(0, 24), default=9, show_default=True, help="Poses: 0, or 4 and more.")
@_limit_options
@output_options
def command(
    output: Output,
    identified: Path | None,
    out: Path,
    axis: str | None,
    present: Path | None,
    mass: float | None,
    stiffness: float | None,
    max_tilt: float,
    poses: int,
    max_speed: float,
    max_force: float,
    max_stroke: float,
    max_duration: float,
    max_frequency: float | None,
) -> None:
    """Propose the recording that reduces the binding uncertainty most: poses, sweep, taps and contacts.

    With IDENTIFIED, from its values, noise and deviations; without, a first recording from usual values. Exit code 4:
    poses are needed, and none within the largest tilt identify mass and centre of mass; nothing is written then.
    """
    from autotune.errors import UsageError
    from autotune.formats.atomic import check_target
    from autotune.formats.plan import plan_tree, write_plan
    from autotune.version import __version__
    from identification.experiment_design.experiment import plan_experiment
    from identification.experiment_design.poses import FEWEST_POSES
    from identification.experiment_design.result import ExperimentLimits
    from identification.experiment_design.values import usual_values

    check_target(out, [path for path in (identified, present) if path is not None], kind="plan")
    if 0 < poses < FEWEST_POSES:
        raise UsageError(
            f"--poses must be 0 (none) or at least {FEWEST_POSES}, as mass and centre of mass need; found {poses}."
        )
    limits = ExperimentLimits(
        max_tilt_deg=max_tilt,
        pose_count=poses,
        max_speed_m_s=max_speed,
        max_force_n=max_force,
        max_stroke_m=max_stroke,
        max_duration_s=max_duration,
        max_frequency_hz=max_frequency,
    )
    provenance: dict[str, object] = {"tool": f"autotune {__version__}"}
    if identified is None:
        name, values = axis or "x", usual_values(mass_kg=mass, stiffness_n_per_m=stiffness)
    elif mass is not None or stiffness is not None:
        raise UsageError("--mass and --stiffness are guesses for a first recording; leave them out beside a file.")
    else:
        name, values = _from_file(output, identified, axis, provenance)
    law = None if present is None else _law(present, name, provenance)
    with output.progress("planning", None):
        plan = plan_experiment(name, values, limits, law)
    if law is not None and (plan.effect is None or plan.effect.controller != law):
        output.note(f"{present} is not stable on the surface that is assumed; what binds is counted without it.")
    with output.replacing(out, "plan"):
        write_plan(out, plan, provenance)
    output.result(plan_tree(plan, provenance), lambda: print_plan(plan, out))
    _name_next(output, out, identified)


def _name_next(output: Output, out: Path, identified: Path | None) -> None:
    """Name what reads the recording that is planned, beside the logs that the plant is from where they are there."""
    from autotune.formats.identified import read_identified

    made = {} if identified is None else read_identified(identified).provenance
    before = [str(log["path"]) for log in made.get("logs", ()) if Path(str(log["path"])).exists()]
    words = shlex.join(["autotune", "identify", *before, str(out.with_suffix(".mcap"))])
    output.next_line(f"{words}  # once you have recorded what {out} asks for, in any format, under any name")


def _from_file(output: Output, path: Path, axis: str | None, provenance: dict[str, object]) -> tuple[str, "PlanValues"]:
    """Return the axis and its values, note the file in `provenance`, and repeat what it says against its own values."""
    from autotune.formats.identified import read_identified
    from identification.experiment_design.values import values_of

    source = read_identified(path)
    provenance["identified"] = {"path": str(source.path), "sha256": source.sha256}
    for finding in source.result.findings:
        if finding.code in _CONTRADICTIONS:
            output.note(f"{path.name} says: {printable(finding.message)} The plan takes the values as they are.")
    if axis is not None and axis not in source.result.axes:
        others = ", ".join(source.result.axes) or "none"
        output.note(
            f"{path.name} holds no axis {axis} (its axes: {others}): robot, coupling and surface are usual values, as "
            "in a first recording."
        )
    return values_of(source.result, axis)


def _law(path: Path, axis: str, provenance: dict[str, object]) -> "AdmittanceController":
    """Return the law of one axis of a controller file, and note the file in `provenance`."""
    from autotune.errors import UsageError
    from autotune.formats.controller import read_controller
    from autotune.formats.controller_record import admittance_controller

    source = read_controller(path)
    if axis not in source.controller.axes:
        raise UsageError(f"{path} has no axis {axis}; its axes: {', '.join(source.controller.axes)}.")
    provenance["controller"] = {"path": str(path), "checksum": source.checksum}
    return admittance_controller(source.controller, axis)


def print_plan(plan: "ExperimentPlan", out: Path) -> None:
    """Print the steps in their order, then what each parameter would gain, then what was assumed."""
    from identification.experiment_design.result import LABELS, UNITS

    print_message(f"axis {plan.axis}, binding uncertainty: {LABELS[plan.binding]}{_reference(plan)}")
    if not any(step.is_needed for step in plan.steps):
        print_message("everything is known well enough; what follows would make it sharper, and is not needed")
    for number, step in enumerate(plan.steps, start=1):
        wanted = "" if step.is_needed else " (not needed)"
        print_message(f"{step.kind.value}{wanted}: {step.why}", verdict=f"{number}. ")
        for line in _settings(step, plan):
            print_message(f"   {line}")
    heads = ("parameter", "value", "± now", "± after", "allowed", "unit", "peak ± now", "± after [N]", "by")
    rows: list[tuple[str, ...]] = [heads]
    rows += [
        _row(entry, LABELS[entry.name], UNITS[entry.name], step.kind.value)
        for step in plan.steps
        for entry in step.predictions
    ]
    print_table(rows, left=(0, 5, 8), point=(1, 2, 3, 4, 6, 7))
    if plan.values.assumed:
        assumed = ", ".join(f"{name} {value:.4g}" for name, value in plan.values.assumed.items())
        print_message(f"assumed, not measured: {assumed}")
    print_message(f"written: {out}")


def _row(entry: "Prediction", label: str, shown_in: tuple[str, float], step: str) -> tuple[str, ...]:
    from autotune.text import rounded_to, with_deviation

    unit, scale = shown_in
    value, now = with_deviation(entry.value, entry.std_now, scale)
    after, allowed = (
        "-" if std is None else rounded_to(std * scale, std * scale) for std in (entry.std_after, entry.allowed_std)
    )
    if entry.std_now is None:
        value = rounded_to(scale * (entry.std_after or entry.allowed_std), scale * entry.value)
    peaks = ("-" if n is None else rounded_to(n, n) if n > 0.0 else "0" for n in (entry.peak_now_n, entry.peak_after_n))
    return label, value, now, after, allowed, unit, *peaks, step


def _reference(plan: "ExperimentPlan") -> str:
    """Say by how much it moves which peak."""
    effect = plan.effect
    if effect is None:
        return ""
    entry = next(entry for step in plan.steps for entry in step.predictions if entry.name == plan.binding)
    peak, damping = f"{effect.peak_force_n:.3g} N", f"{effect.controller.damping_n_s_per_m:g} N·s/m"
    reference = f"the peak of {peak} (a contact with {effect.approach_force_n:g} N, B_a = {damping})"
    if entry.peak_now_n is None:
        return f"; the table counts in {reference}"
    return f", which moves {reference} by {significant(entry.peak_now_n)} N"


def _settings(step: "Step", plan: "ExperimentPlan") -> list[str]:
    from identification.experiment_design.contacts import ContactPlan
    from identification.experiment_design.poses import PosePlan
    from identification.experiment_design.sweep import SweepPlan

    settings = step.settings
    if settings is None:
        return ["no setting within the limits identifies it"]
    if isinstance(settings, PosePlan):
        return _poses(settings)
    if isinstance(settings, SweepPlan):
        return _sweep(settings, plan)
    return _contacts(settings) if isinstance(settings, ContactPlan) else _taps(settings)


def _poses(poses: "PosePlan") -> list[str]:
    turns = ", ".join(f"{t:.0f}/{a:.0f}" for t, a in zip(poses.tilt_deg, poses.azimuth_deg, strict=True))
    return [
        f"{len(poses.tilt_deg)} rests of {poses.hold_s:g} s, turned from the present orientation about a horizontal",
        f"axis of the base, angle/azimuth of the axis [deg]: {turns}",
        f"mass to ±{significant(poses.mass_std_kg)} kg, centre to ±{significant(1e3 * poses.com_std_m)} mm; as many in",
        f"equal steps about two axes: ±{poses.naive_mass_std_kg:.2g} kg, ±{1e3 * poses.naive_com_std_m:.2g} mm",
    ]


def _sweep(found: "SweepPlan", plan: "ExperimentPlan") -> list[str]:
    sweep = found.sweep
    speed = 1e3 * sweep.command_speed_m_s(plan.values.robot)
    amplitude = speed / (2.0 * math.pi * sweep.frequency_hz())
    worst, repeat = found.worst, found.repeat
    peak, mass, stiffness = found.worst_peak_force_n, worst.mass_kg, 1e-3 * worst.stiffness_n_per_m
    expected, ends = significant(found.peak_force_n), [significant(amplitude[at]) for at in (0, -1)]
    lines = [
        f"{sweep.low_hz:.2g} to {sweep.high_hz:.3g} Hz in {sweep.duration_s:g} s (logarithmic), in free space, command",
        f"logged; its amplitude {ends[0]} to {ends[1]} mm, {speed[0]:.3g} to {speed[-1]:.3g} mm/s,",
        f"so that the flange keeps {1e3 * sweep.flange_speed_m_s:.3g} mm/s; it rises and falls over {found.fade_s:g} s",
        f"peak force {expected} N expected, {peak:.3g} N at worst: at {worst.frequency_hz:.3g} Hz,",
        f"{mass:.4g} kg on K_s of {stiffness:.4g} N/mm with {100.0 * worst.damping_ratio:.2g} % of critical damping,",
        f"robot of {worst.bandwidth_hz:.3g} Hz; stop it above {found.abort_force_n:.3g} N (sensor, gravity taken off)",
        f"{found.bound_by} holds the amplitude down; the robot passes little above {found.robot_limit_hz:.0f} Hz",
    ]
    if repeat is not None:
        noise = plan.values.force_noise_rms_n.value
        largest, expected = f"{repeat.largest_factor:.0f}", significant(repeat.expected_factor)
        lines += [
            f"then once more with all amplitudes times {repeat.aim_force_n:.3g} N / (largest force that the first",
            f"showed), at most times {largest}; expected is {expected}, which the table counts on",
        ]
        if found.peak_force_n < _NOISES * noise:
            lines.append(
                f"the first one hardly exceeds the sensor's noise of {significant(noise)} N: repeat it more than once"
            )
    return lines


def _taps(taps: "TapPlan") -> list[str]:
    return [
        f"{taps.count} taps along the axis with a soft hammer, {taps.spacing_s:g} s apart, the robot holding still:",
        f"about {significant(taps.impulse_n_s)} N·s, {taps.peak_force_n:.0f} N at the sensor",
    ]


def _contacts(contacts: "ContactPlan") -> list[str]:
    return [
        f"{contacts.count} contacts at {1e3 * contacts.speed_m_s:.3g} mm/s, each held at {contacts.hold_force_n:g} N",
        f"expected peak {contacts.peak_contact_force_n:.0f} N on the surface, {contacts.peak_sensor_force_n:.0f} N at",
        f"the sensor, with B_a = {contacts.assumed_damping_n_s_per_m:g} N·s/m",
    ]
