"""What `controller.yaml` holds, as values; on rx, ry, rz read N·m, rad and kg·m² for N, m and kg."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal

from problems.contact.nonlinearities import Deadband, DeadbandType
from problems.design.hand import HandImpedance
from problems.design.problem import BIQUAD_VARIABLES
from problems.design.requirements import HANDS, Hand
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.frozen import Rule, Text, freeze
from problems.model.controller import SMALLEST_FEEDBACK_DAMPING_S, AdmittanceController

from .certificate_record import Band, Certificate, FurtherName, Period, check_interval
from .limits import Biquad, CollisionResponse, Limits, Peak, ResidualPeaks, VariableDampingSettings
from .units import AXES, ROTATIONAL_AXES, Axis

Vector = tuple[float, float, float]
Corner = Annotated[float, Rule(minimum=0.1, maximum=1_000_000)]


class ControllerStatus(StrEnum):
    """Whether the certificate of a controller was found to hold."""

    VALIDATED = "validated"
    UNVALIDATED = "unvalidated"


@dataclass(frozen=True, kw_only=True)
class AxisGains:
    """M_a (kg), B_a (N·s/m), K_l (s), B_fb (s), the deadband (N) and the biquad, if any, of one axis.

    Raises ParameterError unless M_a and B_a are positive, the others not negative, and B_fb is 0 or at least 1e-4 s:
    the values printed in the paper (2e-5, 7.5e-6) cannot be seconds.
    """

    mass: Annotated[float, Rule(minimum=0.01, maximum=10_000, turning=Rule(minimum=1e-5, maximum=1000))]
    damping: Annotated[float, Rule(minimum=1, maximum=1_000_000, turning=Rule(minimum=0.001, maximum=100_000))]
    lead_s: Annotated[float, Rule(minimum=0, maximum=1)]
    feedback_damping_s: Annotated[
        float,
        Rule(
            description="0 or at least 1e-4 s, and at most 1 s; a smaller value, such as the 2e-5 and 7.5e-6 "
            "printed in the paper, cannot be seconds (it would change the admittance by 0.003 dB at most) and must be "
            "converted first: times 1000 if the robot reports mm, or divided by the sample time if it is per sample",
            anyOf=[{"const": 0}, Rule(minimum=SMALLEST_FEEDBACK_DAMPING_S, maximum=1)],
        ),
    ]
    deadband: Annotated[float, Rule(minimum=0, maximum=100, turning=Rule(maximum=20))]
    deadband_type: DeadbandType
    biquad: Annotated[Biquad | None, Rule(description="what the force passes before the admittance; none without")] = (
        None
    )

    def __post_init__(self) -> None:
        for name in ("mass", "damping"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "greater than 0")
        for name in ("lead_s", "feedback_damping_s", "deadband"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "at least 0")
        if 0.0 < self.feedback_damping_s < SMALLEST_FEEDBACK_DAMPING_S:
            must = "0 or at least 1e-4 s (values as printed in the paper are not seconds; convert them first)"
            raise ParameterError("feedback_damping_s", self.feedback_damping_s, must)


@dataclass(frozen=True, kw_only=True)
class Filters:
    """ω_v and ω_a, rad/s."""

    velocity_rad_per_s: Corner
    acceleration_rad_per_s: Corner


@dataclass(frozen=True, kw_only=True)
class FalseTriggers:
    """How often a response is expected to begin in free motion, where nothing was touched.

    `free_motion_n` is what opposes the motion at most without noise, `noise_rms_n` the noise on top, with
    `noise_correlation` from one tick to the next; `noise_per_hour` times an hour both pass the threshold.
    `braking_share` is the share of the simulated movements of an operator that do, `braking_per_hour` the probability
    that one of an hour's does; `braking_n` is what opposes the hardest of them.
    """

    free_motion_n: Annotated[float, Rule(minimum=0, maximum=10_000)]
    noise_rms_n: Annotated[float, Rule(minimum=0, maximum=1000)]
    noise_correlation: Annotated[float, Rule(minimum=0, exclusiveMaximum=1)]
    noise_per_hour: Annotated[float, Rule(minimum=0)]
    movements_per_hour: Annotated[float, Rule(exclusiveMinimum=0)]
    braking_n: Annotated[float, Rule(minimum=0)]
    braking_share: Annotated[float, Rule(minimum=0, maximum=1)]
    braking_per_hour: Annotated[float, Rule(minimum=0, maximum=1)]


@dataclass(frozen=True, kw_only=True)
class CollisionSettings:
    """The collision response and its force threshold (N); None exactly when there is no response."""

    response: CollisionResponse
    threshold_n: Annotated[float | None, Rule(minimum=0.1, maximum=10_000)]
    false_triggers: FalseTriggers | None = None

    def __post_init__(self) -> None:
        if (self.response == CollisionResponse.NONE) != (self.threshold_n is None):
            raise ParameterError("threshold_n", self.threshold_n, "a force exactly when there is a collision response")


@dataclass(frozen=True, kw_only=True)
class RuntimePayload:
    """What the runtime's gravity compensation needs, in the sensor frame.

    With `set_in_cell` nobody knew centre of mass and bias when the controller was made: they are 0 here, and whoever
    loads the controller must say the payload.
    """

    mass_kg: Annotated[float, Rule(minimum=0, maximum=1000)]
    com_m: Annotated[Vector, Rule(items=Rule(minimum=-2, maximum=2))]
    force_bias_n: Annotated[Vector, Rule(items=Rule(minimum=-300, maximum=300))]
    torque_bias_n_m: Annotated[Vector, Rule(items=Rule(minimum=-50, maximum=50))]
    set_in_cell: Annotated[
        bool,
        Rule(
            description="true where centre of mass and bias were not known: the runtime starts only with a payload "
            "that the cell gives"
        ),
    ] = False


@dataclass(frozen=True, kw_only=True)
class ScenarioPrediction:
    """The peaks (N) of one contact and the time of the peak after touching (s).

    `further` holds what of the plant is not nominal beyond K_e and M_p.
    """

    name: Text
    environment_stiffness_n_per_m: Annotated[float, Rule(exclusiveMinimum=0, maximum=1_000_000_000)]
    payload_mass_kg: float
    peak_sensor_force_n: Peak
    peak_contact_force_n: Peak
    time_of_peak_s: Annotated[float, Rule(minimum=0, maximum=1000)]
    further: Mapping[FurtherName, float] | None = None

    @classmethod
    def of(cls, name: str, scenario: Scenario, run: Any) -> "ScenarioPrediction":
        """Return what a run, anything with two peaks and the time of the larger, predicts of a scenario."""
        return cls(
            name=name,
            environment_stiffness_n_per_m=scenario.environment_stiffness_n_per_m,
            payload_mass_kg=scenario.payload_mass_kg,
            peak_sensor_force_n=run.peak_sensor_force_n,
            peak_contact_force_n=run.peak_contact_force_n,
            time_of_peak_s=run.time_of_peak_s,
            further=scenario.further() or None,
        )

    def __post_init__(self) -> None:
        if self.further is not None:
            freeze(self, "further")

    def scenario(self) -> Scenario:
        """Return the point of the uncertainty."""
        return Scenario(
            environment_stiffness_n_per_m=self.environment_stiffness_n_per_m,
            payload_mass_kg=self.payload_mass_kg,
            **(self.further or {}),
        )


@dataclass(frozen=True, kw_only=True)
class FreeSpaceAdmittance:
    """The least |G| over the band (Hz), m/s per N, and the steady hand force per speed, N/(m/s)."""

    band_hz: Band
    min_m_s_per_n: Annotated[float, Rule(minimum=1e-9, maximum=10, turning=Rule(maximum=100))]
    hand_force_n_per_m_s: Annotated[float, Rule(minimum=0, maximum=1_000_000_000)]

    def __post_init__(self) -> None:
        check_interval("band_hz", self.band_hz)


@dataclass(frozen=True, kw_only=True)
class PeakPerSpeed:
    """The largest peak contact force per speed of the touch (N·s/m) over the certified plants, the same at any speed.

    A contact is linear while it lasts and one-sided, so that its forces scale with the speed. Under `pushes_on` what
    drives the payload, a hand or F^d, goes on after the impact; under `lets_go` the hand that led it does not; one that
    `holds` pushes on with up to `hand_mass_kg` that moves with the payload (both None in files of an earlier release).
    Under `drives` the aim of an `arm` with mass, damper and spring goes on for `drives_for_s` after the touch and then
    rests: at the ends of K_e and M_p and in the hardest predicted contact (None where that is not simulated).
    """

    pushes_on: Annotated[float, Rule(exclusiveMinimum=0)]
    lets_go: Annotated[float, Rule(exclusiveMinimum=0)]
    holds: Annotated[float | None, Rule(exclusiveMinimum=0)] = None
    hand_mass_kg: Annotated[float | None, Rule(minimum=0)] = None
    drives: Annotated[float | None, Rule(exclusiveMinimum=0)] = None
    drives_for_s: Annotated[float | None, Rule(minimum=0, maximum=10)] = None
    arm: HandImpedance | None = None

    def __post_init__(self) -> None:
        if len({each is None for each in (self.drives, self.drives_for_s, self.arm)}) > 1:
            raise ParameterError("peak_per_speed.drives", self.drives, "given with drives_for_s and arm, and only then")
        for name in (*self.hands, *(("drives",) if self.drives is not None else ())):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ParameterError(f"peak_per_speed.{name}", getattr(self, name), "greater than 0")
        if (self.holds is None) != (self.hand_mass_kg is None):
            raise ParameterError("peak_per_speed.hand_mass_kg", self.hand_mass_kg, "given with holds, and only then")

    @property
    def hands(self) -> tuple[Hand, ...]:
        """What the hands may do of which there are numbers."""
        return tuple(hand for hand in HANDS if getattr(self, hand) is not None)

    def largest_speed(self, force: float, hand: Hand) -> float:
        """Return the speed of the touch (m/s) up to which no contact exceeds `force` (N)."""
        peak = getattr(self, hand)
        return 0.0 if peak is None else force / float(peak)

    @classmethod
    def of(cls, worst: Mapping[Hand, float], hand_mass_kg: float) -> "PeakPerSpeed":
        """Return what was found; without `holds` where the loop is not stable with the mass of the hand."""
        if math.isfinite(worst["holds"]):
            holds = worst["holds"]
            return cls(pushes_on=worst["pushes_on"], lets_go=worst["lets_go"], holds=holds, hand_mass_kg=hand_mass_kg)
        return cls(pushes_on=worst["pushes_on"], lets_go=worst["lets_go"])


@dataclass(frozen=True, kw_only=True)
class AxisPrediction:
    """What the model predicts for one axis; `scenarios` are contacts without a collision response.

    `with_variable_damping` holds all of these with it, and the worst one where that is another; empty without one. So
    does `with_collision_response`, with the variable damping where there is one too.
    `with_residual_weight` holds the worst peaks of all under the residual that the start check of the runtime allows,
    `peak_per_speed` those of a payload that is led by hand; None in files of an earlier release.
    """

    scenarios: Annotated[tuple[ScenarioPrediction, ...], Rule(description="without a collision response", minItems=1)]
    free_space_admittance: FreeSpaceAdmittance
    with_variable_damping: Annotated[
        tuple[ScenarioPrediction, ...],
        Rule(
            description="the same contacts with it, and the worst one where that is another", minItems=1, turning=None
        ),
    ] = ()
    with_collision_response: Annotated[
        tuple[ScenarioPrediction, ...],
        Rule(
            description="the same contacts with it, and the worst one where that is another", minItems=1, turning=None
        ),
    ] = ()
    with_residual_weight: ResidualPeaks | None = None
    peak_per_speed: PeakPerSpeed | None = None


@dataclass(frozen=True, kw_only=True)
class Controller:
    """A tuned controller, what it is predicted to do, and what its certificate says.

    `limits` is what the runtime enforces; None in files of an earlier release, for which the runtime has defaults.

    Raises ParameterError when the certificate is for another sample time, the limits leave out a tuned axis, or when a
    validated controller has an axis without domain, margins or prediction, or proves nothing.
    """

    status: ControllerStatus
    sample_time_s: Period
    discretization: Literal["tustin"]
    delay_samples: Annotated[float, Rule(minimum=0, maximum=1000)]
    axes: Annotated[Mapping[Axis, AxisGains], Rule(minProperties=1)]
    filters: Filters
    compensation_mass_kg: Annotated[float, Rule(minimum=0, maximum=1000)]
    collision: Annotated[
        CollisionSettings,
        Rule(
            {
                "if": {"properties": {"response": {"const": "none"}}},
                "then": {"properties": {"threshold_n": {"type": "null"}}},
                "else": {"properties": {"threshold_n": {"type": "number"}}},
            }
        ),
    ]
    payload: RuntimePayload
    predicted: Mapping[Axis, AxisPrediction]
    certificate: Certificate
    provenance: Mapping[str, Any]
    limits: Limits | None = None
    variable_damping: (
        Annotated[Mapping[Annotated[str, Rule(enum=AXES[:3])], VariableDampingSettings], Rule(minProperties=1)] | None
    ) = None

    def __post_init__(self) -> None:
        freeze(self, "axes", "predicted", "provenance")
        self._check_variable_damping()
        if self.limits is not None and set(self.axes) - set(self.limits.axes):
            must = f"given for all tuned axes, {', '.join(self.axes)}"
            raise ParameterError("limits.axes", sorted(self.limits.axes), must)
        if self.certificate.sample_time_s != self.sample_time_s:
            must = f"the sample_time_s of the controller, {self.sample_time_s!r}"
            raise ParameterError("certificate.sample_time_s", self.certificate.sample_time_s, must)
        parts: dict[str, Mapping[str, object]] = {
            "predicted": self.predicted,
            "certificate.domain": self.certificate.domain,
            "certificate.margins": self.certificate.margins,
        }
        for name in ("soft", "continuous"):
            strangers = sorted(set(getattr(self.certificate, name) or {}) - set(self.axes))
            if strangers:
                raise ParameterError(f"certificate.{name}", strangers, f"for tuned axes only, {', '.join(self.axes)}")
        for name, part in parts.items():
            if set(part) - set(self.axes):
                raise ParameterError(name, sorted(part), f"for tuned axes only, {', '.join(self.axes)}")
            if self.status == ControllerStatus.VALIDATED and set(part) != set(self.axes):
                raise ParameterError(name, sorted(part), f"given for all tuned axes, {', '.join(self.axes)}")
        if self.status == ControllerStatus.VALIDATED and not self.certificate.proved:
            raise ParameterError("certificate.proved", (), "at least one claim in a validated controller")

    def _check_variable_damping(self) -> None:
        if self.variable_damping is None:
            return
        freeze(self, "variable_damping")
        for name, variable in self.variable_damping.items():
            if name not in self.axes or name in ROTATIONAL_AXES:
                raise ParameterError("variable_damping", name, "given for tuned x, y, z only")
            if not variable.lowest <= self.axes[name].damping <= variable.highest:
                must = f"around the damping of the axis, {self.axes[name].damping:g}"
                raise ParameterError(f"variable_damping.{name}", (variable.lowest, variable.highest), must)

    def damping_of(self, axis: str) -> VariableDampingSettings | None:
        """Return the variable damping of an axis, None where B_a is constant."""
        return (self.variable_damping or {}).get(axis)


def admittance_controller(controller: Controller, name: str) -> AdmittanceController:
    """Return the control law of one axis."""
    gains = controller.axes[name]
    biquad: dict[str, Any] = {}
    if gains.biquad is not None:
        biquad = dict(zip(BIQUAD_VARIABLES, gains.biquad.numbers(), strict=True))
    return AdmittanceController(
        mass_kg=gains.mass,
        damping_n_s_per_m=gains.damping,
        lead_s=gains.lead_s,
        feedback_damping_s=gains.feedback_damping_s,
        velocity_filter_rad_per_s=controller.filters.velocity_rad_per_s,
        acceleration_filter_rad_per_s=controller.filters.acceleration_rad_per_s,
        compensation_mass_kg=controller.compensation_mass_kg,
        **biquad,
    )


def is_linear(controller: Controller) -> bool:
    """Return whether the controller is its gains alone: no collision response, no variable damping."""
    return controller.collision.response is CollisionResponse.NONE and not controller.variable_damping


def file_deadband(gains: AxisGains) -> Deadband:
    """Return the deadband of an axis."""
    return Deadband(width_n=gains.deadband, kind=gains.deadband_type)
