"""A certificate over more than K_e and M_p: what is proved, what is sampled, and claims that go too far."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import CertificateError
from autotune.formats.certificate_record import AxisDomain, ConfidenceSet
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.validation.domain import check_domain
from autotune.validation.validate import validate_controller
from autotune.validation.validation_samples import build_validation_samples
from problems.errors import ParameterError
from tests.autotune.tuning.cases import FURTHER, identified_axis, known, uncertain_optimized, with_axis

Change = Callable[[Controller], Controller]


@cache
def small() -> Controller:
    """The controller with the worst of its predicted contacts, which is quick to validate."""
    controller = uncertain_optimized().controller
    predicted = controller.predicted["x"]
    worst = max(predicted.scenarios, key=lambda scenario: scenario.peak_contact_force_n)
    return replace(controller, predicted={"x": replace(predicted, scenarios=(worst,))})


def uncertain(**ranges: tuple[float, float]) -> Change:
    def changed(controller: Controller) -> Controller:
        domain = controller.certificate.domain["x"]
        wider = replace(domain, uncertain={**(domain.uncertain or {}), **ranges})
        return replace(controller, certificate=replace(controller.certificate, domain={"x": wider}))

    return changed


def test_the_file_shows_proved_from_sampled() -> None:
    certificate = uncertain_optimized().controller.certificate
    assert dict(certificate.domain["x"].uncertain or {}) == FURTHER
    assert all("everything else at its nominal value" in str(proof.over) for proof in certificate.proved)
    claim, led = certificate.sampled
    assert "led by hand" in str(led.claim)
    assert "no proof" in str(led.method)
    for reported in ("K_s in [285000, 315000] N/m", "T_d in [0.00235, 0.0026] s", "f_b in [3.1, 3.27] Hz"):
        assert reported in str(claim.over)
    assert (claim.numbers or {})["plants"] >= 64.0
    # That contacts come to rest is proved over all that is uncertain, so that no impact need be followed.
    bouncing = (certificate.bouncing or {})["x"]
    assert (bouncing.share, bouncing.impacts) == (1.0, 0)
    assert set(FURTHER) <= set(bouncing.over)


def test_the_worst_cases_are_written_with_all_their_parameters() -> None:
    controller = uncertain_optimized().controller
    assert any(set(case) > {"environment_stiffness_n_per_m", "payload_mass_kg"} for case in _worst(controller))
    worst = max(controller.predicted["x"].scenarios, key=lambda s: s.peak_contact_force_n)
    assert set(worst.further or {}) <= set(FURTHER)
    assert worst.peak_contact_force_n == pytest.approx(uncertain_optimized().searches["x"].evaluation.cost, rel=1e-9)
    assert controller.delay_samples == pytest.approx(2.6e-3 / 8e-4)


def _worst(controller: Controller) -> list[Any]:
    return list(controller.certificate.margins["x"].worst.values())


def test_the_file_survives_the_disk_and_is_verified_from_it(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    write_controller(path, small())
    assert read_controller(path).controller == small()
    report = validate_controller(read_controller(path).controller)
    assert report.passed, [check.message for check in report.checks if not check.passed]
    assert {"margins", "peak force"} <= {check.name for check in report.checks}


@pytest.mark.parametrize(
    ("change", "check", "output"),
    [
        (uncertain(delay_s=(2.35e-3, 6e-3)), "delay", r"delay_samples says 3\.25, .* has 7\.5"),
        (uncertain(coupling_damping_n_s_per_m=(0.0, 170.0)), "margins", r"modulus is claimed as 0\.\d+, found 0\.\d+"),
        (uncertain(robot_bandwidth_hz=(1.0, 3.27)), "free-space admittance", r"must be at least 0\.00055 m/s/N, found"),
        (uncertain(coupling_stiffness_n_per_m=(2.95e5, 3.05e5)), "peak force", r"lies outside of the certified domain"),
        (uncertain(coupling_stiffness_n_per_m=(2.95e5, 3.05e5), mass=(1.0, 2.0)), "", "one of"),
    ],
)  # fmt: skip
def test_a_set_that_is_claimed_too_wide_is_found_out(change: Change, check: str, output: str) -> None:
    if not check:
        with pytest.raises(ParameterError, match=output):
            change(small())
        return
    report = validate_controller(change(small()))
    messages = {each.name: each.message for each in report.checks if not each.passed}
    with pytest.raises(AssertionError, match=output):
        raise AssertionError(messages[check])
    with pytest.raises(CertificateError, match="Axis x, "):
        report.require()


def test_a_higher_peak_elsewhere_in_the_set_is_found_out() -> None:
    """The same set with a softer promise: the gentlest contact stands for all."""
    predicted = uncertain_optimized().controller.predicted["x"]
    gentle = min(predicted.scenarios, key=lambda scenario: scenario.peak_contact_force_n)
    widened = uncertain(coupling_damping_n_s_per_m=(130.0, 170.0))(small())
    soft = replace(widened, predicted={"x": replace(predicted, scenarios=(gentle,))})
    domain = soft.certificate.domain["x"]
    stiffer = replace(domain, environment_stiffness_n_per_m=(1e5, 2.4e5))
    report = validate_controller(replace(soft, certificate=replace(soft.certificate, domain={"x": stiffer})))
    message = next(check.message for check in report.checks if check.name == "peak force")
    assert "more than the largest predicted" in message


def test_a_confidence_set_must_fit_the_ranges_and_itself() -> None:
    domain: AxisDomain = small().certificate.domain["x"]
    with pytest.raises(ParameterError, match="given for delay_s"):
        ConfidenceSet(level=0.95, centre={"delay_s": 2.4e-3}, covariance={"drag_n_s_per_m": {"delay_s": 1e-10}})
    cut = ConfidenceSet(level=0.95, centre={"delay_s": 2.4e-3}, covariance={"delay_s": {"delay_s": 1e-10}})
    with_cut = replace(domain, confidence=cut)
    margins, predicted = small().certificate.margins["x"], small().predicted["x"]
    others = build_validation_samples(with_cut, margins, predicted)
    low, high = cut.ellipsoid().box()["delay_s"]
    drawn = [s for s in others.scenarios if s not in {p.scenario() for p in predicted.scenarios}][8:]
    assert all(low * (1 - 1e-9) <= (s.delay_s or 0.0) <= high * (1 + 1e-9) for s in drawn[-64:])
    with pytest.raises(ParameterError, match="together with the ranges"):
        replace(domain, uncertain=None, confidence=cut)


def test_an_identified_plant_inside_the_ranges_is_inside_the_domain() -> None:
    axis = identified_axis()
    shifted = replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=known(3.1e5, 10.0)))
    assert check_domain(small(), with_axis(shifted))[0].passed
    outside = replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=known(3.4e5, 10.0)))
    check, _ = check_domain(small(), with_axis(outside))
    assert not check.passed
    assert "K_s [N/mm] is 340, certified for [285, 315]" in check.message
