"""Guess what columns and fields mean, from their names and values, with the evidence beside each guess."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from problems.arrays import FloatArray
from problems.frozen import freeze

from ..errors import LogError
from .containers.channel import Held
from .guess_trace import FORCE_UNITS, UNLOADED_SHARE, Entry, NamedChannel, guess_trace, span_text
from .messages.decode import Wanted
from .messages.first import decode_first
from .names import Meaning, Named, NamedVector, is_unit, joint_groups, leaps, read_names, rises, unevenness
from .numbers import NumberFields, number_fields
from .opened import OpenedLogs, open_logs
from .roles.cell import TORQUE_N_M, Cell
from .roles.orientation import COLUMN_MAJOR, ROW_MAJOR, read_by_weight
from .roles.registry import JOINT_STATE, POSE_STAMPED, WRENCH_STAMPED, Role
from .tables.layout import TableLayout
from .tables.read import TableLog

_FARTHEST_M = 20.0
_LARGEST_RAD = 6.6
_MOST_POSES = 500
_NORM_TOLERANCE = 2e-3
_SHORTEST_STEP = {"ns": 2e4, "us": 50.0, "ms": 0.5}
_EPOCH = {"ns": 1e17, "us": 1e14, "ms": 1e11}
_N_MM_RATIO = 30.0
_FEWEST = 3
_NINE, _SIXTEEN = 9, 16
# The first and the last of so many parts of a log.
_ENDS = 50
_UNLOADED = "it begins and ends near 0, whatever the payload weighs"
_FORCE = tuple(f"wrench.force.{axis}" for axis in "xyz")


@dataclass(frozen=True, kw_only=True)
class CellGuess:
    """Guessed entries: `roles` by role (the topic first), `tables` by file name, and remarks on what is open.

    `others` maps a topic to its numbers without a guess, each with its range. With `is_displacement` the pose is a
    travel along one axis from a place that is not known. `joints` maps a topic to its joint angles and why they are,
    `wrenches` a topic whose type says that it is one to what its numbers and its frame say of it.
    """

    roles: Mapping[Role, tuple[Entry, ...]] = field(default_factory=dict)
    tables: Mapping[str, Entry] = field(default_factory=dict)
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    is_displacement: bool = False
    joints: Mapping[str, tuple[tuple[str, ...], str]] = field(default_factory=dict)
    wrenches: Mapping[str, tuple[Entry, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "roles", "tables", "others", "joints", "wrenches")


def guess_cell(paths: Sequence[Path], *, salvage: bool = False) -> CellGuess:
    """Guess roles, units, orientations and the time of tables from names and values.

    Parameters
    ----------
    paths
        Parts of one recording.
    salvage
        Take what a damaged log still holds.

    Returns
    -------
    CellGuess
        Nothing of what neither names nor values say, nor of a JointState, whose names are those of joints.

    Raises
    ------
    LogError
        A log is damaged.

    """
    tables: dict[str, Entry] = {}
    others: dict[str, tuple[str, ...]] = {}
    vectors: list[tuple[NamedChannel, NamedVector]] = []
    asked: list[tuple[NamedChannel, NamedVector]] = []
    traces: list[dict[Role, tuple[Entry, ...]]] = []
    joints: dict[str, tuple[tuple[str, ...], str]] = {}
    untimed = Cell(table=TableLayout(rows="poses"))
    with open_logs(paths, untimed, salvage=salvage) as logs:
        units = {part.path.name: part.units for part in logs.parts if isinstance(part, TableLog)}
        fields = [found for part in logs.parts for found in number_fields(part) if found.type != JOINT_STATE]
        for found in fields:
            channel = _channel(logs, found, units.get(found.topic, ()))
            if channel is None:
                continue
            vectors += [(channel, vector) for vector in channel.named.vectors]
            asked += [(channel, vector) for vector in channel.named.asked if vector.kind is Meaning.FORCE]
            trace = guess_trace(channel)
            if trace:
                traces.append(trace)
            time = _time(channel) if found.topic in units else None
            if time is not None:
                tables[found.topic] = time
            angles = _joint_angles(channel)
            if angles:
                joints[found.topic] = (angles, f"by name; {span_text(channel, angles)}")
            left = () if trace else tuple(_ranges(channel, angles))
            if left:
                others[found.topic] = left
        wrenches = dict(_typed_wrenches(logs))
    is_trace = len(traces) == 1 and not vectors
    is_displacement = is_trace and any("displacement" in each.evidence for each in traces[0][Role.POSE])
    roles = traces[0] if is_trace else dict(_roles(vectors))
    if len(asked) == 1 and Role.DESIRED_FORCE not in roles:
        roles[Role.DESIRED_FORCE] = tuple(_asked_entries(*asked[0]))
    return CellGuess(
        roles=roles, tables=tables, others=others, is_displacement=is_displacement, joints=joints, wrenches=wrenches
    )


def _typed_wrenches(logs: OpenedLogs) -> Iterator[tuple[str, tuple[Entry, ...]]]:
    """Yield the topics of WrenchStamped, with what force and frame say of weight and axes."""
    held = {each.channel: each for part in logs.parts for each in part.survey.held if each.count}
    posed = {_frame_of(each) for channel, each in held.items() if channel.type_name == POSE_STAMPED}
    for channel in (channel for channel in held if channel.type_name == WRENCH_STAMPED):
        force = logs.read({channel: Wanted(fields=_FORCE)})[channel].values
        if len(force) < _FEWEST or not _is_unloaded(np.linalg.norm(force, axis=1)):
            continue
        entries = [Entry(key="gravity_compensated", value=True, evidence=_UNLOADED)]
        frame = _frame_of(held[channel])
        if frame and frame in posed:
            evidence = f"its frame, {frame}, is that of the poses"
            entries.append(Entry(key="expressed_in", value="base", evidence=evidence))
        yield channel.topic, tuple(entries)


def _frame_of(held: Held) -> str:
    """Return the frame of a channel's first message, empty without one."""
    try:
        return next(iter(decode_first(held, Wanted(fields=())).frame_ids), "")
    except LogError:
        return ""


def _channel(logs: OpenedLogs, found: NumberFields, units: Sequence[str]) -> NamedChannel | None:
    info = next(info for info in logs.infos if info.channel.topic == found.topic)
    columns: dict[str, FloatArray] = {}
    try:
        values = logs.read({info.channel: Wanted(fields=found.paths)})[info.channel].values
        columns = dict(zip(found.paths, values.T, strict=True))
    except LogError:
        for path in found.paths:  # one of text beside numbers
            try:
                columns[path] = logs.read({info.channel: Wanted(fields=(path,))})[info.channel].values[:, 0]
            except LogError:
                continue
    if not columns or len(next(iter(columns.values()))) < _FEWEST:
        return None
    below = dict(zip(found.paths, units or [""] * len(found.paths), strict=True))
    named = read_names(tuple(columns), [below[path] for path in columns])
    if all(path.isdigit() for path in columns):
        named = _by_values(columns)
    return NamedChannel(topic=found.topic, named=named, columns=columns)


def _by_values(columns: Mapping[str, FloatArray]) -> Named:
    """Find in columns without names a time, which always rises, and a quaternion, whose norm is 1 and which turns.

    Of two columns neither is a time; of two that rise the one of even steps is.
    """
    paths = tuple(columns)
    rising = [path for path in paths[:2] if len(paths) > 2 and rises(columns[path])]
    times = dict.fromkeys(sorted(rising, key=lambda path: unevenness(columns[path]))[:1], "")
    turns = []
    for at in range(len(paths) - 3):
        four = np.column_stack([columns[path] for path in paths[at : at + 4]])
        if is_unit(four) and np.any(np.ptp(four, axis=0) > 0.0):
            turns.append(NamedVector(kind=Meaning.TURN, paths=paths[at : at + 4], words=(), unit=""))
    vectors = tuple(turns) if len(turns) == 1 else ()
    used = {*times, *(path for vector in vectors for path in vector.paths)}
    return Named(vectors=vectors, times=times, others=tuple(path for path in paths if path not in used))


def _joint_angles(channel: NamedChannel) -> tuple[str, ...]:
    """Return the paths of the angles of one arm, nothing where names and values leave none or several."""
    groups = [
        paths for paths in joint_groups(channel.named.others) if np.nanmax(np.abs(channel.of(paths))) < _LARGEST_RAD
    ]
    return groups[0] if len(groups) == 1 else ()


def _ranges(channel: NamedChannel, known: Sequence[str] = ()) -> Iterator[str]:
    """Describe the numbers without a guess, and where a time runs backwards."""
    for path in channel.named.times:
        back = np.flatnonzero(np.diff(channel.columns[path]) < 0.0)
        if back.size:
            before, after = channel.columns[path][back[0] : back[0] + 2]
            place = f"from {before:.10g} to {after:.10g} in row {back[0] + 2}"
            yield f"{path}: a time that falls {back.size} time(s), first {place}"
    for path in (path for path in channel.named.others if path not in known):
        values = channel.columns[path][np.isfinite(channel.columns[path])]
        span = f"{values.min():.4g} to {values.max():.4g}" if values.size else "nothing"
        yield f"{path}: {span}"


def _time(channel: NamedChannel) -> Entry | None:
    """Guess the time column of a table and its unit, or that each row is a pose at rest."""
    turns = [vector.paths for vector in channel.named.vectors if vector.kind in (Meaning.TURN, Meaning.MATRIX)]
    are_rests = bool(turns) and len(channel.columns[turns[0][0]]) <= _MOST_POSES and leaps(channel.of(turns[0]))
    has_force = any(vector.kind in (Meaning.FORCE, Meaning.WRENCH) for vector in channel.named.vectors)
    if are_rests and (has_force or not channel.named.times):
        evidence = "the orientation leaps from row to row, as no robot turns: each row is taken as the mean of a rest"
        return Entry(key="table", value={"rows": "poses"}, evidence=evidence)
    for path, named_unit in channel.named.times.items():
        unit = named_unit
        values = channel.columns[path]
        if not rises(values):
            continue
        step = float(np.median(np.diff(values)[np.diff(values) > 0.0]))
        if unit:
            why = "its unit by its name"
        elif any(values[0] > least for least in _EPOCH.values()):
            unit = next(name for name, least in _EPOCH.items() if values[0] > least)
            why = f"counted since 1970 in {unit}"
        else:
            unit = "s" if are_rests else next((name for name, least in _SHORTEST_STEP.items() if step >= least), "s")
            why = f"rows are {step:.4g} {unit} apart, of s, ms, us and ns the unit of a control loop"
        layout: dict[str, object] = {"time": path, "time_unit": unit}
        repeats = int(np.count_nonzero(np.diff(values) == 0.0))
        mean = (values[-1] - values[0]) / (len(values) - 1)
        rising = f"it never falls, {repeats} rows repeat a time, {mean:.4g} {unit} apart on average"
        return Entry(key="table", value=layout, evidence=f"{rising if repeats else 'it always rises'}; {why}")
    return None


_PARTS: Mapping[Meaning, tuple[str, ...]] = {
    Meaning.FORCE: ("force",),
    Meaning.TORQUE: ("torque",),
    Meaning.WRENCH: ("force", "torque"),
    Meaning.POSITION: ("position",),
    Meaning.TURN: ("orientation",),
    Meaning.POSE: ("position", "orientation"),
    Meaning.MATRIX: ("orientation",),
    Meaning.LINEAR: ("linear",),
    Meaning.ANGULAR: ("angular",),
}
_MAIN_PART = {Role.WRENCH: "force", Role.DESIRED_FORCE: "force", Role.TWIST: "linear"}


def _role(vector: NamedVector) -> Role | None:
    if vector.kind in (Meaning.FORCE, Meaning.TORQUE, Meaning.WRENCH):
        return Role.DESIRED_FORCE if vector.is_command else Role.WRENCH
    if vector.kind in (Meaning.LINEAR, Meaning.ANGULAR):
        return None if vector.is_command else Role.TWIST
    return Role.COMMAND if vector.is_command else Role.POSE


_Chosen = Mapping[str, tuple[NamedChannel, NamedVector]]


def _roles(vectors: Sequence[tuple[NamedChannel, NamedVector]]) -> Iterator[tuple[Role, tuple[Entry, ...]]]:
    """Yield for each role the entries of the vectors that serve it, where names leave one of each."""
    selected: dict[Role, _Chosen] = {}
    for role in (Role.WRENCH, Role.POSE, Role.COMMAND, Role.TWIST, Role.DESIRED_FORCE):
        mine = [(channel, vector) for channel, vector in vectors if _role(vector) is role]
        chosen: dict[str, tuple[NamedChannel, NamedVector]] = {}
        for part in ("force", "torque", "position", "orientation", "linear", "angular"):
            found = _one([pair for pair in mine if part in _PARTS[pair[1].kind]])
            if found is not None:
                chosen[part] = found
        topics = {channel.topic for channel, _ in chosen.values()}
        needed = _MAIN_PART.get(role)
        if len(topics) == 1 and (needed is None or needed in chosen):
            selected[role] = chosen
    for role, of_role in selected.items():
        yield role, tuple(_entries(role, of_role, selected.get(Role.WRENCH, {})))


def _one(found: Sequence[tuple[NamedChannel, NamedVector]]) -> tuple[NamedChannel, NamedVector] | None:
    """Return the vector that was measured and not processed, None where that leaves none or several."""
    for better in (lambda v: not v.is_processed, lambda v: v.is_measured):
        found = [pair for pair in found if better(pair[1])] or found
    return found[0] if len(found) == 1 else None


def _fields(chosen: _Chosen) -> dict[str, list[str]]:
    """Return the paths of each part."""
    fields: dict[str, list[str]] = {}
    for part, (_, vector) in chosen.items():
        parts = _PARTS[vector.kind]
        split = 3 if len(parts) == 2 else len(vector.paths)
        paths = vector.paths[split:] if len(parts) == 2 and part == parts[1] else vector.paths[:split]
        fields[part] = list(paths)
    return fields


def _entries(role: Role, chosen: _Chosen, wrench: _Chosen) -> Iterator[Entry]:
    channel, first = next(iter(chosen.values()))
    yield Entry(key="topic", value=channel.topic, evidence="")
    fields = _fields(chosen)
    ranges = "; ".join(f"{part} {span_text(channel, paths)}" for part, paths in fields.items())
    said = "by name" if first.words or first.components else "four columns of norm 1"
    yield Entry(key="fields", value=fields, evidence=f"{said}; {ranges}")
    if role in (Role.WRENCH, Role.DESIRED_FORCE):
        yield from _wrench_entries(channel, chosen, fields)
    elif role is not Role.TWIST:
        force = wrench.get("force")
        beside = channel.of(_fields(wrench)["force"]) if force is not None and force[0] is channel else None
        yield from _pose_entries(channel, chosen, fields, beside)


def _wrench_entries(channel: NamedChannel, chosen: _Chosen, fields: Mapping[str, list[str]]) -> Iterator[Entry]:
    force = chosen["force"][1]
    units: dict[str, object] = {"force": force.unit if force.unit in FORCE_UNITS else "N"}
    why = ["by name" if force.unit else "newtons are usual"]
    if "torque" in chosen:
        torque = chosen["torque"][1]
        sizes = [float(np.nanmax(np.ptp(channel.of(fields[part]), axis=0))) for part in ("force", "torque")]
        unit = torque.unit if torque.unit in TORQUE_N_M else ""
        if not unit and sizes[1] > _N_MM_RATIO * sizes[0]:
            unit = "N·mm"
            why.append(f"torques vary {sizes[1] / sizes[0]:.0f} times as much as forces")
        units["torque"] = unit or "N·m"
    yield Entry(key="units", value=units, evidence="; ".join(why))
    words = {*force.words}
    loads = np.linalg.norm(channel.of(fields["force"]), axis=1)
    if {"f", "ext", "hat"} <= words or ({"tcp", "force"} <= words and force.kind is Meaning.WRENCH):
        maker = "Franka's estimate of the external wrench" if "hat" in words else "UR's force at the TCP"
        base = "hat" not in words or force.words[0] == "o"
        yield Entry(key="expressed_in", value="base" if base else "sensor", evidence=f"{maker}, by name")
        yield Entry(key="gravity_compensated", value=True, evidence=f"{maker}, by name")
        if "hat" in words:
            yield Entry(key="exerted_by", value="sensor", evidence="the robot's force on its surroundings, by name")
    elif not force.is_command and _is_unloaded(loads):
        yield Entry(key="gravity_compensated", value=True, evidence=_UNLOADED)


def _is_unloaded(loads: FloatArray) -> bool:
    """Return whether a load (n,) is near 0 at its beginning and end, beside its largest."""
    rows = max(1, len(loads) // _ENDS)
    ends = [float(np.nanmedian(part)) for part in (loads[:rows], loads[-rows:])]
    return max(ends) < UNLOADED_SHARE * float(np.nanmax(loads))


def _asked_entries(channel: NamedChannel, force: NamedVector) -> Iterator[Entry]:
    """Yield the entries of a desired force along one axis; F^d of the others is then taken as 0."""
    fields = [force.paths[0] if axis == force.components else None for axis in "xyz"]
    yield Entry(key="topic", value=channel.topic, evidence="")
    yield Entry(key="fields", value={"force": fields}, evidence=f"by name; {span_text(channel, force.paths)}")
    if force.unit in FORCE_UNITS:
        yield Entry(key="units", value={"force": force.unit}, evidence="by name")


def _pose_entries(
    channel: NamedChannel, chosen: _Chosen, fields: Mapping[str, list[str]], force: FloatArray | None
) -> Iterator[Entry]:
    units: dict[str, object] = {}
    why = []
    kind, about = "", ""
    if "orientation" in chosen:
        vector = chosen["orientation"][1]
        turns = channel.of(fields["orientation"])
        kind, about = _orientation(vector, turns)
        if turns.shape[1] == 3:
            largest = float(np.nanmax(np.abs(turns)))
            by_name = vector.unit if vector.unit in ("rad", "deg") else ""
            units["angle"] = by_name or ("deg" if largest > _LARGEST_RAD else "rad")
            why.append("angle by name" if by_name else f"angles up to {largest:.4g}")
            if force is not None:
                angles = np.radians(turns) if units["angle"] == "deg" else turns
                are_rests = len(turns) <= _MOST_POSES and leaps(turns)
                kind, about = read_by_weight(angles, force, (kind, about), are_rests=are_rests)
    if "position" in chosen:
        vector = chosen["position"][1]
        largest = float(np.nanmax(np.abs(channel.of(fields["position"]))))
        by_name = vector.unit if vector.unit in ("mm", "cm", "m", "in") else ""
        units = {"position": by_name or ("mm" if largest > _FARTHEST_M else "m"), **units}
        why.insert(0, "position by name" if by_name else f"positions up to {largest:.4g}")
    if units:
        yield Entry(key="units", value=units, evidence="; ".join(why))
    if kind:
        yield Entry(key="orientation_as", value=kind, evidence=about)


def _orientation(vector: NamedVector, turns: FloatArray) -> tuple[str, str]:
    """Return how an orientation is written, and why."""
    if turns.shape[1] in (_NINE, _SIXTEEN):
        return _matrix(turns)
    if turns.shape[1] == 4:
        if vector.components == "xyzw":
            return "quaternion_xyzw", "by name"
        counted = "four counted parts do not say whether w is first or last; " if vector.words else ""
        return (
            "quaternion_xyzw",
            f"{counted}or quaternion_wxyz: identify compares both with the weight where the tool tilts",
        )
    if vector.components == "abc":
        return "euler_ZYX", "A, B and C as KUKA's: about z, y and x of the moved axes"
    if vector.components == "rpy" or {"rpy", "euler"} & {*vector.words}:
        return "euler_xyz", "roll, pitch and yaw about the fixed x, y and z; or another euler_…"
    return "rotation_vector", "three numbers; or euler_xyz, euler_ZYZ, …: check it in the robot's manual"


def _matrix(entries: FloatArray) -> tuple[str, str]:
    """Return in which order a matrix is written; nine entries are known by row and column."""
    if entries.shape[1] == _NINE:
        return ROW_MAJOR, "by name: row, then column"
    last_of_column = float(np.nanmax(np.abs(entries[:, [3, 7, 11]])))
    kind = COLUMN_MAJOR if last_of_column < _NORM_TOLERANCE else ROW_MAJOR
    return kind, "the entries that are 0 throughout are the last row of the matrix"
