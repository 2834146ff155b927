"""Units and ways to tell an orientation that a log may be declared to use."""

import re
from collections.abc import Mapping

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
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})")
_QUATERNIONS = ("quaternion_xyzw", "quaternion_wxyz")


def orientation_width(kind: str) -> int:
    """Count the numbers of an orientation; raise ParameterError for a kind that is not known."""
    if kind in _QUATERNIONS:
        return 4
    match = _EULER.fullmatch(kind)
    if kind == "rotation_vector" or (match and all(a != b for a, b in zip(match[1], match[1][1:], strict=False))):
        return 3
    must = (
        "quaternion_xyzw, quaternion_wxyz, rotation_vector, or euler_ and three axes, no two neighbours alike "
        "(euler_ZYZ about the moved axes, euler_xyz about the fixed ones)"
    )
    raise ParameterError("orientation_as", kind, must)


def check_unit(name: str, unit: str, known: Mapping[str, float]) -> None:
    """Raise ParameterError for a unit that is not known."""
    if unit not in known:
        raise ParameterError(name, unit, f"one of {', '.join(known)}")
