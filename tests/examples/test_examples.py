"""The examples run and make what they promise."""

import runpy
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

import autotune as at
from autotune.formats.controller import write_controller
from tests.autotune.formats.samples import make_controller
from tests.autotune.tuning.cases import shorten_checks


def _run(repository: Path, script: str, *arguments: str) -> str:
    command = [sys.executable, str(repository / "examples" / script), *arguments]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=True, timeout=300)
    return done.stdout


def test_a_cell_of_ones_own_is_identified_within_five_percent(repository: Path) -> None:
    lines = _run(repository, "simulate_own_cell.py").splitlines()
    assert len(lines) == 4
    for line in lines:
        words = line.split()
        truth, found = float(words[words.index("true") + 1]), float(words[words.index("identified") + 1])
        assert abs(found / truth - 1.0) < 0.05, line  # the accuracy that the README's demo promises


def test_the_picture_is_an_svg_with_both_curves(repository: Path, tmp_path: Path) -> None:
    controller, picture = tmp_path / "controller.yaml", tmp_path / "contact.svg"
    write_controller(controller, make_controller(("x",)))
    _run(repository, "draw_contact.py", str(controller), str(picture))
    texts = [node.text for node in ET.parse(picture).iter() if node.tag.endswith("text")]
    assert any(text and text.startswith("present controller: peak") for text in texts)
    assert any(text and text.startswith("chosen by autotune: peak") for text in texts)


@pytest.mark.slow
def test_uncertainty_costs_peak_force_in_the_example_from_python(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shorten_checks(monkeypatch)
    main = runpy.run_path(str(repository / "examples" / "design_from_python.py"))["main"]
    main(str(tmp_path / "controller.yaml"))
    lines = capsys.readouterr().out.splitlines()
    peaks = [float(line.partition("largest peak ")[2].split()[0]) for line in lines]
    # The larger set holds the smaller one, and the search is within a share of 1e-3 of the best.
    assert peaks[1] > peaks[0] * (1.0 - 1e-3)
    assert isinstance(at.load(tmp_path / "controller.yaml"), at.Design)
