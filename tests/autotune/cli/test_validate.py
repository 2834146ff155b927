"""`autotune validate` through the real entry point: a true file, false ones with a right checksum, altered ones."""

import json
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from autotune.formats.canonical import short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import ControllerStatus
from autotune.formats.identified import write_identified
from autotune.formats.signature import fingerprint
from autotune.simulation.write import write_mcap
from problems.text import rounded_down
from tests.autotune.prediction.pressing import Cell, recorded_contact
from tests.autotune.tuning.cases import identified_plant, known, small_controller, write_plant
from tests.autotune.validation.test_against_log import recorded
from tests.autotune.validation.test_validate import EVERY_CHECK, FALSE_CLAIMS
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
FEW = ("--samples", "4")
SIMULATED = ["sampled peaks", "full simulation"]
COMPENSATED_YAML = """\
format: autotune/cell
version: 1
table: {time: t}
pose:
  fields: {position: [x, y, z], orientation: [qx, qy, qz, qw]}
  units: {position: m}
  orientation_as: quaternion_xyzw
wrench: {fields: {force: [fx, null, null]}, units: {force: N}, gravity_compensated: true}
desired_force: {force: [30.0, 0.0, 0.0]}
"""
THROUGH_THE_COMMAND_LINE = [
    "modulus too high",
    "damping too low",
    "an unstable gap among the walls",
    "stiffer walls",
    "contact peak too small",
    "admittance too high",
    "delay too small",
    "requirement unknown",
    "compensation",
    "collision response",
]


@pytest.fixture
def good(tmp_path: Path) -> Path:
    write_controller(tmp_path / "controller.yaml", small_controller())
    return tmp_path / "controller.yaml"


def test_a_true_file_passes_and_every_check_is_reported(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", "controller.yaml", *FEW)
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    lines = done.stdout.splitlines()
    assert lines[0].startswith("axis x, led by hand: ")
    assert lines[1].startswith("axis x, driven on for 0.2 s after the touch by ")
    assert lines[2].startswith("limits of the runtime: ")
    assert lines[4].startswith("axis x, contact force of 4 plants: at most ")
    reported = [re.match(r"ok +axis x, ([^:]+): \S", line)[1] for line in lines[5:-1]]  # type: ignore[index]
    assert reported == [*EVERY_CHECK, *SIMULATED]
    assert lines[-1] == f"controller.yaml: valid, checksum {short(read_controller(good).checksum)}"
    assert [path.name for path in good.parent.iterdir()] == ["controller.yaml"]


def test_a_limit_of_the_force_says_which_speed_is_safe(run_cli: RunCli, good: Path) -> None:
    """Twice the force, twice the speed; a part of the body stands for its force, another word for none."""
    per_speed = small_controller().predicted["x"].peak_per_speed
    assert per_speed is not None
    line = run_cli("validate", str(good), "--force-limit", "65", *FEW).stdout.splitlines()[0]
    assert per_speed.holds is not None
    slow, held, fast = (rounded_down(65.0 / each) for each in (per_speed.pushes_on, per_speed.holds, per_speed.lets_go))
    assert line.endswith(f"at most 65 N (--force-limit) up to {slow:g}, {held:g} and {fast:g} m/s")
    refused = run_cli("validate", str(good), "--force-limit", "nose")
    assert refused.returncode == 2
    assert "Or name one of skull, face" in refused.stderr


def test_a_log_without_weight_and_command_is_compared_by_its_peaks(run_cli: RunCli, good: Path) -> None:
    """A cell of scipy's integrator with a plant of the certified set, under the law of the file."""
    gains = small_controller().axes["x"]
    cell = Cell(coupling_damping=150.0, drag=330.0, wall=1.1e5)
    log = recorded_contact(
        cell,
        mass=gains.mass,
        damping=gains.damping,
        lead=gains.lead_s,
        feedback=gains.feedback_damping_s,
        deadband=gains.deadband,
        # T_d and half a sample.
        lag_s=2.4e-3 + 4e-4,
        force=30.0,
    )
    rest = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(log), 1))
    noisy = log[:, 2] + np.random.default_rng(1).normal(scale=0.2, size=len(log))
    rows = np.column_stack([log[:, :2], rest, noisy])
    np.savetxt(good.parent / "log.csv", rows, delimiter=",", header="t,x,y,z,qx,qy,qz,qw,fx", comments="")
    (good.parent / "cell.yaml").write_text(COMPENSATED_YAML)
    done = run_cli("validate", good, "--samples", "0", "--log", "log.csv", "--cell", "cell.yaml", "--json")
    assert done.returncode == 0, done.stderr
    (contact,) = json.loads(done.stdout)["log"]["contacts"]
    assert contact["is_inside"]
    # The steady approach against the drag, and the integrator's own peak but for noise.
    assert contact["speed_m_s"] == pytest.approx(30.0 / (gains.damping + cell.drag), rel=0.01)
    assert contact["predicted_peak_n"] == pytest.approx(-np.min(log[:, 2]), rel=0.02)


def test_json_is_one_object_and_quiet_is_silent(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", "controller.yaml", "--json", *FEW)
    tree = json.loads(done.stdout)
    assert (done.returncode, done.stderr, tree["passed"]) == (0, "", True)
    assert [check["name"] for check in tree["checks"]] == [*EVERY_CHECK, *SIMULATED]
    assert tree["checksum"] == read_controller(good).checksum
    assert (tree["signed_by"], tree["log"]) == (None, None)
    assert tree["monte_carlo"]["x"]["samples"] == 4
    quiet = run_cli("validate", "controller.yaml", "--quiet", "--samples", "0")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def test_quantiles_of_the_sampled_peak_are_printed(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", good, "--samples", "16", "--json")
    quantiles = json.loads(done.stdout)["monte_carlo"]["x"]["contact"]["observed"]["quantiles"]
    said = ", ".join(f"{value:.2f} N in {100.0 * float(share):g} %" for share, value in quantiles.items())
    lines = run_cli("validate", good, "--samples", "16").stdout.splitlines()
    assert f"axis x, contact force of 16 plants: at most {said}" in lines
    assert not any(line.startswith("worst plants") for line in lines)


def test_a_larger_study_prints_quantiles_and_the_worst_plants(run_cli: RunCli, good: Path) -> None:
    done = run_cli("validate", good, "--samples", "300")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert any(line.startswith("axis x, contact force of 300 plants: at most ") for line in lines)
    (first,) = (i for i, line in enumerate(lines) if line.startswith("worst plants of x"))
    peaks = [float(line.split()[-2]) for line in lines[first + 2 : first + 12]]
    assert peaks == sorted(peaks, reverse=True)
    assert all(line.startswith("K_e ") for line in lines[first + 2 : first + 12])
    assert "none of 300 plants breaks a limit" in done.stdout


@pytest.mark.parametrize("name", THROUGH_THE_COMMAND_LINE)
def test_a_false_file_with_a_right_checksum_is_exit_6_and_the_check_names_numbers(
    run_cli: RunCli, tmp_path: Path, name: str
) -> None:
    change, check, reported = FALSE_CLAIMS[name]
    write_controller(tmp_path / "controller.yaml", change(small_controller()))
    done = run_cli("validate", "controller.yaml")
    assert done.returncode == 6
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("autotune: Axis x, ")
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    assert any(f"axis x, {check}: " in line and re.search(reported, line) for line in failed)
    assert "controller.yaml: NOT valid, checksum " in done.stdout


def test_a_false_file_with_json_is_one_object_and_exit_6(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", FALSE_CLAIMS["delay too small"][0](small_controller()))
    done = run_cli("validate", "controller.yaml", "--json")
    tree = json.loads(done.stdout)
    assert (done.returncode, tree["passed"]) == (6, False)
    assert [check["name"] for check in tree["checks"] if not check["passed"]] == ["delay"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"(?m)^    damping: .*$", "    damping: 2000.0"),
        ("status: validated", "status: unvalidated"),
        (r"(?s)certificate:.*", ""),
        (r"(?s).*", ""),
    ],
    ids=["a gain", "the status", "the end is missing", "empty"],
)
def test_an_altered_file_is_exit_6(run_cli: RunCli, good: Path, old: str, new: str) -> None:
    text = good.read_text(encoding="utf-8")
    altered = re.sub(old, new, text, count=1)
    assert altered != text
    good.write_text(altered, encoding="utf-8")
    done = run_cli("validate", "controller.yaml")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (6, "", 1)
    assert done.stderr.startswith("autotune: controller.yaml")


def test_an_unvalidated_file_is_exit_6(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "c.yaml", replace(small_controller(), status=ControllerStatus.UNVALIDATED))
    done = run_cli("validate", "c.yaml")
    assert (done.returncode, done.stdout) == (6, "")
    assert "not validated" in done.stderr


def test_the_identified_plant_is_compared_with_the_domain(run_cli: RunCli, good: Path) -> None:
    write_plant(good.parent)
    inside = run_cli("validate", "controller.yaml", "--identified", "identified.yaml", *FEW)
    assert inside.returncode == 0
    assert is_next_alone(inside.stderr)
    assert "axis x, identified plant: lies inside the certified domain" in inside.stdout
    assert "0.14 N noise" in inside.stdout
    plant = identified_plant()
    heavy = replace(plant, payload=replace(plant.payload, mass_kg=known(20.0, 0.1)))
    write_identified(good.parent / "heavy.yaml", heavy, {"tool": "by hand"})
    outside = run_cli("validate", "controller.yaml", "--identified", "heavy.yaml", "--samples", "0")
    assert outside.returncode == 6
    assert "payload mass [kg] is 20, certified for [16, 16]" in outside.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument 'CONTROLLER'"),
        (["absent.yaml"], "absent.yaml cannot be read"),
        (["controller.yaml", "--identified", "absent.yaml"], "absent.yaml cannot be read"),
        (
            ["controller.yaml", "--identified", "controller.yaml"],
            "controller.yaml is a controller, not an identified plant",
        ),
        (["controller.yaml", "--noise", "soft"], "must be a number, or two with a comma between"),
        (["controller.yaml", "--noise", "-1"], "noise_rms must be not below 0"),
        (["controller.yaml", "--sensor-range", "1,2,3"], "must be a number, or two with a comma between"),
        (["controller.yaml", "--late", "1"], "--late"),
        (["controller.yaml", "--late", "nan"], "nan is not a finite number"),
        (["controller.yaml", "--sign", "absent.pem"], "absent.pem cannot be read"),
        (["controller.yaml", "--public-key", "controller.yaml"], "must hold an Ed25519 public key"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, good: Path, arguments: list[str], message: str) -> None:
    done = run_cli("validate", *arguments)
    assert good.exists()
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr


def test_a_file_is_signed_once_it_holds_and_the_signature_is_demanded(run_cli: RunCli, good: Path) -> None:
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    folder = good.parent
    (folder / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    (folder / "key.pem").chmod(0o600)
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (folder / "pub.pem").write_bytes(public)
    check = ("validate", "controller.yaml", "--samples", "0", "--public-key", "pub.pem")
    unsigned = run_cli(*check)
    assert (unsigned.returncode, unsigned.stdout) == (6, "")
    assert "controller.yaml must be signed" in unsigned.stderr
    signed = run_cli("validate", "controller.yaml", "--samples", "0", "--sign", "key.pem", "--json")
    assert signed.returncode == 0
    assert json.loads(signed.stdout)["signed_by"] == fingerprint(key.public_key())
    again = run_cli("validate", "controller.yaml", "--samples", "0", "--sign", "key.pem")
    assert again.returncode == 0
    assert "controller.yaml.sig: replaced the signature of sha256 " in again.stderr
    demanded = run_cli(*check)
    assert demanded.returncode == 0
    assert is_next_alone(demanded.stderr)
    assert demanded.stdout.endswith(f", signed by the key {fingerprint(key.public_key())}\n")
    good.write_text(good.read_text(encoding="utf-8") + "# looked at\n", encoding="utf-8")
    changed = run_cli(*check)
    assert (changed.returncode, changed.stdout, changed.stderr.count("\n")) == (6, "", 1)
    assert "is not a signature of controller.yaml" in changed.stderr


@pytest.mark.parametrize("is_link", [False, True])
def test_what_is_no_signature_is_not_replaced(run_cli: RunCli, good: Path, is_link: bool) -> None:
    beside, kept = good.with_name("controller.yaml.sig"), good.with_name("kept")
    (beside, kept)[is_link].write_text("of somebody else", encoding="utf-8")
    if is_link:
        beside.symlink_to(kept)
    done = run_cli("validate", "controller.yaml", "--samples", "0", "--sign", "absent.pem")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "controller.yaml.sig" in done.stderr
    assert beside.read_text(encoding="utf-8") == "of somebody else"


def test_a_file_that_does_not_hold_is_not_signed(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", FALSE_CLAIMS["delay too small"][0](small_controller()))
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    (tmp_path / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    (tmp_path / "key.pem").chmod(0o600)
    assert run_cli("validate", "controller.yaml", "--sign", "key.pem").returncode == 6
    assert not (tmp_path / "controller.yaml.sig").exists()


def test_a_log_is_compared_contact_by_contact(run_cli: RunCli, good: Path, good_log: Path) -> None:
    write_mcap(recorded(), good.parent / "own.mcap")
    asked = ("validate", "controller.yaml", "--samples", "0", "--log")
    done = run_cli(*asked, "own.mcap")
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    assert "2 of 2 traces lie inside the predicted band all the time\n" in done.stdout
    tree = json.loads(run_cli(*asked, "own.mcap", "--json").stdout)
    assert (tree["passed"], tree["log"]["inside_share"], tree["log"]["payload_from"]) == (True, 1.0, "log")
    for contact in tree["log"]["contacts"]:
        error = contact["predicted_peak_n"] - contact["measured_peak_n"]
        assert contact["peak_error_n"] == error
        assert contact["peak_error_percent"] == pytest.approx(100.0 * error / contact["measured_peak_n"])
    other = run_cli(*asked, good_log)
    assert (other.returncode, other.stdout, other.stderr.count("\n")) == (3, "", 1)
    assert "was recorded with another controller" in other.stderr
