"""Several logs of one cell: least squares of what each tells, and a loud word where they disagree."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from identification.errors import LogError
from identification.fit_quality import FitQuality
from identification.given import Given
from identification.merging.combine import NamedResult, combine_identified
from identification.payload.gravity import LOCAL_GRAVITY_STD
from identification.result import (
    AxisEstimate,
    CouplingEstimate,
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
    VectorEstimate,
    WrenchFilterEstimate,
)
from tests.problems.axes import LAW


def known(value: float, std: float, status: Status = Status.IDENTIFIED) -> Estimate:
    return Estimate(value=value, std=std, status=status, method="a fit")


def vector(*values: float, std: float = 1e-3) -> VectorEstimate:
    return VectorEstimate(value=values, std=(std,) * len(values), status=Status.IDENTIFIED)


UNDECIDED = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)


def surface(stiffness: float, std: float, peaks: tuple[float, ...] = (40.0,), name: str = "x1") -> EnvironmentEstimate:
    return EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=known(stiffness, std),
        secant_stiffness_n_per_m=known(0.7 * stiffness, 0.7 * std),
        damping_n_s_per_m=UNDECIDED,
        mass_kg=UNDECIDED,
        contacts=len(peaks),
        peak_force_n=peaks,
    )


def reported(
    mass: Estimate | None = None,
    *,
    surfaces: tuple[EnvironmentEstimate, ...] = (),
    bias: float = 1.0,
    period: float = 8e-4,
    delay: Estimate | None = None,
    findings: tuple[Finding, ...] = (),
) -> Identified:
    axis = AxisEstimate(
        coupling=CouplingEstimate(stiffness_n_per_m=known(3e5, 1e3), damping_n_s_per_m=known(150.0, 5.0)),
        drag_n_s_per_m=known(330.0, 2.0),
        environments=surfaces,
        robot=RobotEstimate(
            numerator=vector(1.0),
            denominator=vector(0.05, 1.0),
            delay_s=known(2.4e-3, 1e-5) if delay is None else delay,
            bandwidth_hz=known(3.2, 0.01),
        ),
    )
    sensor = SensorEstimate(
        force_bias_n=vector(bias, 2.0, 3.0, std=0.01),
        torque_bias_n_m=vector(0.1, 0.2, 0.3),
        force_noise_rms_n=known(0.14, 1e-3),
        gravity_residual_rms_n=known(0.01, 1e-3),
        deadband_n=known(0.0, 0.0),
    )
    return Identified(
        sample_time_s=known(period, 0.0),
        payload=PayloadEstimate(mass_kg=known(16.2, 0.02) if mass is None else mass, com_m=vector(0.01, 0.0, 0.14)),
        axes={"x": axis},
        sensor=sensor,
        findings=findings,
    )


def combined(*results: Identified) -> Identified:
    return combine_identified([NamedResult(name=f"log{i}", result=r) for i, r in enumerate(results)])


def codes(result: Identified, severity: str) -> list[str]:
    return [finding.code for finding in result.findings if finding.severity == severity]


@LAW
@given(st.lists(st.tuples(st.floats(15.9, 16.1), st.floats(0.05, 0.5)), min_size=2, max_size=5))
def test_the_mean_is_that_of_least_squares(values: list[tuple[float, float]]) -> None:
    """A second road: the normal equations of what is different in each log, the shared local gravity added after."""
    found = combined(*(reported(known(value, std)) for value, std in values)).payload.mass_kg
    seen, std = np.array(values).T
    shared = LOCAL_GRAVITY_STD * np.mean(seen)
    noise = np.sqrt(std**2 - shared**2)

    def solved(beyond: float) -> tuple[float, float, float]:
        weights = 1.0 / np.sqrt(noise**2 + beyond)
        (mean,), (square,) = np.linalg.lstsq(weights[:, None], seen * weights, rcond=None)[:2]
        return mean, square, float(np.linalg.norm(weights)) ** -1.0

    excess = solved(0.0)[1] - (len(values) - 1)
    beyond = 0.0 if excess <= 0.0 else brentq(lambda t: solved(t)[1] - (len(values) - 1), 0.0, 1.0, xtol=1e-16)
    mean, _, alone = solved(beyond)
    assert found.value == pytest.approx(mean, rel=1e-9)
    # Two roots of one equation, each found to 1e-16 of a variance of 1e-4 or more.
    assert found.std == pytest.approx(min(np.hypot(alone, shared), np.inf if beyond else np.min(std)), rel=1e-6)


def test_a_payload_changed_by_0_1_kg_of_16_2_is_distinguished() -> None:
    """Both logs share local gravity, 0.024 kg of each deviation of 0.026 kg: the difference does not hold it."""
    shared = LOCAL_GRAVITY_STD * 16.2
    std = float(np.hypot(shared, 0.008))
    found = combined(reported(known(16.2, std)), reported(known(16.3, std)))
    assert codes(found, "error") == ["logs-disagree"]
    # Chance: 0.02 kg is 1.8 deviations of the difference of two masses known to 0.008 kg beside gravity.
    again = combined(reported(known(16.2, std)), reported(known(16.22, std)))
    assert codes(again, "error") == []
    # Two that scatter are known to half their distance.
    assert again.payload.mass_kg.std == pytest.approx(np.hypot(shared, 0.02 / 2.0), rel=1e-2)


def test_one_log_is_what_it_is() -> None:
    alone = reported()
    assert combined(alone) is alone


def test_logs_of_two_payloads_disagree_loudly() -> None:
    found = combined(reported(known(16.2, 0.02)), reported(known(22.0, 0.03)))
    assert codes(found, "error") == ["logs-disagree"]
    (finding,) = (f for f in found.findings if f.code == "logs-disagree")
    assert "payload mass [kg]: 16.2 ± 0.02 (log0), 22 ± 0.03 (log1)" in finding.message
    # The mean of what does not agree is not known to a hundredth: at least as wide as half their distance.
    assert found.payload.mass_kg.std is not None
    assert found.payload.mass_kg.std > 2.0


def test_a_mean_of_two_payloads_is_weak_at_best() -> None:
    """16 and 18 kg: 17 ± 1.4 is nobody's mass, however sharply each log tells its own."""
    parts = [NamedResult(name=f"{m}", result=reported(known(m, 0.01))) for m in (15.0, 18.0)]
    mass = combine_identified(parts).payload.mass_kg
    assert mass.status is Status.WEAK
    assert "disagree" in mass.note
    alike = [NamedResult(name=f"{m}", result=reported(known(m, 0.01))) for m in (16.0, 16.01)]
    assert combine_identified(alike).payload.mass_kg.status is Status.IDENTIFIED


def test_a_bias_may_change_from_log_to_log() -> None:
    """What lies between two biases was never the sensor's: the last one counts, whatever the order of the names."""
    found = combined(reported(bias=1.0), reported(bias=4.0))
    assert codes(found, "error") == []
    assert codes(found, "warning") == ["logs-differ"]
    assert found.sensor.force_bias_n == reported(bias=4.0).sensor.force_bias_n
    (finding,) = (each for each in found.findings if each.code == "logs-differ")
    assert finding.advice == "That of the last, log1, is taken; the sensor was tared or has drifted before."
    timed = (("late", 4.0, 2e9), ("early", 1.0, 1e9))
    parts = [NamedResult(name=name, result=reported(bias=bias), recorded_s=at) for name, bias, at in timed]
    assert combine_identified(parts).sensor.force_bias_n == reported(bias=4.0).sensor.force_bias_n
    alike = combined(reported(bias=1.0), reported(bias=1.0))
    assert codes(alike, "warning") == []
    assert alike.sensor.force_bias_n.value == pytest.approx(reported(bias=1.0).sensor.force_bias_n.value)


def test_what_one_log_lacks_another_shows() -> None:
    missing = Finding(code="robot", severity="error", message="Axis x: no motion.", advice="")
    found = combined(reported(delay=UNDECIDED, findings=(missing,)), reported())
    # Rounding of a matrix inverse.
    assert found.axes["x"].robot.delay_s.value == pytest.approx(2.4e-3, rel=1e-12)
    assert found.axes["x"].robot.delay_s.std == pytest.approx(1e-5, rel=1e-9)
    assert found.axes["x"].robot.delay_s.status is Status.IDENTIFIED
    assert codes(found, "error") == []
    assert "log0: Axis x: no motion." in [finding.message for finding in found.findings]
    both = combined(reported(delay=UNDECIDED, findings=(missing,)), reported(delay=UNDECIDED, findings=(missing,)))
    assert codes(both, "error") == ["robot", "robot"]


def test_surfaces_that_agree_are_one_and_others_stay_apart() -> None:
    soft, hard = surface(5e4, 1e3, (30.0, 31.0)), surface(2e5, 4e3, name="x2")
    again = surface(5.1e4, 1e3, (33.0,))
    found = combined(reported(surfaces=(soft, hard)), reported(surfaces=(again,))).axes["x"].environments
    assert [each.name for each in found] == ["x1", "x2"]
    # The mean of compliances is that of stiffnesses to the square of their scatter, 1 % here, up to a factor.
    assert found[0].stiffness_n_per_m.value == pytest.approx(5.05e4, rel=5e-4)
    assert (found[0].contacts, found[0].peak_force_n) == (3, (30.0, 31.0, 33.0))
    assert found[1].stiffness_n_per_m.value == pytest.approx(2e5, rel=1e-12)
    assert found[1].stiffness_n_per_m.std == pytest.approx(4e3, rel=1e-9)


def test_two_surfaces_of_one_log_are_never_one() -> None:
    twins = (surface(5e4, 1e4), surface(5.2e4, 1e4, name="x2"))
    assert (
        len(combined(reported(surfaces=twins), reported(surfaces=(surface(5.1e4, 1e4),))).axes["x"].environments) == 2
    )


def test_logs_of_two_control_periods_are_refused() -> None:
    with pytest.raises(LogError, match=r"one control period, found 0\.8000 ms \(log0\), 1\.0000 ms \(log1\)"):
        combined(reported(), reported(period=1e-3))


def test_an_axis_that_only_one_log_moved_is_kept() -> None:
    one = reported()
    other = replace(one, axes={"y": one.axes["x"]})
    assert dict(combined(one, other).axes) == {"x": one.axes["x"], "y": one.axes["x"]}


def test_the_rate_of_a_wrench_is_no_control_period() -> None:
    """A log without a command calls the period of its wrench weak; one with a command knows."""
    wrench = replace(reported(), sample_time_s=known(1e-3, 1e-9, Status.WEAK))
    assert combined(wrench, reported()).sample_time_s.value == 8e-4
    assert combined(reported(), wrench).sample_time_s.value == 8e-4
    other = replace(reported(), sample_time_s=known(2e-3, 1e-9, Status.WEAK))
    found = combined(wrench, other)
    assert found.sample_time_s.value is None
    assert codes(found, "error") == ["control-period"]
    parts = [NamedResult(name="0", result=wrench), NamedResult(name="1", result=other)]
    given_ = combine_identified(parts, {"sample_time_s": Given(value=8e-4, std=0.0)})
    assert (given_.sample_time_s.value, codes(given_, "error")) == (8e-4, [])


def test_the_worst_of_a_known_and_an_unknown_noise_is_the_known_one() -> None:
    quiet, unknown = reported(), reported()
    unknown = replace(unknown, sensor=replace(unknown.sensor, force_noise_rms_n=UNDECIDED))
    for pair in ((quiet, unknown), (unknown, quiet)):
        noise = combined(*pair).sensor.force_noise_rms_n
        assert noise.value == 0.14
        assert noise.note == "known from 1 of 2 logs"
    assert combined(unknown, unknown).sensor.force_noise_rms_n.value is None


def test_each_log_keeps_its_time_line_under_its_name() -> None:
    phase = LogPhase(kind=PhaseKind.REST, start_s=0.0, stop_s=1.0)
    parts = [replace(reported(), timelines=(Timeline(phases=(phase,)),)) for _ in range(2)]
    assert [line.log for line in combined(*parts).timelines] == ["log0", "log1"]


def filtered(late: WrenchFilterEstimate | None) -> Identified:
    result = reported()
    return replace(result, sensor=replace(result.sensor, wrench_filter=late))


def test_filters_of_one_kind_are_averaged_and_a_log_that_shows_none_has_no_say() -> None:
    parts = [
        NamedResult(name=name, result=filtered(late))
        for name, late in (
            ("a", WrenchFilterEstimate(corner_hz=known(50.0, 1.0))),
            ("b", None),
            ("c", WrenchFilterEstimate(corner_hz=known(51.0, 1.0))),
        )
    ]
    merged = combine_identified(parts)
    assert merged.sensor.wrench_filter is not None
    assert merged.sensor.wrench_filter.corner_hz is not None
    assert merged.sensor.wrench_filter.corner_hz.value == pytest.approx(50.5)
    assert not [f for f in merged.findings if f.severity == "error"]
    assert combine_identified([parts[1], parts[1]]).sensor.wrench_filter is None


def test_a_log_whose_wrench_is_not_late_contradicts_one_with_a_filter() -> None:
    corner = WrenchFilterEstimate(corner_hz=known(50.0, 1.0))  # 3.18 ms late
    prompt = filtered(None)
    fit = FitQuality(
        free_spans=1, explained_free=1.0, whiteness_free=0.5, noise_ratio_free=1.0, left_out_free=None,
        contacts=0, explained_contact=None, whiteness_contact=None, noise_ratio_contact=None, left_out_contact=None,
        widening=1.0, wrench_lag_s=1e-5, wrench_lag_std_s=2e-5,
    )  # fmt: skip
    prompt = replace(prompt, axes={name: replace(axis, fits=(fit,)) for name, axis in prompt.axes.items()})
    merged = combine_identified([NamedResult(name="a", result=filtered(corner)), NamedResult(name="b", result=prompt)])
    assert merged.sensor.wrench_filter == corner
    finding = next(f for f in merged.findings if f.severity == "error")
    assert "3.18 ms late (a), not late (b)" in finding.message


def test_a_filter_and_a_delay_disagree_and_the_later_one_counts() -> None:
    corner = WrenchFilterEstimate(corner_hz=known(50.0, 1.0))  # 3.18 ms late
    delay = WrenchFilterEstimate(delay_s=known(1e-3, 1e-5))
    merged = combine_identified(
        [NamedResult(name="a", result=filtered(delay)), NamedResult(name="b", result=filtered(corner))]
    )
    assert merged.sensor.wrench_filter == corner
    finding = next(f for f in merged.findings if f.severity == "error")
    assert "1 ms late (a), 3.18 ms late (b)" in finding.message


def test_the_noisiest_pose_counts_and_a_log_that_is_silent_of_it_does_not() -> None:
    def with_noise(value: Estimate | None) -> Identified:
        found = reported()
        return replace(found, sensor=replace(found.sensor, position_noise_rms_m=value))

    noises = (None, known(2e-6, 1e-8), known(2e-5, 1e-7), UNDECIDED)
    parts = [NamedResult(name=str(i), result=with_noise(noise)) for i, noise in enumerate(noises)]
    assert combine_identified(parts).sensor.position_noise_rms_m == known(2e-5, 1e-7)
    assert combine_identified([parts[0], parts[0]]).sensor.position_noise_rms_m is None
