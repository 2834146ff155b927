"""A collision response through the command line: asked for, chosen, told, verified, refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.identified import write_identified
from tests.autotune.tuning.responding import GAINS, responding, small_robot

Run = Callable[..., tuple[int, str, str]]
PROBLEM = f"""\
axis: x
bounds: {json.dumps({name: [value, value] for name, value in GAINS.items()})}
payload_mass_kg: [6.3, 6.3]
environment_stiffness_n_per_m: [3.6e4, 3.6e4]
requirements: {{modulus_margin: null, gain_margin_db: null, phase_margin_deg: null, delay_margin_s: null}}
objective: sensor_force
free: {{collision_threshold_n: [5, 40]}}
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line in this process, in a folder with the small robot and a problem."""
    monkeypatch.chdir(tmp_path)
    write_identified(tmp_path / "identified.yaml", small_robot().result, {})
    (tmp_path / "problem.yaml").write_text(PROBLEM, encoding="utf-8")

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main([*arguments])
        output = capsys.readouterr()
        return code, output.out, output.err

    return run


def optimize(out: str, problem: str = "problem.yaml") -> tuple[str, ...]:
    return "optimize", "identified.yaml", "--problem", problem, "-o", out, "--proof-budget", "0"


def test_a_threshold_is_chosen_reported_and_verified_and_a_second_run_gives_the_same_bytes(
    run: Run, tmp_path: Path
) -> None:
    code, reported, _ = run(*optimize("a.yaml"))
    assert code == 0
    controller = read_controller(tmp_path / "a.yaml").controller
    threshold = controller.collision.threshold_n
    assert f"collision response: reset at {threshold:g} N takes the worst peak at the sensor from 43." in reported
    assert "a lower one, which free motion and noise forbid, might save more" in reported
    assert "thresholds below " in reported
    assert f"ok     collision response: reset at {threshold:g} N: " in reported
    assert run(*optimize("b.yaml"))[0] == 0
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    code, reported, _ = run("validate", "a.yaml", "--samples", "0")
    assert code == 0
    assert f"axis x, collision response: reset at {threshold:g} N" in reported
    assert run("export", "a.yaml", "--target", "c", "-o", "cell.c")[0] == 0


def test_an_edited_threshold_is_refused_with_and_without_a_new_checksum(run: Run, tmp_path: Path) -> None:
    whole = responding().controller
    write_controller(tmp_path / "controller.yaml", whole)
    text = (tmp_path / "controller.yaml").read_text(encoding="utf-8")
    edited = text.replace(f"threshold_n: {whole.collision.threshold_n}\n", "threshold_n: 20.0\n", 1)
    assert edited != text
    (tmp_path / "edited.yaml").write_text(edited, encoding="utf-8")
    code, _, aside = run("validate", "edited.yaml", "--samples", "0")
    assert (code, "the file is altered" in aside) == (6, True)
    write_controller(tmp_path / "sealed.yaml", replace(whole, collision=replace(whole.collision, threshold_n=20.0)))
    code, reported, aside = run("validate", "sealed.yaml", "--samples", "0")
    assert code == 6
    assert "FAILED axis x, collision response: " in reported
    assert "with it the peak" in aside


def test_what_free_motion_passes_is_refused_and_nothing_is_written(run: Run, tmp_path: Path) -> None:
    (tmp_path / "low.yaml").write_text(PROBLEM.replace("[5, 40]", "[5, 7]"), encoding="utf-8")
    code, _, aside = run(*optimize("c.yaml", "low.yaml"))
    assert code == 5
    assert "free.collision_threshold_n asks for 5 to 7 N, and a threshold must be above " in aside
    assert not (tmp_path / "c.yaml").exists()


def test_a_comparison_says_that_it_knows_no_response(run: Run, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", responding().controller)
    code, _, aside = run(*optimize("d.yaml"), "--compare", "controller.yaml")
    assert code == 2
    assert "responds to collisions or varies its damping, which the comparison does not evaluate" in aside
    assert "compare with its gains alone" in aside
