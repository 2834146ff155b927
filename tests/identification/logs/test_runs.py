"""Which logs are parts of one recording."""

from dataclasses import replace
from pathlib import Path

from identification.logs.read import separate_runs
from identification.logs.roles.cell import Cell
from tests.identification.logs.log_builder import Options, Stream, complete, write_mcap


def moved(stream: Stream, seconds: float) -> Stream:
    shift = round(seconds * 1e9)
    return replace(stream, stamp_ns=stream.stamp_ns + shift, log_ns=stream.log_ns + shift)


def test_logs_within_a_second_are_one_recording_and_later_ones_another(tmp_path: Path) -> None:
    starts = {"a": 0.0, "b": 0.5, "c": 60.0, "d": 60.9}
    paths = {
        name: write_mcap(tmp_path / f"{name}.mcap", [moved(stream, start) for stream in complete()], Options(extra=()))
        for name, start in starts.items()
    }
    # Whatever the order in which they are named.
    runs = separate_runs([paths[name] for name in "cabd"], Cell())
    assert [{path.stem for path in run} for run in runs] == [{"a", "b"}, {"c", "d"}]


def test_a_single_log_is_not_opened_for_that(tmp_path: Path) -> None:
    assert separate_runs([tmp_path / "missing.mcap"], Cell()) == ((tmp_path / "missing.mcap",),)
