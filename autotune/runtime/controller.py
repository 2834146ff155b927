"""A verified controller file as the cell runs it, and for which cells its certificate holds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from autotune.errors import CertificateError, UsageError
from autotune.formats.limits import CollisionResponse, Limits
from autotune.formats.units import AXES
from problems.errors import ParameterError
from problems.frozen import FrozenDict

from .guard import Guard
from .law import TRANSLATIONS, AxisLaw, Payload, is_number

# A sample time is declared, not measured: the same number, or another one.
SAME_SAMPLE_TIME = 1e-6


@dataclass(frozen=True, kw_only=True)
class RuntimeController:
    """A controller file that was verified, ready to be stepped: the tuned axes in the order x y z rx ry rz.

    `threshold_n` is that of the collision detection, infinite without a response. `checksum` is that of the file,
    `limits` are its own or, for a file without, those of `load.default_limits`.

    Raises ParameterError where the limits leave out a tuned axis.
    """

    checksum: str
    sample_time_s: float
    axes: tuple[AxisLaw, ...]
    response: CollisionResponse
    threshold_n: float
    payload: Payload
    limits: Limits
    guard: Guard = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        missing = [axis.name for axis in self.axes if axis.name not in self.limits.axes]
        if missing:
            raise ParameterError("limits.axes", list(self.limits.axes), f"given for {', '.join(missing)} too")
        guard = Guard(limits=self.limits, sample_time_s=self.sample_time_s, axes=self.axes)
        object.__setattr__(self, "guard", guard)

    def check_cell(
        self, *, sample_time_s: float, payload_mass_kg: float, payload_inertia_kg_m2: Mapping[str, float] | None = None
    ) -> None:
        """Raise CertificateError unless the certificate holds for this cell's period and payload.

        `payload_inertia_kg_m2` is by axis, for each of rx, ry, rz that is tuned. The mass that is compensated must be
        that of the cell to `limits.rest_force_n`: what is left of the weight adds to F^d. Raises UsageError for what is
        no number and for inertias about another axis.
        """
        h, inertias = self.sample_time_s, _checked_inertias(payload_inertia_kg_m2)
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
                    "give the payload's in payload_inertia_kg_m2."
                )
            value, what, unit = (payload_mass_kg, "mass", "kg")
            if axis.turns:
                value, what, unit = inertias[axis.name], "inertia", "kg·m²"
            _check_range(axis, value, what, unit)
        self._check_weight(payload_mass_kg)

    def _check_weight(self, mass_kg: float) -> None:
        left = abs(float(mass_kg) - self.payload.mass_kg) * math.hypot(*self.payload.gravity_W_m_s2)
        if not left <= self.limits.rest_force_n:
            raise CertificateError(
                f"The gravity compensation is for {self.payload.mass_kg:g} kg and would leave {left:.3g} N of the "
                f"cell's {mass_kg:g} kg, more than the {self.limits.rest_force_n:g} N that the predicted peaks include "
                "(limits.rest_force_n); give the payload that the cell carries in payload."
            )


def _checked_inertias(given: Mapping[str, float] | None) -> Mapping[str, float]:
    """Return the inertias by axis; an unknown name would be an inertia that is checked against nothing."""
    if given is None:
        return FrozenDict({})
    if not isinstance(given, Mapping):
        raise UsageError(f"payload_inertia_kg_m2 must hold inertias by axis, as {{'rz': 0.4}}; found {given!r}.")
    for name, inertia in given.items():
        if name not in AXES[TRANSLATIONS:]:
            raise UsageError(f"payload_inertia_kg_m2 is by axis, rx, ry or rz; found {name!r}.")
        _check_number(f"payload_inertia_kg_m2[{name!r}]", inertia)
    return given


def _check_number(what: str, value: object) -> None:
    if not is_number(value):
        found = (
            f"one of {value.bit_length()} bits"
            if isinstance(value, int) and not isinstance(value, bool)
            else repr(value)
        )
        raise UsageError(f"{what} must be a number, found {found}.")


def _check_range(axis: AxisLaw, value: float, what: str, unit: str) -> None:
    low, high = axis.payload_range
    if not low <= value <= high:
        raise CertificateError(
            f"The payload's {what} of {value:g} {unit} is outside of what axis {axis.name} is certified for, "
            f"{low:g} to {high:g} {unit}; optimize for a range that holds it."
        )
