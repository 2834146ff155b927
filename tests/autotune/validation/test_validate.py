"""Validation finds out a file that is whole and claims too much; every verdict names its numbers."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.errors import CertificateError
from autotune.formats.controller_record import (
    CollisionSettings,
    Controller,
    ControllerStatus,
    FreeSpaceAdmittance,
    ScenarioPrediction,
    admittance_controller,
)
from autotune.formats.limits import CollisionResponse
from autotune.validation.axis_proof import ProofOptions, prove_axis
from autotune.validation.bouncing import RefutedError
from autotune.validation.report import Check, ValidationReport
from autotune.validation.validate import validate_controller
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.tuning.cases import fast_optimized, small_controller

Change = Callable[[Controller], Controller]
EVERY_CHECK = [
    "parameters",
    "payload",
    "delay",
    "stability in free space",
    "stability in contact",
    "statements",
    "continuous proof",
    "held by a hand",
    "margins",
    "requirements",
    "free-space admittance",
    "peak force",
    "proved peak",
    "led by hand",
    "bouncing",
    "limits",
]


def gains(**values: float) -> Change:
    return lambda c: replace(c, axes={"x": replace(c.axes["x"], **values)})  # type: ignore[arg-type]


def domain(**values: Any) -> Change:
    return lambda c: _certified(c, domain={"x": replace(c.certificate.domain["x"], **values)})


def margins(**values: float | None) -> Change:
    return lambda c: _certified(c, margins={"x": replace(c.certificate.margins["x"], **values)})  # type: ignore[arg-type]


def reach(**values: Any) -> Change:
    def changed(c: Controller) -> Controller:
        (reported,) = (c.certificate.continuous or {})["x"]
        return _certified(c, continuous={"x": (replace(reported, **values),)})

    return changed


def required(**values: float | bool) -> Change:
    return lambda c: _certified(c, requirements={**c.certificate.requirements, **values})


def peaks(share_contact: float, share_sensor: float) -> Change:
    def scaled(s: ScenarioPrediction) -> ScenarioPrediction:
        return replace(
            s,
            peak_contact_force_n=share_contact * s.peak_contact_force_n,
            peak_sensor_force_n=share_sensor * s.peak_sensor_force_n,
        )

    return lambda c: _predicted(c, scenarios=tuple(scaled(s) for s in c.predicted["x"].scenarios))


def admittance(**values: float) -> Change:
    def changed(c: Controller) -> Controller:
        promised: FreeSpaceAdmittance = c.predicted["x"].free_space_admittance
        return _predicted(c, free_space_admittance=replace(promised, **values))  # type: ignore[arg-type]

    return changed


def _certified(controller: Controller, **parts: Any) -> Controller:
    return replace(controller, certificate=replace(controller.certificate, **parts))


def _predicted(controller: Controller, **parts: Any) -> Controller:
    return replace(controller, predicted={"x": replace(controller.predicted["x"], **parts)})


def _moved(controller: Controller) -> Controller:
    first = controller.predicted["x"].scenarios[0]
    return _predicted(controller, scenarios=(replace(first, environment_stiffness_n_per_m=5e4),))


def _softest_only(controller: Controller) -> Controller:
    """Keep the gentlest contact in the file and promise a limit that only this one keeps."""
    first = controller.predicted["x"].scenarios[0]
    limit = 1.01 * first.peak_contact_force_n
    return required(max_peak_force_n=limit)(_predicted(controller, scenarios=(first,)))


# Stable in free space, against soft and against stiff walls, and not in between (see the tests of the proof).
LIGHTLY_DAMPED = domain(
    coupling_stiffness_n_per_m=2.1e5,
    coupling_damping_n_s_per_m=0.0,
    drag_n_s_per_m=30.0,
    robot_numerator=(24.0,),
    robot_denominator=(1.0, 24.0),
    environment_stiffness_n_per_m=(1e5, 3e6),
)
FALSE_CLAIMS: dict[str, tuple[Change, str, str]] = {
    "modulus too high": (margins(modulus=0.6), "margins", r"modulus is claimed as 0\.6, found 0\.5\d*"),
    "phase too high": (margins(phase_deg=45.0), "margins", r"phase_deg is claimed as 45, found 3\d\."),
    "gain margin without limit": (margins(gain_db=None), "margins", r"gain_db is claimed as inf, found 1\d\."),
    "delay margin too high": (margins(delay_s=0.02), "margins", r"delay_s is claimed as 0\.02, found 0\.00\d"),
    "proof of too much modulus": (
        reach(modulus=0.6),
        "continuous proof",
        r"stability with a modulus of 0\.6 is refuted at K_e \d+\.?\d* N/mm, M_p 16 kg, \d+\.?\d* Hz",
    ),
    "proof of more than its work allows": (
        reach(budget_s=1e-4),
        "continuous proof",
        r"over K_e, M_p: claimed for the share 1, proved for 0$",
    ),
    "proof over what is not in the domain": (
        reach(over=("environment_stiffness_n_per_m", "gripper")),
        "continuous proof",
        r"gripper",
    ),
    "damping too low": (
        gains(damping=300.0),
        "stability in free space",
        r"stability in free space does not hold or cannot be proved: fails at K_e 0 N/mm, M_p 16 kg",
    ),
    "an unstable gap among the walls": (
        lambda c: gains(mass=9.3, damping=1340.0, lead_s=0.019, feedback_damping_s=0.0)(LIGHTLY_DAMPED(c)),
        "stability in contact",
        r"stability in contact does not hold or cannot be proved: fails at K_e 1550 N/mm, M_p 16 kg",
    ),
    "lead too high for free space": (
        gains(lead_s=0.2),
        "stability in free space",
        r"stability in free space does not hold .* M_p 16 kg",
    ),
    "stiffer walls": (
        domain(environment_stiffness_n_per_m=(1e5, 5e5)),
        "margins",
        r"gain_db is claimed as 11\.\d+, found 11\.0",
    ),
    "heavier payloads": (
        domain(payload_mass_kg=(16.0, 30.0)),
        "requirements",
        r"modulus_margin must be at least 0\.5, found 0\.499",
    ),
    "stiffer coupling": (
        domain(coupling_stiffness_n_per_m=1e6),
        "stability in free space",
        r"stability in free space does not hold",
    ),
    "contact peak too small": (
        peaks(0.8, 1.0),
        "peak force",
        r"contact force is predicted as \d+\.\d\d N, replayed \d",
    ),
    "sensor peak too small": (peaks(1.0, 0.8), "peak force", r"sensor force is predicted as \d+\.\d\d N, replayed \d"),
    "admittance too high": (
        admittance(min_m_s_per_n=9e-4),
        "free-space admittance",
        r"\|G\| is claimed as 0\.0009 m/s/N, found 0\.00065",
    ),
    "hand force too small": (
        admittance(hand_force_n_per_m_s=500.0),
        "free-space admittance",
        r"hand force is claimed as 500 N/\(m/s\), found 16\d\d",
    ),
    "delay too small": (
        lambda c: replace(c, delay_samples=2.0),
        "delay",
        r"delay_samples says 2, the certificate's plant has 3",
    ),
    "weight that is not certified": (
        lambda c: replace(c, payload=replace(c.payload, mass_kg=2.0 * c.payload.mass_kg)),
        "payload",
        r"takes off the weight of \d+ kg, which is outside the certified",
    ),
    "longer delay than certified gains allow": (domain(delay_s=8e-3), "delay", r"delay_samples says 3, .* has 10"),
    "requirement missed": (
        required(modulus_margin=0.6),
        "requirements",
        r"modulus_margin must be at least 0\.6, found 0\.5",
    ),
    "decay missed": (
        required(decay_rate_per_s=40.0),
        "requirements",
        r"decay_rate_per_s must be at least 40, found \d",
    ),
    "requirement unknown": (required(passivity=True), "requirements", "passivity cannot be verified by this release"),
    "peak limit missed": (required(max_peak_force_n=40.0), "peak force", r"must be at most 40 N, found 4\d\.\d\d N"),
    "worst contact left out": (_softest_only, "peak force", r"must be at most \d+(\.\d+)? N, found \d+\.\d\d N"),
    "no contact predicted": (lambda c: _predicted(c, scenarios=()), "peak force", "the file predicts no contact"),
    "contact outside of the domain": (_moved, "peak force", "lies outside of the certified domain"),
    "no approach": (domain(approach_force_n=None), "peak force", "names no approach"),
    "compensation": (
        lambda c: replace(c, compensation_mass_kg=16.0),
        "requirements",
        r"modulus_margin must be at least 0\.5, found 0\.3",
    ),
    "collision response": (
        lambda c: replace(c, collision=CollisionSettings(response=CollisionResponse.RESET, threshold_n=100.0)),
        "collision response",
        "the file has a collision response and predicts no contact with it",
    ),
    "full stop": (
        lambda c: replace(c, collision=CollisionSettings(response=CollisionResponse.STOP, threshold_n=100.0)),
        "collision response",
        "the file has a collision response and predicts no contact with it",
    ),
    "wall with mass": (domain(environment_mass_kg=2.0), "proved peak", "environment_mass_kg must be 0"),
    "robot that is none": (domain(robot_denominator=(1.0, -20.0)), "parameters", r"r\(s\)"),
}


def test_a_good_file_passes_every_check() -> None:
    report = validate_controller(small_controller())
    assert [(check.name, check.passed) for check in report.checks] == [(name, True) for name in EVERY_CHECK]
    assert report.passed
    report.require()


@pytest.mark.parametrize("name", list(FALSE_CLAIMS))
def test_a_false_claim_is_found_out_with_its_numbers(name: str) -> None:
    change, check_name, reported = FALSE_CLAIMS[name]
    report = validate_controller(change(small_controller()))
    assert not report.passed
    failed = [check for check in report.checks if not check.passed]
    assert check_name in [check.name for check in failed]
    with pytest.raises(AssertionError, match=reported):
        raise AssertionError(next(check.message for check in failed if check.name == check_name))
    with pytest.raises(CertificateError, match="Axis x, "):
        report.require()


def test_a_modest_claim_is_no_false_one() -> None:
    """Margins and delay may be stated lower than they are: what is promised holds."""
    modest = margins(modulus=0.4, phase_deg=20.0, gain_db=5.0, delay_s=1e-3)(small_controller())
    assert validate_controller(replace(modest, delay_samples=4.0)).passed


def test_what_is_passed_without_being_shown_is_reported_so() -> None:
    """A budget for nothing proves nothing, and a deadband of nearly F^d hides the contact: neither is wrong."""
    whole = small_controller()
    swept, options = whole.certificate.margins["x"].modulus, ProofOptions(budget_s=1e-4)
    found = prove_axis(
        whole.certificate.domain["x"].plants, admittance_controller(whole, "x"), 8e-4, "x", swept, options
    )
    given_up = _certified(whole, proved=found.proofs, continuous={"x": found.regions})
    driving = small_controller().certificate.domain["x"].approach_force_n or 0.0
    report = validate_controller(gains(deadband=0.97 * driving)(given_up))
    assert report.passed
    noted = {check.name: check.message for check in report.checks if check.verdict == "note"}
    assert set(noted) == {"continuous proof", "deadband"}
    assert noted["continuous proof"].startswith("not proved: nothing could be shown within the budget")
    assert f"97 % of the {driving:g} N that drive the approach" in noted["deadband"]


def test_an_axis_without_certificate_is_not_valid() -> None:
    bare = replace(
        small_controller(),
        status=ControllerStatus.UNVALIDATED,
        certificate=replace(small_controller().certificate, domain={}, margins={}),
    )
    (check,) = validate_controller(bare).checks
    assert (check.passed, check.message) == (False, "the file holds no certificate for this axis")


def test_progress_is_reported_and_never_more_than_the_whole() -> None:
    shares: list[float] = []
    validate_controller(small_controller(), shares.append)
    assert min(shares) > 0.0
    assert sum(shares) == pytest.approx(1.0)


def test_the_first_failure_is_raised_and_the_others_are_counted() -> None:
    checks = [
        Check(axis="x", name=n, passed=p, message=f"about {n}") for n, p in (("a", True), ("b", False), ("c", False))
    ]
    with pytest.raises(CertificateError, match=r"^Axis x, b: about b \(1 more checks failed\)$"):
        ValidationReport(checks=tuple(checks)).require()
    ValidationReport(checks=(checks[0],)).require()


def test_a_requirement_that_is_missed_names_the_plant_that_misses_it_most() -> None:
    controller = required(modulus_margin=0.6)(small_controller())
    with pytest.raises(RefutedError, match=r"must be at least 0\.6, found") as refuted:
        validate_controller(controller).require()
    plants, h = controller.certificate.domain["x"].plants, controller.sample_time_s
    assert plants.contains(refuted.value.scenario)
    there = refuted.value.scenario.plant(plants.nominal)
    loops = [build_sampled_plant(each, h) for each in (there, there.in_contact_with(FREE_SPACE))]
    law = admittance_controller(controller, "x")
    found = float(str(refuted.value).rpartition("found ")[2].split()[0].rstrip(";"))
    assert min(find_margins(loop, law).modulus for loop in loops) == pytest.approx(found, rel=1e-3)


def test_the_whole_file_of_optimize_is_verified_with_all_its_contacts() -> None:
    report = fast_optimized().report
    assert report.passed
    peak = next(check for check in report.checks if check.name == "peak force")
    assert peak.message.startswith(f"{len(fast_optimized().controller.predicted['x'].scenarios)} contacts replayed")
    assert np.isfinite(float(peak.message.split("largest ")[1].split(" ")[0]))
