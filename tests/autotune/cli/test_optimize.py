"""`autotune optimize` through the real entry point."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import cast

import pytest

from autotune.formats.canonical import short
from autotune.formats.controller import read_controller
from autotune.formats.controller_record import Controller
from autotune.formats.limits import ResidualPeaks
from autotune.formats.yaml12 import load_yaml
from autotune.tuning.provenance import residual_notes
from problems.design.problem import DesignProblem
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, write_plant
from tests.autotune.tuning.turning import write_two_axes
from tests.autotune.validation.test_validate import EVERY_CHECK
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> tuple[Path, str, str]:
    """One run: where, standard output, standard error."""
    folder = tmp_path_factory.mktemp("optimize")
    prepare(folder)
    done = subprocess.run(
        [sys.executable, "-m", "autotune", "optimize", "identified.yaml", "--problem", "problem.yaml"],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(repository)},
        check=True,
    )
    return folder, done.stdout, done.stderr


def prepare(folder: Path, problem: str = FAST_PROBLEM_YAML) -> None:
    write_plant(folder)
    (folder / "problem.yaml").write_text(problem, encoding="utf-8")


def test_people_see_gains_peaks_what_holds_them_up_and_the_checks(first_run: tuple[Path, str, str]) -> None:
    folder, reported, aside = first_run
    assert is_next_alone(aside)
    lines = reported.splitlines()
    assert lines[0].startswith("before → after, axis x: nothing to compare with: say the gains that run now")
    assert lines[1].startswith("axis x: M_a 6 kg, B_a ")
    assert lines[2] == "  predicted contacts, approached with F^d = 30 N:"
    assert "peak at contact [N]" in lines[3]
    assert any("holds the peak up: easing it by 1 % saves" in line for line in lines)
    assert any(
        line.startswith("  every requirement is met over 33 contacts; nearest to its limit is ") for line in lines
    )
    assert any("of the gradient is left over (KKT residual), unused slack is worth" in line for line in lines)
    assert any("% to a reference: " in line and "descents from the best of 128 other designs" in line for line in lines)
    assert sum(line.startswith("  ok ") for line in lines) == len(EVERY_CHECK)
    digest = read_controller(folder / "controller.yaml").checksum
    assert lines[-1] == f"written: controller.yaml, checksum {short(digest)}"


def test_the_file_is_validated_and_validates(run_cli: RunCli, first_run: tuple[Path, str, str]) -> None:
    done = run_cli("validate", first_run[0] / "controller.yaml", "--identified", first_run[0] / "identified.yaml")
    # The identified surface of 1.1e5 N/m lies in the range that was asked, 1e5 to 1.2e5; the payload is 16 kg exactly.
    assert done.returncode == 0
    assert is_next_alone(done.stderr)


def test_json_is_the_tree_of_the_file_and_the_same_seed_gives_the_same_bytes(
    run_cli: RunCli, tmp_path: Path, first_run: tuple[Path, str, str]
) -> None:
    prepare(tmp_path)
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    tree = json.loads(done.stdout)
    active = tree.pop("active")
    reported = tree["provenance"]["optimality"]["x"]
    assert (reported["feasible"], reported["gap"] < 1e-3, reported["kkt_residual"] < 1e-3) == (True, True, True)
    assert [each["name"] for each in reported["active"]] == [each["name"] for each in active["x"]]
    changes = tree.pop("before_after")["x"]
    assert changes["largest_certified_peak"]["before"] is None
    assert tree == load_yaml(tmp_path / "controller.yaml")
    assert {entry["name"] for entry in active["x"]} <= set(tree["certificate"]["requirements"]) | {
        f"{side} bound of {name}" for side in ("lower", "upper") for name in ("damping", "lead_s")
    }
    assert (tmp_path / "controller.yaml").read_bytes() == (first_run[0] / "controller.yaml").read_bytes()


def test_an_existing_controller_stands_beside_the_new_one(
    run_cli: RunCli, tmp_path: Path, first_run: tuple[Path, str, str]
) -> None:
    prepare(tmp_path)
    old = first_run[0] / "controller.yaml"
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--compare", old, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    output, digest = json.loads(done.stdout), read_controller(old).checksum
    assert (output["compare"]["path"], output["compare"]["checksum"]) == (str(old), digest)
    assert output["provenance"]["options"]["compare"] == {"path": str(old), "checksum": digest}
    both = output["compare"]["axes"]["x"]
    assert (both["started_from_old"], both["old"]["missed"], both["new"]["missed"]) == (True, {}, {})
    assert both["new"]["mass"] == output["axes"]["x"]["mass"]
    # The old controller is the optimum of the same problem: the new one can only be it, or better by a hair.
    assert both["new"]["peak_contact_force_n"] <= both["old"]["peak_contact_force_n"]


@pytest.mark.parametrize(
    ("edit", "code", "message"),
    [
        (("lead_s: 0.0", "lead_s: 0.1"), 6, "the file is altered"),
        (
            ("format: autotune/controller", "format: autotune/identified"),
            2,
            "old.yaml is an identified plant, not a controller",
        ),
        (None, 2, "old.yaml cannot be read"),
    ],
)
def test_an_existing_controller_that_is_altered_or_absent_is_refused_before_the_search(
    run_cli: RunCli,
    tmp_path: Path,
    first_run: tuple[Path, str, str],
    edit: tuple[str, str] | None,
    code: int,
    message: str,
) -> None:
    prepare(tmp_path)
    if edit is not None:
        text = (first_run[0] / "controller.yaml").read_text(encoding="utf-8")
        assert edit[0] in text
        (tmp_path / "old.yaml").write_text(text.replace(*edit, 1), encoding="utf-8")
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--compare", "old.yaml")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", 1)
    assert message in done.stderr
    assert not (tmp_path / "controller.yaml").exists()


def test_a_straight_and_a_turning_axis_come_from_one_call(run_cli: RunCli, tmp_path: Path) -> None:
    write_two_axes(tmp_path / "identified.yaml")
    rotational = (
        "rotational:\n  environment_stiffness_n_m_per_rad: [4000, 4800]\n  payload_inertia_kg_m2: [0.64, 0.64]\n"
    )
    (tmp_path / "problem.yaml").write_text(FAST_PROBLEM_YAML + rotational, encoding="utf-8")
    ranges = ["--environment-stiffness", "1.0e5:1.2e5"]
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", *ranges)
    assert done.returncode == 0
    assert done.stderr.startswith("The range of environment stiffness is in N/m and says nothing of ry")
    assert "axis ry: M_a 0.24 kg·m², B_a " in done.stdout
    assert "inertia [kg·m²]  peak at contact [N·m]" in done.stdout
    assert sum(line.startswith("  ok     ry: ") for line in done.stdout.splitlines()) == len(EVERY_CHECK) - 1
    valid = run_cli("validate", "controller.yaml")
    assert valid.returncode == 0
    assert is_next_alone(valid.stderr)
    assert run_cli("export", "controller.yaml", "--target", "json", "-o", "controller.json").returncode == 0


def test_an_approach_at_a_speed_is_said_as_one(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    with (tmp_path / "problem.yaml").open("a", encoding="utf-8") as file:
        file.write("approach: {speed_m_s: 0.012}\n")
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--proof-budget", "0")
    assert done.returncode == 0, done.stderr
    assert "predicted contacts, approached at 12 mm/s:" in done.stdout
    assert "written: controller.yaml" in done.stdout


def test_quiet_and_the_ranges_of_the_command_line(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path)
    ranges = ["--payload-mass", "16.1", "--environment-stiffness", "9e4:1.0e5", "--seed", "3", "--slack", "3"]
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", *ranges, "--quiet", "-o", "c.yaml")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    controller = read_controller(tmp_path / "c.yaml").controller
    domain = controller.certificate.domain["x"]
    assert (domain.payload_mass_kg, domain.environment_stiffness_n_per_m) == ((16.1, 16.1), (9e4, 1e5))
    assert controller.provenance["options"]["seed"] == 3
    (reach,) = (controller.certificate.continuous or {})["x"]
    assert (reach.slack, reach.share) == (0.03, 1.0)
    assert not (tmp_path / "controller.yaml").exists()


@pytest.mark.parametrize(
    ("requirements", "named"),
    [
        ("modulus_margin: 0.99", "Enough by itself would be: modulus_margin 0."),
        # The band by default would end where the robot follows: beside that one, easing the peak alone is enough.
        (
            "max_peak_force_n: 31\n  free_space_admittance: {min_m_s_per_n: 7e-4, band_hz: [0.1, 2]}",
            "enough would be: all requirements together at ",
        ),
    ],
)
def test_what_cannot_be_met_is_exit_5_with_the_reason_and_no_file(
    run_cli: RunCli, tmp_path: Path, requirements: str, named: str
) -> None:
    prepare(tmp_path, FAST_PROBLEM_YAML.split("requirements:")[0] + f"requirements:\n  {requirements}\n")
    (tmp_path / "controller.yaml").write_text("format: autotune/controller\n", encoding="utf-8")
    # What freer structures find has tests of its own, in tests/autotune/tuning/test_beyond_gains.py.
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--structure", "gains")
    assert (done.returncode, done.stdout) == (5, "")
    said, *lines = done.stderr.splitlines()
    assert named in said
    # What is to be pasted stands on lines of its own, at the margin as in its file.
    assert all(line.startswith("requirements: {") for line in lines)
    assert (tmp_path / "controller.yaml").read_text(encoding="utf-8") == "format: autotune/controller\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["controller.yaml", "identified.yaml", "problem.yaml"]


def test_the_line_that_a_refusal_gives_makes_a_proved_controller_with_the_peak_it_names(
    run_cli: RunCli, tmp_path: Path
) -> None:
    bounds, _, _ = FAST_PROBLEM_YAML.partition("requirements:")
    prepare(tmp_path, bounds + "requirements: {free_space_admittance: {min_m_s_per_n: 1e-2, band_hz: [1, 2]}}\n")
    refused = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--structure", "gains")
    assert refused.returncode == 5
    assert "instead of 0.01" in refused.stderr
    _, _, checked = refused.stderr.partition("the search finds a controller, peak contact force ")
    peak, _, lines = checked.partition(" N:\n")
    (tmp_path / "problem.yaml").write_text(bounds + dedent(lines), encoding="utf-8")
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml", "--json")
    assert done.returncode == 0, done.stderr
    peaks = json.loads(done.stdout)["predicted"]["x"]["scenarios"]
    assert max(each["peak_contact_force_n"] for each in peaks) == pytest.approx(float(peak), abs=5e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument 'IDENTIFIED'"),
        (["absent.yaml"], "absent.yaml cannot be read"),
        (["identified.yaml", "--problem", "absent.yaml"], "absent.yaml cannot be read"),
        (["identified.yaml", "--payload-mass", "heavy"], "'heavy' is not a number"),
        (["identified.yaml", "--payload-mass", "12,10"], "the lower one first; found 12 and 10"),
        (["identified.yaml", "--payload-mass", "1,2,3"], "give one mass, or two"),
        (["identified.yaml", "--payload-mass", "0"], "above 0"),
        (["identified.yaml", "--payload-mass", "0,22"], "the sensor carries the gripper: its mass"),
        (["identified.yaml", "--payload-mass", "nan"], "finite"),
        (["identified.yaml", "--environment-stiffness", "1e5"], "give a range as LOW:HIGH"),
        (["identified.yaml", "--environment-stiffness", "2e5:1e5"], "the lower one first"),
        (["identified.yaml", "--environment-stiffness", "1e5:inf"], "finite"),
        (["identified.yaml", "--seed", "-1"], "seed"),
        (["identified.yaml", "--slack", "0"], "slack"),
        (["identified.yaml", "--proof-budget", "-1"], "proof-budget"),
        (["identified.yaml", "--seed", "one"], "seed"),
        (["problem.yaml"], "format must be autotune/identified"),
        (["identified.yaml", "--problem", "identified.yaml"], "is an identified plant, not a problem.yaml"),
        (["identified.yaml", "--problem", "wrong.yaml"], "wrong.yaml, line 2: bounds.weight must be one of"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, tmp_path: Path, arguments: list[str], message: str) -> None:
    prepare(tmp_path)
    (tmp_path / "wrong.yaml").write_text("bounds:\n  weight: [1, 2]\n", encoding="utf-8")
    done = run_cli("optimize", *arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr
    assert not (tmp_path / "controller.yaml").exists()


def test_an_axis_that_was_not_identified_is_exit_2(run_cli: RunCli, tmp_path: Path) -> None:
    prepare(tmp_path, "axis: y\n")
    done = run_cli("optimize", "identified.yaml", "--problem", "problem.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "autotune: Axis y is not in the plant; it holds x.\n"


def test_a_limit_of_the_peak_that_the_residual_weight_breaks_is_said() -> None:
    scenario = SimpleNamespace(peak_contact_force_n=49.0)
    left = ResidualPeaks(force_n=1.0, peak_sensor_force_n=48.0, peak_contact_force_n=50.6)
    prediction = SimpleNamespace(scenarios=(scenario,), with_residual_weight=left)

    def notes(limit: float | None) -> list[str]:
        problem = SimpleNamespace(requirements=SimpleNamespace(max_peak_force_n=limit))
        controller = cast(Controller, SimpleNamespace(predicted={"x": prediction}))
        return list(residual_notes(controller, {"x": cast(DesignProblem, problem)}))

    # 50 N asked and 49 N reached; with 1 N of weight left 50.6 N, so 50·49/50.6 = 48.4 N must be asked.
    (note,) = notes(50.0)
    assert "the worst peak is 50.6 N, above max_peak_force_n of 50; ask for 48.4" in note
    assert notes(51.0) == notes(None) == []
