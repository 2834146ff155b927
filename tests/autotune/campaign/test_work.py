"""What the outcome of a run says beside its numbers, and which outcomes are none of the inputs."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from autotune.campaign.manifest import LoggedRun
from autotune.campaign.options import RunOptions
from autotune.campaign.run import work_on_runs
from autotune.campaign.tables import campaign_rows
from autotune.campaign.work import RunOutcome, _tune, build_task, parse_outcome
from autotune.formats.controller import write_controller
from autotune.formats.identified import identified_tree
from autotune.formats.yaml12 import dump_yaml
from identification.logs.containers.formats import sha256_of
from tests.autotune.campaign.test_run import Counting
from tests.autotune.formats.samples import make_identified
from tests.autotune.prediction.test_before_after import replayed
from tests.autotune.tuning.cases import small_controller


def test_peaks_say_on_which_surface_and_at_which_speed_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = SimpleNamespace(controller=small_controller(), before_after={"x": replayed()})
    monkeypatch.setattr("autotune.tuning.optimize.optimize", lambda *_, **__: found)
    (log := tmp_path / "mon.csv").write_text("t,a\n0,1\n", encoding="utf-8")
    task = build_task(LoggedRun(cell="press", run="mon", logs=(log,)), tmp_path / "out", RunOptions())
    files = {"identified.yaml": dump_yaml(identified_tree(make_identified(), {}))}
    outcome = _tune(task, files, RunOutcome(cell="press", run="mon", key="k"))
    assert outcome.peaks_at == {"x": "K_e 100 to 120 N/mm, approach with 30 N"}
    assert outcome.log_peaks_at == {"x": "surface, 20 mm/s"}
    assert parse_outcome(outcome.text()) == outcome
    columns, (row,) = campaign_rows([outcome])
    said = dict(zip(columns, row, strict=True))
    assert (said["x.peak_n.at"], said["x.log_peak_n.at"]) == (outcome.peaks_at["x"], outcome.log_peaks_at["x"])
    assert (said["x.peak_n.after"], said["x.log_peak_n.after"]) == (
        outcome.peaks_n["x"][1],
        outcome.log_peaks_n["x"][1],
    )


class Losing(Counting):
    """Works while a file is away, which is put back behind it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._away = path, path.with_name("away")

    def submit(self, fn: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        self._path.rename(self._away)
        try:
            return super().submit(fn, *arguments, **named)
        finally:
            self._away.rename(self._path)


@pytest.mark.parametrize("name", ["mon.csv", "cell.yaml", "problem.yaml", "controller.yaml"])
def test_a_file_that_is_away_while_a_run_is_worked_on_costs_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def identified(logs: Sequence[Path], _options: object) -> SimpleNamespace:
        for log in logs:
            sha256_of(log)
        return SimpleNamespace(result=make_identified(), provenance={"time_span_s": (0.0, 1.0)})

    monkeypatch.setattr("autotune.campaign.work.identify_log", identified)
    monkeypatch.setattr(
        "autotune.tuning.optimize.optimize",
        lambda *_, **__: SimpleNamespace(controller=small_controller(), before_after={}),
    )
    (log := tmp_path / "mon.csv").write_text("t,a\n0,1\n", encoding="utf-8")
    kinds = ("cell", "problem", "controller")
    cell, problem, controller = (tmp_path / f"{kind}.yaml" for kind in kinds)
    cell.write_text("format: autotune/cell\nversion: 1\n", encoding="utf-8")
    problem.write_text("format: autotune/problem\nversion: 1\n", encoding="utf-8")
    write_controller(controller, small_controller())
    run = LoggedRun(cell="a", run="mon", logs=(log,), cell_file=cell, problem=problem, controller=controller)
    (before,) = work_on_runs([run], tmp_path / "out", executor=Counting())
    made = {path: path.read_bytes() for path in (tmp_path / "out" / "cells" / "a" / "mon").iterdir()}
    seeded = RunOptions(seed=1, allow_partial=True)
    (lost,) = work_on_runs([run], tmp_path / "out", seeded, executor=Losing(tmp_path / name))
    assert lost.refused == "unreadable"
    assert f"{name} cannot be read: No such file or directory" in lost.reason
    assert lost.reason.endswith(". It is tried again by the next campaign.")
    assert (lost.outside, {path: path.read_bytes() for path in made}) == (None, made)
    (found,) = work_on_runs([run], tmp_path / "out", seeded, executor=(again := Counting()))
    assert (found.refused, found.outside, again.worked) == ("", before.outside, ["a/mon"])
    work_on_runs([run], tmp_path / "out", seeded, executor=again)
    assert again.worked == ["a/mon"]


def test_a_controller_that_is_away_while_it_alone_is_checked_is_tried_again(tmp_path: Path) -> None:
    (log := tmp_path / "mon.csv").write_text("t,a\n0,1\n", encoding="utf-8")
    write_controller(controller := tmp_path / "controller.yaml", small_controller())
    without = LoggedRun(cell="a", run="mon", logs=(log,))
    run = LoggedRun(cell="a", run="mon", logs=(log,), controller=controller)
    work_on_runs([without], tmp_path, executor=Counting())
    refused = [
        work_on_runs([run], tmp_path, executor=each)[0].refused for each in (Losing(controller), Counting(), Counting())
    ]
    assert refused == ["unreadable", "log", "log"]


def test_a_damaged_file_of_which_a_library_says_that_it_cannot_be_read_is_not_tried_again(tmp_path: Path) -> None:
    (log := tmp_path / "mon.parquet").write_bytes(b"PAR1" + 100 * b"\xff" + b"PAR1")
    run, pool = LoggedRun(cell="a", run="mon", logs=(log,)), Counting()
    for _ in range(2):
        assert work_on_runs([run], tmp_path / "out", executor=pool)[0].refused == "log"
    assert pool.worked == ["a/mon"]
