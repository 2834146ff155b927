"""What may be said of the work on runs, of all of them or of one: how `identify` reads, and whether controllers are."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
from autotune.formats.cell import CellFile
from autotune.pipeline import IdentifyOptions
from autotune.quantities import parse_given
from autotune.windows import window_length_s
from identification.given import Given
from identification.logs.read import Instant, LogSpan
from problems.errors import ParameterError
from problems.frozen import freeze

_TRUTHS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_ALWAYS_SAID = ("optimize", "seed")
_NOT_READ = (*_ALWAYS_SAID, "urdf")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Whether controllers are searched, the seed of the search, and how `identify` reads (as in `IdentifyOptions`)."""

    optimize: bool = True
    seed: int = 0
    allow_partial: bool = False
    salvage: bool = False
    wrench_topic: str | None = None
    pose_topic: str | None = None
    command_topic: str | None = None
    urdf: Path | None = None
    tip: str | None = None
    start: Instant | None = None
    stop: Instant | None = None
    windows_s: float | None = None
    given: Mapping[str, Given] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "given")

    def tree(self) -> dict[str, Any]:
        """Return what is part of a run's key, without files; options that are not used are no part of it."""
        own = {**vars(self), "given": {name: asdict(each) for name, each in self.given.items()}}
        unused = {name for name, value in own.items() if value is None or value is False or value == {}} | {"urdf"}
        return {name: value for name, value in own.items() if name in _ALWAYS_SAID or name not in unused}

    def of_identify(self, cell: CellFile | None) -> IdentifyOptions:
        """Return how the logs of a run are read."""
        own = {name: value for name, value in vars(self).items() if name not in _NOT_READ}
        return IdentifyOptions(cell=cell, urdf=None if self.urdf is None else str(self.urdf), **own)


def _truth(said: Any) -> bool:
    found = _TRUTHS.get(str(said).strip().lower())
    if found is None:
        raise ValueError(f"must be true or false, found {said!r}.")
    return found


def _seed(said: Any) -> int:
    if isinstance(said, bool) or not str(said).strip().isdecimal():
        raise ValueError(f"must be a whole number of 0 or more, found {said!r}.")
    return int(said)


def _instant(said: Any) -> Instant:
    try:
        return float(said)
    except (TypeError, ValueError):
        return str(said)


def _given(said: Any) -> Mapping[str, Given]:
    if isinstance(said, Mapping):
        said = [f"{name}={value}" for name, value in said.items()]
    return parse_given(said.split(";") if isinstance(said, str) else said)


_OPTIONS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "optimize": ("optimize", _truth),
    "seed": ("seed", _seed),
    "allow_partial": ("allow_partial", _truth),
    "salvage": ("salvage", _truth),
    "wrench_topic": ("wrench_topic", str),
    "pose_topic": ("pose_topic", str),
    "command_topic": ("command_topic", str),
    "urdf": ("urdf", Path),
    "tip": ("tip", str),
    "from": ("start", _instant),
    "to": ("stop", _instant),
    "windows": ("windows_s", window_length_s),
    "given": ("given", _given),
}
OPTION_NAMES = tuple(_OPTIONS)
"""How a manifest calls them: as the command line does, with _ for -."""


def read_options(place: str, said: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the fields of `RunOptions` that a manifest says of a run; `folder` is that of relative paths.

    Raises UsageError, which begins with `place`, for an option that there is not, or a value that it cannot have.
    """
    found: dict[str, Any] = {}
    for name, value in said.items():
        if name not in _OPTIONS:
            raise UsageError(f"{place}: there is no option {name}; there are {', '.join(OPTION_NAMES)}.")
        key, read = _OPTIONS[name]
        try:
            found[key] = read(value)
        except (ValueError, UsageError) as error:
            raise UsageError(f"{place}, option {name}: {str(error).replace('--given ', '')}") from error
    if found.get("urdf") is not None:
        found["urdf"] = folder / found["urdf"]
        if not found["urdf"].is_file():
            raise UsageError(f"{place}, option urdf: {found['urdf']} is not there.")
    try:
        LogSpan(start=found.get("start"), stop=found.get("stop"))
    except ParameterError as error:
        raise UsageError(f"{place}, option {error}") from error
    return found
