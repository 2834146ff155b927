"""What `autotune plan` asks for, replayed on cells that nobody measured: the force limit holds on all of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from autotune.cli.main import main
from autotune.formats.yaml12 import load_yaml
from problems.arrays import FloatArray

LIMIT_N = 100.0
MASS_KG = 16.2
STEP_S = 2.5e-4


@dataclass(frozen=True, kw_only=True)
class Felt:
    """A payload on spring and damper behind a robot of one pole: x' = w (u - x), M y'' = K (x - y) + B (x' - y')."""

    damping_ratio: float
    robot_rad_s: float
    stiffness_n_per_m: float

    def force_n(self, command_m: FloatArray) -> FloatArray:
        """Return the force between robot and payload at the steps of the command, which runs straight between them."""
        k, w = self.stiffness_n_per_m, self.robot_rad_s
        b = 2.0 * self.damping_ratio * np.sqrt(k * MASS_KG)
        rows = [
            [-w, 0.0, 0.0],
            [0.0, 0.0, 1.0],
            [(k - b * w) / MASS_KG, -k / MASS_KG, -b / MASS_KG],
        ]
        inputs = [[w], [0.0], [b * w / MASS_KG]]
        felt = StateSpace(rows, inputs, [[k - b * w, -k, -b]], [[b * w]])
        _, force, _ = lsim(felt, command_m, np.arange(len(command_m)) * STEP_S)
        return np.asarray(force)


def command_m(settings: dict[str, Any], factor: float = 1.0) -> FloatArray:
    """Return the sweep that plan.yaml describes: amplitudes straight between its points on logarithmic scales."""
    length, low, high = settings["duration_s"], settings["low_hz"], settings["high_hz"]
    t = np.arange(0.0, length + 1.0, STEP_S)
    inside = np.minimum(t, length)
    rate = np.log(high / low) / length
    frequency = low * np.exp(rate * inside)
    points = np.array([[p["frequency_hz"], p["amplitude_m"]] for p in settings["command"]])
    amplitude = np.exp(np.interp(np.log(frequency), *np.log(points.T)))
    fade = np.clip(np.minimum(t, length - t) / settings["fade_s"], 0.0, 1.0)
    return np.asarray(factor * fade * amplitude * np.sin(2.0 * np.pi * low * np.expm1(rate * inside) / rate))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("plan") / "plan.yaml"
    assert main(["plan", "--mass", str(MASS_KG), "--max-force", str(LIMIT_N), "--quiet", "-o", str(path)]) == 0
    (step,) = [step for step in load_yaml(path)["steps"] if step["record"] == "sweep"]
    return dict(step["settings"])


@pytest.mark.parametrize(
    "cell",
    [
        Felt(damping_ratio=0.107, robot_rad_s=20.0, stiffness_n_per_m=3.1e5),
        Felt(damping_ratio=0.045, robot_rad_s=20.0, stiffness_n_per_m=3.0e5),
        Felt(damping_ratio=0.014, robot_rad_s=20.0, stiffness_n_per_m=3.0e5),
        Felt(damping_ratio=0.014, robot_rad_s=40.0, stiffness_n_per_m=3.0e5),
        Felt(damping_ratio=0.010, robot_rad_s=40.0, stiffness_n_per_m=6.0e5),
    ],
)
def test_neither_the_first_sweep_nor_its_repeat_passes_the_limit(sweep: dict[str, Any], cell: Felt) -> None:
    first = float(np.max(np.abs(cell.force_n(command_m(sweep)))))
    assert first <= sweep["worst_case"]["peak_force_n"] <= sweep["abort_force_n"] < LIMIT_N
    repeat = sweep["repeat"]
    factor = min(repeat["aim_force_n"] / first, repeat["largest_factor"])
    again = float(np.max(np.abs(cell.force_n(command_m(sweep, factor)))))
    assert again < sweep["abort_force_n"]
    # Force and amplitude are proportional: rounding alone is left.
    assert again == pytest.approx(min(repeat["aim_force_n"], repeat["largest_factor"] * first), rel=1e-9)
    # The repeat is what tells: a first sweep that stays far below is followed by a loud one.
    assert factor > 1.0


def test_the_worst_cell_that_is_named_makes_the_force_that_is_named(sweep: dict[str, Any]) -> None:
    """A sine that lasts, at the frequency that is named, on the cell that is named."""
    worst = sweep["worst_case"]
    nominal, fast = 20.0, 2.0 * np.pi * worst["bandwidth_hz"]
    s = 2j * np.pi * worst["frequency_hz"]
    k, m = worst["stiffness_n_per_m"], worst["mass_kg"]
    coupling = k + 2.0 * worst["damping_ratio"] * np.sqrt(k * m) * s
    felt = coupling * m * s**2 / (m * s**2 + coupling)
    flange = sweep["flange_speed_m_s"] * (s + nominal) / nominal * fast / (s + fast) / s
    # The plan adds nothing to that cell but the sign.
    assert abs(felt * flange) == pytest.approx(worst["peak_force_n"], rel=1e-6)
    assert worst["damping_ratio"] == pytest.approx(0.01)
    assert worst["peak_force_n"] == pytest.approx(0.9 * LIMIT_N)


def test_people_read_what_the_worst_case_makes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "--mass", str(MASS_KG), "--poses", "0"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "90 N at worst" in text
    assert "with 1 % of critical damping" in text
    assert "stop it above 90 N" in text
    assert "then once more with all amplitudes times 45 N / (largest force that the first showed)" in text
    assert (tmp_path / "plan.yaml").is_file()
