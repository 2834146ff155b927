"""`schedule.yaml` and the folder around it: controllers by class of payload and surface, and what one for all costs."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from autotune.errors import AutotuneError, CertificateError, UsageError
from problems.frozen import AboveZero, Rule

from .atomic import check_target, write_folder_atomic
from .canonical import checksum, dump_yaml, plain, short
from .controller import ControllerFile, controller_tree, read_controller
from .controller_record import Controller
from .records import record_tree, rename_axis_keys
from .schema import VERSION, check_document, check_format, check_tree
from .units import ROTATIONAL_AXES, Axis
from .yaml12 import Document, load_document

if TYPE_CHECKING:
    from problems.design.objectives import PeakObjective

FORMAT = "autotune/schedule"
SCHEDULE_FILE, COMMON_FILE = "schedule.yaml", "all.yaml"

_RANGES = ("payload_mass_kg", "environment_stiffness_n_per_m")
_HEAD_BYTES = 256

Interval = tuple[float, float]
Range = tuple[AboveZero, AboveZero]
Ranges = Annotated[tuple[Range, ...], Rule(minItems=1)]
_PLAIN = Rule(maxLength=120, description="a plain file name, without a folder")
FileName = Annotated[str, _PLAIN, Rule(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.yaml$")]
Digest = Annotated[str, Rule(pattern="^[0-9a-f]{64}$", description="64 hexadecimal digits")]


@dataclass(frozen=True, kw_only=True)
class ScheduleClass:
    """One cell of the table: ranges of payload mass (kg) and surface stiffness (N/m), None where nothing is given."""

    payload_mass_kg: Interval | None = None
    environment_stiffness_n_per_m: Interval | None = None

    @property
    def name(self) -> str:
        """The class as a short name that holds its ranges to the last digit, such as `m16.2_k2e4-1e5`."""
        parts = []
        if self.payload_mass_kg is not None:
            parts.append("m" + _range_text(self.payload_mass_kg, _decimal))
        if self.environment_stiffness_n_per_m is not None:
            parts.append("k" + _range_text(self.environment_stiffness_n_per_m, _scientific))
        return "_".join(parts)


@dataclass(frozen=True, kw_only=True)
class Tuned:
    """The controller of one class and, per axis, its worst peak and that of the common controller there (N, N·m).

    `peaks_with_common` is None where there is no common controller.
    """

    of: ScheduleClass
    controller: Controller
    peaks: Mapping[str, float]
    peaks_with_common: Mapping[str, float] | None = None

    def cost_n(self, axis: str) -> float | None:
        """Return by how much the common controller's worst peak is higher; None where there is none."""
        return None if self.peaks_with_common is None else self.peaks_with_common[axis] - self.peaks[axis]


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """The table, class by class, and the common controller over the hull of all classes, or why there is none.

    `dwell_time_s` is how long each runs at least before another one takes over, None where that is not known, and
    `dwell_proved_share` for which share of the certified K_e × M_p that is proved.
    """

    tuned: tuple[Tuned, ...]
    hull: ScheduleClass
    common: Controller | None
    common_refusal: str
    objective: "PeakObjective"
    dwell_time_s: float | None = None
    dwell_proved_share: float | None = None


@dataclass(frozen=True, kw_only=True)
class ScheduleFile:
    """A schedule that was read and found whole, with its controllers by name; the common one, if any, is `all`."""

    tree: Mapping[str, Any]
    controllers: Mapping[str, ControllerFile]
    checksum: str
    path: Path


@dataclass(frozen=True, kw_only=True)
class ScheduledAxis:
    """What the file says of one axis of a class: its worst peak, and what the common controller costs there."""

    peak_force_n: AboveZero
    peak_with_common_n: AboveZero | None
    cost_n: float | None
    cost_percent: float | None


@dataclass(frozen=True, kw_only=True)
class ScheduledClass:
    """What the file says of one class."""

    name: Annotated[str, _PLAIN, Rule(pattern="^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    payload_mass_kg: Range | None = None
    environment_stiffness_n_per_m: Range | None = None
    file: FileName
    checksum: Digest
    axes: Annotated[Mapping[Axis, ScheduledAxis], Rule(minProperties=1)]


@dataclass(frozen=True, kw_only=True)
class CommonController:
    """What the file says of the controller over the hull of all classes."""

    payload_mass_kg: Range | None = None
    environment_stiffness_n_per_m: Range | None = None
    file: FileName | None
    checksum: Digest | None
    refusal: str | None


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """The ranges that the classes cover together."""

    payload_mass_kg: Ranges | None = None
    environment_stiffness_n_per_m: Ranges | None = None
    RULE = Rule(minProperties=1)


@dataclass(frozen=True, kw_only=True)
class ScheduleTable:
    """The entries of `schedule.yaml`, but for where it comes from."""

    objective: Literal["contact_force", "sensor_force"]
    covered: Coverage
    common: CommonController
    classes: Annotated[tuple[ScheduledClass, ...], Rule(minItems=1)]
    dwell_time_s: (
        Annotated[float, Rule(minimum=0, description="how long each runs at least before another one takes over")]
        | None
    ) = None
    dwell_proved_share: (
        Annotated[float, Rule(minimum=0, maximum=1, description="of K_e and M_p, for which that is proved")] | None
    ) = None


def worst_peaks(controller: Controller, objective: "PeakObjective") -> dict[str, float]:
    """Return the largest predicted peak of every axis (N, N·m), where the objective has it."""
    return {axis: max(map(objective.of_peak, each.scenarios)) for axis, each in controller.predicted.items()}


def covered(intervals: Iterable[Interval]) -> tuple[Interval, ...]:
    """Return the union of intervals as disjoint ones from low to high; between two of them nothing is covered."""
    union: list[Interval] = []
    for low, high in sorted(intervals):
        if union and low <= union[-1][1]:
            union[-1] = (union[-1][0], max(union[-1][1], high))
        else:
            union.append((low, high))
    return tuple(union)


def schedule_tree(schedule: Schedule) -> dict[str, Any]:
    """Return the plain tree of `schedule.yaml`, its checksum last; raises ParameterError as `controller_tree` does."""
    common, ranges = schedule.common, _ranges(schedule.hull)
    table = ScheduleTable(
        objective=schedule.objective.name,  # type: ignore[arg-type]  # the schema checks it
        covered=Coverage(**{name: covered({getattr(each.of, name) for each in schedule.tuned}) for name in ranges}),
        common=CommonController(
            **ranges,
            file=None if common is None else COMMON_FILE,
            checksum=None if common is None else controller_tree(common)["checksum"],
            refusal=schedule.common_refusal or None,
        ),
        classes=tuple(map(_class, schedule.tuned)),
        dwell_time_s=schedule.dwell_time_s,
        dwell_proved_share=schedule.dwell_proved_share,
    )
    tree = {"format": FORMAT, "version": VERSION, **record_tree(table), "provenance": _provenance(schedule)}
    for each in tree["classes"]:
        each["axes"] = {axis: rename_axis_keys(axis, cost, reading=False) for axis, cost in each["axes"].items()}
    tree["checksum"] = checksum(tree)
    check_tree(tree, "schedule")
    return tree


def check_schedule_target(folder: Path) -> None:
    """Raise UsageError now if `write_schedule` could not write there later, or would delete what is no schedule."""
    check_target(folder)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UsageError(f"{folder} is a file; a schedule is a folder of its own.")
    present = {entry.name for entry in folder.iterdir()}
    if not present:
        return
    advice = "remove it, or name another folder with -o"
    if SCHEDULE_FILE not in present:
        raise UsageError(f"{folder} exists and holds no schedule; {advice}.")
    try:
        former = read_schedule(folder / SCHEDULE_FILE)
    except AutotuneError as error:
        raise UsageError(f"{folder} holds something else than an unaltered schedule; {advice}. {error}") from error
    strange = sorted(present - {SCHEDULE_FILE} - {each.path.name for each in former.controllers.values()})
    if strange:
        raise UsageError(f"{folder} holds {strange[0]} beside its schedule, which would be lost; {advice}.")


def write_schedule(folder: Path, schedule: Schedule) -> dict[str, Any]:
    """Write the controllers and `schedule.yaml` as a folder in one step, and return the tree of `schedule.yaml`.

    A former schedule there is replaced. Raises UsageError as `check_schedule_target` and `write_folder_atomic` do.
    """
    check_schedule_target(folder)
    tree = schedule_tree(schedule)
    controllers = {f"{each.of.name}.yaml": each.controller for each in schedule.tuned}
    if schedule.common is not None:
        controllers[COMMON_FILE] = schedule.common
    texts = {name: dump_yaml(controller_tree(controller)) for name, controller in controllers.items()}
    write_folder_atomic(folder, {**texts, SCHEDULE_FILE: dump_yaml(tree)})
    return tree


def is_schedule(path: Path | str) -> bool:
    """Return whether a file begins as `schedule.yaml` does; False where it cannot be read."""
    try:
        with Path(path).open("rb") as stream:
            return FORMAT.encode() in stream.read(_HEAD_BYTES)
    except OSError:
        return False


def read_schedule(path: Path | str) -> ScheduleFile:
    """Read `schedule.yaml` and every controller that it lists, and refuse them unless they fit to each other.

    The checksums must be those of the files; each controller must be certified for the ranges of its class, and
    predict the peak that the schedule states.

    Raises UsageError: the schedule cannot be opened. CertificateError: anything else.
    """
    document = load_document(path, error=CertificateError, exact=True)
    check_format(document, "schedule")
    check_document(document, "schedule")
    tree = document.tree
    found = checksum(tree)
    if tree["checksum"] != found:
        reason = (
            f"the checksum says {short(tree['checksum'])}, but the content has {short(found)}; the file is altered."
        )
        document.refuse(("checksum",), reason)
    controllers = {}
    for index, entry in enumerate(tree["classes"]):
        if entry["name"] in controllers or entry["file"] != f"{entry['name']}.yaml":
            document.refuse(("classes", index, "name"), "each class must have a name and file of its own.")
        controllers[entry["name"]] = _listed(document, ("classes", index), entry)
        _check_peaks(document, index, controllers[entry["name"]])
    if tree["common"]["file"] is not None:
        controllers["all"] = _listed(document, ("common",), tree["common"])
    return ScheduleFile(tree=tree, controllers=controllers, checksum=found, path=document.path)


def _listed(document: Document, place: tuple[str | int, ...], entry: Mapping[str, Any]) -> ControllerFile:
    """Return the controller of one entry, which must be the file that the entry speaks of."""
    try:
        file = read_controller(document.path.parent / entry["file"])
    except UsageError as error:
        raise CertificateError(f"{document.path}: {error}") from error
    if file.checksum != entry["checksum"]:
        reason = (
            f"{entry['file']} must have the checksum {short(entry['checksum'] or '')}, found {short(file.checksum)}."
        )
        document.refuse((*place, "checksum"), reason)
    for axis, domain in file.controller.certificate.domain.items():
        for name in _RANGES:
            said = entry.get(name)
            if axis not in ROTATIONAL_AXES and said is not None and tuple(said) != getattr(domain, name):
                low, high = getattr(domain, name)
                document.refuse((*place, name), f"{entry['file']} is certified for {low:g} to {high:g} on axis {axis}.")
    return file


def _check_peaks(document: Document, index: int, file: ControllerFile) -> None:
    from problems.design.objectives import BUILT_IN, force_of  # noqa: PLC0415 - what only prints a table does without

    entry, force = document.tree["classes"][index], force_of(BUILT_IN[document.tree["objective"]])
    stated = {axis: rename_axis_keys(axis, tree, reading=True)["peak_force_n"] for axis, tree in entry["axes"].items()}
    if stated != worst_peaks(file.controller, force):
        reason = f"the peaks of {entry['name']} are not those that {entry['file']} predicts."
        document.refuse(("classes", index, "axes"), reason)


def _class(tuned: Tuned) -> ScheduledClass:
    return ScheduledClass(
        name=tuned.of.name,
        **_ranges(tuned.of),
        file=f"{tuned.of.name}.yaml",
        checksum=controller_tree(tuned.controller)["checksum"],
        axes={axis: _cost(tuned, axis) for axis in tuned.peaks},
    )


def _cost(tuned: Tuned, axis: str) -> ScheduledAxis:
    peak, cost = tuned.peaks[axis], tuned.cost_n(axis)
    return ScheduledAxis(
        peak_force_n=peak,
        peak_with_common_n=None if tuned.peaks_with_common is None else tuned.peaks_with_common[axis],
        cost_n=cost,
        cost_percent=None if cost is None else 100.0 * cost / peak,
    )


def _ranges(of: ScheduleClass) -> dict[str, Any]:
    return {name: getattr(of, name) for name in _RANGES if getattr(of, name) is not None}


def _provenance(schedule: Schedule) -> dict[str, Any]:
    """Return what the controllers have in common: tool, identified file, and the options but for the classes."""
    first = schedule.tuned[0].controller.provenance
    kept = {
        name: value
        for name, value in first["options"].items()
        if name != "compare" and getattr(schedule.hull, name, None) is None
    }
    return {"tool": first["tool"], "identified": first["identified"], "options": plain(kept)}


def _range_text(interval: Interval, digits: Callable[[float], str]) -> str:
    low, high = interval
    return digits(low) if low == high else f"{digits(low)}-{digits(high)}"


def _decimal(value: float) -> str:
    return f"{Decimal(repr(value)).normalize():f}"


def _scientific(value: float) -> str:
    """Return the value as mantissa and exponent, `2e4`."""
    number = Decimal(repr(value)).normalize()
    digits = "".join(map(str, number.as_tuple().digits))
    return f"{digits[0]}{'.' if len(digits) > 1 else ''}{digits[1:]}e{number.adjusted()}"
