"""The two kinds of axis: what a quantity's unit is along one and about one, and what its entry in a file is called."""

from dataclasses import dataclass
from typing import Literal

QuantityKind = Literal["stiffness", "damping", "mass", "time", "frequency", "ratio"]

# What a name ends with along an axis, and about one; the first that fits holds.
_ENDINGS = (
    ("_m_s_per_n", "_rad_s_per_n_m"),
    ("_n_per_m_s", "_n_m_per_rad_s"),
    ("_n_s_per_m", "_n_m_s_per_rad"),
    ("_n_per_m", "_n_m_per_rad"),
    ("_kg", "_kg_m2"),
    ("_rms_m", "_rms_rad"),
    ("_m_s", "_rad_s"),
    ("_n", "_n_m"),
)
_NOUNS = {"force": "torque", "mass": "inertia", "position": "angle"}

LEVER_M = 0.2
"""Where an angle is counted as a path: the deadbands of the paper, 5 N and 1 N·m, are one at this distance."""
_SHOWN = {"s": (1e3, "ms"), "N/m": (1e-3, "N/mm")}


def for_people(unit: str) -> tuple[float, str]:
    """Return factor and unit in which people read a number of an SI unit: times in ms, stiffness in N/mm."""
    return _SHOWN.get(unit, (1.0, unit))


@dataclass(frozen=True, kw_only=True)
class AxisKind:
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
    time: str = "s"
    frequency: str = "Hz"
    ratio: str = ""

    @property
    def shown_stiffness(self) -> tuple[float, str]:
        """Factor and unit in which people read a stiffness: N/mm along an axis, as on data sheets."""
        return for_people(self.stiffness)

    def unit(self, kind: QuantityKind) -> str:
        """Return the SI unit of a kind of quantity."""
        return str(getattr(self, kind))

    def shown(self, kind: QuantityKind) -> tuple[float, str]:
        """Return factor and unit in which people read a kind of quantity: stiffness in N/mm, times in ms."""
        return for_people(self.unit(kind))


STRAIGHT = AxisKind(
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
TURNING = AxisKind(
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


def rotational_name(name: str) -> str:
    """Return what an entry of a straight axis is called about a turning one: `peak_force_n` is `peak_torque_n_m`."""
    old, new = next(((old, new) for old, new in _ENDINGS if name.endswith(old)), ("", ""))
    words = name.removesuffix(old).split("_")
    return "_".join(_NOUNS.get(word, word) for word in words) + new
