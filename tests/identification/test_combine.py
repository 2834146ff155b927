"""Several logs of one cell: least squares of what each tells, and a loud word where they disagree."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.combine import NamedResult, combine_identified
from identification.errors import LogError
from identification.result import (
    AxisEstimate,
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
    VectorEstimate,
    WrenchFilterEstimate,
)
from identification.timeline_phases import Kind, Phase, Timeline
from tests.problems.axes import LAW


def known(value: float, std: float, status: Status = Status.IDENTIFIED) -> Estimate:
    return Estimate(value=value, std=std, status=status, method="a fit")


def vector(*values: float, std: float = 1e-3) -> VectorEstimate:
    return VectorEstimate(value=values, std=(std,) * len(values), status=Status.IDENTIFIED)


UNTOLD = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)


def surface(stiffness: float, std: float, peaks: tuple[float, ...] = (40.0,)) -> EnvironmentEstimate:
    return EnvironmentEstimate(
        name="x1",
        stiffness_n_per_m=known(stiffness, std),
        secant_stiffness_n_per_m=known(0.7 * stiffness, 0.7 * std),
        damping_n_s_per_m=UNTOLD,
        mass_kg=UNTOLD,
        contacts=len(peaks),
        peak_force_n=peaks,
    )


def told(
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
    """A second road: the normal equations of one unknown seen several times with known deviations."""
    found = combined(*(told(known(value, std)) for value, std in values)).payload.mass_kg
    seen, std = np.array(values).T
    solution = np.linalg.lstsq((1.0 / std)[:, None], seen / std, rcond=None)[0]
    assert found.value == pytest.approx(solution[0], rel=1e-12)
    scatter = float(np.sum(((seen - solution[0]) / std) ** 2)) / (len(values) - 1)
    # Not 1/√Σσ⁻²: what the logs share does not average out.
    assert found.std == pytest.approx(np.min(std) * np.sqrt(max(scatter, 1.0)), rel=1e-9)


def test_one_log_is_what_it_is() -> None:
    alone = told()
    assert combined(alone) is alone


def test_logs_of_two_payloads_disagree_loudly() -> None:
    found = combined(told(known(16.2, 0.02)), told(known(22.0, 0.03)))
    assert codes(found, "error") == ["logs-disagree"]
    (finding,) = (f for f in found.findings if f.code == "logs-disagree")
    assert "payload mass [kg]: 16.2 ± 0.02 (log0), 22 ± 0.03 (log1)" in finding.message
    # The mean of what does not agree is not known to a hundredth: at least as wide as half their distance.
    assert found.payload.mass_kg.std is not None
    assert found.payload.mass_kg.std > 2.0


def test_a_mean_of_two_payloads_is_weak_at_best() -> None:
    """16 and 18 kg: 17 ± 1.4 is nobody's mass, however sharply each log tells its own."""
    parts = [NamedResult(name=f"{m}", result=told(known(m, 0.01))) for m in (15.0, 18.0)]
    mass = combine_identified(parts).payload.mass_kg
    assert mass.status is Status.WEAK
    assert "disagree" in mass.note
    alike = [NamedResult(name=f"{m}", result=told(known(m, 0.01))) for m in (16.0, 16.01)]
    assert combine_identified(alike).payload.mass_kg.status is Status.IDENTIFIED


def test_a_bias_may_change_from_log_to_log() -> None:
    found = combined(told(bias=1.0), told(bias=4.0))
    assert codes(found, "error") == []
    assert codes(found, "warning") == ["logs-differ"]


def test_what_one_log_lacks_another_tells() -> None:
    missing = Finding(code="robot", severity="error", message="Axis x: no motion.", advice="")
    found = combined(told(delay=UNTOLD, findings=(missing,)), told())
    assert found.axes["x"].robot.delay_s == known(2.4e-3, 1e-5)
    assert codes(found, "error") == []
    assert "log0: Axis x: no motion." in [finding.message for finding in found.findings]
    both = combined(told(delay=UNTOLD, findings=(missing,)), told(delay=UNTOLD, findings=(missing,)))
    assert codes(both, "error") == ["robot", "robot"]


def test_surfaces_that_agree_are_one_and_others_stay_apart() -> None:
    soft, hard = surface(5e4, 1e3, (30.0, 31.0)), surface(2e5, 4e3)
    again = surface(5.1e4, 1e3, (33.0,))
    found = combined(told(surfaces=(soft, hard)), told(surfaces=(again,))).axes["x"].environments
    assert [each.name for each in found] == ["x1", "x2"]
    assert found[0].stiffness_n_per_m.value == pytest.approx(5.05e4)
    assert (found[0].contacts, found[0].peak_force_n) == (3, (30.0, 31.0, 33.0))
    assert found[1].stiffness_n_per_m == hard.stiffness_n_per_m


def test_two_surfaces_of_one_log_are_never_one() -> None:
    twins = (surface(5e4, 1e4), surface(5.2e4, 1e4))
    assert len(combined(told(surfaces=twins), told(surfaces=(surface(5.1e4, 1e4),))).axes["x"].environments) == 2


def test_logs_of_two_control_periods_are_refused() -> None:
    with pytest.raises(LogError, match=r"one control period, found 0\.8000 ms \(log0\), 1\.0000 ms \(log1\)"):
        combined(told(), told(period=1e-3))


def test_an_axis_that_only_one_log_moved_is_kept() -> None:
    one = told()
    other = replace(one, axes={"y": one.axes["x"]})
    assert dict(combined(one, other).axes) == {"x": one.axes["x"], "y": one.axes["x"]}


def with_covariance(result: Identified, stiffness: float, std: float, correlation: float) -> Identified:
    axis = result.axes["x"]
    drag_std = axis.drag_n_s_per_m.std
    assert drag_std is not None
    covariance = Covariance(
        names=("K_s", "B_p"),
        values=(stiffness, 330.0),
        matrix=((std**2, correlation * std * drag_std), (correlation * std * drag_std, drag_std**2)),
    )
    coupling = replace(axis.coupling, stiffness_n_per_m=known(stiffness, std))
    return replace(result, axes={"x": replace(axis, coupling=coupling, covariance=covariance)})


def test_a_combined_covariance_has_the_combined_values_and_the_correlation_of_one_log() -> None:
    one, other = with_covariance(told(), 3.00e5, 1e3, 0.5), with_covariance(told(), 3.01e5, 2e3, 0.2)
    axis = combined(one, other).axes["x"]
    assert axis.covariance is not None
    matrix, std = np.array(axis.covariance.matrix), axis.coupling.stiffness_n_per_m.std
    assert std is not None
    assert axis.covariance.values[0] == axis.coupling.stiffness_n_per_m.value
    assert matrix[0, 0] == pytest.approx(std**2)
    assert matrix[0, 1] / np.sqrt(matrix[0, 0] * matrix[1, 1]) == pytest.approx(0.5)


def test_each_log_keeps_its_time_line_under_its_name() -> None:
    phase = Phase(kind=Kind.REST, start_s=0.0, stop_s=1.0)
    parts = [replace(told(), timelines=(Timeline(phases=(phase,)),)) for _ in range(2)]
    assert [line.log for line in combined(*parts).timelines] == ["log0", "log1"]


def filtered(late: WrenchFilterEstimate | None) -> Identified:
    result = told()
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
        found = told()
        return replace(found, sensor=replace(found.sensor, position_noise_rms_m=value))

    noises = (None, known(2e-6, 1e-8), known(2e-5, 1e-7), UNTOLD)
    parts = [NamedResult(name=str(i), result=with_noise(noise)) for i, noise in enumerate(noises)]
    assert combine_identified(parts).sensor.position_noise_rms_m == known(2e-5, 1e-7)
    assert combine_identified([parts[0], parts[0]]).sensor.position_noise_rms_m is None
