"""Control laws and payload of a controller file as frozen values, checked once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real

from autotune.formats.limits import Biquad, VariableDampingSettings
from autotune.formats.units import AXES
from problems.errors import ParameterError
from problems.model.difference import write_blocks

Vector = tuple[float, float, float]
Interval = tuple[float, float]
Blocks = Mapping[tuple[int, int], float]

TRANSLATIONS = 3

# Of the Tustin rule, the only one that a controller file may say.
_THETA = 0.5

STANDARD_GRAVITY_M_S2 = 9.80665
"""With which the mass in the file was identified, so that mass times this is the weight that was measured."""


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
        if not is_number(self.mass_kg):
            raise ParameterError("mass_kg", type(self.mass_kg).__name__, "a finite number")
        if not 0.0 <= self.mass_kg < math.inf:
            raise ParameterError("mass_kg", self.mass_kg, "a finite number and not below 0")
        object.__setattr__(self, "mass_kg", float(self.mass_kg))
        for name in ("com_S_m", "force_bias_S_n", "torque_bias_S_n_m", "gravity_W_m_s2"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))


def _vector(name: str, values: Sequence[float]) -> Vector:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise ParameterError(name, type(values).__name__, "three finite numbers") from None
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ParameterError(name, values, "three finite numbers")
    return numbers[0], numbers[1], numbers[2]


@dataclass(frozen=True, kw_only=True)
class AxisLaw:
    """The control law of one axis, in N, m, kg or, about rx, ry, rz, in N·m, rad, kg·m².

    `mass` M_a, `damping` B_a, `lead_s` K_l, `feedback_damping_s` B_fb, both filters' corners and `compensation_mass_kg`
    P̂; `payload_range` holds the masses, or inertias, for which the certificate holds. `blocks` are the coefficients of
    `problems.model.difference.controller_step` in the Tustin form at `sample_time_s`, by row and column; with a
    `variable_damping` those at its highest B_a, that of rest, and `damping` is then that of the design. With a
    `biquad` the force passes it first.
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
    variable_damping: VariableDampingSettings | None = None
    biquad: Biquad | None = None
    index: int = field(init=False)
    blocks: Blocks = field(init=False, repr=False)

    def __post_init__(self) -> None:
        blocks = self.blocks_at(self.start_damping)
        if not all(map(math.isfinite, blocks.values())):
            numbers = (self.mass, self.damping, self.lead_s, self.feedback_damping_s)
            raise ParameterError(
                f"axes.{self.name}", numbers, "gains whose difference equation has finite coefficients"
            )
        object.__setattr__(self, "index", AXES.index(self.name))
        object.__setattr__(self, "blocks", blocks)

    @property
    def start_damping(self) -> float:
        """B_a at rest."""
        return self.damping if self.variable_damping is None else self.variable_damping.highest

    def blocks_at(self, damping: float) -> Blocks:
        """Return the coefficients with another B_a."""
        blocks: dict[tuple[int, int], float] = {}
        numbers = (self.mass, damping, self.lead_s, self.feedback_damping_s)
        filters = (self.velocity_filter_rad_per_s, self.acceleration_filter_rad_per_s, self.compensation_mass_kg)
        biquad = () if self.biquad is None else self.biquad.numbers()
        write_blocks(blocks, (*numbers, *filters, *biquad), self.sample_time_s, _THETA, ideal=False)
        return blocks

    @property
    def turns(self) -> bool:
        """Whether this is one of rx, ry, rz."""
        return self.index >= TRANSLATIONS


def is_number(value: object) -> bool:
    """Return whether a value is a real number that a double holds."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True
