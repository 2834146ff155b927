"""Design for another controller from the start: its period, none of the gains it lacks, and its own certificate."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.formats.canonical import lines_to_paste, place_to_paste
from autotune.formats.controller import ControllerFile, controller_tree
from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import AXES
from problems.design.requirements import AdmittanceTarget
from problems.design.uncertainty import MASS, STIFFNESS

from .ros_yaml import DOWNWARDS
from .target import ExportRequest, ExportTarget, Rendered

Found = TypeVar("Found")
_ADMITTANCE = "free_space_admittance"
# As `autotune.tuning.defaults`: the very most leaves one design and no choice of a gentle one.
_SHARE_OF_ATTAINABLE = 0.8
DESIGNED = "for_target.yaml"
"""The controller file of the commands that are named."""
_PROBLEM = "problem.yaml"
_PINNED = ("lead_s", "feedback_damping_s")


def specs_for(target: ExportTarget | None, spec: ProblemSpec) -> tuple[ProblemSpec, ...]:
    """Return the problem without the gains that the target lacks, and behind it the problem as it is.

    The second is for where our own law can do nothing without them, though the target's may. Raises UsageError where
    the bounds of a gain that the target lacks leave out 0.
    """
    if target is not None and spec.structure not in (None, "gains"):
        raise UsageError(f"{target.name} runs another law; leave --structure, or structure in problem.yaml, out.")
    if target is not None and spec.bumper is not None:
        raise UsageError(f"{target.name} runs another law; leave payload.bumper out of problem.yaml.")
    if target is None:
        return (spec,)
    spec = replace(spec, structure="gains")
    lacking = [name for name in _PINNED if name not in target.expresses]
    for name in lacking:
        for bounds in (spec.bounds, spec.rotational.bounds):
            if bounds.get(name, (0.0, 0.0))[0] > 0.0:
                raise UsageError(f"{target.name} has no {name}, whose bounds in problem.yaml must hold 0.")
    if not lacking:
        return (spec,)
    pinned = dict.fromkeys(lacking, (0.0, 0.0))
    turning = {name: each for name, each in spec.rotational.bounds.items() if name not in pinned}
    without = replace(spec, bounds={**spec.bounds, **pinned}, rotational=replace(spec.rotational, bounds=turning))
    return without, spec


def first_feasible(specs: Sequence[ProblemSpec], search: Callable[[ProblemSpec], Found]) -> Found:
    """Return what a search finds for the first problem that has a solution; raises as it does for the last."""
    for spec in specs[:-1]:
        try:
            return search(spec)
        except InfeasibleError:
            continue
    return search(specs[-1])


def lacking_gains(target: ExportTarget, controller: Controller) -> tuple[str, ...]:
    """Return the gains by name that the target lacks and that some axis of a controller has."""
    lacking = (name for name in _PINNED if name not in target.expresses)
    return tuple(name for name in lacking if any(getattr(each, name) for each in controller.axes.values()))


def raised_default(
    target: ExportTarget, spec: ProblemSpec, controller: Controller, progress: Callable[[float], None] | None = None
) -> tuple[ProblemSpec, str] | None:
    """Return the problem with the admittance that a target can have where nobody asked for one, and a note on it.

    Our own law without the gains that the target lacks may have to do with less. None where it had not to, where the
    target cannot have more either, and for axes that turn.
    """
    said = {axis: each for axis, each in controller.provenance.get("defaults", {}).items() if axis in AXES[:3]}
    lowered = {axis: each[_ADMITTANCE] for axis, each in said.items() if each[_ADMITTANCE]["attainable"] is not None}
    if not lowered:
        return None
    of = next(iter(lowered.values()))
    usual, band, used = of["usual"]["min_m_s_per_n"], tuple(of["used"]["band_hz"]), of["used"]["min_m_s_per_n"]
    asked = {**controller.certificate.requirements, _ADMITTANCE: AdmittanceTarget(min_m_s_per_n=usual, band_hz=band)}
    hoped, attainable = replace(controller, certificate=replace(controller.certificate, requirements=asked)), usual
    try:
        _rendered(target, hoped, Path(DESIGNED), progress)
    except InfeasibleError as error:
        if {name for name, _, _ in error.relaxations} != {_ADMITTANCE}:
            return None
        attainable = min(possible for _, _, possible in error.relaxations)
    except CertificateError:
        return None
    least = usual if attainable >= usual else float(f"{_SHARE_OF_ATTAINABLE * attainable:.2g}")
    if least <= used:
        return None
    return _with_default(
        target, spec, list(lowered), AdmittanceTarget(min_m_s_per_n=least, band_hz=band), attainable, usual
    )


def lowered_default(
    target: ExportTarget, spec: ProblemSpec, controller: Controller, error: InfeasibleError
) -> tuple[ProblemSpec, str] | None:
    """Return the problem with four fifths of the admittance that a target can have, and a note on it.

    `error` says that the target cannot do what our own law does. None where somebody asked for that admittance, where
    more than it is in the way, and for axes that turn.
    """
    said = controller.provenance.get("defaults", {})
    are_straight = set(controller.axes) <= set(AXES[:3]) & set(said)
    if not are_straight or {name for name, _, _ in error.relaxations} != {_ADMITTANCE}:
        return None
    used = next(iter(said.values()))[_ADMITTANCE]["used"]
    attainable, usual = min(possible for _, _, possible in error.relaxations), used["min_m_s_per_n"]
    least = float(f"{_SHARE_OF_ATTAINABLE * attainable:.2g}")
    asked = AdmittanceTarget(min_m_s_per_n=least, band_hz=tuple(used["band_hz"]))
    return _with_default(target, spec, list(said), asked, attainable, usual)


def _with_default(
    target: ExportTarget,
    spec: ProblemSpec,
    axes: Sequence[str],
    asked: AdmittanceTarget,
    attainable: float,
    usual: float,
) -> tuple[ProblemSpec, str]:
    can = f"can have in this cell ({attainable:.3g}); the usual {usual:g} cannot be had with it"
    is_usual = asked.min_m_s_per_n == usual
    note = (
        f"Axis {', '.join(axes)}: nobody asked for a free-space admittance, so {asked.min_m_s_per_n:g} m/s/N are asked "
        f"from {asked.band_hz[0]:g} to {asked.band_hz[1]:g} Hz, "
        + (f"as usual, which {target.name} can have" if is_usual else f"four fifths of what {target.name} {can}")
    )
    return replace(spec, requirements=replace(spec.requirements, free_space_admittance=asked)), f"{note}."


def plant_for(target: ExportTarget | None, plant: IdentifiedFile) -> IdentifiedFile:
    """Return the plant at the period that the target has of its own; its delay in seconds is taken to stay."""
    own, known = None if target is None else target.sample_time_s, plant.result.sample_time_s
    if own is None or known.value == own:
        return plant
    return replace(plant, result=replace(plant.result, sample_time_s=replace(known, value=own)))


def design_command(target: ExportTarget, controller: Controller, problem: str | None, out: str = DESIGNED) -> str:
    """Return the command that designs for a target as a controller was designed, with the options that were given."""
    made = controller.provenance
    said, plant = made.get("options", {}), made.get("identified", {}).get("path", "identified.yaml")
    words = ["autotune", "optimize", plant, *(["--problem", problem] if problem else []), "--for", target.name]
    is_freer = any(each.biquad is not None for each in controller.axes.values())
    if problem and (is_freer or "structure" in said):
        words += ["--structure", "gains"]  # in the place of what the problem may say
    for flag, joint, name in (("--payload-mass", ",", MASS), ("--environment-stiffness", ":", STIFFNESS)):
        if said.get(name):
            words += [flag, joint.join(f"{each:.15g}" for each in said[name])]
    compared = said.get("compare") or {}
    before = compared.get("path") or compared.get("from", "")
    words += ["--compare", before] if "path" in compared or "=" in before else []
    words += ["--seed", str(said["seed"])] if said.get("seed") else []
    return shlex.join([*words, "-o", out])


def export_command(
    target: ExportTarget, source: Path | str, out: Path | str, options: Mapping[str, Any] | None = None
) -> str:
    """Return the command that exports a controller file to a target, with options by name."""
    given = options or {}
    typed = [word for each in target.options if each.name in given for word in (each.flag, each.said(given[each.name]))]
    return shlex.join(["autotune", "export", str(source), "--target", target.name, *typed, "-o", str(out)])


def example_export(target: ExportTarget, source: Path | str) -> str:
    """Return the command that usually exports to a target, for a tool that points down where that matters."""
    options = DOWNWARDS if any(each.name in DOWNWARDS for each in target.options) else {}
    name = Path(source).with_suffix(".c") if target.suffix == ".c" else f"{target.name}{target.suffix}"
    return export_command(target, source, name, options)


def certify_for(
    target: ExportTarget, controller: Controller, out: Path, progress: Callable[[float], None] | None = None
) -> Rendered:
    """Return what an export of the controller to the target will say, whatever the names of the installation.

    Raises InfeasibleError, with the easing that is enough, where the target has nothing that meets the requirements,
    and what else the target's `render` raises.
    """
    try:
        return _rendered(target, controller, out, progress)
    except InfeasibleError as error:
        if not error.suggestion:
            raise
        command = design_command(target, controller, _PROBLEM, str(out))
        raise InfeasibleError(
            f"With {target.name}: {error} {lines_for(controller, error.suggestion)}: "
            f"{'; '.join(lines_to_paste(error.suggestion))} and run {command}",
            error.relaxations,
            suggestion=error.suggestion,
            to_paste=(command,),
        ) from error


def _rendered(
    target: ExportTarget, controller: Controller, out: Path, progress: Callable[[float], None] | None
) -> Rendered:
    source = ControllerFile(
        controller=controller, checksum=str(controller_tree(controller)["checksum"]), path=out, sha256=""
    )
    return target.render(ExportRequest(source=source, out=out, options=dict(target.design_options), progress=progress))


def lines_for(controller: Controller, lines: Mapping[str, Any]) -> str:
    """Return where lines that ease the requirements are put: into a new problem.yaml, or a copy of the one used."""
    problem = controller.provenance.get("options", {}).get("problem")
    if problem is None:
        return f"Put into {_PROBLEM}"
    copied = _PROBLEM if problem == _PROBLEM else f"{_PROBLEM}, a copy of {problem},"
    return f"Put into {copied} {place_to_paste(lines)}"
