"""What the runtime needs of a controller file, as frozen values that are checked once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from numbers import Real
from types import MappingProxyType

from autotune.errors import CertificateError, UsageError
from problems.difference import write_blocks
from problems.errors import ParameterError

Vector = tuple[float, float, float]
Interval = tuple[float, float]

AXES = ("x", "y", "z", "rx", "ry", "rz")
TRANSLATIONS = 3

# Of the Tustin rule, the only one that a controller file may say.
_THETA = 0.5
# A sample time is declared, not measured: the same number, or another one.
SAME_SAMPLE_TIME = 1e-6
# What a payload that was identified well still leaves of its weight (the paper: 1.1 N of 157 N).
_WEIGHT_LEFT = 0.01

STANDARD_GRAVITY_M_S2 = 9.80665
"""With which the mass in the file was identified, so that mass times this is the weight that was measured."""


class CollisionResponse(StrEnum):
    """What follows a collision: nothing, the reset of the paper's Algorithm 1, or a full stop."""

    NONE = "none"
    RESET = "reset"
    STOP = "stop"


@dataclass(frozen=True, kw_only=True)
class Payload:
    """What the gravity compensation takes off the wrench, in the sensor frame S; gravity in the world frame W.

    `mass_kg`, `com_S_m` (3,), `force_bias_S_n` (3,), `torque_bias_S_n_m` (3,) about the sensor's origin and
    `gravity_W_m_s2` (3,), which points down.

    Raises ParameterError: something is not finite, or the mass below 0.
    """

    mass_kg: float
    com_S_m: Vector
    force_bias_S_n: Vector
    torque_bias_S_n_m: Vector
    gravity_W_m_s2: Vector = (0.0, 0.0, -STANDARD_GRAVITY_M_S2)

    def __post_init__(self) -> None:
        if not _is_number(self.mass_kg) or not 0.0 <= self.mass_kg < math.inf:
            raise ParameterError("mass_kg", self.mass_kg, "a finite number and not below 0")
        object.__setattr__(self, "mass_kg", float(self.mass_kg))
        for name in ("com_S_m", "force_bias_S_n", "torque_bias_S_n_m", "gravity_W_m_s2"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))


def _vector(name: str, values: Sequence[float]) -> Vector:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ParameterError(name, values, "three finite numbers") from None
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ParameterError(name, values, "three finite numbers")
    return numbers[0], numbers[1], numbers[2]


@dataclass(frozen=True, kw_only=True)
class AxisLaw:
    """The control law of one axis, in N, m, kg or, about rx, ry, rz, in N·m, rad, kg·m².

    `mass` M_a, `damping` B_a, `lead_s` K_l, `feedback_damping_s` B_fb, both filters' corners and `compensation_mass_kg`
    P̂; `payload_range` holds the masses, or inertias, for which the certificate holds. `blocks` are the coefficients of
    `problems.difference.controller_step` in the Tustin form at `sample_time_s`, by row and column.
    """

    name: str
    sample_time_s: float
    mass: float
    damping: float
    lead_s: float
    feedback_damping_s: float
    velocity_filter_rad_per_s: float
    acceleration_filter_rad_per_s: float
    compensation_mass_kg: float
    deadband: float
    is_subtractive: bool
    payload_range: Interval
    index: int = field(init=False)
    blocks: Mapping[tuple[int, int], float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        blocks: dict[tuple[int, int], float] = {}
        numbers = (self.mass, self.damping, self.lead_s, self.feedback_damping_s)
        filters = (self.velocity_filter_rad_per_s, self.acceleration_filter_rad_per_s, self.compensation_mass_kg)
        write_blocks(blocks, (*numbers, *filters), self.sample_time_s, _THETA, ideal=False)
        if not all(map(math.isfinite, blocks.values())):
            raise ParameterError(
                f"axes.{self.name}", numbers, "gains whose difference equation has finite coefficients"
            )
        object.__setattr__(self, "index", AXES.index(self.name))
        object.__setattr__(self, "blocks", blocks)

    @property
    def turns(self) -> bool:
        """Whether this is one of rx, ry, rz."""
        return self.index >= TRANSLATIONS


@dataclass(frozen=True, kw_only=True)
class RuntimeController:
    """A controller file that was verified, ready to be stepped: the tuned axes in the order x y z rx ry rz.

    `threshold_n` is that of the collision detection, infinite without a response. `checksum` is that of the file.
    """

    checksum: str
    sample_time_s: float
    axes: tuple[AxisLaw, ...]
    response: CollisionResponse
    threshold_n: float
    payload: Payload

    def check_cell(
        self, *, sample_time_s: float, payload_mass_kg: float, payload_inertia_kg_m2: Mapping[str, float] | None = None
    ) -> None:
        """Raise CertificateError unless the certificate holds for this cell's period and payload.

        `payload_inertia_kg_m2` is by axis, for each of rx, ry, rz that is tuned. The mass that is compensated must be
        that of the cell: what is left of the weight pushes the robot once it is beyond the deadband. Raises UsageError
        for what is no number and for inertias about another axis.
        """
        h, inertias = self.sample_time_s, _told_inertias(payload_inertia_kg_m2)
        _check_number("sample_time_s", sample_time_s)
        _check_number("payload_mass_kg", payload_mass_kg)
        if not abs(sample_time_s - h) <= SAME_SAMPLE_TIME * h:
            raise CertificateError(
                f"The cell runs every {sample_time_s:g} s, but the controller and its certificate are for {h:g} s; "
                "run the cell at that period, or optimize for this one."
            )
        for axis in self.axes:
            if axis.turns and axis.name not in inertias:
                low, high = axis.payload_range
                raise CertificateError(
                    f"Axis {axis.name} is certified for an inertia from {low:g} to {high:g} kg·m²; "
                    f"tell the payload's in payload_inertia_kg_m2."
                )
            told, what, unit = (payload_mass_kg, "mass", "kg")
            if axis.turns:
                told, what, unit = inertias[axis.name], "inertia", "kg·m²"
            _check_range(axis, told, what, unit)
        self._check_weight(payload_mass_kg)

    def _check_weight(self, mass_kg: float) -> None:
        gravity = math.hypot(*self.payload.gravity_W_m_s2)
        left = abs(mass_kg - self.payload.mass_kg) * gravity
        widths = [axis.deadband for axis in self.axes if not axis.turns]
        allowed = max(min(widths, default=math.inf), _WEIGHT_LEFT * mass_kg * gravity)
        if not left <= allowed:
            raise CertificateError(
                f"The gravity compensation is for {self.payload.mass_kg:g} kg and would leave {left:.3g} N of the "
                f"cell's {mass_kg:g} kg, more than {allowed:.3g} N; give the payload that the cell carries in payload."
            )


def _told_inertias(told: Mapping[str, float] | None) -> Mapping[str, float]:
    """Return the inertias by axis; an unknown name would be an inertia that is checked against nothing."""
    if told is None:
        return MappingProxyType({})
    if not isinstance(told, Mapping):
        raise UsageError(f"payload_inertia_kg_m2 must hold inertias by axis, as {{'rz': 0.4}}; found {told!r}.")
    for name, inertia in told.items():
        if name not in AXES[TRANSLATIONS:]:
            raise UsageError(f"payload_inertia_kg_m2 is by axis, rx, ry or rz; found {name!r}.")
        _check_number(f"payload_inertia_kg_m2[{name!r}]", inertia)
    return told


def _check_number(what: str, told: object) -> None:
    if not _is_number(told):
        raise UsageError(f"{what} must be a number, found {told!r}.")


def _is_number(told: object) -> bool:
    return isinstance(told, Real) and not isinstance(told, bool)


def _check_range(axis: AxisLaw, told: float, what: str, unit: str) -> None:
    low, high = axis.payload_range
    if not low <= told <= high:
        raise CertificateError(
            f"The payload's {what} of {told:g} {unit} is outside of what axis {axis.name} is certified for, "
            f"{low:g} to {high:g} {unit}; optimize for a range that holds it."
        )
