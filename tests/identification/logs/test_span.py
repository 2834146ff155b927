"""A part of a log is what its arrays hold between two stamps."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.pipeline import IdentifyOptions
from identification.errors import LogError, UntimedError
from identification.logs.inspect import inspect_log
from identification.logs.read import LogSpan, read_recording
from identification.logs.roles.cell import Cell, PoseFields, PoseSource, WrenchFields, WrenchSource
from identification.logs.tables.layout import TableLayout
from problems.errors import ParameterError
from tests.identification.logs.log_builder import START_NS, complete, pose_stream, wrench_stream, write_mcap


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("log") / "run.mcap", complete())


def test_a_part_holds_the_samples_between_its_ends(log: Path) -> None:
    whole, part = read_recording(log), read_recording(log, span=LogSpan(start=0.1, stop=0.3))
    assert whole.command is not None
    assert part.command is not None
    for before, after in ((whole.wrench, part.wrench), (whole.pose, part.pose), (whole.command, part.command)):
        inside = (before.stamp_ns >= START_NS + 100_000_000) & (before.stamp_ns <= START_NS + 300_000_000)
        assert np.array_equal(after.stamp_ns, before.stamp_ns[inside])
    assert np.array_equal(part.wrench.force_n, whole.wrench.force_n[50:151])
    [message] = [finding.message for finding in part.findings if finding.code == "part-read"]
    assert message == "Of run.mcap only 0.1 s to 0.3 s is read."


def test_a_log_starts_where_wrench_and_pose_have_both_begun(tmp_path: Path) -> None:
    late = pose_stream(duration_s=0.6)
    late = late.with_stamps(late.stamp_ns + 200_000_000)
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(duration_s=0.8), late])
    part = read_recording(path, span=LogSpan(start="0.1"))
    assert part.wrench.stamp_ns[0] == part.pose.stamp_ns[0] == START_NS + 300_000_000


@given(st.integers(0, 200), st.integers(201, 400))
def test_seconds_and_stamps_name_the_same_part(first: int, last: int) -> None:
    stamps = START_NS + np.arange(401, dtype=np.int64) * 1_000_000
    seconds = LogSpan(start=first / 1000, stop=f"{last / 1000}")
    absolute = LogSpan(start=f"@{START_NS // 10**9}.{first:03d}", stop=f"@{START_NS // 10**9}.{last:03d}")
    expected = np.zeros(401, dtype=bool)
    expected[first : last + 1] = True
    assert np.array_equal(seconds.covers(stamps, START_NS), expected)
    assert np.array_equal(absolute.covers(stamps, 0), expected)


def test_a_window_without_a_wrench_is_refused_as_a_part_and_not_as_a_file(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [wrench_stream(duration_s=0.2), pose_stream(duration_s=0.6)])
    with pytest.raises(LogError) as refused:
        read_recording(path, span=LogSpan(recorded_ns=(START_NS + 300_000_000, START_NS + 600_000_000)))
    assert str(refused.value) == (
        "Topic /ft/wrench must hold the wrench in the part of run.mcap that is read, found no message of it there; "
        "read another part."
    )


@pytest.mark.parametrize("span", [LogSpan(start=1.0), LogSpan(stop="@3"), LogSpan(start="1700000000")])
def test_a_part_outside_of_the_log_is_refused_with_where_it_is(span: LogSpan, log: Path) -> None:
    with pytest.raises(LogError, match=r"found none; it is 0\.39\d s long and starts at @1700000000\.000000000"):
        read_recording(log, span=span)


@pytest.mark.parametrize("text", ["x", "", "-1", "nan", "1e30", "2023-11-14", "@"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="from must be seconds after the log's start"):
        LogSpan(start=text)


def test_the_end_is_after_the_beginning() -> None:
    with pytest.raises(ParameterError, match="to must be after the beginning, 2"):
        LogSpan(start=2, stop=1)


def test_files_outside_of_the_part_are_left_out(tmp_path: Path) -> None:
    """Of a recording of two files the first ends before the part begins."""
    first = write_mcap(tmp_path / "a.mcap", complete())
    moved = [stream.with_stamps(stream.stamp_ns + 400_000_000) for stream in complete()]
    moved = [stream.__class__(**{**vars(stream), "log_ns": stream.log_ns + 400_000_000}) for stream in moved]
    second = write_mcap(tmp_path / "b.mcap", moved)
    part = read_recording([first, second], span=LogSpan(start=0.5))
    assert part.wrench.stamp_ns[0] == START_NS + 500_000_000
    both = read_recording([first, second], span=LogSpan(start=0.2, stop=0.6))
    assert (both.wrench.stamp_ns[0] - START_NS, both.wrench.stamp_ns[-1] - START_NS) == (200_000_000, 600_000_000)


def test_rows_of_a_table_are_cut_by_its_time(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    rows = [f"{i / 100},{0.1 * i},{np.sin(i)}" for i in range(100)]
    path.write_text("\n".join(["t,z,f", *rows]) + "\n")
    cell = Cell(
        table=TableLayout(time="t"),
        displacement=PoseSource(fields=PoseFields(position=(None, None, "z"))),
        wrench=WrenchSource(fields=WrenchFields(force=(None, None, "f"))),
    )
    part = read_recording(path, cell, span=LogSpan(start=0.25, stop=0.5))
    assert np.allclose(part.wrench.force_n[:, 2], np.sin(np.arange(25, 51)), rtol=1e-15)


def test_inspect_summarises_the_part(log: Path) -> None:
    summary = inspect_log(log, span=LogSpan(start=0.1, stop=0.3))
    counts = {channel.topic: channel.count for channel in summary.channels}
    assert counts["/ft/wrench"] == 101
    assert counts["/robot/pose"] == 51
    assert summary.end_ns - summary.start_ns == pytest.approx(0.2e9, abs=1e6)  # each channel is recorded a little later
    assert "part-read" in [finding.code for finding in summary.findings]


def test_inspect_times_a_log_that_was_written_anew_by_its_headers(tmp_path: Path) -> None:
    """All messages came within a thirtieth of the time that their headers count."""
    quick = [
        stream.__class__(**{**vars(stream), "log_ns": START_NS + (stream.log_ns - START_NS) // 30})
        for stream in complete()
    ]
    summary = inspect_log(write_mcap(tmp_path / "quick.mcap", quick))
    whole = max(int(stream.stamp_ns[-1] - stream.stamp_ns[0]) for stream in quick)
    assert summary.end_ns - summary.start_ns == pytest.approx(whole, rel=0.01)


@pytest.mark.parametrize("factor", [1000, 0.001])
def test_stamps_in_a_mistaken_unit_are_named(tmp_path: Path, factor: float) -> None:
    """Milliseconds written where seconds belong, and the other way round."""
    scaled = [
        stream.with_stamps(START_NS + np.round((stream.stamp_ns - START_NS) * factor).astype(np.int64))
        for stream in complete()
    ]
    with pytest.raises(LogError, match=r"a factor of 1000 is a mistaken unit \(ms or µs for s\)"):
        read_recording(write_mcap(tmp_path / "unit.mcap", scaled))


def test_the_provenance_holds_the_part_and_only_where_there_is_one() -> None:
    options = IdentifyOptions(start="12.5", stop="@1700000020")
    assert IdentifyOptions.from_tree(options.tree(), None) == options
    assert not {"start", "stop"} & set(IdentifyOptions().tree())


def test_of_a_table_without_times_no_part_is_read(tmp_path: Path) -> None:
    """Rows are no seconds."""
    (tmp_path / "run.csv").write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    with pytest.raises(UntimedError, match=r"the times must be known: run\.csv .*columns are: a, b"):
        inspect_log(tmp_path / "run.csv", span=LogSpan(start=0.0, stop=1.0))
