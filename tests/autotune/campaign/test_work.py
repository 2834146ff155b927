"""What the outcome of a run says beside its numbers."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from autotune.campaign.manifest import LoggedRun
from autotune.campaign.options import RunOptions
from autotune.campaign.tables import campaign_rows
from autotune.campaign.work import RunOutcome, _tune, build_task, parse_outcome
from autotune.formats.identified import identified_tree
from autotune.formats.yaml12 import dump_yaml
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
