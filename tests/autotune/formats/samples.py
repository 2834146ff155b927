"""Whole, plausible contents of the files, and strategies for arbitrary ones."""

import math
from dataclasses import replace

from hypothesis import strategies as st

from autotune.formats.certificate_record import AxisDomain, AxisMargins, Certificate, Proof
from autotune.formats.controller_record import (
    AxisGains,
    AxisPrediction,
    CollisionSettings,
    Controller,
    ControllerStatus,
    Filters,
    FreeSpaceAdmittance,
    RuntimePayload,
    ScenarioPrediction,
)
from autotune.formats.limits import AxisLimits, CollisionResponse, Limits
from identification.fit_quality import FitQuality, HeldOutPeak
from identification.measured_response import FrequencyResponse, MeasuredResponse
from identification.result import (
    AxisEstimate,
    Blow,
    ContactPhase,
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    LogPhase,
    PayloadEstimate,
    PhaseKind,
    RobotEstimate,
    SensorEstimate,
    Status,
    Timeline,
    Touch,
    TouchCause,
    VectorEstimate,
    WrenchFilterEstimate,
)
from problems.contact.nonlinearities import DeadbandType
from problems.design.requirements import AdmittanceTarget

GAINS = AxisGains(
    mass=12.5,
    damping=913.0000000000001,
    lead_s=0.0125,
    feedback_damping_s=2e-2,
    deadband=5.0,
    deadband_type=DeadbandType.THRESHOLD,
)
PREDICTION = AxisPrediction(
    scenarios=(
        ScenarioPrediction(
            name="stiffest",
            environment_stiffness_n_per_m=5e5,
            payload_mass_kg=16.0,
            peak_sensor_force_n=71.23456789012345,
            peak_contact_force_n=93.1,
            time_of_peak_s=0.0184,
        ),
        ScenarioPrediction(
            name="softest: foam",
            environment_stiffness_n_per_m=2e4,
            payload_mass_kg=16.0,
            peak_sensor_force_n=41.0,
            peak_contact_force_n=44.25,
            time_of_peak_s=0.4,
        ),
    ),
    free_space_admittance=FreeSpaceAdmittance(
        band_hz=(0.5, 5.0), min_m_s_per_n=1e-3 / 3, hand_force_n_per_m_s=913.0000000000001
    ),
)
DOMAIN = AxisDomain(
    environment_stiffness_n_per_m=(2e4, 5e5),
    payload_mass_kg=(14.0, 18.0),
    environment_damping_n_s_per_m=0.0,
    environment_mass_kg=0.0,
    coupling_stiffness_n_per_m=3e5,
    coupling_damping_n_s_per_m=120.0,
    drag_n_s_per_m=630.0,
    robot_numerator=(20.0,),
    robot_denominator=(1.0, 20.0),
    delay_s=2.4e-3,
    approach_force_n=30.0,
)
MARGINS = AxisMargins(
    gain_db=6.5,
    phase_deg=41.0,
    delay_s=1.25e-5,
    modulus=0.51,
    worst={"modulus": {"environment_stiffness_n_per_m": 123456.7, "payload_mass_kg": 18.0}},
)


def make_controller(axes: tuple[str, ...] = ("x", "rz")) -> Controller:
    return Controller(
        status=ControllerStatus.VALIDATED,
        sample_time_s=8e-4,
        discretization="tustin",
        delay_samples=3.0,
        axes=dict.fromkeys(axes, GAINS),
        filters=Filters(velocity_rad_per_s=120.0, acceleration_rad_per_s=200.0),
        compensation_mass_kg=0.0,
        collision=CollisionSettings(response=CollisionResponse.RESET, threshold_n=150.0),
        payload=RuntimePayload(
            mass_kg=16.0,
            com_m=(0.01, -0.02, 0.1),
            force_bias_n=(1.5, -0.25, 3.0),
            torque_bias_n_m=(0.1, 0.2, -0.0),
        ),
        predicted=dict.fromkeys(axes, PREDICTION),
        certificate=Certificate(
            domain=dict.fromkeys(axes, DOMAIN),
            sample_time_s=8e-4,
            requirements={
                "modulus_margin": 0.5,
                "passivity": False,
                "free_space_admittance": AdmittanceTarget(min_m_s_per_n=3e-4, band_hz=(0.5, 5.0)),
            },
            proved=(
                Proof(
                    claim="stable",
                    method="Schur–Cohn on a grid with a Lipschitz bound",
                    over={"environment_stiffness_n_per_m": [2e4, 5e5], "points": 1020},
                    numbers={"slack": 0.1},
                ),
                Proof(claim="modulus margin", method="sweep", over="the whole domain"),
            ),
            margins=dict.fromkeys(axes, MARGINS),
        ),
        provenance={"tool": "autotune 0.1.0", "log": "run 7: é.mcap", "seed": 1, "identified": {"sha256": "0" * 64}},
    )


def make_limits(axes: tuple[str, ...] = ("x", "rz")) -> Limits:
    return Limits(
        force_n=500.0,
        torque_n_m=50.0,
        axes=dict.fromkeys(axes, AxisLimits(speed=0.25, acceleration=60.0)),
        pose_speed_m_s=1.0,
        pose_speed_rad_s=5.0,
        stale_wrench_s=0.02,
        stale_pose_s=0.1,
        rest_samples=125,
        rest_force_n=1.5,
        rest_torque_n_m=0.5,
        reasons={"force_n": "the sensor's range: ±500 N"},
    )


FLOATS = st.floats(allow_nan=False, allow_infinity=False)
BLOW = Blow(onset_s=1.2, peak_s=1.3, peak_force=30.0, approach_speed=0.01, peak_interval=(29.0, None))
POSITIVE = st.floats(min_value=0, exclude_min=True, allow_infinity=False)
NOT_NEGATIVE = st.floats(min_value=0, allow_infinity=False)
TEXTS = st.text(max_size=12)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | FLOATS | TEXTS,
    lambda children: st.lists(children, max_size=4) | st.dictionaries(TEXTS, children, max_size=4),
    max_leaves=12,
)
TREES = st.dictionaries(TEXTS, PLAIN, max_size=5)


def within(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers of a range that the schema of a controller allows."""
    return st.floats(low, high)


@st.composite
def intervals(draw: st.DrawFn) -> tuple[float, float]:
    low, high = sorted((draw(within(0.0, 1e9)), draw(within(0.0, 1e9))))
    return (low, high)


@st.composite
def controllers(draw: st.DrawFn) -> Controller:
    gains = st.builds(
        AxisGains,
        mass=within(0.01, 1e3),
        damping=within(1.0, 1e5),
        lead_s=within(0.0, 1.0),
        feedback_damping_s=st.just(0.0) | st.floats(1e-4, 1.0),
        deadband=within(0.0, 20.0),
        deadband_type=st.sampled_from(DeadbandType),
    )
    finite_or_none = st.none() | within(0.0, 180.0)
    margins = st.builds(
        AxisMargins,
        gain_db=finite_or_none,
        phase_deg=finite_or_none,
        delay_s=finite_or_none,
        modulus=within(0.0, 1.0),
        worst=st.fixed_dictionaries({}, optional={"gain_db": st.dictionaries(TEXTS, within(0.0, 1e9), max_size=3)}),
    )
    domain = st.builds(
        replace,
        st.just(DOMAIN),
        environment_stiffness_n_per_m=intervals(),
        robot_numerator=st.lists(within(-1e40, 1e40), min_size=1, max_size=4).map(tuple),
        approach_speed_m_s=st.none() | within(1e-4, 5.0),
    )
    axes = draw(st.sets(st.sampled_from(("x", "y", "z", "rx", "ry", "rz")), min_size=1))
    base = make_controller(tuple(axes))
    sample_time_s = draw(within(1e-5, 0.1))
    certificate = replace(
        base.certificate,
        sample_time_s=sample_time_s,
        domain={axis: draw(domain) for axis in axes},
        margins={axis: draw(margins) for axis in axes},
        requirements=draw(st.dictionaries(TEXTS, FLOATS | st.booleans(), max_size=3)),
    )
    return replace(
        base,
        sample_time_s=sample_time_s,
        axes={axis: draw(gains) for axis in axes},
        certificate=certificate,
        provenance=draw(TREES),
        limits=draw(st.sampled_from((None, make_limits(tuple(axes))))),
    )


def _with_status(value: st.SearchStrategy[object]) -> st.SearchStrategy[tuple[object, Status]]:
    return (
        st.tuples(value, st.sampled_from((Status.IDENTIFIED, Status.GIVEN, Status.WEAK)))
        | st.just((None, Status.WEAK))
        | st.just((None, Status.UNIDENTIFIABLE))
    )


@st.composite
def estimates(draw: st.DrawFn, *, positive: bool = False) -> Estimate:
    value, status = draw(_with_status(POSITIVE if positive else FLOATS))
    return Estimate(
        value=value,  # type: ignore[arg-type]  # a float or None, as drawn
        std=draw(st.none() | NOT_NEGATIVE),
        status=status,
        method=draw(TEXTS),
        note=draw(TEXTS),
        ci95=draw(st.none() | st.tuples(FLOATS, FLOATS)),
    )


@st.composite
def vectors(draw: st.DrawFn, *, size: int = 3) -> VectorEstimate:
    value, status = draw(_with_status(st.tuples(*[FLOATS] * size)))
    return VectorEstimate(
        value=value,  # type: ignore[arg-type]  # a tuple or None, as drawn
        std=draw(st.none() | st.tuples(*[NOT_NEGATIVE] * size)),
        status=status,
        method=draw(TEXTS),
    )


HELD_OUT = (
    HeldOutPeak(without="contact", surface="x1", time_s=2.5, measured_peak=50.0, predicted_peak=48.5),
    HeldOutPeak(without="log", surface="x1", time_s=2.5, measured_peak=50.0, predicted_peak=51.0, log="run7.mcap"),
)
RESPONSE = FrequencyResponse(
    command_to_pose=MeasuredResponse(points=((0.5, 0.98, -0.1, 0.002, 0.001), (1.0, 0.9, -0.2, 0.003, 0.003))),
    pose_to_force=MeasuredResponse(points=((1.0, -3.5e3, 40.0, 12.5, 9.0),), records=2),
)


def identified_results() -> st.SearchStrategy[Identified]:
    free, positive = estimates(), estimates(positive=True)
    environment = st.builds(
        EnvironmentEstimate,
        name=st.text(min_size=1, max_size=8),
        stiffness_n_per_m=positive,
        secant_stiffness_n_per_m=positive,
        damping_n_s_per_m=free,
        mass_kg=free,
        contacts=st.integers(0, 100),
        peak_force_n=st.lists(FLOATS, max_size=20).map(tuple),
        relaxed_stiffness_n_per_m=st.none() | positive,
        impact_n_s_per_m=st.none() | positive,
        contact_spread=st.none() | st.floats(0.0, 1e3),
    )
    axis = st.builds(
        AxisEstimate,
        coupling=st.builds(CouplingEstimate, stiffness_n_per_m=positive, damping_n_s_per_m=free),
        drag_n_s_per_m=free,
        environments=st.lists(environment, max_size=2).map(tuple),
        robot=st.builds(
            RobotEstimate, numerator=vectors(size=1), denominator=vectors(size=3), delay_s=free, bandwidth_hz=free
        ),
    )
    axis = st.builds(
        replace,
        axis,
        mass_kg=st.none() | positive,
        covariance=st.none() | covariances(),
        fits=st.lists(st.just(FIT), max_size=2).map(tuple),
        held_out=st.lists(st.sampled_from(HELD_OUT), max_size=2).map(tuple),
        frequency_response=st.none() | st.just(RESPONSE),
    )
    sensor = st.builds(
        SensorEstimate,
        force_bias_n=vectors(),
        torque_bias_n_m=vectors(),
        force_noise_rms_n=free,
        gravity_residual_rms_n=free,
        deadband_n=free,
        wrench_filter=st.none() | wrench_filters(),
        position_noise_rms_m=st.none() | estimates(positive=True),
    )
    finding = st.builds(
        Finding,
        code=st.text(min_size=1, max_size=8),
        severity=st.sampled_from(("info", "warning", "error")),
        message=TEXTS,
        advice=TEXTS,
    )
    return st.builds(
        Identified,
        sample_time_s=positive,
        payload=st.builds(PayloadEstimate, mass_kg=positive, com_m=vectors()),
        axes=st.dictionaries(st.sampled_from(("x", "z", "rx", "rz")), axis, max_size=2),
        sensor=sensor,
        findings=st.lists(finding, max_size=2).map(tuple),
        timelines=st.lists(timelines(), max_size=2).map(tuple),
    )


def wrench_filters() -> st.SearchStrategy[WrenchFilterEstimate]:
    delays = estimates(positive=True) | st.just(Estimate(value=0.0, std=1e-5, status=Status.IDENTIFIED))
    return st.builds(WrenchFilterEstimate, corner_hz=estimates(positive=True)) | st.builds(
        WrenchFilterEstimate, delay_s=delays
    )


FIT = FitQuality(
    free_spans=1,
    explained_free=0.999,
    whiteness_free=0.2,
    noise_ratio_free=1.01,
    left_out_free=None,
    contacts=0,
    explained_contact=None,
    whiteness_contact=None,
    noise_ratio_contact=None,
    left_out_contact=None,
    widening=1.5,
    wrench_lag_s=-1e-4,
    wrench_lag_std_s=1e-5,
)


@st.composite
def covariances(draw: st.DrawFn) -> Covariance:
    names = draw(st.lists(st.text(min_size=1, max_size=6), min_size=1, max_size=3, unique=True))
    root, share = [draw(FLOATS.map(abs).map(math.sqrt)) for _ in names], draw(st.floats(-1.0, 1.0))
    matrix = [[a * b * (1.0 if i == j else share) for j, b in enumerate(root)] for i, a in enumerate(root)]
    return Covariance(
        names=tuple(names), values=tuple(draw(FLOATS) for _ in names), matrix=tuple(tuple(row) for row in matrix)
    )


def timelines() -> st.SearchStrategy[Timeline]:
    maybe, spans = st.none() | FLOATS, st.none() | st.tuples(FLOATS, FLOATS)
    contact = st.builds(
        ContactPhase,
        onset_s=maybe,
        peak_s=FLOATS,
        peak_force_n=FLOATS,
        hold_s=spans,
        release_s=maybe,
        bounces_s=st.lists(FLOATS, max_size=3).map(tuple),
        surface=st.none() | TEXTS,
        hand_suspected=st.none() | st.booleans(),
    )
    phase = st.builds(
        LogPhase,
        kind=st.sampled_from(PhaseKind),
        start_s=FLOATS,
        stop_s=FLOATS,
        axis=st.none() | st.sampled_from(("x", "rz")),
        contact=st.none() | contact,
    )
    touch = st.builds(
        Touch,
        axis=st.sampled_from(("x", "rz")),
        sign=st.sampled_from((-1, 1)),
        cause=st.sampled_from(TouchCause),
        peak_s=FLOATS,
        peak_force=FLOATS,
        onset_s=maybe,
        hold_s=spans,
        bounces_s=st.lists(FLOATS, max_size=3).map(tuple),
        later_blows=st.sampled_from(((), (BLOW,))),
        peak_interval=st.none() | st.tuples(FLOATS, st.none() | FLOATS),
        rise_samples=st.none() | st.integers(0, 100),
        approach_speed=maybe,
        surface=st.none() | TEXTS,
        is_led=st.none() | st.booleans(),
        is_withdrawn=st.booleans(),
        damping=st.none() | st.floats(0.0, 1e6),
        lead_s=st.none() | st.floats(0.0, 1.0),
    )
    return st.builds(
        Timeline,
        phases=st.lists(phase, max_size=3).map(tuple),
        log=TEXTS,
        touches=st.lists(touch, max_size=2).map(tuple),
    )


def make_identified() -> Identified:
    def given(value: float) -> Estimate:
        return Estimate(value=value, std=None, status=Status.GIVEN)

    def vector(*value: float) -> VectorEstimate:
        return VectorEstimate(value=value, std=tuple(0.01 for _ in value), status=Status.IDENTIFIED, method="lsq")

    environment = EnvironmentEstimate(
        name="table",
        stiffness_n_per_m=given(5e5),
        secant_stiffness_n_per_m=given(1.9e5),
        damping_n_s_per_m=given(2e-5),
        mass_kg=given(0.0),
        contacts=2,
        peak_force_n=(70.0, 71.5),
    )
    axis = AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=given(3e5), damping_n_s_per_m=given(120.0)),
        drag_n_s_per_m=Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE, note="no free motion"),
        environments=(environment,),
        robot=RobotEstimate(
            numerator=vector(20.0), denominator=vector(1.0, 20.0), delay_s=given(2.4e-3), bandwidth_hz=given(3.2)
        ),
    )
    return Identified(
        sample_time_s=given(8e-4),
        payload=PayloadEstimate(mass_kg=given(16.0), com_m=vector(0.01, -0.02, 0.1)),
        axes={"x": axis, "rz": axis},
        sensor=SensorEstimate(
            force_bias_n=vector(1.5, -0.25, 3.0),
            torque_bias_n_m=vector(0.1, 0.2, -0.1),
            force_noise_rms_n=given(0.3),
            gravity_residual_rms_n=given(1.1),
            deadband_n=given(0.0),
        ),
        findings=(Finding(code="one_surface", severity="info", message="One surface.", advice="Touch another."),),
    )
