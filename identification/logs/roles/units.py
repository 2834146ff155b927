"""Units in which logs are written, each as so much of its SI unit."""

from collections.abc import Collection, Mapping

from problems.errors import ParameterError

FORCE_N: Mapping[str, float] = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665}
TORQUE_N_M: Mapping[str, float] = {
    "N·m": 1.0,
    "Nm": 1.0,
    "N·mm": 1e-3,
    "Nmm": 1e-3,
    "kN·m": 1e3,
    "kNm": 1e3,
    "lbf·in": 4.4482216152605 * 0.0254,
    "lbf·ft": 4.4482216152605 * 0.3048,
}
LENGTH_M: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
ANGLE_RAD: Mapping[str, float] = {"rad": 1.0, "deg": 0.017453292519943295}


def check_unit(name: str, unit: str, known: Collection[str]) -> None:
    """Raise ParameterError for a unit that is not known."""
    if unit not in known:
        raise ParameterError(name, unit, f"one of {', '.join(known)}")
