"""Results of an identification: every parameter with its uncertainty and a verdict, and the phases of the log."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, ClassVar

from problems.errors import ParameterError
from problems.frozen import Rule, freeze

from .fit_quality import FitQuality, HeldOutPeak
from .measured_response import FrequencyResponse

_NOT_NEGATIVE, _SOME = Rule(minimum=0), Rule(minItems=1)
_Name = Annotated[str, Rule(minLength=1)]
AxisName = Annotated[str, Rule(enum=["x", "y", "z", "rx", "ry", "rz"])]


class PhaseKind(StrEnum):
    """What a phase of a log is."""

    REST = "rest"
    TURNING = "turning"
    FREE_MOTION = "free-motion"
    COMMANDED_MOTION = "commanded-motion"
    HAND_LED_MOTION = "hand-led-motion"
    CONTACT = "contact"
    UNKNOWN = "unknown"


@dataclass(frozen=True, kw_only=True)
class ContactPhase:
    """What happens in a contact, in s after the start of the log, None where it is not shown.

    `hold_s` from when to when the payload rested on the surface; `bounces_s` when it left the surface before that;
    `surface` is the name of what was touched, None until it is known; `hand_suspected` that somebody pushed meanwhile,
    None where the log does not show.
    """

    onset_s: float | None
    peak_s: float
    peak_force_n: float
    hold_s: tuple[float, float] | None
    release_s: float | None
    bounces_s: tuple[float, ...]
    surface: str | None
    hand_suspected: bool | None


@dataclass(frozen=True, kw_only=True)
class LogPhase:
    """One stretch of a log, `start_s` to `stop_s` after its start; `axis` of S where it goes along or about one.

    A contact begins with the first touch and ends with the last.
    """

    kind: PhaseKind
    start_s: float
    stop_s: float
    axis: str | None = None
    contact: ContactPhase | None = None


class TouchCause(StrEnum):
    """What a payload touched."""

    WALL = "wall"
    HAND = "hand"
    UNDETERMINED = "undetermined"


@dataclass(frozen=True, kw_only=True)
class Blow:
    """A blow of a payload that comes back to what it touched: its time [s], largest sample and approach speed.

    Units and `peak_interval` are those of `Touch`.
    """

    onset_s: float
    peak_s: float
    peak_force: float
    approach_speed: float
    peak_interval: tuple[float, float | None]


@dataclass(frozen=True, kw_only=True)
class Touch:
    """One touch of a log on one axis of S: N, m, kg along it, N·m, rad, kg·m² about it; None where it is not shown.

    Times are in s after the start of the log: `onset_s` of the first blow, `peak_s`, `hold_s` from when to when the
    payload rested, `release_s`, and `bounces_s` when it left the surface before. `later_blows` are those of them
    behind which it comes back with a fifth of the peak and more. `sign` is +1 where the payload presses towards
    +axis. `peak_force` is the largest sample, `peak_interval` what the peak of the sensor's force may be, without
    its noise and between the samples (without an upper end where it is too narrow for them), `sample_period_s` how
    far the samples are apart, and `rise_samples` how many of them the force took from a tenth of the peak to the
    peak. `approach_speed` is that of the flange right before the onset, towards what is touched (None where it does
    not go there), `impulse` ∫F dt of the first blow, `held_force` that of the hold. `is_led` says that a hand led
    the payload into it, `is_withdrawn` that F^d turned away before the peak, which is then that of no whole blow.
    `mass`, `damping`, `lead_s` and `desired_force` are M_a, B_a, K_l and F^d at the onset. `surface` is the name of
    what was touched, None until it is known.
    """

    axis: AxisName
    sign: Annotated[int, Rule(enum=[-1, 1])]
    cause: TouchCause
    peak_s: float
    peak_force: float
    onset_s: float | None = None
    release_s: float | None = None
    hold_s: tuple[float, float] | None = None
    bounces_s: tuple[float, ...] = ()
    later_blows: tuple[Blow, ...] = ()
    peak_interval: tuple[float, float | None] | None = None
    rise_samples: Annotated[int | None, _NOT_NEGATIVE] = None
    approach_speed: float | None = None
    impulse: float | None = None
    held_force: float | None = None
    surface: str | None = None
    is_led: bool | None = None
    is_withdrawn: bool = False
    mass: Annotated[float | None, _NOT_NEGATIVE] = None
    damping: Annotated[float | None, _NOT_NEGATIVE] = None
    lead_s: float | None = None
    desired_force: float | None = None
    sample_period_s: Annotated[float | None, _NOT_NEGATIVE] = None


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """What happened when in one log: `phases` each instant once, `touches` by their time, which may overlap.

    `log` is its name where there are several.
    """

    phases: tuple[LogPhase, ...]
    log: str = ""
    touches: tuple[Touch, ...] = ()


class Status(StrEnum):
    """How far a parameter may be trusted."""

    IDENTIFIED = "identified"
    WEAK = "weak"
    UNIDENTIFIABLE = "unidentifiable"
    GIVEN = "given"


def _known(value: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return in JSON Schema that a parameter has such a `value` where it is known, and none where nothing shows it."""
    known = {"properties": {"status": {"enum": [Status.IDENTIFIED.value, Status.GIVEN.value]}}}
    unknown = {"properties": {"status": {"const": Status.UNIDENTIFIABLE.value}}}
    return [
        {"if": known, "then": {"properties": {"value": value}}},
        {"if": unknown, "then": {"properties": {"value": {"type": "null"}}}},
    ]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A scalar parameter; `std` is one standard deviation, both None where the log does not show."""

    RULE: ClassVar = Rule(allOf=_known({"type": "number"}))

    value: float | None
    std: Annotated[float | None, _NOT_NEGATIVE]
    status: Status
    method: str = ""
    note: str = ""
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class VectorEstimate:
    """A vector parameter with one standard deviation per component."""

    RULE: ClassVar = Rule(allOf=_known({"type": "array"}))

    value: tuple[float, ...] | None
    std: tuple[Annotated[float, _NOT_NEGATIVE], ...] | None
    status: Status
    method: str = ""
    note: str = ""


def _of_size(record: str, fewest: int, most: int) -> Rule:
    size = {"minItems": fewest, "maxItems": most}
    return Rule(record=record, properties={"value": size, "std": size})


_Above0 = Annotated[Estimate, Rule(record="PositiveEstimate", allOf=_known({"type": "number", "exclusiveMinimum": 0}))]
_AtLeast0 = Annotated[Estimate, Rule(record="NotNegativeEstimate", properties={"value": {"minimum": 0}})]
_Three = Annotated[VectorEstimate, _of_size("TripleEstimate", 3, 3)]
_Polynomial = Annotated[VectorEstimate, _of_size("PolynomialEstimate", 1, 24)]


@dataclass(frozen=True, kw_only=True)
class InertiaEstimate:
    """The inertia tensor about the sensor's origin in the sensor frame S [kg·m²], component by component."""

    xx: Estimate
    yy: Estimate
    zz: Estimate
    xy: Estimate
    xz: Estimate
    yz: Estimate


@dataclass(frozen=True, kw_only=True)
class PayloadEstimate:
    """Mass, centre of mass (sensor frame S) and, where the tool was turned fast enough, the inertia tensor.

    `contact_points_m` are where it may touch, as declared of the cell (sensor frame); () where nothing is declared.
    """

    mass_kg: _Above0
    com_m: _Three
    inertia_kg_m2: InertiaEstimate | None = None
    contact_points_m: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True, kw_only=True)
class CouplingEstimate:
    """K_s and B_s; on a rotational axis in N·m/rad and N·m·s/rad."""

    stiffness_n_per_m: _Above0
    damping_n_s_per_m: Estimate


@dataclass(frozen=True, kw_only=True)
class EnvironmentEstimate:
    """One surface: K_e alone, the secant (K_s and K_e in series), B_e, M_e, and its contacts.

    Both stiffnesses are those of the loading, which make the peak. `relaxed_stiffness_n_per_m` is force over depth
    where it is held. `impact_n_s_per_m` is the force of the first blow over the speed of the approach, sqrt(k m) of the
    mass that it stops. `contact_spread` is the standard deviation of the loading stiffness from contact to contact, as
    a share of it; None with one contact.
    """

    name: _Name
    stiffness_n_per_m: _Above0
    secant_stiffness_n_per_m: _Above0
    damping_n_s_per_m: Estimate
    mass_kg: Estimate
    contacts: Annotated[int, _NOT_NEGATIVE]
    peak_force_n: tuple[float, ...]
    relaxed_stiffness_n_per_m: _Above0 | None = None
    impact_n_s_per_m: _Above0 | None = None
    contact_spread: Annotated[float | None, _NOT_NEGATIVE] = None


@dataclass(frozen=True, kw_only=True)
class RobotEstimate:
    """r(s) with coefficients in descending powers of s, r(0) = 1, and the delay T_d."""

    numerator: _Polynomial
    denominator: _Polynomial
    delay_s: Estimate
    bandwidth_hz: Estimate


_ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """How the errors of one axis go together: `matrix` (p, p) in SI, in the order of `names`.

    Names are K_s, B_s, B_p, M_p, then of the robot omega (rad/s), zeta, T_d, then K_e, B_e, M_e after the name of the
    surface and a point, as in `x1.K_e`. `values` (p,) is where the likelihood is highest, trusted alone or not.
    """

    names: Annotated[tuple[_Name, ...], _SOME]
    values: Annotated[tuple[float, ...], _SOME]
    matrix: Annotated[tuple[Annotated[tuple[float, ...], _SOME], ...], _SOME]

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(set(self.names)) < count:
            raise ParameterError("names", ", ".join(self.names), "different names")
        if len(self.values) != count:
            raise ParameterError("values", len(self.values), f"as many numbers as there are names, {count}")
        if len(self.matrix) != count or any(len(row) != count for row in self.matrix):
            raise ParameterError("matrix", [len(row) for row in self.matrix], f"{count} rows of {count} numbers")
        if any(row[j] != self.matrix[j][i] for i, row in enumerate(self.matrix) for j in range(i)):
            raise ParameterError("matrix", "another number across the diagonal", "symmetric")
        least = min(row[i] for i, row in enumerate(self.matrix))
        if least < 0.0:
            raise ParameterError("matrix", least, "0 or more on the diagonal, which holds variances")
        for i, row in enumerate(self.matrix):
            for j in range(i):
                if abs(row[j]) > (1.0 + _ROUNDING) * math.sqrt(row[i]) * math.sqrt(self.matrix[j][j]):
                    pair = f"{row[j]:g} of {self.names[j]} and {self.names[i]}"
                    raise ParameterError("matrix", pair, "at most the product of both deviations beside the diagonal")


@dataclass(frozen=True, kw_only=True)
class SecondModeEstimate:
    """A part of the payload that swings on the rest."""

    mass_share: _AtLeast0
    frequency_hz: _Above0
    damping_ratio: _AtLeast0


@dataclass(frozen=True, kw_only=True)
class AxisEstimate:
    """Everything that one axis of the control frame needs.

    `drag_n_s_per_m` is B_p; `mass_kg` is M_p as motion along this axis shows it; `fits` has an entry for every log that
    shows something of the axis, `held_out` for every contact predicted without itself; `frequency_response` is what
    free motion shows without a model; None of a second mode or of dry friction says that none shows.
    """

    coupling: CouplingEstimate
    drag_n_s_per_m: Estimate
    environments: tuple[EnvironmentEstimate, ...]
    robot: RobotEstimate
    mass_kg: _Above0 | None = None
    covariance: Covariance | None = None
    fits: tuple[FitQuality, ...] = ()
    held_out: tuple[HeldOutPeak, ...] = ()
    frequency_response: FrequencyResponse | None = None
    second_mode: SecondModeEstimate | None = None
    coupling_friction_n: _AtLeast0 | None = None

    def plant_estimates(self) -> dict[str, Estimate]:
        """Return what is identified of the plant beside K_e and M_p, by `problems.model.plant_parameters`."""
        return {
            "coupling_stiffness_n_per_m": self.coupling.stiffness_n_per_m,
            "coupling_damping_n_s_per_m": self.coupling.damping_n_s_per_m,
            "drag_n_s_per_m": self.drag_n_s_per_m,
            "delay_s": self.robot.delay_s,
            "robot_bandwidth_hz": self.robot.bandwidth_hz,
        }


@dataclass(frozen=True, kw_only=True)
class NoiseSpectrum:
    """The sensor's noise at rest in bands of frequency, (k,) each, one-sided, the mean of the three axes.

    `frequency_hz` are the bands' centres. `resolution` is the step of Fx, Fy, Fz [N] and Tx, Ty, Tz [N·m] as logged,
    None where none shows. Of a log without torques theirs is empty.
    """

    frequency_hz: Annotated[tuple[Annotated[float, _NOT_NEGATIVE], ...], _SOME]
    force_n2_per_hz: Annotated[tuple[Annotated[float, _NOT_NEGATIVE], ...], _SOME]
    torque_n2_m2_per_hz: tuple[Annotated[float, _NOT_NEGATIVE], ...]
    resolution: Annotated[tuple[float | None, ...], Rule(minItems=6, maxItems=6)]


@dataclass(frozen=True, kw_only=True)
class WrenchFilterEstimate:
    """How the wrench is late in the sensor or its driver: a first-order low-pass or a pure delay, one of the two.

    `corner_hz` [Hz] is the corner of F_m = F / (s / (2π corner) + 1), `delay_s` [s] the delay of F_m(t) = F(t - delay).
    Raises ParameterError unless exactly one is there, a corner above 0 or a delay of at least 0.
    """

    RULE: ClassVar = Rule(minProperties=1, maxProperties=1, description="corner_hz or delay_s, one of the two")

    corner_hz: _Above0 | None = None
    delay_s: _AtLeast0 | None = None

    def __post_init__(self) -> None:
        if (self.corner_hz is None) == (self.delay_s is None):
            raise ParameterError("corner_hz", "both" if self.corner_hz else "neither", "there, or delay_s, not both")
        if self.corner_hz is not None and self.corner_hz.value is not None and not self.corner_hz.value > 0.0:
            raise ParameterError("corner_hz.value", self.corner_hz.value, "greater than 0")
        if self.delay_s is not None and self.delay_s.value is not None and not self.delay_s.value >= 0.0:
            raise ParameterError("delay_s.value", self.delay_s.value, "at least 0")


@dataclass(frozen=True, kw_only=True)
class SensorEstimate:
    """The six-axis sensor: what it shows at rest, and how late it is.

    `mounting_rad` (3) is the rotation vector of the real sensor axes as seen from the assumed ones, `base_tilt_rad` (2)
    that of the vertical about x and y of the base; `torque_noise_rms_n_m` (3) per axis. `wrench_filter` is None where
    the wrench is as late as pose and command. `position_noise_rms_m` is that of one sample and coordinate of the
    measured pose at rest, None where nothing showed.
    """

    force_bias_n: _Three
    torque_bias_n_m: _Three
    force_noise_rms_n: Estimate
    gravity_residual_rms_n: Estimate
    deadband_n: Estimate
    torque_noise_rms_n_m: _Three | None = None
    mounting_rad: _Three | None = None
    base_tilt_rad: Annotated[VectorEstimate, _of_size("PairEstimate", 2, 2)] | None = None
    noise: NoiseSpectrum | None = None
    wrench_filter: WrenchFilterEstimate | None = None
    position_noise_rms_m: _Above0 | None = None


TICK_S = 1.5e-3
"""A log with a longer period may hold samples of a faster controller."""
CONTACT_UNEXPLAINED = "contact-unexplained"
RESPONSE_DIFFERS = "response-differs"
"""Code of the finding, of severity `error`, that something was touched whose stiffness is not known."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something the user should know; `severity` is `info`, `warning` or `error`.

    `axis` is the axis that it is about where a machine has to know it, else empty.
    """

    code: _Name
    severity: Annotated[str, Rule(enum=["info", "warning", "error"])]
    message: str
    advice: str
    axis: str = ""

    @classmethod
    def info(cls, code: str, message: str, advice: str) -> "Finding":
        """Return a remark."""
        return cls(code=code, severity="info", message=message, advice=advice)

    @classmethod
    def warning(cls, code: str, message: str, advice: str) -> "Finding":
        """Return something that may spoil a result."""
        return cls(code=code, severity="warning", message=message, advice=advice)

    @classmethod
    def error(cls, code: str, message: str, advice: str) -> "Finding":
        """Return something that a result cannot be trusted with."""
        return cls(code=code, severity="error", message=message, advice=advice)


@dataclass(frozen=True, kw_only=True)
class Identified:
    """The plant as the log shows it; `axes` is keyed x y z rx ry rz of the control frame, `timelines` one per log."""

    sample_time_s: _Above0
    payload: PayloadEstimate
    axes: Mapping[AxisName, AxisEstimate]
    sensor: SensorEstimate
    findings: tuple[Finding, ...]
    timelines: tuple[Timeline, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "axes")
