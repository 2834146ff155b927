"""`autotune predict` through its real entry point."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest

from autotune.cli.main import main
from autotune.errors import UsageError
from autotune.formats.controller import write_controller
from autotune.formats.controller_record import CollisionSettings
from autotune.formats.limits import CollisionResponse
from autotune.formats.quantity import Uncertain
from autotune.predicting import ContactRequest, parse_approach, parse_surface
from autotune.prediction.plants import Surface
from autotune.prediction.said_gains import parse_gains
from problems.contact.nonlinearities import DeadbandType
from problems.errors import ParameterError
from tests.autotune.cli.test_next import PLANT_TEXT
from tests.autotune.formats.samples import make_identified
from tests.autotune.tuning.cases import fast_optimized

GAINS = ("--gains", "mass=13,damping=1kNs/m,lead=20ms")


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT_TEXT, encoding="utf-8")
    return path


def test_one_contact_as_table_json_picture_and_page(
    plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = (
        "predict",
        str(plant),
        *GAINS,
        "--surface",
        "20N/mm",
        "--approach",
        "speed=28mm/s",
        "--plot",
        "contact.svg",
    )
    assert main([*asked, "--json", "--report", "contact.html"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["plant"]["environment"]["stiffness_n_per_m"] == 2e4
    assert tree["contact"]["contact_speed_m_s"] == pytest.approx(0.028)
    low, high = tree["interval"]["sensor"]
    assert low <= tree["peak_sensor_force"] <= high
    assert (tmp_path / "contact.svg").read_bytes().startswith(b"<?xml")
    assert "Predicted contact on axis x" in (tmp_path / "contact.html").read_text(encoding="utf-8")
    assert main([*asked]) == 0
    said = capsys.readouterr()
    assert f"peak {tree['peak_force']:.4g} N at the surface" in " ".join(said.out.split())
    assert "contact.svg: replaced" in said.err


def test_contacts_of_a_log_are_predicted_with_the_gains_that_ran(
    good_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["identify", str(good_log), "--quiet"]) == 0
    asked = ["predict", "identified.yaml", "--gains", "mass=10,damping=1400", "--approach", "force=30"]
    assert main([*asked, "--log", str(good_log), "--json"]) == 0
    contacts = json.loads(capsys.readouterr().out)["contacts"]
    assert len(contacts) == 2
    for each in contacts:
        # The sensor's noise lifts the largest sample by up to 1 %; the log was recorded at 1250 Hz.
        assert abs(each["error_percent"]) < 2.0
        assert each["is_inside"]
        low, high = each["touch"]["peak_interval"]
        assert low <= each["touch"]["peak_force"] < high < 1.05 * low
    assert main([*asked, "--log", str(good_log)]) == 0
    said = capsys.readouterr()
    assert "the log does not hold the gains that ran" in " ".join(said.out.split())
    assert "simulated on axis x without a deadband, as a log does not hold it" in " ".join(said.out.split())


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("--approach", "force=30"), 2, "--gains"),
        (GAINS, 2, "--approach"),
        ((*GAINS, "--approach", "force=30", "--surface", "wood"), 2, "stiffness such as 20N/mm"),
        ((*GAINS, "--approach", "push=30"), 2, "force, speed"),
        ((*GAINS, "--approach", "force=30", "--plot", "contact.pdf"), 2, ".svg or .png"),
        (("--gains", "mass=10,damping=200", "--approach", "force=30", "--surface", "5e5"), 5, "unstable"),
    ],
)
def test_what_cannot_be_predicted_is_one_sentence(
    plant: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, said: str
) -> None:
    assert main(["predict", str(plant), *arguments]) == code
    found = capsys.readouterr()
    assert said in found.err
    assert len(found.err.strip().splitlines()) == 1
    assert found.out == ""


def test_gains_surface_and_approach_are_read_with_units() -> None:
    result = make_identified()
    surface = next(each.name for axis in result.axes.values() for each in axis.environments)
    assert parse_gains("mass=13,damping=1kNs/m,lead=20ms", None) == {"mass": 13.0, "damping": 1e3, "lead": 0.02}
    assert parse_gains("mass=0.3,damping=40,deadband=1Nm", "rz") == {"mass": 0.3, "damping": 40.0, "deadband": 1.0}
    assert parse_approach("speed=28mm/s,force=15", None) == {"speed": pytest.approx(0.028), "force": 15.0}
    assert parse_surface(surface, result) == (surface, None)
    assert parse_surface("20N/mm", result) == ("", 2e4)
    assert parse_surface("20±2N/mm", result) == ("", Uncertain(2e4, 2e3))
    assert parse_surface("4000Nm/rad", result) == ("", 4e3)
    for text in ("mass=13,mass=12", "mass", "weight=3"):
        with pytest.raises(UsageError, match="--gains"):
            parse_gains(text, None)
    with pytest.raises(UsageError, match="holds"):
        parse_surface("x99", result)


def test_a_prediction_says_with_which_deadband_it_was_simulated(
    plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, controller = tmp_path / "controller.yaml", fast_optimized().controller
    gains, reset = controller.axes["x"], CollisionSettings(response=CollisionResponse.RESET, threshold_n=60.0)
    of_file = dataclasses.replace(gains, deadband=5.0, deadband_type=DeadbandType.SUBTRACTIVE)
    write_controller(path, dataclasses.replace(controller, axes={"x": of_file}, collision=reset))
    numbers = f"mass={gains.mass!r},damping={gains.damping!r},lead={gains.lead_s!r}"
    numbers += f",feedback_damping={gains.feedback_damping_s!r}"
    asked = ("predict", str(plant), "--surface", "20N/mm", "--approach", "force=30")

    def found(*law: str) -> tuple[float, str]:
        assert main([*asked, *law, "--json"]) == 0
        peak = json.loads(capsys.readouterr().out)["peak_force"]
        assert main([*asked, *law]) == 0
        return peak, " ".join(capsys.readouterr().out.split())

    peak, said = found("--controller", str(path))
    assert "and the deadband of 5 N (subtractive: only what exceeds it acts) of the controller file" in said
    assert "not simulated: the reset on a collision of 60 N of the controller file" in said
    same, said = found("--gains", f"{numbers},deadband=5")
    assert same == pytest.approx(peak, rel=1e-6)
    assert "and a deadband of 5 N (subtractive: only what exceeds it acts), as the gains say" in said
    other, said = found("--gains", numbers)
    assert other < 0.95 * peak
    assert "and no deadband, as the gains name none" in said
    assert main(["predict", str(path), "--surface", "20N/mm"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "and without the deadband of 5 N (subtractive: only what exceeds it acts) of the controller file" in said


def test_a_controller_file_is_predicted_with_its_own_gains_and_plants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, found = tmp_path / "controller.yaml", fast_optimized().controller
    write_controller(path, found)
    peak = found.predicted["x"].scenarios[0]
    surface = ("--surface", f"{peak.environment_stiffness_n_per_m:.17g}")
    assert main(["predict", str(path), *surface, "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["peak_force"] == pytest.approx(peak.peak_contact_force_n, rel=1e-6)
    assert tree["axis"] == "x"
    for arguments, said in (
        ((), "--surface 20N/mm"),
        ((*surface, *GAINS), "--gains does not go with a controller file"),
        ((*surface, "--controller", str(path)), "--controller does not go with"),
        ((*surface, "--sample-time", "1ms"), "--sample-time does not go with"),
        ((*surface, "--axis", "y"), "holds the axes x; say one of them with --axis"),
        (("--surface", "20±2N/mm"), "one number for a design"),
        (("--surface", "wood"), "stiffness such as 20N/mm"),
    ):
        assert main(["predict", str(path), *arguments]) == 2
        assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan, math.inf, True, "hard"])
def test_a_contact_that_is_asked_for_has_numbers_above_0(wrong: Any) -> None:
    with pytest.raises(ParameterError, match="environment_stiffness must be a number greater than 0"):
        ContactRequest(stiffness=wrong).touched()
    for name in ("speed", "force"):
        with pytest.raises(ParameterError, match=f"approach_{name} must be a number greater than 0"):
            ContactRequest(**{name: wrong})
    for name, most in (("payload_mass", 1000.0), ("sample_time", 0.1)):
        with pytest.raises(ParameterError, match=f"{name} must be a number greater than 0 and at most {most:g}"):
            ContactRequest(**{name: wrong})
    assert ContactRequest(payload_mass=1000.0, sample_time=0.1).payload_mass == 1000.0
    for beyond in ({"payload_mass": 1000.1}, {"sample_time": 0.1001}):
        with pytest.raises(ParameterError, match=next(iter(beyond))):
            ContactRequest(**beyond)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="environment_stiffness must be a number greater than 0"):
        ContactRequest(stiffness=Uncertain(value=-1.0, std=1.0)).touched()
    assert ContactRequest(stiffness=2e4).touched() == Surface(stiffness=2e4, std=0.0)
    assert ContactRequest(stiffness=Uncertain(value=2e4, std=9.0)).touched() == Surface(stiffness=2e4, std=9.0)
    assert ContactRequest(surface="x1").touched() == Surface(name="x1")
