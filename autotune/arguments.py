"""Check the arguments of the public functions, and let errors speak of them instead of the command line's options."""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from autotune.errors import AutotuneError, UsageError
from autotune.formats.quantity import Interval, Quantity, Uncertain, as_interval, as_number, as_quantity
from autotune.quantities import check_given
from identification.given import Given
from problems.errors import ParameterError, shown

# In a command within backticks an option is one.
_COMMAND = re.compile(r"`autotune [^`]*`")
_REWORDED = (
    # Arguments are in SI: there is no unit that could be said.
    (re.compile(r" If it is meant, say its unit: --\S+ \S+?\.(?=\s|$)"), ""),
    (re.compile(r"--environment-stiffness LO:HI"), "environment_stiffness=(low, high)"),
    (re.compile(r"--(compare|gains) mass=(\d+),damping=(\d+)"), r'\1={"mass": \2, "damping": \3}'),
    (re.compile(r"`?--salvage`?"), "salvage=True (an argument of read_log)"),
    (re.compile(r"--allow-partial"), "allow_partial=True"),
    (re.compile(r"--given ([\w.{}]+)=([A-Z]+)"), r'given={"\1": \2}'),
    (re.compile(r"(?<![\w-])--([a-z]+(?:-[a-z]+)*)"), lambda found: found[1].replace("-", "_")),
)


def in_arguments(text: str, *, compare: str = "compare") -> str:
    """Return a sentence in which options of the command line are arguments of Python, --compare being `compare`."""
    commands = _COMMAND.findall(text)
    parts = _COMMAND.split(text.replace("--compare", f"--{compare}"))
    for pattern, said in _REWORDED:
        parts = [pattern.sub(said, part) for part in parts]
    return "".join(part + command for part, command in zip(parts, [*commands, ""], strict=True))


@contextmanager
def errors_in_arguments(*, compare: str = "compare") -> Iterator[None]:
    """Let errors of the block speak of arguments; `compare` is that of --compare."""
    try:
        yield
    except AutotuneError as error:
        error.args = tuple(
            in_arguments(each, compare=compare) if isinstance(each, str) else each for each in error.args
        )
        raise


def file_path(name: str, given: object) -> Path:
    """Return the path of a file; raises UsageError for what is none."""
    if isinstance(given, str | os.PathLike) and isinstance(os.fspath(given), str):
        return Path(os.fspath(given))
    raise UsageError(f"{name} must be the path of a file, found {_kind(given)}.")


def file_paths(name: str, given: object) -> tuple[Path, ...]:
    """Return one or several paths; raises UsageError for what is none."""
    if isinstance(given, list | tuple):
        return tuple(file_path(f"each of {name}", each) for each in given)
    if isinstance(given, str | os.PathLike):
        return (file_path(name, given),)
    raise UsageError(f"{name} must be the path of a file or several in a list, found {_kind(given)}.")


def count(name: str, given: object, *, least: int = 0, most: int | None = None) -> int:
    """Return a whole number of at least `least`, and at most `most`; raises UsageError for anything else."""
    try:
        if isinstance(given, bool):
            raise TypeError(name)
        found = index(given)  # type: ignore[arg-type]
    except TypeError:
        found = least - 1
    if found < least or (most is not None and found > most):
        allowed = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise UsageError(f"{name} must be a whole number {allowed}, found {shown(given)}.")
    return found


def truth(name: str, given: object) -> bool:
    """Return what is True or False; raises UsageError for anything else."""
    if isinstance(given, bool | np.bool_):
        return bool(given)
    raise UsageError(f"{name} must be True or False, found {shown(given)}.")


def axis_names(given: object) -> tuple[str, ...] | None:
    """Return the names of axes, None for all; raises UsageError for an empty list and for what is no name."""
    if given is None:
        return None
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, list | tuple) or not names or not all(isinstance(each, str) for each in names):
        raise UsageError(f'axes must be names of axes as in ["x", "rz"], or None for all; found {shown(given)}.')
    return tuple(names)


def interval(name: str, given: Quantity | None) -> Interval | None:
    """Return the range of a quantity above 0, None for none; raises ParameterError for what is no quantity."""
    return None if given is None else as_interval(name, as_quantity(name, given, may_vanish=False), may_vanish=False)


def priors(given: Mapping[str, float | Uncertain] | None) -> dict[str, Given]:
    """Return what is known from elsewhere; raises UsageError for a name or number that is none."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise UsageError(f'given must be a dictionary as in {{"mass_kg": 16.2}}, found {_kind(given)}.')
    return {str(name): _prior(str(name), each) for name, each in given.items()}


def _prior(name: str, given: Any) -> Given:
    said = f"given[{name!r}]"
    try:
        value, std = (given.value, given.std) if isinstance(given, Uncertain) else (as_number(said, given), 0.0)
    except ParameterError:
        raise UsageError(f"{said} must be a finite number or Uncertain(value, std), found {shown(given)}.") from None
    check_given(name, value, std, said)
    return Given(value=value, std=std)


def _kind(given: object) -> str:
    text, name = shown(given), type(given).__name__
    return text if given is None or text.endswith(f" {name}") else f"{text} of type {name}"
