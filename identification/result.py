"""Results of an identification: every parameter with its uncertainty and a verdict, and the phases of the log."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

from problems.errors import ParameterError
from problems.frozen import freeze

from .measured_response import FrequencyResponse

_SAME_ONSET_S = 0.3


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
    `surface` is the name of what was touched, None until it is known (`name_surfaces`); `hand_suspected` that somebody
    pushed meanwhile, None where the log does not show.
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
class Touch:
    """One touch of a log on one axis of S: N, m, kg along it, N·m, rad, kg·m² about it; None where it is not shown.

    Times are in s after the start of the log: `onset_s` of the first blow, `peak_s`, `hold_s` from when to when the
    payload rested, `release_s`, and `bounces_s` when it left the surface before. `sign` is +1 where the payload presses
    towards +axis. `peak_force` is the largest sample, `peak_interval` what the peak of the sensor's force may be,
    without its noise and between the samples (without an upper end where it is too narrow for them), and
    `rise_samples` how many of them the force took from a tenth of the peak to the peak. `approach_speed` is that of the
    flange right before the onset, towards what is touched, `impulse` ∫F dt of the first blow, `held_force` that of the
    hold. `is_led` says that a hand led the payload into it, `is_withdrawn` that F^d
    turned away before the peak, which is then that of no whole blow. `mass`, `damping`, `lead_s` and `desired_force`
    are M_a, B_a, K_l and F^d at the onset. `surface` is the name of what was touched, None until it is known.
    """

    axis: str
    sign: int
    cause: TouchCause
    peak_s: float
    peak_force: float
    onset_s: float | None = None
    release_s: float | None = None
    hold_s: tuple[float, float] | None = None
    bounces_s: tuple[float, ...] = ()
    peak_interval: tuple[float, float | None] | None = None
    rise_samples: int | None = None
    approach_speed: float | None = None
    impulse: float | None = None
    held_force: float | None = None
    surface: str | None = None
    is_led: bool | None = None
    is_withdrawn: bool = False
    mass: float | None = None
    damping: float | None = None
    lead_s: float | None = None
    desired_force: float | None = None


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """What happened when in one log: `phases` each instant once, `touches` by their time, which may overlap.

    `log` is its name where there are several.
    """

    phases: tuple[LogPhase, ...]
    log: str = ""
    touches: tuple[Touch, ...] = ()


def name_surfaces(phases: Sequence[LogPhase], axis: str, onsets_s: Sequence[Sequence[float]]) -> tuple[LogPhase, ...]:
    """Give the contacts of an axis the names of their surfaces, `x1` for the first one on axis x.

    `onsets_s` holds for each surface when it was touched, in s after the start of the log.
    """

    def surface(phase: LogPhase) -> str | None:
        within = [
            f"{axis}{index + 1}"
            for index, onsets in enumerate(onsets_s)
            if any(phase.start_s - _SAME_ONSET_S <= onset < phase.stop_s for onset in onsets)
        ]
        return within[0] if len(within) == 1 else None

    return tuple(
        replace(phase, contact=replace(phase.contact, surface=surface(phase)))
        if phase.contact is not None and phase.axis == axis
        else phase
        for phase in phases
    )


class Status(StrEnum):
    """How far a parameter may be trusted."""

    IDENTIFIED = "identified"
    WEAK = "weak"
    UNIDENTIFIABLE = "unidentifiable"
    GIVEN = "given"


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A scalar parameter; `std` is one standard deviation, both None where the log does not show."""

    value: float | None
    std: float | None
    status: Status
    method: str = ""
    note: str = ""
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class VectorEstimate:
    """A vector parameter with one standard deviation per component."""

    value: tuple[float, ...] | None
    std: tuple[float, ...] | None
    status: Status
    method: str = ""
    note: str = ""


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
    """Mass, centre of mass (sensor frame S) and, where the tool was turned fast enough, the inertia tensor."""

    mass_kg: Estimate
    com_m: VectorEstimate
    inertia_kg_m2: InertiaEstimate | None = None


@dataclass(frozen=True, kw_only=True)
class CouplingEstimate:
    """K_s and B_s; on a rotational axis in N·m/rad and N·m·s/rad."""

    stiffness_n_per_m: Estimate
    damping_n_s_per_m: Estimate


@dataclass(frozen=True, kw_only=True)
class EnvironmentEstimate:
    """One surface: K_e alone, the secant (K_s and K_e in series), B_e, M_e, and its contacts.

    Both stiffnesses are those of the loading, which make the peak. `relaxed_stiffness_n_per_m` is force over depth
    where it is held. `impact_n_s_per_m` is the force of the first blow over the speed of the approach, sqrt(k m) of the
    mass that it stops. `contact_spread` is the standard deviation of the loading stiffness from contact to contact, as
    a share of it; None with one contact.
    """

    name: str
    stiffness_n_per_m: Estimate
    secant_stiffness_n_per_m: Estimate
    damping_n_s_per_m: Estimate
    mass_kg: Estimate
    contacts: int
    peak_force_n: tuple[float, ...]
    relaxed_stiffness_n_per_m: Estimate | None = None
    impact_n_s_per_m: Estimate | None = None
    contact_spread: float | None = None


@dataclass(frozen=True, kw_only=True)
class RobotEstimate:
    """r(s) with coefficients in descending powers of s, r(0) = 1, and the delay T_d."""

    numerator: VectorEstimate
    denominator: VectorEstimate
    delay_s: Estimate
    bandwidth_hz: Estimate


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """How the errors of one axis go together: `matrix` (p, p) in SI, in the order of `names`.

    Names are K_s, B_s, B_p, M_p, then of the robot omega (rad/s), zeta, T_d, then K_e, B_e, M_e after the name of the
    surface and a point, as in `x1.K_e`. `values` (p,) is where the likelihood is highest, also of what is no value to
    trust when taken alone.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]

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


@dataclass(frozen=True, kw_only=True)
class FitQuality:
    """How well one log is explained, in free motion and in contact.

    `explained_*`: share of the force's variance; `whiteness_*`: probability of a residual at least as coloured if the
    whitened one were white (Ljung-Box); `noise_ratio_*`: residual RMS over the force's noise at rest; `left_out_*`:
    residual over force of a span that is predicted by all others, None where there is no other; `widening`: the largest
    factor by which deviations were widened for what the model leaves out; `wrench_lag_s`: how late the wrench is
    stamped against pose and command. Without contacts those entries are None.
    """

    free_spans: int
    explained_free: float
    whiteness_free: float
    noise_ratio_free: float
    left_out_free: float | None
    contacts: int
    explained_contact: float | None
    whiteness_contact: float | None
    noise_ratio_contact: float | None
    left_out_contact: float | None
    widening: float
    wrench_lag_s: float
    wrench_lag_std_s: float


@dataclass(frozen=True, kw_only=True)
class HeldOutPeak:
    """The peak of a contact beside what everything but this contact, or but its whole log, predicts.

    `without` is `contact` (predicted from the command as it was recorded, the other contacts of the log saying what
    plant and surface are) or `log` (predicted from gains and approach). `time_s` counts from the start of the log;
    peaks are those of the sensor, in N or N·m.
    """

    without: Literal["contact", "log"]
    surface: str
    time_s: float
    measured_peak: float
    predicted_peak: float
    log: str = ""

    @property
    def log_ratio(self) -> float:
        """ln(predicted/measured), which is the relative error where that is small."""
        return math.log(self.predicted_peak / self.measured_peak)


@dataclass(frozen=True, kw_only=True)
class AxisEstimate:
    """Everything that one axis of the control frame needs.

    `drag_n_s_per_m` is B_p; `mass_kg` is M_p as motion along this axis shows it; `fits` has an entry for every log that
    shows something of the axis, `held_out` for every contact that was predicted without itself; `frequency_response` is
    what free motion shows without a model.
    """

    coupling: CouplingEstimate
    drag_n_s_per_m: Estimate
    environments: tuple[EnvironmentEstimate, ...]
    robot: RobotEstimate
    mass_kg: Estimate | None = None
    covariance: Covariance | None = None
    fits: tuple[FitQuality, ...] = ()
    held_out: tuple[HeldOutPeak, ...] = ()
    frequency_response: FrequencyResponse | None = None

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

    frequency_hz: tuple[float, ...]
    force_n2_per_hz: tuple[float, ...]
    torque_n2_m2_per_hz: tuple[float, ...]
    resolution: tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class WrenchFilterEstimate:
    """How the wrench is late in the sensor or its driver: a first-order low-pass or a pure delay, one of the two.

    `corner_hz` [Hz] is the corner of F_m = F / (s / (2π corner) + 1), `delay_s` [s] the delay of F_m(t) = F(t - delay).
    Raises ParameterError unless exactly one is there, a corner above 0 or a delay of at least 0.
    """

    corner_hz: Estimate | None = None
    delay_s: Estimate | None = None

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

    force_bias_n: VectorEstimate
    torque_bias_n_m: VectorEstimate
    force_noise_rms_n: Estimate
    gravity_residual_rms_n: Estimate
    deadband_n: Estimate
    torque_noise_rms_n_m: VectorEstimate | None = None
    mounting_rad: VectorEstimate | None = None
    base_tilt_rad: VectorEstimate | None = None
    noise: NoiseSpectrum | None = None
    wrench_filter: WrenchFilterEstimate | None = None
    position_noise_rms_m: Estimate | None = None


CONTACT_UNEXPLAINED = "contact-unexplained"
"""Code of the finding, of severity `error`, that something was touched whose stiffness is not known."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something the user should know; `severity` is `info`, `warning` or `error`.

    `axis` is the axis that it is about where a machine has to know it, else empty.
    """

    code: str
    severity: str
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

    sample_time_s: Estimate
    payload: PayloadEstimate
    axes: Mapping[str, AxisEstimate]
    sensor: SensorEstimate
    findings: tuple[Finding, ...]
    timelines: tuple[Timeline, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "axes")
