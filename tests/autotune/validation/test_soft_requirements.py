"""What a certificate says of noise, passivity and wishes is verified like every other claim."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from autotune.errors import CertificateError
from autotune.formats.certificate_record import SoftRequirement
from autotune.formats.controller import controller_tree, read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile
from autotune.tuning.optimize import optimize
from autotune.validation.validate import validate_controller
from problems.design.requirements import NoiseLimit, PassivityTarget
from problems.errors import ParameterError
from tests.autotune.tuning.cases import FAST_REQUIREMENTS, FAST_SPEC, identified_plant

ASKED = replace(
    FAST_REQUIREMENTS,
    command_noise=NoiseLimit(max_speed_rms_m_s=6e-4),
    passivity=PassivityTarget(passive_below_hz=20.0),
    max_peak_force_n=40.0,
    soft_n={"modulus_margin": 1.0, "gain_margin_db": 1.0, "free_space_admittance": 30.0, "max_peak_force_n": 1.0},
)


@cache
def wished() -> Controller:
    """Return a controller of which noise and passivity are required, and much else is wished."""
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    whole = optimize(plant, replace(FAST_SPEC, requirements=ASKED), seed=1).controller
    predicted = whole.predicted["x"]
    fewer = replace(predicted, scenarios=(predicted.scenarios[0], predicted.scenarios[-1]))
    return replace(whole, predicted={"x": fewer})


def soft(name: str, **changes: object) -> Callable[[Controller], Controller]:
    def changed(controller: Controller) -> Controller:
        claims = dict((controller.certificate.soft or {})["x"])
        claims[name] = replace(claims[name], **changes)  # type: ignore[arg-type]  # fields of the dataclass
        return replace(controller, certificate=replace(controller.certificate, soft={"x": claims}))

    return changed


def required(name: str, value: NoiseLimit | PassivityTarget) -> Callable[[Controller], Controller]:
    def changed(controller: Controller) -> Controller:
        asked = {**controller.certificate.requirements, name: value}
        return replace(controller, certificate=replace(controller.certificate, requirements=asked))

    return changed


def test_every_check_passes_and_the_file_is_read_back(tmp_path: Path) -> None:
    report = validate_controller(wished())
    assert report.passed
    names = [check.name for check in report.checks]
    assert names.count("command noise") == names.count("passivity") == 1
    message = next(check.message for check in report.checks if check.name == "requirements")
    assert "achieved of soft requirements: modulus_margin 0.4" in message
    write_controller(tmp_path / "controller.yaml", wished())
    assert read_controller(tmp_path / "controller.yaml").controller == wished()


def test_the_certificate_shows_what_was_achieved_and_asks_hard_for_the_rest_alone() -> None:
    certificate = wished().certificate
    claims = (certificate.soft or {})["x"]
    assert set(claims) == set(ASKED.soft_n)
    assert set(certificate.requirements) == set(ASKED.asked()) - set(ASKED.soft_n)
    assert certificate.requirements["command_noise"] == NoiseLimit(max_speed_rms_m_s=6e-4, force_noise_rms_n=0.14)
    assert claims["modulus_margin"].asked == 0.5
    assert claims["modulus_margin"].achieved == pytest.approx(certificate.margins["x"].modulus, rel=1e-12)
    peak = max(s.peak_contact_force_n for s in wished().predicted["x"].scenarios)
    assert claims["max_peak_force_n"].achieved == pytest.approx(peak, rel=1e-3)


FALSE_CLAIMS: dict[str, tuple[Callable[[Controller], Controller], str, str]] = {
    "less noise": (
        required("command_noise", NoiseLimit(max_speed_rms_m_s=3e-4, force_noise_rms_n=0.14)),
        "command noise",
        r"found 0\.000\d+ m/s, required: speed RMS at most 0\.0003 m/s under noise of 0\.14 N",
    ),
    "a noisier sensor": (
        required("command_noise", NoiseLimit(max_speed_rms_m_s=6e-4, force_noise_rms_n=0.3)),
        "command noise",
        "under noise of 0.3 N",
    ),
    "passive further": (
        required("passivity", PassivityTarget(passive_below_hz=60.0)),
        "passivity",
        r"found \d\d\.\d+ Hz, required: up to 60 Hz",
    ),
    "a margin that was only wished": (
        soft("modulus_margin", achieved=0.5),
        "requirements",
        r"modulus_margin must be at least 0\.5, found 0\.4",
    ),
    "no limit to the gain": (
        soft("gain_margin_db", achieved=None),
        "requirements",
        "gain_margin_db must be at least inf",
    ),
    "more freedom of motion": (
        soft("free_space_admittance", achieved=9e-4),
        "free-space admittance",
        r"\|G\| must be at least 0\.0009",
    ),
    "a lower peak": (soft("max_peak_force_n", achieved=30.0), "peak force", r"must be at most 30 N, found [34]\d\."),
}


@pytest.mark.parametrize("name", list(FALSE_CLAIMS))
def test_a_false_claim_is_found_out_with_its_numbers(name: str) -> None:
    change, check_name, reported = FALSE_CLAIMS[name]
    report = validate_controller(change(wished()))
    failed = {check.name: check.message for check in report.checks if not check.passed}
    assert check_name in failed
    with pytest.raises(AssertionError, match=reported):
        raise AssertionError(failed[check_name])
    with pytest.raises(CertificateError):
        report.require()


def test_a_wish_of_an_axis_that_is_not_there_is_refused() -> None:
    certificate = wished().certificate
    claim = SoftRequirement(asked=0.5, soft_n=1.0, achieved=0.4)
    with pytest.raises(ParameterError, match="for tuned axes only, x"):
        replace(wished(), certificate=replace(certificate, soft={"z": {"modulus_margin": claim}}))


def test_a_turning_axis_shows_its_soft_limits_in_its_units() -> None:
    """The tree alone: the certificate of x said about ry."""
    whole = wished()
    claims = (whole.certificate.soft or {})["x"]
    noise = SoftRequirement(asked=NoiseLimit(max_speed_rms_m_s=0.01, force_noise_rms_n=0.1), soft_n=2.0, achieved=0.02)
    certificate = replace(
        whole.certificate,
        domain={"ry": whole.certificate.domain["x"]},
        margins={"ry": whole.certificate.margins["x"]},
        rotational_requirements=whole.certificate.requirements,
        soft={"ry": {**claims, "command_noise": noise}},
        continuous={"ry": (whole.certificate.continuous or {})["x"]},
    )
    turned = replace(
        whole,
        limits=None,
        axes={"ry": whole.axes["x"]},
        predicted={"ry": whole.predicted["x"]},
        certificate=certificate,
    )
    tree = controller_tree(turned)["certificate"]["soft"]["ry"]
    assert tree["command_noise"] == {
        "asked": {"max_speed_rms_rad_s": 0.01, "torque_noise_rms_n_m": 0.1},
        "soft_n_m": 2.0,
        "achieved": 0.02,
    }
    assert set(tree) >= {"max_peak_torque_n_m", "modulus_margin"}
