"""Gains as a person says them: numbers with units, those of a log, of a cell.yaml or of a controller file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from autotune.arguments import file_path
from autotune.errors import UsageError
from autotune.formats.controller import ControllerFile, read_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.kinds import check_kind
from autotune.formats.units import ROTATIONAL_AXES
from autotune.formats.yaml12 import kind_of_file
from autotune.quantities import parse_quantity

from .law import PresentGains, law_of_gains

LOGGED = "log"
"""Placeholder of the gains with which the contacts of the log were recorded."""
Present = Mapping[str, Any] | ControllerFile | str | Path | None


def present_gains(said: Present, file: IdentifiedFile | None, axes: Sequence[str] | None = None) -> PresentGains | None:
    """Return the gains of today: numbers, those in the log or a cell.yaml, or a controller.

    Parameters
    ----------
    said
        Gains by name, or by axis and name; a text as in mass=10,damping=1500 or x.mass=10,x.damping=1500; "log"; a
        controller file or its path, or that of a cell.yaml; None for those in the log where it holds some.
    file
        What was identified; None where that is not at hand, which gains in the log then need.
    axes
        The axes that are tuned; all of the file unless they are said.

    Returns
    -------
    PresentGains or None
        By axis; None where nothing was said and the log holds none.

    Raises
    ------
    UsageError
        The gains are none, or it is not said of which axis they are.
    CertificateError
        The controller file is altered.

    """
    names = tuple(axes if axes is not None else file.result.axes if file is not None else ())
    if said is None:
        try:
            return None if file is None else PresentGains.of_log(file.result, names)
        except UsageError:
            return None
    if said == LOGGED:
        if file is None:
            raise UsageError("--compare log needs the identified.yaml that the controller is from; give it too.")
        return PresentGains.of_log(file.result, names)
    if isinstance(said, Mapping) or (isinstance(said, str) and "=" in said):
        return _said_gains(said, names)
    return _gains_of_file(said, names)


def _said_gains(said: Mapping[str, Any] | str, axes: Sequence[str]) -> PresentGains:
    """Return gains in numbers: those of a mapping in SI, those of a text in units of the axis."""
    if isinstance(said, str):
        parts = [part.partition("=") for part in said.split(",")]
        texts = {
            axis: ",".join(f"{name}={value}" for name, value in gains.items())
            for axis, gains in _by_axis([(name.strip(), value) for name, _, value in parts], axes).items()
        }
        laws = {axis: law_of_gains(parse_gains(text, axis, "--compare")) for axis, text in texts.items()}
        return PresentGains(laws=laws, label=said)
    flat = [(key, each) for key, each in said.items() if not isinstance(each, Mapping)]
    nested = [(key, each) for key, each in said.items() if isinstance(each, Mapping)]
    flat += [(f"{axis}.{name}", value) for axis, gains in nested for name, value in gains.items()]
    laws = {axis: law_of_gains(gains) for axis, gains in _by_axis(flat, axes).items()}
    return PresentGains(laws=laws, label=",".join(f"{name}={value}" for name, value in flat))


def _gains_of_file(said: ControllerFile | str | Path, axes: Sequence[str]) -> PresentGains:
    if isinstance(said, ControllerFile):
        return PresentGains.of_file(said)
    if isinstance(said, str) and not said.strip():
        raise UsageError("--compare must be gains as in mass=10,damping=1500, log or a file; found an empty text.")
    path = file_path("--compare", said)
    check_kind(path, ("controller", "cell"))
    if kind_of_file(path) == "cell":
        from autotune.formats.cell import read_cell  # noqa: PLC0415 - brings the readers of logs along

        return PresentGains.of_cell(read_cell(path), axes)
    return PresentGains.of_file(read_controller(path))


def _by_axis(pairs: Sequence[tuple[str, Any]], axes: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return gains by axis: x.mass is that of x, and mass alone that of the only axis; raises UsageError otherwise."""
    found: dict[str, dict[str, Any]] = {}
    for name, value in pairs:
        axis, point, gain = name.rpartition(".")
        if not point and len(axes) > 1:
            every = ",".join(f"{each}.{name}=…" for each in axes)
            raise UsageError(
                f"Compared are the axes {', '.join(axes)}, and {name} is said of none of them; say {every}."
            )
        if point and axis not in axes:
            raise UsageError(f"Compared gains must be of an axis that is tuned ({', '.join(axes)}); found {name}.")
        of = found.setdefault(axis or axes[0], {})
        if gain in of:
            raise UsageError(f"Compared gains must name each gain once; found {name} twice.")
        of[gain] = value
    return found


def parse_gains(text: str, axis: str | None, option: str = "--gains") -> dict[str, float | str]:
    """Return gains of the form mass=13,damping=1000,lead=20ms; raises UsageError."""
    turns = axis in ROTATIONAL_AXES
    kinds = {
        "mass": "inertia" if turns else "mass",
        "damping": "rotational damping" if turns else "damping",
        "lead": "time",
        "feedback_damping": "time",
        "deadband": "torque" if turns else "force",
    }
    found: dict[str, float | str] = {}
    for name, value in parse_pairs(text, option, (*kinds, "deadband_type")):
        found[name] = value if name == "deadband_type" else parse_number(value, kinds[name], option)
    return found


def parse_pairs(text: str, option: str, known: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the pairs of a text NAME=VALUE,… whose names are `known`, each once; raises UsageError."""
    pairs: list[tuple[str, str]] = []
    for part in text.split(","):
        name, sign, value = (each.strip() for each in part.partition("="))
        if not sign or name not in known or name in dict(pairs):
            raise UsageError(f"{option} must be NAME=VALUE,… with {', '.join(known)}, each once; found {part!r}.")
        pairs.append((name, value))
    return pairs


def parse_number(text: str, kind: str, option: str) -> float:
    """Return a number of a kind in SI; raises UsageError that names the option."""
    try:
        return parse_quantity(text, kind).value
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from None
