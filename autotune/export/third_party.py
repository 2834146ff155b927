"""Translate a controller to the law of another program, certify what runs there, and tune where that fails.

The written parameters are those that were certified, digit for digit.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from autotune.certificate.family import ProofOutcome
from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.formats.canonical import short
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import AxisGains, Controller
from autotune.formats.limits import CollisionResponse
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.text import margins_text
from autotune.validation.bouncing import search_bouncing
from autotune.validation.law import AxisTask, LawCertificate, axis_task, certify_law
from autotune.version import __version__
from problems.design.requirements import AdmittanceTarget
from problems.errors import ParameterError
from problems.model.axis_kind import for_people
from problems.model.linear_controllers import LinearController
from problems.model.third_party_controllers import alternates
from problems.text import significant

from .easing import easing_message, find_easing, heavier_hand, merged
from .retune import ControllerStructure, Values, retune
from .ros_yaml import Tree, check_joint_count, joint_notes, render_commented
from .target import Rendered


@dataclass(frozen=True, kw_only=True)
class ParameterFile:
    """What another controller reads, the update rate that it holds for, which software it is, and notes.

    `content` is the tree of a parameter file, or the text of a script whose comments begin with #.
    """

    content: Tree | str
    update_rate_hz: int
    software: str
    notes: tuple[str, ...]


AxisBuilder = Callable[[Mapping[str, AxisTask], Mapping[str, AxisGains]], tuple[Sequence[ControllerStructure], bool]]
"""Returns the axes in the structure of another controller, and whether their masses had to be made the same."""
FileBuilder = Callable[[Controller, "Sequence[TranslatedAxis]"], ParameterFile]
"""Returns the parameter file from the controller and its axes as certified."""


@dataclass(frozen=True, kw_only=True)
class TranslatedAxis:
    """One exported axis: its numbers as written and their law, whether they were tuned and why, what was certified."""

    axis: str
    law: LinearController
    written: Mapping[str, float]
    tuned_because: str | None
    certificate: LawCertificate
    peak_before_n: float
    notes: tuple[str, ...]

    @property
    def peak_n(self) -> float:
        """The largest force on the environment of all contacts that were looked at."""
        assert self.certificate.worst is not None  # a certificate that holds has one
        return self.certificate.worst.peak_contact_force_n

    def margins(self) -> dict[str, float | None]:
        """Return the smallest margins by name, None where there is no finite limit."""
        found = {} if self.certificate.margins is None else self.certificate.margins.values
        return {name: value if math.isfinite(value) else None for name, value in found.items()}

    def free_motion(self) -> dict[str, float]:
        """Return the least admittance over the band that was asked, and the force per speed of a steady hand."""
        found = self.certificate.admittance
        assert found is not None  # a certificate that holds has one
        return {"least_admittance": found.min_m_s_per_n, "hand_force": found.hand_force_n_per_m_s}

    def price(self) -> str:
        """Return in words the peak force beside that of the file's own law."""
        unit, more = axis_units(self.axis).force, self.peak_n - self.peak_before_n
        change = f"{abs(more):.1f} {unit} {'more' if more >= 0.0 else 'less'}"
        return f"{self.peak_n:.1f} {unit}, {self.peak_before_n:.1f} {unit} with the law of the file itself: {change}"


@dataclass(frozen=True, kw_only=True)
class Translation:
    """A controller as another program runs it: the axes, what was dropped, notes, and the text of its file."""

    axes: tuple[TranslatedAxis, ...]
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    text: str

    def tree(self) -> dict[str, Any]:
        """Return the same as a plain tree."""
        axes = {
            each.axis: {
                "parameters": dict(each.written),
                "tuned": each.tuned_because is not None,
                "reason": each.tuned_because,
                "peak_contact_force": each.peak_n,
                "peak_contact_force_before": each.peak_before_n,
                "margins": each.margins(),
                **each.free_motion(),
                "notes": list(each.notes),
            }
            for each in self.axes
        }
        return {"axes": axes, "dropped": list(self.dropped), "notes": list(self.notes)}

    def lines(self) -> Iterator[str]:
        """Return lines for a person."""
        for axis in self.axes:
            how = "translated" if axis.tuned_because is None else f"tuned anew, since {axis.tuned_because}"
            units = axis_units(axis.axis)
            known = {name: f" {getattr(units, name)}" for name in ("mass", "damping", "stiffness")}
            numbers = ", ".join(f"{name} {value:g}{known.get(name, '')}" for name, value in axis.written.items())
            yield f"axis {axis.axis}: {numbers} ({how})"
            yield f"axis {axis.axis}: peak force {axis.price()}"
            yield from axis.notes
        yield from (f"dropped: {line}" for line in self.dropped)
        yield from (f"note: {line}" for line in self.notes)

    def rendered(self) -> Rendered:
        """Return the same as what an export writes and prints."""
        laws = {each.axis: each.law for each in self.axes}
        return Rendered(texts=(self.text,), lines=tuple(self.lines()), tree=self.tree(), laws=laws)


def translate_controller(
    source: ControllerFile,
    joints: tuple[str, ...],
    build_axes: AxisBuilder,
    build_file: FileBuilder,
    progress: Callable[[float], None] | None = None,
) -> Translation:
    """Return the controller as another program can run it, certified over the domain of the file.

    `progress` gets the share of the work done since the last call. Raises CertificateError for a file that states
    what cannot be certified, InfeasibleError where the other controller can do nothing that meets the file's
    requirements, UsageError for options that do not fit the file.
    """
    if source.controller.payload.set_in_cell:
        raise UsageError(
            f"{source.path} holds no centre of mass and no sensor bias, which that controller needs against gravity; "
            "give them in the plant, or identify the payload, and optimize again."
        )
    controller = source.controller
    tasks = {name: axis_task(controller, name) for name in controller.axes}
    axes, common = build_axes(tasks, controller.axes)
    check_joint_count(joints, len(axes))
    done = _all_certified(axes, joints, common, progress)
    file = build_file(controller, done)
    dropped = (*_dropped(controller), *(line for axis in axes for line in axis.dropped()))
    return Translation(axes=done, dropped=dropped, notes=file.notes, text=_text(source, file, done, dropped))


def _all_certified(
    axes: Sequence[ControllerStructure], joints: tuple[str, ...], common: bool, progress: Callable[[float], None] | None
) -> tuple[TranslatedAxis, ...]:
    """Certify every axis, so that one error names all that fail; the first of them decides its kind."""
    done, failed = [], list[CertificateError | InfeasibleError]()
    for axis in axes:
        try:
            done.append(_certified(axis, joints, common))
        except (CertificateError, InfeasibleError) as error:
            failed.append(error)
        if progress is not None:
            progress(1.0 / len(axes))
    if failed:
        raise _joined(failed, [axis for axis in axes if axis.task.axis not in {each.axis for each in done}])
    return tuple(done)


def _joined(
    failed: Sequence[CertificateError | InfeasibleError], axes: Sequence[ControllerStructure]
) -> CertificateError | InfeasibleError:
    """Return one error of all axes that failed, with the easing that is enough where one was found for each."""
    message = " ".join(str(each) for each in failed)
    if not all(isinstance(each, InfeasibleError) for each in failed):
        return type(failed[0])(message)
    easings = [easing for easing in map(find_easing, axes) if easing is not None]
    if len(easings) < len(axes):
        return InfeasibleError(f"{message} No easing was found that would be enough; narrower ranges may be.")
    return InfeasibleError(
        f"{message} {easing_message(easings)}",
        tuple(each for easing in easings for each in easing.relaxations()),
        suggestion=merged(easings),
    )


def _certified(axis: ControllerStructure, joints: tuple[str, ...], common: bool) -> TranslatedAxis:
    """Certify the translated gains of an axis, or tune what the structure can do."""
    task, values = axis.task, axis.translated
    found, reason = _translated(axis)
    if found is None or reason is not None:
        try:
            values, found = retune(task, axis)
        except InfeasibleError as error:
            fixed = " with one mass for all axes of a kind (6.4.0 and later do not need that)" if common else ""
            raise InfeasibleError(
                f"Axis {task.axis}: that controller{fixed} cannot do what was asked. The translated gains fail "
                f"({reason}), and {error}."
            ) from error
    bouncing = search_bouncing(task.axis, task.domain, axis.law(values), task.sample_time_s)
    if not bouncing.passed:
        raise CertificateError(f"Axis {task.axis}: with what that controller runs, {bouncing.message()}.")
    return TranslatedAxis(
        axis=task.axis,
        law=axis.law(values),
        written=axis.written(values),
        tuned_because=reason,
        certificate=found,
        peak_before_n=task.promised_n(),
        notes=(
            *axis.notes(values),
            *_hand_notes(task, found),
            *(() if reason is None else _bound_notes(axis, values)),
            *joint_notes(joints, axis.task.axis),
        ),
    )


def _translated(axis: ControllerStructure) -> tuple[LawCertificate | None, str | None]:
    """Certify the numbers that come nearest to the file's; return why they cannot be used, None where they can."""
    try:
        law = axis.law(axis.translated)
    except ParameterError as error:
        return None, str(error).removesuffix(".")
    if alternates(law):
        return None, "the law itself would change the sign of its speed in every cycle at this update rate"
    found = certify_law(axis.task, law)
    return found, None if found.holds else found.missed[0]


def _hand_notes(task: AxisTask, found: LawCertificate) -> Iterator[str]:
    """Say what a hand needs where a straight axis moves far heavier than by the admittance that is usually asked."""
    if task.axis in ROTATIONAL_AXES or found.admittance is None:
        return
    heavy = heavier_hand(task.axis, AdmittanceTarget().min_m_s_per_n, found.admittance.min_m_s_per_n)
    if heavy:
        yield f"axis {task.axis}: {heavy.replace(' instead of', ', with the usual admittance')}."


def _bound_notes(axis: ControllerStructure, values: Values) -> Iterator[str]:
    """Say which numbers of a search sit on a bound."""
    for each, value in zip(axis.variables, values, strict=True):
        if each.high > each.low and value in (each.low, each.high):
            end = "lowest" if value == each.low else "highest"
            scale, unit = for_people(each.unit)
            chosen = f"{scale * value:.4g} {unit}".rstrip()
            yield f"axis {axis.task.axis}: {each.name} is the {end} that the search may choose, {chosen}."


def _dropped(controller: Controller) -> Iterator[str]:
    """Say what of the file beyond the axes' gains no such controller has."""
    if controller.compensation_mass_kg:
        yield f"acceleration compensation of {controller.compensation_mass_kg:g} kg"
    for axis, gains in controller.axes.items():
        if gains.biquad is not None:
            yield f"biquad of axis {axis}, {gains.biquad.describe()}"
    if controller.collision.response is not CollisionResponse.NONE:
        yield f"collision response {controller.collision.response.value} at {controller.collision.threshold_n:g} N"
    for axis, variable in (controller.variable_damping or {}).items():
        yield f"variable damping {variable.lowest:g} to {variable.highest:g} {axis_units(axis).damping} of axis {axis}"
    limits = controller.limits
    if limits is not None:
        speeds = (f"{axis} {each.speed:g} {axis_units(axis).speed}" for axis, each in limits.axes.items())
        yield (
            f"limits ({limits.force_n:g} N, {limits.torque_n_m:g} N·m, commanded {', '.join(speeds)}, stale readings, "
            "the check at rest): that controller moves on any reading, so limit speed and wrench below and before it"
        )
    payload = controller.payload
    if any((*payload.force_bias_n, *payload.torque_bias_n_m)):
        bias = ", ".join(f"{each + 0.0:g}" for each in (*payload.force_bias_n, *payload.torque_bias_n_m))
        yield f"sensor bias ({bias}) N and N·m: remove it before the wrench reaches the controller"
    soft = controller.certificate.soft or {}
    if any(soft.values()):
        names = ", ".join(sorted({name for each in soft.values() for name in each}))
        yield f"soft requirements ({names}): they are not evaluated here"


def _text(
    source: ControllerFile, file: ParameterFile, axes: tuple[TranslatedAxis, ...], dropped: tuple[str, ...]
) -> str:
    """Return the whole file, comments first."""
    check = " Names of joints, frames and topics are those of your installation: check them."
    names = "" if isinstance(file.content, str) else check
    comments = [
        f"Written by autotune {__version__} for {file.software}.",
        f"Source: {source.path.name} with checksum {short(source.checksum)} (sha256 {source.checksum}).",
        f"Holds at an update rate of {file.update_rate_hz} Hz and for the cell of that file.{names}",
        "",
    ]
    comments += _by_axes({each.axis: (*_certificate(each), *each.notes) for each in axes})
    comments += [f"Dropped: {line}." for line in dropped] or ["Nothing of the file is dropped."]
    return render_commented(file.content, [*comments, "", *file.notes, ""])


def _by_axes(said: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield what is said of each axis and a blank line; what is the same of several is said once, of `Axes x, y`."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for axis, lines in said.items():
        alike.setdefault(tuple(re.sub(rf"^([Aa])xis {axis}:", r"\1x\0:", line) for line in lines), []).append(axis)
    for key, axes in alike.items():
        names = f"is {axes[0]}" if len(axes) == 1 else f"es {', '.join(axes)}"
        yield from (line.replace("\0", names, 1) for line in key)
        yield ""


def _certificate(each: TranslatedAxis) -> Iterator[str]:
    """Say what was certified of one axis."""
    found, units = each.certificate, axis_units(each.axis)
    assert found.margins is not None
    assert found.worst is not None
    assert found.admittance is not None
    if each.tuned_because is None:
        yield f"Axis {each.axis}: the gains of the file, translated. Peak force {each.price()}."
    else:
        yield (
            f"Axis {each.axis}: tuned anew for this controller, since the translated gains fail: {each.tuned_because}. "
            f"Peak force {each.price()}."
        )
    spring = ""
    if found.spring_share is not None:
        spring = f", where the return spring takes {significant(100.0 * max(found.spring_share, 0.0))} % of its room"
    yield (
        f"axis {each.axis}: certified for what runs: stable in contact ({_cells(found.stability.contact)}) "
        f"and in free space ({_cells(found.stability.free_space)}{spring}); "
        f"{margins_text(found.margins.values)} on {found.margins.plants} plants."
    )
    low, high = found.admittance.band_hz
    yield (
        f"axis {each.axis}: largest contact {units.force_name} {each.peak_n:.4g} {units.force} at {found.worst.name}; "
        f"free-space admittance at least {found.admittance.min_m_s_per_n:.4g} {units.admittance} from {low:g} to "
        f"{high:g} Hz; a hand needs {found.admittance.hand_force_n_per_m_s:.4g} {units.hand}."
    )


def _cells(parts: tuple[ProofOutcome, ...]) -> str:
    cells = sum(part.cells for part in parts)
    return f"proved in {cells} cell{'s' * (cells != 1)}"
