"""Long logs in windows: the numbers of recordings on their own, what changed, and nothing read but the window."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from autotune.api import identify
from autotune.charts.chart import Chart
from autotune.drift import MASS
from autotune.errors import UsageError
from autotune.pieces import LogPiece, PieceRun, RunSource, telling
from autotune.pipeline import IdentifyOptions, identify_log, identify_windows
from autotune.report.page import Page, render_page
from autotune.report.window_blocks import window_section
from autotune.results import Identification
from autotune.simulation.simulate import made_later, simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from autotune.windows import (
    Window,
    most_telling,
    new_surfaces,
    window_changes,
    window_findings,
    window_rows,
    windows_of,
)
from identification.errors import EstimateError, LogError, OutsideSpanError
from identification.identify import identify_cell
from identification.logs import long_logs, read
from identification.logs.containers.channel import ByteArray
from identification.logs.containers.mcap_file import ChunkReader
from identification.logs.containers.mcap_kernel import Chunk
from identification.logs.inspect import inspect_log
from identification.logs.read import LogSpan, read_checked_recording, read_recording, window_bounds
from identification.logs.roles.cell import Cell
from identification.merging.combine import NamedResult
from identification.result import CONTACT_UNEXPLAINED, AxisEstimate, Finding
from identification.signals.recording import Recording, join_recordings
from identification.verdicts import unidentifiable
from tests.autotune.simulation.runs import SHORT

PROGRAM = replace(SHORT, pose_count=5, pose_hold_s=1.0, jogging_s=2.0, sweep_s=2.0, contact_count=0)
WIDTH_S = 40.0
IN_WINDOWS = IdentifyOptions(allow_partial=True, windows_s=WIDTH_S)
LIGHTER = replace(SimulatedCell(), payload_mass_kg=11.3, inertia_S_kg_m2=(0.4, 0.38, 0.15))


def written(path: Path, *recordings: Recording) -> Path:
    write_mcap(join_recordings([made_later(each, k * WIDTH_S / 3600.0) for k, each in enumerate(recordings)]), path)
    return path


@pytest.fixture(scope="module")
def days() -> tuple[Recording, Recording]:
    """Two recordings of the same cell, each shorter than a window."""
    first, second = (simulate_cell(SimulatedCell(), PROGRAM, seed=seed).recording for seed in (1, 2))
    return first, second


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory, days: tuple[Recording, Recording]) -> Path:
    return written(tmp_path_factory.mktemp("long") / "day.mcap", *days)


@pytest.fixture(scope="module")
def in_windows(long_log: Path) -> Identification:
    return identify_log(long_log, IN_WINDOWS)


def test_windows_show_what_the_recordings_in_them_show(
    tmp_path: Path, days: tuple[Recording, Recording], in_windows: Identification
) -> None:
    parts = [tmp_path / "monday.mcap", tmp_path / "tuesday.mcap"]
    write_mcap(days[0], parts[0])
    write_mcap(made_later(days[1], WIDTH_S / 3600.0), parts[1])
    apart = identify_log(parts, IdentifyOptions(allow_partial=True))
    assert in_windows.result.payload == apart.result.payload
    assert in_windows.result.axes["x"].coupling == apart.result.axes["x"].coupling
    assert in_windows.result.axes["x"].robot == apart.result.axes["x"].robot
    first, second = windows_of(in_windows.provenance)
    assert (first.name, second.name) == ("0:00:00 to 0:00:40", "0:00:40 to 0:01:01")
    assert first.is_used
    assert second.is_used
    assert first.values[MASS][0] == pytest.approx(16.2, abs=3.0 * first.values[MASS][1])


def test_a_script_asks_for_windows_as_the_command_line_does(long_log: Path, in_windows: Identification) -> None:
    found = identify(long_log, windows=WIDTH_S, allow_partial=True)
    assert found.result == in_windows.result
    assert windows_of(found.provenance) == windows_of(in_windows.provenance)
    for length_s in (5.0, 1e300):
        with pytest.raises(UsageError, match=r"windows: must be from 20 s to 1e\+07 s, for example 10min"):
            identify(long_log, windows=length_s)


def test_only_the_chunks_of_a_window_are_unpacked(long_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []
    unpack = ChunkReader.unpack

    def noted(reader: ChunkReader, chunk: Chunk) -> ByteArray:
        opened.append(chunk.start_ns)
        return unpack(reader, chunk)

    monkeypatch.setattr(ChunkReader, "unpack", noted)
    whole = read_recording(long_log, span=LogSpan(recorded_ns=(0, 2**62)))
    every, begin = len(opened), int(whole.wrench.stamp_ns[0])
    opened.clear()
    window = (begin, begin + round(WIDTH_S * 1e9))
    part = read_recording(long_log, span=LogSpan(recorded_ns=window))
    assert 0 < len(opened) < 0.7 * every
    assert max(opened) < window[1]
    kept = whole.wrench.stamp_ns < window[1]
    np.testing.assert_array_equal(part.wrench.stamp_ns, whole.wrench.stamp_ns[kept])
    np.testing.assert_array_equal(part.wrench.force_n, whole.wrench.force_n[kept])


def test_a_payload_that_was_swapped_is_named_and_the_windows_that_agree_give_the_result(
    tmp_path: Path, days: tuple[Recording, Recording]
) -> None:
    swapped = simulate_cell(LIGHTER, PROGRAM, seed=3).recording
    found = identify_log(written(tmp_path / "swap.mcap", *days, swapped), IN_WINDOWS)
    assert found.result.payload.mass_kg.value == pytest.approx(16.2, rel=5e-3)
    assert [each.is_used for each in windows_of(found.provenance)] == [True, True, False]
    (change,) = (each for each in window_changes(windows_of(found.provenance)) if each.name == MASS)
    assert change.old == pytest.approx(16.2, rel=5e-3)
    assert change.new == pytest.approx(11.3, rel=5e-3)
    (said,) = (each.message for each in found.result.findings if "payload mass went from" in each.message)
    assert "Between 0:00:40 to 0:01:20 and 0:01:20 to" in said


def test_a_log_of_which_no_window_says_anything_is_refused_with_the_commonest_reason(long_log: Path) -> None:
    with pytest.raises(LogError, match="no_such_topic"):
        identify_log(long_log, replace(IN_WINDOWS, wrench_topic="/no_such_topic"))


def test_windows_of_a_part_are_those_of_its_length_and_show_what_the_part_shows(
    long_log: Path, days: tuple[Recording, Recording]
) -> None:
    begin, ends = int(days[1].wrench.stamp_ns[0]), int(days[1].wrench.stamp_ns[-1])
    late = int(made_later(days[1], WIDTH_S / 3600.0).wrench.stamp_ns[0]) - begin
    part = IdentifyOptions(allow_partial=True, start=35.0)
    found = identify_log(long_log, replace(part, windows_s=60.0))
    assert [each.name for each in windows_of(found.provenance)] == ["0:00:35 to 0:01:01"]
    assert found.result.payload == identify_log(long_log, part).result.payload
    by_stamp = replace(IN_WINDOWS, start=f"@{(begin + late) / 1e9 + 1.0:.6f}", stop=f"@{(ends + late) / 1e9:.6f}")
    alone = identify_log(long_log, by_stamp)
    assert alone.provenance["time_span_s"][0] == pytest.approx((begin + late) / 1e9 + 1.0, abs=1e-3)
    with pytest.raises(OutsideSpanError, match=r"from @5 s to @6 s, found none; it is 60\.999 s long"):
        identify_log(long_log, replace(IN_WINDOWS, start="@5", stop="@6"))


def test_of_a_long_log_no_more_than_the_part_is_read(long_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("LONGEST_WHOLE_S", 50.0), ("LARGEST_WHOLE_BYTES", 1_000_000)):
        monkeypatch.setattr(read, name, value)
    monkeypatch.setattr(long_logs, "LONGEST_WHOLE_S", 50.0)
    monkeypatch.setattr(long_logs, "_MARGIN_NS", 10**9)
    options, opened = IdentifyOptions(allow_partial=True, start=38.0), list[int]()
    unpack = ChunkReader.unpack
    whole = identify_log(long_log, options, recording=read_checked_recording(long_log, Cell(), span=options.span))

    def noted(reader: ChunkReader, chunk: Chunk) -> ByteArray:
        opened.append(chunk.start_ns)
        return unpack(reader, chunk)

    monkeypatch.setattr(ChunkReader, "unpack", noted)
    part = identify_log(long_log, options)
    assert part.result.payload == whole.result.payload
    assert part.result.axes == whole.result.axes
    first = min(opened)
    # Where it starts is looked for in its first ten seconds; the last chunk before the pause reaches into the part.
    assert not any(first + 11e9 < start < first + 19e9 for start in opened)


@pytest.fixture(scope="module")
def shift(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    """A payload is weighed and works; another one is weighed, swapped in within a window, and works."""
    weighing = replace(PROGRAM, pose_count=6, sweep_s=0.0, jogging_s=0.0)
    working = replace(PROGRAM, pose_count=1, sweep_s=3.0, contact_count=2)
    parts = [
        simulate_cell(cell, program, seed=seed).recording
        for seed, (cell, program) in enumerate(
            [(SimulatedCell(), weighing), (LIGHTER, weighing), (LIGHTER, working), (SimulatedCell(), working)]
        )
    ]
    starts_s = (0.0, 19.0, 1.0 * WIDTH_S, 2.0 * WIDTH_S)
    late = [made_later(part, start / 3600.0) for part, start in zip(parts, starts_s, strict=True)]
    path = tmp_path_factory.mktemp("shift") / "shift.mcap"
    write_mcap(join_recordings(late), path)
    return identify_log(path, IN_WINDOWS)


def test_a_window_in_which_the_payload_changes_is_two(shift: Identification) -> None:
    first, second, *_ = windows_of(shift.provenance)
    assert first.name == "0:00:00 to 0:00:18"
    assert second.name == "0:00:18 to 0:00:40"
    assert first.values[MASS][0] == pytest.approx(16.2, abs=3.0 * first.values[MASS][1])
    assert second.values[MASS][0] == pytest.approx(11.3, abs=3.0 * second.values[MASS][1])
    swap, change, *_ = (each.message for each in shift.result.findings if each.code == "changed-within-log")
    assert re.search(r"^0:00:00 to 0:00:40: The payload of .* changed between 18.* Both sides are identified", swap)
    assert "Between 0:00:00 to 0:00:18 and 0:00:18 to 0:00:40, payload mass went from 16.2" in change


def test_a_window_with_too_few_poses_takes_the_payload_that_its_force_agrees_with(shift: Identification) -> None:
    *_, light, heavy = windows_of(shift.provenance)
    assert light.payload_from == "window 0:00:18 to 0:00:40"
    # The nearer payload is not the one that hangs there.
    assert heavy.payload_from == "window 0:00:00 to 0:00:18"
    for each in (light, heavy):
        for name, true in (("x.stiffness_n_per_m", 3.1e5), ("x.x1.stiffness_n_per_m", 1.2e5)):
            (value, std) = next(held for key, held in each.values.items() if key.endswith(name.partition(".")[2]))
            assert value == pytest.approx(true, abs=4.0 * std), name
            assert std < 0.05 * true
    rows = [row[-1] for row in window_rows(windows_of(shift.provenance))]
    assert rows[-1].endswith("payload from window 0:00:00 to 0:00:18")


def test_the_payload_of_another_window_counts_once(shift: Identification) -> None:
    used = [each for each in windows_of(shift.provenance) if each.is_used]
    (own,) = (each for each in used if not each.payload_from)
    assert len(used) == 2
    assert shift.result.payload.mass_kg.value == own.values[MASS][0]
    assert shift.result.payload.mass_kg.std == own.values[MASS][1]
    assert "x" in shift.result.axes


def test_contacts_of_every_window_are_shown_not_only_of_those_that_give_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (read, long_logs):
        monkeypatch.setattr(module, "LONGEST_WHOLE_S", 35.0)
        monkeypatch.setattr(module, "WINDOW_S", WIDTH_S)
    monkeypatch.setattr(read, "LARGEST_WHOLE_BYTES", 1_000_000)
    pressing = replace(PROGRAM, contact_count=2)
    parts = [simulate_cell(SimulatedCell(), pressing, seed=seed).recording for seed in (1, 2)]
    log = written(tmp_path / "pressed.mcap", *parts)
    shown = identify_windows([log], IdentifyOptions(allow_partial=True))
    assert [name for name, _ in shown] == ["0:00:00 to 0:00:40", "0:00:40 to 0:01:10"]
    for (_, result), part in zip(shown, parts, strict=True):
        path = tmp_path / "alone.mcap"
        write_mcap(part, path)
        alone = identify_log(path, IdentifyOptions(allow_partial=True)).result
        assert [touch.peak_force for line in result.timelines for touch in line.touches] == pytest.approx(
            [touch.peak_force for line in alone.timelines for touch in line.touches]
        )
    assert identify_windows([path], IdentifyOptions(allow_partial=True)) == ()


def test_a_payload_is_not_handed_on_where_the_sensor_was_tared_in_between(tmp_path: Path) -> None:
    working = replace(PROGRAM, pose_count=1, sweep_s=3.0, contact_count=3)
    tared = replace(SimulatedCell(), force_bias_S_n=(4.2, -6.0, 11.0))
    weighed = simulate_cell(SimulatedCell(), PROGRAM, seed=1).recording
    found = identify_log(
        written(tmp_path / "tared.mcap", weighed, simulate_cell(tared, working, seed=2).recording), IN_WINDOWS
    )
    *_, second = windows_of(found.provenance)
    assert second.refused.startswith("The tool rests in fewer than 4 clearly different orientations here, and the")


def test_a_damaged_chunk_of_a_window_costs_that_chunk(
    long_log: Path, in_windows: Identification, tmp_path: Path
) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(long_log.read_bytes())
    # A chunk of the jogging in the first window; without compression and with a CRC.
    data[len(data) // 4] ^= 0x10
    damaged.write_bytes(data)
    found = identify_log(damaged, IN_WINDOWS)
    windows = windows_of(found.provenance)
    assert [each.is_used for each in windows] == [True, True]
    assert windows[0].has_pauses
    (said,) = (each.message for each in found.result.findings if each.code == "salvaged")
    assert re.search(r"^0:00:00 to 0:00:40: damaged.mcap is damaged: .* messages \(the CRC", said)
    assert windows[0].values.keys() == windows_of(in_windows.provenance)[0].values.keys()
    for key, (value, std) in windows_of(in_windows.provenance)[0].values.items():
        assert windows[0].values[key][0] == pytest.approx(value, abs=2.0 * std), key
    assert windows[1].values == windows_of(in_windows.provenance)[1].values


def test_a_damaged_first_chunk_costs_that_chunk(long_log: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(long_log.read_bytes())
    data[100_000] ^= 0x10
    damaged.write_bytes(data)
    found = identify_log(damaged, IN_WINDOWS)
    assert [each.is_used for each in windows_of(found.provenance)] == [True, True]
    assert any("damaged.mcap is damaged: bytes" in each.message for each in found.result.findings)


def test_a_long_log_is_looked_at_in_windows_and_its_channels_are_those_of_the_whole(
    long_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, of_part = inspect_log(long_log), inspect_log(long_log, span=LogSpan(start=35.0))
    for name, value in (("LONGEST_WHOLE_S", 30.0), ("LARGEST_WHOLE_BYTES", 1_000_000)):
        monkeypatch.setattr(read, name, value)
    for name, value in (("LONGEST_WHOLE_S", 30.0), ("WINDOW_S", WIDTH_S)):
        monkeypatch.setattr(long_logs, name, value)
    found = inspect_log(long_log)
    assert (found.start_ns, found.end_ns) == (whole.start_ns, whole.end_ns)
    assert [each.topic for each in found.channels] == [each.topic for each in whole.channels]
    for one, other in zip(found.channels, whole.channels, strict=True):
        assert (one.count, one.backwards_steps, one.duplicates) == (
            other.count,
            other.backwards_steps,
            other.duplicates,
        )
        assert one.median_gap_s == pytest.approx(other.median_gap_s)
    assert any(finding.code == "windows" for finding in found.findings)
    part = inspect_log(long_log, span=LogSpan(start=35.0))
    counts = [each.count for each in part.channels]
    assert counts == [each.count for each in of_part.channels]
    assert 0 < counts[0] < 0.7 * whole.channels[0].count


def test_a_contact_that_a_border_cuts_is_no_error_where_a_surface_is_known() -> None:
    result = identify_cell(simulate_cell(SimulatedCell(), replace(PROGRAM, contact_count=2), seed=1).recording)
    left = [replace(Finding.error(CONTACT_UNEXPLAINED, "what was touched", ""), axis=axis) for axis in ("x", "y")]
    source = RunSource(channels={}, clocks={}, sha256={}, span_s=(0.0, 1.0))
    found = replace(result, findings=tuple(left))
    run = PieceRun(named=NamedResult(name="w", result=found), source=source, evidence=None)
    (kept,), _ = telling([(LogPiece(files=(), span=LogSpan(), window=window(0)), run)])
    assert [(each.axis, each.severity) for each in kept.named.result.findings] == [("x", "warning"), ("y", "error")]


def test_an_axis_of_which_the_windows_show_no_coupling_and_no_surface_is_left_out_and_said() -> None:
    """One motion of a day that looks like a sweep costs no result of the axis that was swept."""
    result = identify_cell(simulate_cell(SimulatedCell(), PROGRAM, seed=1).recording)
    turned = replace(
        result.axes["x"],
        coupling=replace(result.axes["x"].coupling, stiffness_n_per_m=unidentifiable(note="no spring")),
    )
    source = RunSource(channels={}, clocks={}, sha256={}, span_s=(0.0, 1.0))
    fault = Finding.error("axis-unidentifiable", "Axis rx: K_s: not identified from the log.", "")

    def of_a_day(axes: dict[str, AxisEstimate]) -> tuple[PieceRun, tuple[Window, ...]]:
        found = replace(result, axes=axes, findings=(fault,))
        run = PieceRun(named=NamedResult(name="w", result=found), source=source, evidence=None)
        (kept,), windows = telling([(LogPiece(files=(), span=LogSpan(), window=window(0)), run)])
        return kept, windows

    kept, windows = of_a_day({"x": result.axes["x"], "rx": turned})
    assert list(kept.named.result.axes) == ["x"]
    assert kept.named.result.findings == ()
    (said,) = (each for each in window_findings(windows) if each.code == "axis-left-out")
    assert (said.severity, said.message[:24]) == ("warning", "Axis rx: a motion like a")
    # Where it is all that there is, what is missing of it is an error.
    kept, windows = of_a_day({"rx": turned})
    assert list(kept.named.result.axes) == ["rx"]
    assert kept.named.result.findings == (fault,)
    assert "axis-left-out" not in {each.code for each in window_findings(windows)}


@pytest.mark.parametrize(("length_s", "count"), [(10.0, 1), (59.0, 1), (61.0, 2), (120.0, 3), (139.0, 3), (141.0, 4)])
def test_windows_cover_a_log_once_and_none_is_shorter_than_half(length_s: float, count: int) -> None:
    bounds = window_bounds(7, 7 + round(length_s * 1e9), 40.0)
    assert len(bounds) == count
    assert bounds[0][0] == 7
    assert bounds[-1][1] == 8 + round(length_s * 1e9)
    assert all(one[1] == other[0] for one, other in pairwise(bounds))
    assert count == 1 or all(stop - start >= 20e9 for start, stop in bounds)


def window(
    start: int, mass: tuple[float, float] | None = None, *, refused: str = "", surface: float | None = None
) -> Window:
    held = {} if mass is None else {MASS: mass}
    held |= {} if surface is None else {"x.x1.stiffness_n_per_m": (surface, 10.0)}
    return Window(start_s=60.0 * start, stop_s=60.0 * (start + 1), values=held, refused=refused)


def test_the_largest_set_that_agrees_gives_the_result_and_a_surface_may_be_another_one() -> None:
    windows = [
        window(0, (16.2, 0.01)),
        window(1, (11.3, 0.01)),
        window(2, (16.21, 0.01), surface=1e5),
        window(3, refused="no rests"),
        window(4, surface=2e5),
    ]
    assert most_telling(windows) == (0, 2, 4)


def test_a_surface_that_no_window_before_has_touched_is_named_once() -> None:
    surfaces = [None, 1e5, 1.05e5, 2e5, 1.01e5, 2.02e5]
    windows = [window(k, (16.2, 0.01), surface=each) for k, each in enumerate(surfaces)]
    assert new_surfaces(windows) == (
        "0:03:00 to 0:04:00: on axis x a surface of 200 N/mm is touched that no window before has touched (100 N/mm).",
    )
    assert "surface-within-log" in [each.code for each in window_findings(windows)]


def test_the_section_of_windows_and_its_chart_have_keys_of_their_own() -> None:
    section = window_section([window(k, (16.2, 0.01)) for k in range(4)])
    charts = [block.key for block in section.blocks if isinstance(block, Chart)]
    assert charts == ["window-parameters"]
    text = render_page(Page(title="a log", lead="", tone="good", sections=(section,), footer=""))
    assert "The log window by window" in text


def test_of_many_windows_those_that_say_most_are_taken() -> None:
    windows = [window(k, (16.2, 0.1 / (k + 1))) for k in range(12)]
    assert most_telling(windows) == tuple(range(4, 12))


def test_without_any_value_the_commonest_reason_is_given() -> None:
    with pytest.raises(EstimateError, match="Of 3 windows none identifies anything, 2 of them since: no rests"):
        most_telling([window(0, refused="no rests"), window(1, refused="no sweep"), window(2, refused="no rests")])


def test_windows_that_are_refused_alike_are_one_row() -> None:
    rows = window_rows([window(0, (16.2, 0.01)), *(window(k, refused="no rests") for k in (1, 2, 3))])
    assert [row[0] for row in rows] == ["0:00:00 to 0:01:00", "0:01:00 to 0:04:00 (3)"]
    assert rows[1][-1] == "no rests"


def test_pauses_of_the_recorder_are_counted_over_the_windows_that_are_used() -> None:
    paused = Window(start_s=0.0, stop_s=60.0, values={MASS: (16.2, 0.1)}, is_used=True, has_pauses=True)
    assert Window.from_tree(paused.tree()) == paused
    *_, said = window_findings([paused, replace(paused, is_used=False), replace(paused, has_pauses=False)])
    assert "Of 3 windows 2 give the result" in said.message
    assert "in 1 of those used the recorder paused" in said.message


def test_a_cell_without_windows_has_none(in_windows: Identification) -> None:
    assert windows_of({}) == ()
    tree = [each.tree() for each in windows_of(in_windows.provenance)]
    assert [Window.from_tree(each) for each in tree] == [*windows_of(in_windows.provenance)]
