"""A manifest names runs: a folder, a table and a document say the same; what is wrong in one is said with its place."""

import os
from pathlib import Path

import pytest

from autotune.campaign.manifest import LoggedRun, LogWatch, read_manifest
from autotune.campaign.options import RunOptions
from autotune.errors import UsageError
from identification.given import Given

MCAP = b"\x89MCAP0\r\n"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    for name in ("press/mon.mcap", "press/tue.mcap", "mill/mon.mcap", "lathe.mcap"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(MCAP)
    for name in ("cell.yaml", "press/cell.yaml", "press/controller.yaml", "press/notes.txt", "mill/.mon.mcap.part"):
        (folder / name).write_text("format: autotune/cell\nversion: 1\n", encoding="utf-8")
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


def test_a_log_that_a_recorder_left_empty_is_a_run(logs: Path) -> None:
    (logs / "press" / "sat.mcap").touch()
    (logs / "press" / "notes.txt").touch()
    assert "press/sat" in {run.name for run in read_manifest(logs)}
    assert "press/notes" not in {run.name for run in read_manifest(logs)}


@pytest.mark.parametrize("content", [b"\x07\x81 nothing that a recorder writes", MCAP[:4]])
def test_a_log_that_is_damaged_from_its_beginning_on_is_a_run_that_is_refused_and_not_passed_over(
    logs: Path, content: bytes
) -> None:
    (logs / "press" / "sat.mcap").write_bytes(content)
    assert "press/sat" in {run.name for run in read_manifest(logs)}


@pytest.mark.parametrize("ending", [".part", ".tmp", ".active"])
def test_what_is_still_being_copied_is_no_run_however_it_begins(logs: Path, ending: str) -> None:
    before = read_manifest(logs)
    (logs / "press" / f"sat.mcap{ending}").write_bytes(MCAP)
    assert read_manifest(logs) == before


def test_logs_in_deeper_folders_are_said_to_be_passed_over(logs: Path) -> None:
    before, notes = read_manifest(logs), list[str]()
    for name in ("mill/2026-11/thu.mcap", "press/2026/11/fri.mcap"):
        (logs / name).parent.mkdir(parents=True)
        (logs / name).write_bytes(MCAP)
    (logs / "press" / ".trash").mkdir()
    (logs / "press" / ".trash" / "sat.mcap").write_bytes(MCAP)
    (logs / "mill" / "wed" / "wed_0.db3").write_bytes(b"")  # a part of the bag `wed`
    (logs / "mill" / "all").symlink_to(logs)
    assert read_manifest(logs, note=notes.append) == before
    first = logs / "mill" / "2026-11" / "thu.mcap"
    said = (
        f"Passed over 2 logs deeper than in the folder of a cell, the first {first}: move them up, or name them in a "
    )
    assert notes == [f"{said}CSV or YAML file."]
    (logs.parent / "above" / "hall").mkdir(parents=True)
    (logs / "mill").rename(logs.parent / "above" / "hall" / "mill")
    with pytest.raises(UsageError, match=r"names no logs\. Passed over 3 logs deeper than in the folder of a cell"):
        read_manifest(logs.parent / "above")


def test_what_a_campaign_has_written_among_the_logs_is_no_run(logs: Path) -> None:
    before, notes = read_manifest(logs), list[str]()
    for out in (logs, logs / "fleet", logs / "press"):
        (out / "cells" / "mill" / "mon").mkdir(parents=True)
        (out / "cells" / "mill" / "mon" / "identified.yaml").write_text("a: 1\n", encoding="utf-8")
        (out / "campaign.csv").write_text("cell,run\n", encoding="utf-8")
        (out / "campaign.parquet").write_bytes(b"PAR1")
    (logs / "fleet" / "campaign.sqlite").write_bytes(b"SQLite format 3\0")
    assert read_manifest(logs, note=notes.append) == before
    assert notes == []


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
        ("cell,log\n../press,press/mon.mcap\n", "line 2: the name of a cell must be letters, digits, spaces, _ "),
        ("cell,log\n press,press/mon.mcap\n", r"begin with no space, and not be dots alone; found ' press'\.$"),
        ("cell,log\npress,\n", "line 2: the name of a run"),
        ("cell,log\npress,press/mon.mcap\npress,press/mon.mcap\n", "names press/mon twice"),
    ],
)
def test_what_is_wrong_in_a_table_is_said(logs: Path, text: str, message: str) -> None:
    (logs / "runs.csv").write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=message):
        read_manifest(logs / "runs.csv")


def test_a_table_in_another_encoding_is_to_be_saved_as_utf_8(logs: Path) -> None:
    (logs / "runs.csv").write_text("cell,log\nTür 1,press/mon.mcap\n", encoding="latin-1")
    with pytest.raises(UsageError, match=r"runs\.csv must be UTF-8, found the byte 0xfc; save it as UTF-8"):
        read_manifest(logs / "runs.csv")
    (logs / "runs.csv").write_text("cell,log\nTür 1,press/mon.mcap\n", encoding="utf-8")
    assert [run.cell for run in read_manifest(logs / "runs.csv")] == ["Tür 1"]


def test_an_empty_folder_and_a_wrong_document_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="names no logs"):
        read_manifest(tmp_path)
    (tmp_path / "runs.yaml").write_text("format: autotune/cell\nversion: 1\n", encoding="utf-8")
    with pytest.raises(UsageError, match="is a description of a cell, not a manifest of a campaign"):
        read_manifest(tmp_path / "runs.yaml")


def test_options_of_a_run_are_said_alike_in_table_and_document(logs: Path) -> None:
    table, document = logs / "runs.csv", logs / "runs.yaml"
    (logs / "arm.urdf").write_text("<robot/>", encoding="utf-8")
    table.write_text(
        "cell,log,optimize,seed,salvage,wrench_topic,from,to,windows,given,urdf,tip\n"
        "press,press/mon.mcap,no,3,yes,/ft,12.5,@1700000000.5,10min,mass_kg=16.2±0.1;x.delay_s=0.002,arm.urdf,tool0\n"
        "mill,mill/mon.mcap,,,,,,,,,,\n",
        "utf-8",
    )
    document.write_text(
        "format: autotune/campaign\nversion: 1\nruns:\n"
        "  - cell: press\n    log: press/mon.mcap\n"
        "    options: {optimize: false, seed: 3, salvage: true, wrench_topic: /ft, from: 12.5, to: '@1700000000.5',\n"
        "      windows: 600, given: {mass_kg: 16.2±0.1, x.delay_s: 2e-3}, urdf: arm.urdf, tip: tool0}\n"
        "  - {cell: mill, log: mill/mon.mcap}\n",
        "utf-8",
    )
    said, silent = read_manifest(table)
    assert (said, silent) == read_manifest(document)
    assert silent.options == {}
    options = RunOptions(**said.options)
    assert (options.optimize, options.seed, options.salvage, options.allow_partial) == (False, 3, True, False)
    read = options.of_identify(None)
    assert (read.start, read.stop, read.windows_s) == (12.5, "@1700000000.5", 600.0)
    assert read.given == {"mass_kg": Given(value=16.2, std=0.1), "x.delay_s": Given(value=2e-3, std=0.0)}
    assert (read.wrench_topic, read.urdf, read.tip) == ("/ft", str(logs / "arm.urdf"), "tool0")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("salvage", "perhaps", "must be true or false, found 'perhaps'."),
        ("seed", "-1", "must be a whole number of 0 or more, found '-1'."),
        ("windows", "5", "must be from 20 s to 1e+07 s, for example 10min."),
        ("windows", "wide", "'wide' is not a number."),
        ("given", "mass_kg", "must be NAME=VALUE±STD (or +- for ±), found 'mass_kg'."),
        ("given", "mass_kg=16.2+-abc", "option given: mass_kg=16.2+-abc must hold numbers, found 'abc'."),
        ("urdf", "gone.urdf", "gone.urdf is not there."),
    ],
)
def test_an_option_that_cannot_be_is_refused_with_its_place(logs: Path, name: str, value: str, message: str) -> None:
    (logs / "runs.csv").write_text(f"cell,log,{name}\npress,press/mon.mcap,{value}\n", encoding="utf-8")
    with pytest.raises(UsageError) as refused:
        read_manifest(logs / "runs.csv")
    assert str(refused.value).startswith(f"{logs / 'runs.csv'}, line 2, option {name}: ")
    assert str(refused.value).endswith(message)


def test_a_span_that_cannot_be_and_an_unknown_option_are_refused(logs: Path) -> None:
    (logs / "runs.csv").write_text("cell,log,from,to\npress,press/mon.mcap,5,3\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"line 2, option to must be after the beginning, 5\.0, found 3\.0"):
        read_manifest(logs / "runs.csv")
    (logs / "runs.csv").write_text("cell,log,from\npress,press/mon.mcap,noon\n", encoding="utf-8")
    with pytest.raises(UsageError, match="line 2, option from must be seconds after the log's start"):
        read_manifest(logs / "runs.csv")
    (logs / "runs.yaml").write_text(
        "format: autotune/campaign\nversion: 1\nruns:\n  - {cell: a, log: mill/mon.mcap, options: {speed: 1}}\n",
        "utf-8",
    )
    with pytest.raises(UsageError, match="speed"):
        read_manifest(logs / "runs.yaml")


def test_a_log_that_is_watched_rests_when_it_is_old_and_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, looks = 1_000_000.0, LogWatch(2.0)
    monkeypatch.setattr("autotune.campaign.manifest.time.time_ns", lambda: round(1e9 * now_s))
    paths = {name: tmp_path / f"{name}.mcap" for name in ("old", "slow", "ahead", "moved")}
    (bag := tmp_path / "bag").mkdir()
    runs = [LoggedRun(cell="a", run=name, logs=(path,)) for name, path in {**paths, "bag": bag}.items()]

    def changed(path: Path, age_s: float, *, size: int = 1) -> None:
        path.write_bytes(size * b"x")
        for each in (path, path.parent) if path.parent == bag else (path,):
            os.utime(each, (now_s - age_s, now_s - age_s))

    def looked() -> tuple[list[str], list[str]]:
        rested, waiting = looks.look([run for run in runs if run.logs[0].exists()])
        return [run.run for run in rested], [name.removeprefix("a/") for name in waiting]

    changed(paths["old"], 5.0)
    changed(paths["slow"], 4.9)
    changed(paths["ahead"], -3600.0)
    changed(bag / "bag_0.db3", 60.0)
    assert looked() == (["old", "bag"], ["slow", "ahead"])
    now_s += 2.0
    changed(paths["slow"], 0.1, size=2)
    changed(paths["moved"], 3600.0)  # whose time a copy may have set before its end
    changed(bag / "bag_1.db3", 0.1)
    assert looked() == (["old", "ahead"], ["moved", "bag"])
    now_s += 2.0
    assert looked() == (["old", "ahead", "moved"], [])
    now_s += 3.0
    changed(paths["old"], 0.0)
    assert looked() == (["slow", "ahead", "moved", "bag"], ["old"])
