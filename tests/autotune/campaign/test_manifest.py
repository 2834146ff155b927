"""A manifest names runs: a folder, a table and a document say the same; what is wrong in one is said with its place."""

from pathlib import Path

import pytest

from autotune.campaign.manifest import LoggedRun, read_manifest
from autotune.errors import UsageError

MCAP = b"\x89MCAP0\r\n"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    for name in ("press/mon.mcap", "press/tue.mcap", "mill/mon.mcap", "lathe.mcap"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(MCAP)
    for name in ("cell.yaml", "press/cell.yaml", "press/controller.yaml", "press/notes.txt", "mill/.mon.mcap.part"):
        (folder / name).write_text("", encoding="utf-8")
    bag = folder / "mill" / "wed"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("", encoding="utf-8")
    return folder


def test_a_folder_of_cells_has_their_logs_as_runs(logs: Path) -> None:
    found = {run.name: run for run in read_manifest(logs)}
    assert list(found) == ["lathe/lathe", "mill/mon", "mill/wed", "press/mon", "press/tue"]
    assert found["mill/mon"].cell_file == logs / "cell.yaml"
    assert found["mill/mon"].controller is None
    assert found["press/tue"].cell_file == logs / "press" / "cell.yaml"
    assert found["press/tue"].controller == logs / "press" / "controller.yaml"


def test_table_and_document_say_the_same(logs: Path) -> None:
    table, document = logs / "runs.csv", logs / "runs.yaml"
    table.write_text(
        "cell,log,run,cell_file\npress,press/mon.mcap;press/tue.mcap,week,press/cell.yaml\nmill,mill/mon.mcap,,\n",
        "utf-8",
    )
    document.write_text(
        "format: autotune/campaign\nversion: 1\nruns:\n"
        "  - {cell: press, log: [press/mon.mcap, press/tue.mcap], run: week, cell_file: press/cell.yaml}\n"
        "  - {cell: mill, log: mill/mon.mcap}\n",
        "utf-8",
    )
    press = (logs / "press" / "mon.mcap", logs / "press" / "tue.mcap")
    wanted = (
        LoggedRun(cell="press", run="week", logs=press, cell_file=logs / "press" / "cell.yaml"),
        LoggedRun(cell="mill", run="mon", logs=(logs / "mill" / "mon.mcap",)),
    )
    assert read_manifest(table) == read_manifest(document) == wanted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cell,path\n", "must have the columns cell and log"),
        ("cell,log,oven\n", "must have the columns cell and log"),
        ("cell,log\n", "names no logs"),
        ("cell,log\npress,gone.mcap\n", "line 2: .*gone.mcap is not there"),
        ("cell,log\n../press,press/mon.mcap\n", "line 2: the name of a cell"),
        ("cell,log\npress,\n", "line 2: the name of a run"),
        ("cell,log\npress,press/mon.mcap\npress,press/mon.mcap\n", "names press/mon twice"),
    ],
)
def test_what_is_wrong_in_a_table_is_said(logs: Path, text: str, message: str) -> None:
    (logs / "runs.csv").write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=message):
        read_manifest(logs / "runs.csv")


def test_an_empty_folder_and_a_wrong_document_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="names no logs"):
        read_manifest(tmp_path)
    (tmp_path / "runs.yaml").write_text("format: autotune/cell\nversion: 1\n", encoding="utf-8")
    with pytest.raises(UsageError, match="is a description of a cell, not a manifest of a campaign"):
        read_manifest(tmp_path / "runs.yaml")
