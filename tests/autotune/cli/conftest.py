"""Logs of simulated cells, good and unusable, each written once."""

import contextlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.cli.main import main
from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from identification.signals.recording import Recording
from tests.autotune.simulation.runs import SHORT_LOG
from tests.autotune.tuning.cases import PURE, share_results

NO_CONTACT = replace(SHORT_LOG, contact_count=0)
ONE_POSE = replace(SHORT_LOG, pose_count=1, contact_count=1)


def recorded(program: Program) -> Recording:
    return simulate_cell(SimulatedCell(), program, seed=2).recording


def _with_nan(recording: Recording) -> Recording:
    force = np.array(recording.wrench.force_n)
    force[12000:12050] = np.nan
    return replace(recording, wrench=replace(recording.wrench, force_n=force))


@pytest.fixture(autouse=True)
def _shared_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands on the same files compute the same once; fronts are left, of which a test asks that they come again.

    That a run again gives the same is a law of runs in processes of their own, here, and of the functions' own tests.
    """
    share_results(monkeypatch, [name for name in PURE if not name.endswith(".trace_front")])


@pytest.fixture(scope="session")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short log that holds all that `identify` needs."""
    path = tmp_path_factory.mktemp("good") / "cell.mcap"
    write_mcap(recorded(SHORT_LOG), path)
    return path


@pytest.fixture(scope="session")
def identified_page(tmp_path_factory: pytest.TempPathFactory, good_log: Path) -> Path:
    """The folder in which `identify --report page.html --json` of the good log left its files and `printed.json`."""
    folder, printed = tmp_path_factory.mktemp("identified"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        share_results(patch)
        assert main(["identify", str(good_log), "--report", "page.html", "--json"]) == 0
    (folder / "printed.json").write_text(printed.getvalue(), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def unusable_logs(tmp_path_factory: pytest.TempPathFactory, good_log: Path) -> Path:
    """A folder of logs that each lack one thing; the name tells which."""
    folder = tmp_path_factory.mktemp("unusable")
    no_contact = recorded(NO_CONTACT)
    write_mcap(no_contact, folder / "no_contact.mcap")
    write_mcap(_with_nan(no_contact), folder / "nan_burst.mcap")
    write_mcap(replace(no_contact, command=None), folder / "no_command.mcap")
    write_mcap(recorded(ONE_POSE), folder / "one_pose.mcap")
    whole = good_log.read_bytes()
    (folder / "truncated.mcap").write_bytes(whole[: int(0.6 * len(whole))])
    (folder / "no_log.mcap").write_bytes(b"this is not a log")
    (folder / "empty.mcap").write_bytes(b"")
    return folder
