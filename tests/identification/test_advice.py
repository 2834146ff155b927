"""Every weak or missing parameter comes with what to record next."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from identification.advice import advise
from identification.experiment_design.sweep import SweepLimits, fastest_sweep
from identification.experiment_design.values import values_of
from identification.joint_fit.estimates import COARSE_COMMAND
from identification.result import Estimate, Finding, Identified, Status
from identification.robot.logged_command import UNKNOWN_PERIOD
from tests.autotune.formats.samples import FIT
from tests.identification.merging.test_combine import UNDECIDED, known, reported, surface


def weak(value: float, std: float) -> Estimate:
    return Estimate(value=value, std=std, status=Status.WEAK)


def with_surface(**changes: Any) -> Identified:
    return reported(surfaces=(dataclasses.replace(surface(1.0e5, 500.0), **changes),))


def with_stiffness(result: Identified, stiffness: Estimate) -> Identified:
    axis = result.axes["x"]
    coupling = dataclasses.replace(axis.coupling, stiffness_n_per_m=stiffness)
    return dataclasses.replace(result, axes={"x": dataclasses.replace(axis, coupling=coupling)})


def needed(findings: tuple[Finding, ...]) -> list[Finding]:
    return [f for f in findings if f.severity != "info"]


def test_what_is_known_well_needs_no_advice() -> None:
    assert needed(advise(reported())) == []


def test_a_missing_stiffness_is_an_error_and_a_weak_one_a_warning() -> None:
    (missing,) = needed(advise(with_stiffness(reported(), UNDECIDED)))
    assert (missing.code, missing.severity) == ("unidentifiable", "error")
    assert "Axis x: K_s" in missing.message
    assert "sweep" in missing.advice
    (uncertain,) = needed(advise(with_stiffness(reported(), weak(3.0e5, 3.0e4))))
    assert (uncertain.code, uncertain.severity) == ("weak", "warning")
    assert "K_s (± 10 %)" in uncertain.message


def test_a_delay_with_half_an_unknown_control_period_asks_for_that_before_another_sweep() -> None:
    """The log's own period is what it suggests; damping that is weak as well still asks for a sweep, behind it."""
    result = reported()
    axis = result.axes["x"]
    delay = dataclasses.replace(weak(4.5e-3, 3e-4), note=f"the log shows 5 ms; {UNKNOWN_PERIOD}")
    changed = dataclasses.replace(
        axis,
        robot=dataclasses.replace(axis.robot, delay_s=delay),
        coupling=dataclasses.replace(axis.coupling, damping_n_s_per_m=weak(260.0, 40.0)),
    )
    period = dataclasses.replace(result.sample_time_s, value=2.0000000000000005e-3)
    first, second = needed(advise(dataclasses.replace(result, axes={"x": changed}, sample_time_s=period)))
    assert "T_d (± 7 %)" in first.message
    assert "`--given sample_time_s=0.002`" in first.advice
    assert "sweep" not in first.advice
    assert "B_s" in second.message
    assert "sweep" in second.advice


def test_an_interval_is_a_warning() -> None:
    bounded = dataclasses.replace(UNDECIDED, ci95=(0.0, 63.0))
    axis = reported().axes["x"]
    coupling = dataclasses.replace(axis.coupling, damping_n_s_per_m=bounded)
    (found,) = needed(advise(dataclasses.replace(reported(), axes={"x": dataclasses.replace(axis, coupling=coupling)})))
    assert (found.code, found.severity) == ("bounded", "warning")
    assert "B_s (0 to 63 N·s/m with 95 %): known as an interval only" in found.message


@pytest.mark.parametrize(("value", "said"), [(0.0, "± 61 ms"), (1e-12, "± 61 ms"), (0.05, "± 61 ms"), (0.61, "± 10 %")])
def test_a_deviation_above_its_value_is_written_with_its_unit(value: float, said: str) -> None:
    axis = reported().axes["x"]
    robot = dataclasses.replace(axis.robot, delay_s=weak(value, 0.061))
    (found,) = needed(advise(dataclasses.replace(reported(), axes={"x": dataclasses.replace(axis, robot=robot)})))
    assert f"T_d ({said}): weak" in found.message


def test_a_missing_number_is_not_reported_twice() -> None:
    because = Finding(code="coupling", severity="error", message="Axis x: a reason.", advice="")
    broken = dataclasses.replace(with_stiffness(reported(), UNDECIDED), findings=(because,))
    assert needed(advise(broken)) == []


def test_damping_and_mass_of_a_surface_are_information() -> None:
    findings = advise(with_surface(damping_n_s_per_m=UNDECIDED, mass_kg=weak(1.0, 0.2)))
    assert needed(findings) == []
    text = " ".join(f.message for f in findings)
    assert "x1 B_e" in text
    assert "x1 M_e (± 20 %)" in text
    assert all("cm/s" in f.advice for f in findings)


@pytest.mark.parametrize(("k_s_std", "sweep"), [(3.0e4, True), (30.0, False)])
def test_the_binding_uncertainty_decides_what_is_recorded_for_the_environment(k_s_std: float, sweep: bool) -> None:
    """More contacts do not help where K_s is what K_e hides behind."""
    k_s, k_e = 3.0e5, 1.0e5
    secant = k_s * k_e / (k_s + k_e)
    result = with_surface(stiffness_n_per_m=weak(k_e, 0.1 * k_e), secant_stiffness_n_per_m=known(secant, 0.01 * secant))
    findings = needed(advise(with_stiffness(result, known(k_s, k_s_std))))
    (about,) = (f for f in findings if "K_e" in f.message)
    assert ("sweep" in about.advice) == sweep
    assert ("contacts" in about.advice) != sweep


def test_contacts_are_not_asked_for_where_the_command_is_what_is_missing() -> None:
    secant = dataclasses.replace(weak(7.5e4, 500.0), note=COARSE_COMMAND)
    (about,) = (f for f in advise(with_surface(secant_stiffness_n_per_m=secant)) if "secant" in f.message)
    assert COARSE_COMMAND in about.message
    assert "control rate" in about.advice
    assert "contacts" not in about.advice


def with_misfit(result: Identified, ratio: float) -> Identified:
    """The same, its fit leaving so many times the sensor's noise in free motion."""
    axis = result.axes["x"]
    quality = dataclasses.replace(FIT, noise_ratio_free=ratio)
    return dataclasses.replace(result, axes={"x": dataclasses.replace(axis, fits=(quality,))})


@pytest.mark.parametrize(("ratio", "said"), [(5.6, "low-pass in the sensor"), (1.0, "commanded sweep in free space")])
def test_where_the_model_does_not_fit_another_sweep_is_no_advice(ratio: float, said: str) -> None:
    (missing,) = needed(advise(with_misfit(with_stiffness(reported(), UNDECIDED), ratio)))
    assert said in missing.advice
    if said.startswith("low-pass"):
        assert missing.advice.index("slower than") < missing.advice.index("pose's noise") < missing.advice.index(said)


@pytest.mark.parametrize(("ratio", "said"), [(2.4, "--given x.delay_s="), (1.0, "commanded sweep in free space")])
def test_a_robot_of_another_form_is_named(ratio: float, said: str) -> None:
    axis = reported().axes["x"]
    robot = dataclasses.replace(axis.robot, delay_s=UNDECIDED)
    result = dataclasses.replace(reported(), axes={"x": dataclasses.replace(axis, robot=robot)})
    (missing,) = needed(advise(with_misfit(result, ratio)))
    assert said in missing.advice


def test_a_delay_that_the_payload_leaves_open_is_not_blamed_on_the_robot() -> None:
    beside = Finding.warning("second-mode", "Axis x: a part of 10 % of the payload's mass swings on it.", "Fasten it.")
    axis = reported().axes["x"]
    robot = dataclasses.replace(axis.robot, delay_s=UNDECIDED)
    result = dataclasses.replace(reported(), axes={"x": dataclasses.replace(axis, robot=robot)}, findings=(beside,))
    (missing,) = (f for f in advise(with_misfit(result, 2.4)) if "T_d" in f.message)
    assert missing.advice.startswith("The sweep is there, but what the payload has")
    assert "position loop" not in missing.advice


def test_the_sweep_that_is_advised_is_the_one_that_a_plan_would_make() -> None:
    result = with_stiffness(reported(), weak(3.0e5, 3.0e4))
    (uncertain,) = needed(advise(result))
    numbers = re.search(r"to (\d+) Hz.*flange at ([\d.]+) mm/s throughout \(([\d.]+) mm at 0.5 Hz\)", uncertain.advice)
    assert numbers is not None
    highest_hz, speed_mm_s, travel_mm = map(float, numbers.groups())
    # Two digits each.
    assert travel_mm == pytest.approx(speed_mm_s / (2.0 * np.pi * 0.5), rel=0.06)
    _, values = values_of(result, "x")
    found = fastest_sweep(values, SweepLimits(), 0.5, highest_hz, 10.0)
    assert found.worst.force_per_speed_n_s_per_m * found.sweep.flange_speed_m_s <= SweepLimits.max_force_n
    assert speed_mm_s == pytest.approx(1e3 * found.sweep.flange_speed_m_s, rel=0.06)


def test_what_a_drift_widens_is_said_to_be_widened() -> None:
    drift = Finding(code="force-follows-drift", severity="warning", message="It drifts.", advice="")
    result = dataclasses.replace(with_stiffness(reported(), weak(3.0e5, 3.0e4)), findings=(drift,))
    (uncertain,) = needed(advise(result))
    assert uncertain.advice.startswith("The sensor drifts")
