"""From a controller to every export target, by the commands that a refusal names."""

import json
import re
import shlex
from pathlib import Path

import pytest

import autotune as at
from autotune.export.designing import lacking_gains
from autotune.export.targets import TARGETS
from autotune.formats.controller import read_controller
from autotune.prediction.as_run_by import as_run_by
from tests.autotune.tuning.cases import shorten_checks
from tests.conftest import RunCli

# What only an installation knows: the certificate does not depend on it.
NAMES = dict.fromkeys(("fzi_cartesian", "crisp", "lbr_fri_ros2"), ("--orientation", "1,0,0,0"))
OUT = {"c": "cell.c", "ros2_package": "my_admittance"}
NEAR = ("--payload-mass", "16.2", "--environment-stiffness", "1e5:1.6e5")


NONE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a plant and its controller; surfaces that are near each other make for short searches."""
    folder = tmp_path_factory.mktemp("source")
    plant = at.Plant(
        mass=16,
        coupling_stiffness=3e5,
        coupling_damping=150,
        drag=330,
        robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
        environment_stiffness=(1e5, 1.2e5),
        sample_time=8e-4,
        centre_of_mass=(0.0, 0.0, 0.1),
        force_bias=NONE,
        torque_bias=NONE,
    )
    plant.save(folder / "plant.yaml")
    with pytest.MonkeyPatch.context() as patch:
        shorten_checks(patch)
        design = at.optimize(folder / "plant.yaml")
    design.save(folder / "controller.yaml")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_a_controller_reaches_every_target_by_the_commands_that_a_refusal_names(
    target: str, folder: Path, run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_checks(monkeypatch)
    source, out = folder / "controller.yaml", OUT.get(target, "out.txt")
    done = run_cli("export", str(source), "--target", target, *NAMES.get(target, ()), "-o", out, "--json")
    if TARGETS[target].runs_same_law:
        assert done.returncode == 0, done.stderr
        return
    # No law without a lead does what this one does.
    error = json.loads(done.stdout)["error"]
    pasted = [line.removeprefix("    ") for line in done.stderr.splitlines() if line.startswith("    ")]
    assert error["exit_code"] == (5 if TARGETS[target].sample_time_s is None else 2)
    assert not (tmp_path / out).exists()
    if error["exit_code"] == 5:
        (tmp_path / "problem.yaml").write_text(json.dumps(error["suggestion"]), encoding="utf-8")
    found = re.search(r"run (autotune optimize .*); (autotune export .*)$", error["message"].rstrip("."))
    assert found is not None
    assert pasted[-2:] == list(found.groups())
    for command in found.groups():
        done = run_cli(*shlex.split(command)[1:])
        assert done.returncode == 0, f"{command}\n{done.stderr}"
        if command.startswith("autotune optimize"):
            designed = " ".join(done.stdout.split())
            # Our own law is headed as what does not run.
            assert f"As {target} runs it, certified:" in done.stdout
            assert "Our own law, from which that was made, and which does not run there:" in done.stdout
            following = done.stderr.splitlines()[-1].split()
            assert following[:6] == ["next:", "autotune", "export", "for_target.yaml", "--target", target]
            assert ("--orientation" in following) == (target in NAMES)
    assert (tmp_path / out).is_file()
    made = read_controller(tmp_path / "for_target.yaml").controller
    assert made.provenance["options"]["for"] == target
    stated = as_run_by(made, "x")
    assert stated is not None
    led = stated.peak_per_speed
    assert led is not None
    # A hand that pushes on holds more against the wall than what is left where it lets go.
    assert 0.0 < led.lets_go < led.pushes_on
    assert f"axis x, led by hand as {target} runs it: {led.pushes_on:.4g} N per m/s" in designed
    predicted = run_cli("predict", "for_target.yaml", "--surface", "120N/mm", "--payload-mass", "16", "--json")
    found = json.loads(predicted.stdout)
    assert found["run_by"] == target
    # The worst certified contact is near the stiff end.
    assert found["peak_force"] <= stated.peak * (1.0 + 1e-9)
    assert found["peak_force"] > 0.97 * stated.peak
    # Where our own law needs a lead for it, the file says so.
    reported = any("Our own law cannot do this without" in each for each in made.provenance.get("notes", ()))
    assert reported == bool(lacking_gains(TARGETS[target], made))


@pytest.mark.slow
def test_without_an_orientation_the_last_two_commands_lead_there_for_a_tool_that_points_down(
    folder: Path, run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_checks(monkeypatch)
    done = run_cli("export", str(folder / "controller.yaml"), "--target", "fzi_cartesian", "-o", "out.txt")
    assert done.returncode == 2
    *_, design, export = (line for line in done.stderr.splitlines() if line.startswith("    autotune "))
    done = run_cli(*shlex.split(design)[1:])
    assert done.returncode == 0, done.stderr
    # Nobody asked for the admittance that our own law has, and that one has not.
    assert "four fifths of what fzi_cartesian can have" in done.stderr
    done = run_cli(*shlex.split(export)[1:])
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.txt").is_file()


def test_the_replay_of_a_log_is_that_of_the_law_which_will_run(
    good_log: Path, run_cli: RunCli, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_checks(monkeypatch)
    assert run_cli("identify", good_log).returncode == 0
    # Surfaces near each other and one mass make for a short search; the contacts of the log are among them.
    done = run_cli("optimize", "identified.yaml", "--for", "urscript", *NEAR)
    assert "; with this controller as urscript runs it at the same speed" in done.stdout.splitlines()[0]
