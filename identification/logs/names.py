"""What names and values of columns and fields say: which numbers form a vector, of what, in which unit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from problems.arrays import FloatArray
from problems.frozen import FrozenDict, freeze

from .roles.registry import COMMAND_WORDS, PROCESSED_WORDS

_FORCE = frozenset({"f", "force", "forces", "fext", "kraft", "kräfte", "kraefte"})
_TORQUE = frozenset(
    {"m", "mom", "moment", "moments", "momente", "torque", "torques", "tau", "trq", "drehmoment", "drehmomente"}
)
_WRENCH = frozenset({"wrench", "ft", "fts", "ftsensor"})
_POSITION = frozenset(
    {"p", "pos", "position", "positions", "translation", "trans", "xyz", "tcp", "ee", "eef", "flange", "tool", "pose"}
    | {"lage", "ort", "flansch", "werkzeug"}
)
_TURN = frozenset(
    {"q", "quat", "quaternion", "orientation", "orient", "ori", "rot", "rotation", "r", "rotvec", "rv", "euler", "rpy"}
    | {"orientierung", "drehung", "winkel"}
)
_LOAD = frozenset({"load", "last"})
_DISPLACEMENT = frozenset(
    {
        "displacement",
        "disp",
        "travel",
        "stroke",
        "indentation",
        "penetration",
        "deflection",
        "extension",
        "weg",
        "depth",
    }
)
_VELOCITY = frozenset({"v", "vel", "velocity", "speed", "twist", "w", "omega", "geschwindigkeit"})
_OTHER = frozenset(
    {"acc", "accel", "acceleration", "joint", "joints", "motor", "jerk", "temp", "imu", "std", "cov", "qd"}
)
_TRANSLATION_OR_TORQUE = "t"
_KNOWN = _FORCE | _TORQUE | _WRENCH | _POSITION | _DISPLACEMENT | _TURN | _VELOCITY | _OTHER | {_TRANSLATION_OR_TORQUE}
_COMMANDS = COMMAND_WORDS | {"set", "sp", "soll", "rsol", "tgt"}
# German compounds: `Sollkraft` is a commanded force.
_BEFORE = ("soll", "ist")
_MEASURED = frozenset({"actual", "measured", "meas", "act", "ist", "rist", "current", "cur", "real"})
_PROCESSED = PROCESSED_WORDS | {"comp", "ext", "hat", "filt"}
_TIME = frozenset(
    {"t", "time", "times", "timestamp", "stamp", "zeit", "elapsed", "sec", "secs", "seconds", "millis", "nanos", "ipoc"}
    | {"ms", "msec", "us", "µs", "ns", "nsec"}
)
_TIME_UNITS: Mapping[str, str] = FrozenDict(
    {"s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "millis": "ms", "us": "us"}
    | {"µs": "us", "ns": "ns", "nsec": "ns", "nanos": "ns", "ipoc": "ms"}
)
UNITS: Mapping[str, str] = FrozenDict(
    {
        "mm": "mm",
        "cm": "cm",
        "m": "m",
        "in": "in",
        "deg": "deg",
        "°": "deg",
        "grad": "deg",
        "degree": "deg",
        "rad": "rad",
    }
    | {"degrees": "deg", "n": "N", "kn": "kN", "lbf": "lbf", "kgf": "kgf", "nm": "N·m", "n·m": "N·m", "n*m": "N·m"}
    | {"n.m": "N·m", "nmm": "N·mm", "n·mm": "N·mm", "knm": "kN·m", "lbfin": "lbf·in", "lbfft": "lbf·ft"}
    | {"lbf·in": "lbf·in", "lbf*in": "lbf·in", "lbf·ft": "lbf·ft", "lbf*ft": "lbf·ft", **_TIME_UNITS}
)
"""Units by how they are written, in small letters."""
_FORCE_UNITS, _TORQUE_UNITS = (
    frozenset({"N", "kN", "lbf", "kgf"}),
    frozenset({"N·m", "N·mm", "kN·m", "lbf·in", "lbf·ft"}),
)
_TRAILING = frozenset(UNITS) - {"m", "in", "°"}
_BRACKETED = re.compile(r"\s*[\[(<{]\s*([^\])>}]*?)\s*[\])>}]\s*$")
_MATRIX = 16
_COUNTED = re.compile(r"(.*?)[._\[]?\d+\]?")
_JOINTS = frozenset({"q", "j", "joint", "joints"})
_ARM_JOINTS = (6, 7)
_TURN_MATRICES = tuple([f"{row}{column}" for row in of for column in of] for of in ("123", "012"))

_LEAP_SHARE = 0.05
_NORM_TOLERANCE = 2e-3


class Meaning(StrEnum):
    """What a vector is."""

    FORCE = "force"
    TORQUE = "torque"
    WRENCH = "wrench"
    POSITION = "position"
    TURN = "orientation"
    POSE = "pose"
    MATRIX = "pose as a matrix"
    LINEAR = "linear velocity"
    ANGULAR = "angular velocity"


@dataclass(frozen=True, kw_only=True)
class NamedVector:
    """Numbers that belong together by name: `paths` in order, the `words` before the component, the `unit` beside it.

    `is_command` and `is_processed` say what the words say; `components` how the numbers are distinguished: `xyz`,
    `xyzw`, `abc`, `rpy`, or nothing where they are counted.
    """

    kind: Meaning
    paths: tuple[str, ...]
    words: tuple[str, ...]
    unit: str
    components: str = ""

    @property
    def is_command(self) -> bool:
        """Whether a word says that it is commanded or desired."""
        return bool(_COMMANDS & {*self.words}) or (len(self.words) > 1 and self.words[-1] == "d")

    @property
    def is_processed(self) -> bool:
        """Whether a word says that it is not as the sensor shows it."""
        return bool(_PROCESSED & {*self.words})

    @property
    def is_measured(self) -> bool:
        """Whether a word says that it was measured."""
        return bool(_MEASURED & {*self.words})


@dataclass(frozen=True, kw_only=True)
class Named:
    """The vectors among the names, the columns that may be the time with their units, and the names of the others.

    `singles` are forces and displacements along one axis that no name says, as of a test of a surface; `asked` are
    commanded forces and places along one axis.
    """

    vectors: tuple[NamedVector, ...]
    times: Mapping[str, str]
    others: tuple[str, ...]
    singles: tuple[NamedVector, ...] = ()
    asked: tuple[NamedVector, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "times")


@dataclass(kw_only=True)
class _Group:
    paths: dict[str, str] = field(default_factory=dict)
    units: dict[str, None] = field(default_factory=dict)


def read_names(paths: Sequence[str], units: Sequence[str] = ()) -> Named:
    """Group names such as `force_x [N]`, `goal.pos.x`, `O_T_EE[3]`, `qw` or `actual_TCP_force_0` into vectors.

    `units` (as many as `paths`, or none) is what a second line of a table writes below each name.
    """
    groups: dict[tuple[str, ...], _Group] = {}
    times: dict[str, str] = {}
    singles: list[NamedVector] = []
    for path, below in zip(paths, units or [""] * len(paths), strict=True):
        words, component, unit = _split(path, below)
        if not component:
            if words and {*words} <= _TIME | _MEASURED:
                times[path] = _TIME_UNITS.get(unit, "") or _TIME_UNITS.get(words[-1], "")
            kind = _kind_of_single(words)
            if kind is not None:
                singles.append(NamedVector(kind=kind, paths=(path,), words=words, unit=UNITS.get(unit, "")))
            continue
        group = groups.setdefault(words, _Group())
        group.paths[component] = path
        group.units[unit] = None
    vectors = tuple(vector for words, group in groups.items() for vector in _vectors(words, group))
    alone = [single for words, group in groups.items() for single in _one_component(words, group)]
    singles += [single for single in alone if not single.is_command]
    asked = tuple(single for single in alone if single.is_command)
    vectors = _with_torques(vectors)
    used = {path for vector in (*vectors, *asked) for path in vector.paths} | {*times}
    others = tuple(path for path in paths if path not in used)
    return Named(vectors=vectors, times=times, others=others, singles=tuple(singles), asked=asked)


def joint_groups(paths: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the six or seven counted numbers of each arm whose names are those of measured joint angles."""
    found: dict[str, list[str]] = {}
    for path in paths:
        counted = _COUNTED.fullmatch(path)
        words = {*re.findall("[a-z]+", counted[1].lower())} if counted is not None else set()
        if counted is not None and _JOINTS & words and words <= _JOINTS | _POSITION | _MEASURED | {"angle", "angles"}:
            found.setdefault(counted[1], []).append(path)
    return [tuple(group) for group in found.values() if len(group) in _ARM_JOINTS]


def _one_component(words: tuple[str, ...], group: _Group) -> Iterator[NamedVector]:
    """Yield the force or the place along one axis, where x, y or z stands alone."""
    known = [word for word in words if word in _KNOWN]
    kind = _kind_of_three(known[-1] if known else "", words)
    if kind in (Meaning.FORCE, Meaning.POSITION) and len(group.paths) == 1 and not {*words} & _OTHER:
        [(component, path)], [unit] = group.paths.items(), group.units
        if component in ("x", "y", "z"):
            found = NamedVector(kind=kind, paths=(path,), words=words, unit=UNITS.get(unit, ""), components=component)
            yield found


def _kind_of_single(words: Sequence[str]) -> Meaning | None:
    if not words or _OTHER & {*words} or _COMMANDS & {*words}:
        return None
    if words[-1] in _FORCE | _LOAD:
        return Meaning.FORCE
    return Meaning.POSITION if words[-1] in _DISPLACEMENT else None


def _split(path: str, unit: str) -> tuple[tuple[str, ...], str, str]:
    """Return the words before the component, the component (empty for a number of its own), and the unit."""
    unit = unit.strip().strip("[](){}<>").lower()
    bracketed = _BRACKETED.search(path)
    if bracketed is not None and bracketed[1].lower() in UNITS:
        unit, path = bracketed[1].lower(), path[: bracketed.start()]
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", path)
    words = [part for word in re.findall(r"[a-zµäöüß]+|\d+", spaced.lower()) for part in _parted(word)]
    if len(words) > 1 and not unit and (words[-1] in _TRAILING or _is_length(words)):
        unit = words.pop()
    if not words:
        return (), "", unit
    if len(words) > 1 and words[-1] in _COMMANDS | _MEASURED | _PROCESSED:
        words = [words[-1], *words[:-1]]  # `x_cmd` is `cmd_x`
    *before, last = words
    if last.isdigit() or last in ("x", "y", "z", "w", "a", "b", "c"):
        return tuple(before), last, unit
    if last in ("roll", "pitch", "yaw"):
        return (*before, "rpy"), last, unit
    if last[-1] in "xyzw" and (last[:-1] in _KNOWN or _kind_by_unit(unit) is not None):
        return (*before, last[:-1]), last[-1], unit
    return tuple(words), "", unit


def _is_length(words: Sequence[str]) -> bool:
    """Return whether the last word is a unit of length: `x_m` is, `m_m` is not, and of inches `pos_x_in` alone is."""
    asked = _COMMANDS | _MEASURED
    *before, component = [word for i, word in enumerate(words[:-1]) if i == 0 or word not in asked]
    is_component = component in ("x", "y", "z")
    is_place = component[-1:] in ("x", "y", "z") and component[:-1] in _POSITION
    if words[-1] == "m":
        return is_place or (is_component and not _FORCE & {*before})
    return words[-1] == "in" and (is_place or (is_component and bool((_POSITION | asked) & {*words})))


def _parted(word: str) -> tuple[str, ...]:
    """Return a German compound in its two words, and an axis with what it is (`Xset`)."""
    if word[0] in "xyzabc" and word[1:] in _COMMANDS | _MEASURED:
        return word[0], word[1:]
    for before in _BEFORE:
        rest = word.removeprefix(before)
        if rest != word and (rest in _KNOWN or (rest[:-1] in _KNOWN and rest[-1:] in "xyz")):
            return before, rest
    return (word,)


def _vectors(words: tuple[str, ...], group: _Group) -> Iterator[NamedVector]:
    known = [word for word in words if word in _KNOWN]
    if _OTHER & {*words}:
        return
    last = known[-1] if known else ""
    unit = next(iter(group.units)) if len(group.units) == 1 else ""

    def vector(kind: Meaning, names: Sequence[str], components: str = "") -> NamedVector:
        paths = tuple(group.paths[name] for name in names)
        return NamedVector(kind=kind, paths=paths, words=words, unit=UNITS.get(unit, ""), components=components)

    if {"roll", "pitch", "yaw"} <= {*group.paths}:
        yield vector(Meaning.TURN, ("roll", "pitch", "yaw"), "rpy")
    elif {*"xyzw"} <= {*group.paths} and last not in _FORCE | _TORQUE:
        yield vector(Meaning.TURN, "xyzw", "xyzw")
    elif {*"xyz"} <= {*group.paths}:
        kind = _kind_of_three(last, words) or _kind_by_unit(unit)
        if kind is not None:
            yield vector(kind, "xyz", "xyz")
        if {*"abc"} <= {*group.paths} and kind is Meaning.POSITION:
            yield vector(Meaning.TURN, "abc", "abc")
    else:
        numbers = sorted((name for name in group.paths if name.isdigit()), key=int)
        counted = [int(name) for name in numbers]
        if last in _TURN and sorted(numbers) in _TURN_MATRICES:
            yield vector(Meaning.MATRIX, sorted(numbers))
            return
        if known and counted and counted in ([*range(len(counted))], [*range(1, 1 + len(counted))]):
            counted_kind = _kind_of_counted(last, words, len(counted))
            if counted_kind is not None:
                yield vector(counted_kind, numbers)


def _kind_of_three(last: str, words: tuple[str, ...]) -> Meaning | None:
    if last in _FORCE | _WRENCH:
        return Meaning.FORCE
    if last in _TORQUE:
        return Meaning.TORQUE
    if last in _VELOCITY:
        turns = last in ("w", "omega") or {"ang", "angular"} & {*words}
        return Meaning.ANGULAR if turns else Meaning.LINEAR
    if last in _TURN:
        return Meaning.TURN
    # Bare x, y and z are a place, as is what has no other word than one for a command or a measurement.
    is_place = last in _POSITION | _DISPLACEMENT or last == _TRANSLATION_OR_TORQUE or {*words} <= _COMMANDS | _MEASURED
    return Meaning.POSITION if is_place else None


def _kind_by_unit(unit: str) -> Meaning | None:
    """Return what a unit alone says: that `Lx [N]`, whatever L is, is a force."""
    written = UNITS.get(unit, "")
    if written in _FORCE_UNITS:
        return Meaning.FORCE
    return Meaning.TORQUE if written in _TORQUE_UNITS else None


def _kind_of_counted(last: str, words: tuple[str, ...], count: int) -> Meaning | None:
    forces = bool((_FORCE | _WRENCH) & {*words})
    if count == _MATRIX:
        return Meaning.MATRIX
    if count == 6 and last in _VELOCITY:
        return None
    if count == 6 and forces:
        return Meaning.WRENCH
    if count == 3:
        return _kind_of_three(last, words)
    if count == 4 and last in _TURN:
        return Meaning.TURN
    return Meaning.POSE if count in (6, 7) and last in _POSITION else None


def _with_torques(vectors: tuple[NamedVector, ...]) -> tuple[NamedVector, ...]:
    """Return the vectors with `tx ty tz` as torques where forces are there and other torques are not."""
    kinds = {vector.kind for vector in vectors}
    if Meaning.FORCE not in kinds or Meaning.TORQUE in kinds:
        return vectors
    return tuple(
        NamedVector(kind=Meaning.TORQUE, paths=v.paths, words=v.words, unit=v.unit, components=v.components)
        if v.kind is Meaning.POSITION and v.words[-1:] == (_TRANSLATION_OR_TORQUE,)
        else v
        for v in vectors
    )


def path_length(values: FloatArray) -> float:
    """Return how often a signal goes its whole range: noise and what rings do so many times."""
    return float(np.sum(np.abs(np.diff(values)))) / max(float(np.ptp(values)), 1e-300)


def unevenness(values: FloatArray) -> float:
    """Return the deviation of the steps of a column (n,) over their mean."""
    steps = np.diff(values)
    return float(np.std(steps) / np.mean(steps))


def rises(values: FloatArray) -> bool:
    """Return whether a column (n,) is known throughout and never falls."""
    steps = np.diff(values)
    return bool(np.all(np.isfinite(values)) and np.all(steps >= 0.0) and values[-1] > values[0])


def is_unit(four: FloatArray) -> bool:
    """Return whether every row of four columns (n, 4) has the norm 1."""
    return bool(np.all(np.abs(np.linalg.norm(four, axis=1) - 1.0) < _NORM_TOLERANCE))


def leaps(values: FloatArray) -> bool:
    """Return whether columns (n, k) go far from row to row, as of poses at rest that were averaged."""
    moved = np.ptp(values, axis=0)
    steps = np.median(np.abs(np.diff(values, axis=0)), axis=0)
    return bool(np.median(steps[moved > 0.0] / moved[moved > 0.0]) > _LEAP_SHARE) if np.any(moved > 0.0) else False
