"""`autotune campaign`: what is printed and written, and the exit codes."""

import csv
import json
import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from autotune.campaign import run, work
from autotune.formats.controller import write_controller
from autotune.pipeline import identify_log
from autotune.results import Identification
from tests.autotune.campaign.test_run import Counting
from tests.autotune.tuning.cases import small_controller
from tests.conftest import RunCli


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work here, not in processes, which the first test and tests/autotune/campaign have."""

    @contextmanager
    def workers(*_: object) -> Iterator[Executor]:
        yield Counting()

    monkeypatch.setattr(run, "worker_pool", workers)


@pytest.fixture
def fleet(tmp_path: Path, good_log: Path) -> Path:
    """A cell with a good run and a broken one."""
    folder = tmp_path / "logs" / "press"
    folder.mkdir(parents=True)
    (folder / "mon.mcap").write_bytes(good_log.read_bytes())
    (folder / "tue.mcap").write_bytes(good_log.read_bytes()[:5000])
    return tmp_path / "logs"


def test_runs_are_identified_and_told_of(run_cli: RunCli, fleet: Path, tmp_path: Path) -> None:
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1", "--report", "fleet.html")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("2 runs of 1 cell, 1 refused; 0 changes from run to run, 0 unusual values.")
    assert "press/tue: tue.mcap is truncated or damaged" in done.stdout.replace("\n", " ")
    with (tmp_path / "out" / "campaign.csv").open(newline="") as stream:
        good, bad = csv.DictReader(stream)
    assert (good["run"], good["refused"], bad["run"], bad["refused"]) == ("mon", "", "tue", "log")
    assert float(good["payload.mass_kg"]) == pytest.approx(16.2, rel=0.01)
    assert float(good["x.delay_s.std"]) > 0.0
    found = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.[ys]*"))
    assert found == ["campaign.sqlite", "cells/press/mon/identified.yaml"]
    page = (tmp_path / "fleet.html").read_text(encoding="utf-8")
    assert all(text in page for text in ("All runs", "Refused", "press", "payload mass [kg]"))
    again = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--json")
    tree = json.loads(again.stdout)
    done_all = "Nothing to do: 2 of 2 runs done with these inputs, options and version."
    assert (done_all in again.stderr.replace("\n ", ""), "to do" in done.stderr) == (True, False)
    assert [run["refused"] for run in tree["runs"]] == ["", "log"]


@pytest.mark.usefixtures("in_this_process")
def test_the_command_that_is_named_next_is_of_the_same_runs_in_the_same_state(run_cli: RunCli, fleet: Path) -> None:
    said = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--allow-partial", "--storage", "sqlite:///s.db")
    assert "-o out --no-optimize --allow-partial --storage sqlite:///s.db --report campaign.html" in said.stderr


@pytest.mark.usefixtures("in_this_process")
def test_a_controller_that_is_not_certified_for_its_cell_is_exit_code_6(
    run_cli: RunCli, fleet: Path, tmp_path: Path
) -> None:
    write_controller(fleet / "press" / "controller.yaml", small_controller())
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
    assert done.returncode == 6
    assert "1 certificate no longer valid" in done.stdout
    assert "press/mon: the certificate does not hold: axis x, identified plant" in done.stdout.replace("\n", " ")
    assert (
        "The controllers of press are not certified for what the newest run of their cell shows, for the reasons above"
        in done.stderr.replace("\n", " ")
    )
    assert (tmp_path / "out" / "campaign.csv").is_file()


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("content", ["altered", "a: b\n", ""])
def test_a_controller_file_that_certifies_nothing_is_exit_code_6(
    run_cli: RunCli, fleet: Path, tmp_path: Path, content: str
) -> None:
    file = fleet / "press" / "controller.yaml"
    write_controller(file, small_controller())
    file.write_text(file.read_text().replace("mass: ", "mass: 1", 1) if content == "altered" else content)
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
    assert done.returncode == 6
    assert "1 certificate no longer valid" in done.stdout
    assert f"press/mon, press/tue: the certificate does not hold: {file}" in done.stdout.replace("\n", " ")
    # The cell itself is identified all the same.
    assert (tmp_path / "out" / "cells" / "press" / "mon" / "identified.yaml").is_file()


@pytest.mark.usefixtures("in_this_process")
def test_a_controller_file_that_certifies_nothing_beside_a_refused_log_is_exit_code_6(
    run_cli: RunCli, fleet: Path
) -> None:
    (fleet / "press" / "mon.mcap").unlink()
    (fleet / "mill").mkdir()
    (fleet / "mill" / "mon.csv").write_text("t,a\n0,1\n1,2\n")
    for folder in ("press", "mill"):
        write_controller(fleet / folder / "controller.yaml", small_controller())
    file = fleet / "press" / "controller.yaml"
    file.write_text(file.read_text().replace("mass: ", "mass: 1", 1))
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
    assert done.returncode == 6
    assert f"press/tue: the certificate does not hold: {file}" in done.stdout.replace("\n", " ")
    assert "The controllers of press are not certified" in done.stderr.replace("\n", " ")


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(("more", "names"), [(1, ""), (4, " and 3 more runs")])
def test_a_controller_file_that_several_runs_share_is_named_once(
    run_cli: RunCli, fleet: Path, tmp_path: Path, more: int, names: str
) -> None:
    for i in range(more):
        (fleet / "press" / f"u{i}.mcap").write_bytes((fleet / "press" / "tue.mcap").read_bytes())
    file = fleet / "press" / "controller.yaml"
    write_controller(file, small_controller())
    file.write_text(file.read_text().replace("mass: ", "mass: 1", 1))
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1", "--report", "fleet.html")
    said = f"press/mon, press/tue, press/u0{names}: "
    assert done.stdout.replace("\n", " ").count("the certificate does not hold") == 1
    assert f"{said}the certificate does not hold: {file}" in done.stdout.replace("\n", " ")
    assert (tmp_path / "fleet.html").read_text(encoding="utf-8").count(f"{said}{file}") == 1


@pytest.mark.usefixtures("in_this_process")
def test_what_no_campaign_has_written_is_not_deleted(run_cli: RunCli, fleet: Path, tmp_path: Path) -> None:
    notes = tmp_path / "out" / "cells" / "press" / "mon" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("mine")
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
    assert done.returncode == 2
    assert "mon holds notes.txt, which no campaign has written" in done.stderr.replace("\n", " ")
    assert notes.read_text() == "mine"
    notes.unlink()
    assert run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1").returncode == 0


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("name", ["identified.yaml", "controller.yaml"])
@pytest.mark.parametrize("content", ["mine: 1\n", "format: autotune/problem\nversion: 1\n", None])
def test_a_file_of_another_kind_with_the_name_of_a_result_is_not_replaced(
    run_cli: RunCli, fleet: Path, tmp_path: Path, name: str, content: str | None
) -> None:
    file = tmp_path / "out" / "cells" / "press" / "tue" / name
    if content is None:
        (file / "of the user").mkdir(parents=True)
    else:
        file.parent.mkdir(parents=True)
        file.write_text(content)
    for _ in range(2):
        done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
        assert done.returncode == 2
        assert f"tue holds {name}, which no campaign has written" in done.stderr.replace("\n", " ")
        assert (file / "of the user").is_dir() if content is None else file.read_text() == content
    file.rename(tmp_path / "moved")
    assert run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1").returncode == 0


@pytest.mark.usefixtures("in_this_process")
def test_results_of_which_the_state_knows_nothing_are_named_where_they_are_replaced(
    run_cli: RunCli, fleet: Path, tmp_path: Path
) -> None:
    words, folder = ("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1"), tmp_path / "out" / "cells"
    said = "knows nothing of their results in the folder, which are replaced: press/mon."
    first = run_cli(*words)
    (tmp_path / "out" / "campaign.sqlite").unlink()
    second, third = run_cli(*words), run_cli(*words)
    assert [said in done.stderr.replace("\n", " ") for done in (first, second, third)] == [False, True, False]
    # What cannot be made again stays.
    (folder / "press" / "tue").mkdir()
    write_controller(folder / "press" / "tue" / "controller.yaml", small_controller())
    assert run_cli(*words).returncode == 0  # the state knows that tue has no files, and it is not worked on
    (tmp_path / "out" / "campaign.sqlite").unlink()
    done = run_cli(*words)
    assert done.returncode == 2
    assert "has controllers of 1 run that would be removed" in done.stderr.replace("\n", " ")
    assert (folder / "press" / "tue" / "controller.yaml").is_file()


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("name", ["campaign.csv", "campaign.parquet"])
def test_a_table_that_no_campaign_has_written_is_not_replaced(
    run_cli: RunCli, fleet: Path, tmp_path: Path, name: str
) -> None:
    words, table = ("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1"), tmp_path / "out" / name
    table.parent.mkdir()
    table.write_text("cell,log\npress,mon.mcap\n")
    done = run_cli(*words)
    assert done.returncode == 2
    assert f"{name} is no table of a campaign, and this one would replace it" in done.stderr.replace("\n", " ")
    assert table.read_text() == "cell,log\npress,mon.mcap\n"
    assert not (tmp_path / "out" / "cells").exists()
    table.unlink()
    assert run_cli(*words).returncode == 0
    # What the first has written the second replaces, of whichever runs.
    (fleet / "press" / "tue.mcap").unlink()
    assert run_cli(*words).returncode == 0


@pytest.mark.usefixtures("in_this_process")
def test_of_another_controller_only_the_check_is_done_again(
    run_cli: RunCli, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, folder = ("campaign", fleet, "-o", "out", "--no-optimize"), tmp_path / "out" / "cells" / "press" / "mon"
    first = json.loads(run_cli(*asked, "--json").stdout)["runs"]
    monkeypatch.setattr(work, "identify_log", lambda *_: pytest.fail("identified again"))
    made, file = (folder / "identified.yaml").stat(), fleet / "press" / "controller.yaml"
    for content, outside in ((None, "axis x, identified plant"), ("a: b\n", "line 1")):
        if content is None:
            write_controller(file, small_controller())
        else:
            file.write_text(content)
        done = run_cli(*asked)
        assert (done.returncode, "replaced" in done.stderr) == (6, False)
        assert outside in done.stdout
    file.unlink()
    last = json.loads(run_cli(*asked, "--json").stdout)["runs"]
    assert last == first
    now = (folder / "identified.yaml").stat()
    assert (now.st_ino, now.st_mtime_ns) == (made.st_ino, made.st_mtime_ns)


@pytest.mark.usefixtures("in_this_process")
def test_of_another_problem_only_the_controller_is_searched_again(
    run_cli: RunCli, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (fleet / "press" / "tue.mcap").unlink()
    identified, folder = list[object](), tmp_path / "out" / "cells" / "press" / "mon"

    def counted(*arguments: Any) -> Identification:
        identified.append(arguments[0])
        return identify_log(*arguments)

    def tuned(task: work.RunTask, files: dict[str, str], outcome: work.RunOutcome) -> work.RunOutcome:
        files["controller.yaml"] = f"of: {task.key}\n"
        return replace(outcome, peaks_at={"x": files["identified.yaml"]})

    monkeypatch.setattr(work, "identify_log", counted)
    monkeypatch.setattr(work, "_tune", tuned)
    write_controller(fleet / "press" / "controller.yaml", small_controller())
    asked = ("campaign", fleet, "-o", "out", "--json")
    (first,) = json.loads(run_cli(*asked, "--no-optimize").stdout)["runs"]
    made = (folder / "identified.yaml").read_bytes()
    (fleet / "press" / "problem.yaml").write_text("format: autotune/problem\nversion: 1\n", encoding="utf-8")
    for more in ((), ("--seed", "1")):
        (second,) = json.loads(run_cli(*asked, *more).stdout)["runs"]
        assert (second["values"], second["recorded_s"], second["outside"]) == (
            first["values"],
            first["recorded_s"],
            first["outside"],
        )
        assert second["peaks_at"]["x"].encode() == (folder / "identified.yaml").read_bytes() == made
        assert (folder / "controller.yaml").read_text() == f"of: {second['key']}\n"
        assert second["key"] != first["key"]
        assert len(identified) == 1
    # What it follows from is another one, or it is not what was written: it is identified anew.
    run_cli(*asked, "--allow-partial")
    assert len(identified) == 2
    (folder / "identified.yaml").write_bytes(made + b"# mine\n")
    run_cli(*asked, "--allow-partial", "--seed", "2")
    assert (len(identified), b"# mine" in (folder / "identified.yaml").read_bytes()) == (3, False)


@pytest.mark.usefixtures("in_this_process")
def test_a_log_with_a_damaged_chunk_is_said_to_have_one(run_cli: RunCli, fleet: Path, tmp_path: Path) -> None:
    (fleet / "press" / "tue.mcap").unlink()
    log = fleet / "press" / "mon.mcap"
    data = bytearray(log.read_bytes())
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x10
    log.write_bytes(data)
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--allow-partial", "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert "warning: press/mon: mon.mcap is damaged: bytes " in done.stdout.replace("\n", " ")
    with (tmp_path / "out" / "campaign.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert (row["refused"], row["damage"].partition(": ")[0]) == ("", "mon.mcap is damaged")


def test_a_cut_log_is_read_with_salvage_as_its_refusal_says(run_cli: RunCli, fleet: Path) -> None:
    log = fleet / "press" / "mon.mcap"
    log.write_bytes(log.read_bytes()[: -log.stat().st_size // 10])
    words = ("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1", "--json")
    refused, read = (
        {run["run"]: run for run in json.loads(run_cli(*words, *more).stdout).get("runs", ())}["mon"]
        for more in ((), ("--salvage", "--allow-partial"))
    )
    assert "--salvage" in refused["reason"]
    assert read["refused"] == ""
    assert read["values"]["payload.mass_kg"][0] == pytest.approx(16.2, rel=0.01)


@pytest.mark.usefixtures("in_this_process")
def test_nothing_identified_is_exit_code_4_and_a_wrong_manifest_2(run_cli: RunCli, fleet: Path) -> None:
    (fleet / "press" / "mon.mcap").unlink()
    assert run_cli("campaign", fleet, "-o", "out", "--jobs", "1").returncode == 4
    (fleet / "runs.csv").write_text("cell,log\npress,gone.mcap\n", encoding="utf-8")
    done = run_cli("campaign", fleet / "runs.csv", "-o", "out")
    assert (done.returncode, "gone.mcap is not there" in done.stderr.replace("\n", " ")) == (2, True)
    done = run_cli("campaign", fleet, "-o", "out", "--scheduler", "head")
    assert (done.returncode, "--scheduler must be dask" in done.stderr) == (2, True)


@pytest.mark.parametrize("wait", ["nan", "inf", "1e9"])
def test_a_time_that_nobody_waits_is_refused(run_cli: RunCli, fleet: Path, wait: str) -> None:
    done = run_cli("campaign", fleet, "-o", "out", "--watch", wait)
    assert done.returncode == 2
    assert "must be 1 to 604800 seconds" in done.stderr


def rested(*logs: Path) -> None:
    """Let logs be of yesterday: no copy of them is under way."""
    for log in logs:
        os.utime(log, (log.stat().st_mtime - 86400.0,) * 2)


@pytest.mark.usefixtures("forked")
def test_a_folder_that_is_watched_says_what_is_new_and_nothing_else(
    run_cli: RunCli, fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (fleet / "weld").mkdir()
    looks, cut = 0, fleet / "press" / "tue.mcap"
    rested(*cut.parent.iterdir())

    def wait(seconds: float) -> None:
        """Between the looks: nothing, a log that is cut, and an end by hand."""
        nonlocal looks
        looks += 1
        assert seconds == 7.0
        if looks == 2:
            (fleet / "weld" / "new.mcap").write_bytes(cut.read_bytes())
            rested(fleet / "weld" / "new.mcap")
        elif looks == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr("autotune.cli.campaign.time.sleep", wait)
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1", "--watch", "7")
    assert done.returncode == 130
    said = done.stderr.replace("\n ", "")
    assert said.count("Looking again every 7 s") == 2
    assert "to do" not in said
    assert said.count("refused (log): press/tue: ") == said.count("refused (log): weld/new: ") == 1


@pytest.mark.usefixtures("in_this_process")
def test_a_log_that_is_copied_in_slowly_is_waited_for_and_refused_at_no_look(
    run_cli: RunCli, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow, looks = fleet / "press" / "tue.mcap", 0
    whole = (fleet / "press" / "mon.mcap").read_bytes()
    rested(fleet / "press" / "mon.mcap")

    def wait(_seconds: float) -> None:
        """Between the looks: a piece, four times, and its rest."""
        nonlocal looks
        looks += 1
        if looks <= 4:
            slow.write_bytes(whole[: len(whole) * looks // 4])
        elif looks == 5:
            rested(slow)
        elif looks == 7:
            raise KeyboardInterrupt

    monkeypatch.setattr("autotune.cli.campaign.time.sleep", wait)
    done = run_cli("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1", "--watch", "2")
    said = done.stderr.replace("\n ", "")
    assert (done.returncode, "refused (" in said, said.count("Looking again every 2 s")) == (130, False, 2)
    assert said.count("Waits for press/tue: a log that has changed within 5 s may still grow.") == 1
    with (tmp_path / "out" / "campaign.csv").open(newline="") as stream:
        assert [(row["run"], row["refused"]) for row in csv.DictReader(stream)] == [("mon", ""), ("tue", "")]


def test_a_mistake_in_a_file_that_runs_share_costs_no_result(
    run_cli: RunCli, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, out = fleet / "press" / "cell.yaml", tmp_path / "out"

    def results() -> list[bytes]:
        return [(out / name).read_bytes() for name in ("campaign.csv", "cells/press/mon/identified.yaml")]

    words = ("campaign", fleet, "-o", "out", "--no-optimize", "--jobs", "1")
    rested(*cell.parent.iterdir())
    assert run_cli(*words).returncode == 0
    kept, looks = results(), 0

    def wait(_seconds: float) -> None:
        """Between the looks: a mistake, nothing, its correction, and an end by hand."""
        nonlocal looks
        looks += 1
        assert results() == kept
        if looks == 1:
            cell.write_text("format: autotune/cell\nversion: 1\nwrnch: {topic: /ft}\n", encoding="utf-8")
        elif looks == 3:
            cell.unlink()
        elif looks == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr("autotune.cli.campaign.time.sleep", wait)
    done = run_cli(*words, "--watch", "7")
    said = done.stderr.replace("\n ", " ")
    assert (done.returncode, said.count("cell.yaml, line 3"), said.count("Nothing is done until it is mended.")) == (
        130,
        1,
        1,
    )
    assert said.count("Mended: the campaign goes on.") == 1
    cell.write_text("format: autotune/cell\nversion: 1\nwrnch: {topic: /ft}\n", encoding="utf-8")
    done = run_cli(*words)
    assert (done.returncode, "cell.yaml, line 3" in done.stderr) == (2, True)
    assert results() == kept
