"""The units of one axis: m, N and kg along x, y, z; rad, N·m and kg·m² about rx, ry, rz."""

from dataclasses import dataclass

AXES = ("x", "y", "z", "rx", "ry", "rz")
ROTATIONAL_AXES = frozenset({"rx", "ry", "rz"})


@dataclass(frozen=True, kw_only=True)
class AxisUnits:
    """What a number of an axis is followed by; `mass_name` and `force_name` are what the quantity is called."""

    force: str
    mass: str
    stiffness: str
    damping: str
    admittance: str
    hand: str
    speed: str
    mass_name: str
    force_name: str

    @property
    def shown_stiffness(self) -> tuple[float, str]:
        """Factor and unit in which people read a stiffness: N/mm along an axis, as on data sheets."""
        return (1e-3, "N/mm") if self.stiffness == "N/m" else (1.0, self.stiffness)


_TRANSLATION = AxisUnits(
    force="N",
    mass="kg",
    stiffness="N/m",
    damping="N·s/m",
    admittance="m/s/N",
    hand="N/(m/s)",
    speed="m/s",
    mass_name="mass",
    force_name="force",
)
_ROTATION = AxisUnits(
    force="N·m",
    mass="kg·m²",
    stiffness="N·m/rad",
    damping="N·m·s/rad",
    admittance="rad/s/(N·m)",
    hand="N·m/(rad/s)",
    speed="rad/s",
    mass_name="inertia",
    force_name="torque",
)


def axis_units(axis: str) -> AxisUnits:
    """Return the units of the axis `axis`, one of x, y, z, rx, ry, rz."""
    return _ROTATION if axis in ROTATIONAL_AXES else _TRANSLATION
