"""`autotune plan` through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.controller import write_controller
from autotune.formats.identified import write_identified
from identification.result import Estimate, Finding, Identified, Status
from tests.autotune.formats.samples import make_controller, make_identified
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def one_axis() -> Identified:
    found = make_identified()
    return replace(found, axes={"x": found.axes["x"]})


def test_people_see_the_steps_the_gains_and_what_was_assumed(run_cli: RunCli, tmp_path: Path) -> None:
    write_identified(tmp_path / "identified.yaml", one_axis(), {})
    done = run_cli("plan", "identified.yaml")
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    lines = done.stdout.splitlines()
    # The drag has no value in this file, everything else is given.
    assert lines[0].startswith("axis x, binding uncertainty: drag B_p; the table counts in the peak of ")
    assert lines[1] == "1. sweep: drag B_p is not known yet"
    assert any("contacts (not needed)" in line for line in lines)
    (drag,) = [line.split() for line in lines if line.startswith("drag B_p  ")]
    assert drag[3] == "-"
    assert float(drag[4]) < float(drag[5])
    # By how much the peak moves: nobody knows yet, and afterwards by some newtons.
    assert drag[7] == "-"
    assert float(drag[8]) > 0.0
    assumed = next(line for line in lines if line.startswith("assumed, not measured: "))
    # All that the file does not tell, and the torque's misfit at rest, which is reckoned from one of those.
    reported = {"drag_n_s_per_m", "torque_noise_rms_n_m", "pose_torque_std_n_m", "misfit_share", "position_noise_rms_m"}
    assert {entry.split()[0] for entry in assumed.removeprefix("assumed, not measured: ").split(", ")} == reported
    assert lines[-1] == "written: plan.yaml"
    assert (tmp_path / "plan.yaml").is_file()


@pytest.mark.usefixtures("folder")
def test_conflict_of_the_file_and_the_surface_that_is_meant_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    found = one_axis()
    axis = found.axes["x"]
    second = replace(
        axis.environments[0],
        name="x2",
        stiffness_n_per_m=Estimate(value=1e5, std=4e4, status=Status.WEAK),
    )
    doubt = Finding(code="mass-disagreement", severity="warning", message="Axis x: the masses disagree.", advice="")
    both = replace(axis, environments=(axis.environments[0], second))
    write_identified("identified.yaml", replace(found, axes={"x": both}, findings=(doubt,)), {})
    assert main(["plan", "identified.yaml"]) == 0
    out, err = capsys.readouterr()
    assert "Axis x: the masses disagree." in err
    # 4e4 N/m in the unit of the table.
    assert "environment K_e is known to ± 40 N/mm, 8 times what is allowed" in out
    assert "planned for surface x2, the least well known of 2" in out


def test_json_is_the_file_and_names_its_source(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_identified("identified.yaml", one_axis(), {})
    assert main(["plan", "identified.yaml", "--json", "-o", "a.yaml"]) == 0
    first = capsys.readouterr()
    tree = json.loads(first.out)
    assert tree["provenance"]["identified"]["path"] == "identified.yaml"
    assert len(tree["provenance"]["identified"]["sha256"]) == 64
    written = (folder / "a.yaml").read_bytes()
    assert main(["plan", "identified.yaml", "--json", "-o", "a.yaml"]) == 0
    again = capsys.readouterr()
    # What is written is the same; what stood there before is said.
    assert (again.out, first.err) == (first.out, "")
    assert again.err == f"a.yaml: replaced the plan of sha256 {sha256(written).hexdigest()[:8]}.\n"
    assert (folder / "a.yaml").read_bytes() == written


def test_without_a_file_a_first_recording_is_planned_from_guesses(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "plan",
        "--mass",
        "25",
        "--axis",
        "z",
        "--poses",
        "6",
        "--max-tilt",
        "30",
        "--max-force",
        "60",
        "--json",
    ]
    assert main(arguments) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["axis"] == "z"
    assert "mass_kg" not in tree["assumed"]
    assert "stiffness_n_per_m" in tree["assumed"]
    poses, sweep = tree["steps"][0]["settings"], tree["steps"][1]["settings"]
    assert [pose["tilt_deg"] <= 30.0 for pose in poses["poses"]] == [True] * 6
    assert sweep["peak_force_n"] <= 60.0
    assert "identified" not in tree["provenance"]
    assert (folder / "plan.yaml").is_file()


@pytest.mark.usefixtures("folder")
def test_an_axis_that_the_file_does_not_hold_is_planned_from_usual_values_and_says_so(
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_identified("identified.yaml", one_axis(), {})
    assert main(["plan", "identified.yaml", "--axis", "y", "--poses", "0"]) == 0
    out, err = capsys.readouterr()
    assert "identified.yaml holds no axis y (its axes: x): robot, coupling and surface are usual values" in err
    assert "stiffness_n_per_m 3e+05" in out.splitlines()[-2]


@pytest.mark.usefixtures("folder")
def test_what_binds_is_counted_with_the_controller_that_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    write_identified("identified.yaml", one_axis(), {})
    sample = make_controller(("x",))
    gains = replace(sample.axes["x"], mass=12.0, damping=3000.0, lead_s=0.01, feedback_damping_s=0.0)
    write_controller("controller.yaml", replace(sample, axes={"x": gains}))
    arguments = ["plan", "identified.yaml", "--controller", "controller.yaml", "--poses", "0"]
    assert main([*arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    tree = json.loads(out)
    assert err == ""
    assert (tree["reference"]["mass_kg"], tree["reference"]["damping_n_s_per_m"]) == (12.0, 3000.0)
    assert len(tree["provenance"]["controller"]["checksum"]) == 64
    # Another one that is not stable on this surface is said to be none, and a usual one counts.
    write_controller("controller.yaml", replace(sample, axes={"x": replace(gains, mass=1.0, damping=10.0)}))
    assert main([*arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    assert "controller.yaml is not stable on the surface that is assumed" in err
    assert json.loads(out)["reference"]["mass_kg"] == 10.0
    assert main([*arguments, "--axis", "y"]) == 2
    assert "controller.yaml has no axis y; its axes: x." in capsys.readouterr().err


@pytest.mark.usefixtures("folder")
def test_a_first_sweep_below_the_noise_is_said_to_be_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--max-force", "5", "--poses", "0"]) == 0
    assert "hardly exceeds the sensor's noise of 0.2 N: repeat it more than once" in capsys.readouterr().out
    assert main(["plan", "--max-force", "200", "--poses", "0"]) == 0
    assert "hardly exceeds" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--max-tilt", "2"], 4, "it takes 15 degrees"),
        (["--poses", "3"], 2, "--poses must be 0 (none) or at least 4"),
        (["--mass", "16000"], 2, "--mass"),
        (["--stiffness", "300"], 2, "--stiffness"),
        (["missing.yaml"], 2, "missing.yaml"),
        (["identified.yaml", "--mass", "3"], 2, "--mass and --stiffness"),
        (["two.yaml"], 2, "--axis"),
        (["turning.yaml"], 2, "a recording about a turning axis is not planned"),
        (["--max-force", "0"], 2, "--max-force"),
        (["-o", "nowhere/plan.yaml"], 2, "does not exist"),
    ],
)
def test_what_cannot_be_planned_is_one_line_with_its_code(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    found = one_axis()
    write_identified("identified.yaml", found, {})
    write_identified("turning.yaml", replace(found, axes={"rz": found.axes["x"]}), {})
    write_identified("two.yaml", replace(found, axes={"x": found.axes["x"], "y": found.axes["x"]}), {})
    assert main(["plan", *arguments]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert message in err
    assert not (folder / "plan.yaml").exists()
