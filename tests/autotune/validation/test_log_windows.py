"""Contacts of a long log, compared window by window: those of the log as a whole, each once."""

from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from autotune.simulation.simulate import made_later, simulate_cell
from autotune.simulation.write import write_mcap
from autotune.validation import log_windows
from autotune.validation.against_log import LogComparison
from autotune.validation.log_windows import compare_with_logs
from identification.errors import LogError
from identification.logs import long_logs, read
from identification.logs.read import LogSpan
from identification.signals.recording import Recording, join_recordings
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import small_controller

from .test_against_log import PROGRAM, certified_cell, recorded

LATER_S = 20.8
"""One period after the end of a recording, so that nothing is missing between it and the next."""


def written(path: Path, *parts: Recording) -> Path:
    assert (parts[0].wrench.stamp_ns[-1] - parts[0].wrench.stamp_ns[0]) * 1e-9 + 8e-4 == pytest.approx(LATER_S)
    write_mcap(join_recordings([made_later(each, k * LATER_S / 3600.0) for k, each in enumerate(parts)]), path)
    return path


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings with two contacts each; the second has no poses that show the weight."""
    contacts = simulate_cell(certified_cell(), replace(PROGRAM, pose_count=1, contact_count=3), seed=8).recording
    return written(tmp_path_factory.mktemp("long") / "day.mcap", recorded(), contacts)


@pytest.fixture(scope="module")
def whole(long_log: Path) -> LogComparison:
    return compare_with_logs(small_controller(), [long_log])


def shorten(patch: pytest.MonkeyPatch, width_s: float) -> None:
    for module in (read, long_logs):
        patch.setattr(module, "LONGEST_WHOLE_S", 5.0)
    patch.setattr(read, "LARGEST_WHOLE_BYTES", 1_000_000)
    patch.setattr(long_logs, "WINDOW_S", width_s)
    patch.setattr(log_windows, "_OVERLAP_S", 3.0)


@pytest.mark.parametrize("width_s", [11.0, 14.5, 30.0])
def test_windows_hold_the_contacts_of_the_whole_log_each_once(
    long_log: Path, whole: LogComparison, width_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, width_s)
    shares: list[float] = []
    found = compare_with_logs(small_controller(), [long_log], progress=shares.append)
    assert sum(shares) == pytest.approx(1.0)
    assert len(whole.contacts) == 5
    assert [each.onset_s for each in found.contacts] == pytest.approx(
        [each.onset_s for each in whole.contacts], abs=0.01
    )
    for one, other in zip(found.contacts, whole.contacts, strict=True):
        # Where the file weighs, and where the rest before a contact does, differ by what the sensor drifts and rings.
        assert one.measured_peak_n == pytest.approx(other.measured_peak_n, rel=0.005)
        assert one.predicted_peak_n == pytest.approx(other.predicted_peak_n, rel=0.02)
        assert one.desired_force_n == pytest.approx(other.desired_force_n, rel=0.005)
    assert found.is_weighed


def test_damage_of_a_log_is_a_note_and_what_is_left_of_a_cut_one_is_compared_with_salvage(
    long_log: Path, whole: LogComparison, tmp_path: Path
) -> None:
    path, data = tmp_path / "run.mcap", bytearray(long_log.read_bytes())
    with long_log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    start = min(each.message_start_time for each in summary.chunk_indexes)
    onset = start + 1e9 * whole.contacts[3].onset_s
    hit = next(each for each in summary.chunk_indexes if each.message_start_time <= onset < each.message_end_time)
    data[hit.chunk_start_offset + hit.chunk_length // 2] ^= 0x10
    path.write_bytes(data)
    beside = compare_with_logs(small_controller(), [path])
    assert beside.notes[0].startswith(f"run.mcap is damaged: bytes {hit.chunk_start_offset} to ")
    peaks = [each.measured_peak_n for each in whole.contacts]
    kept = [min(peaks, key=lambda peak: abs(peak - each.measured_peak_n)) for each in beside.contacts]
    assert 0 < len(kept) < len(peaks)
    assert [each.measured_peak_n for each in beside.contacts] == pytest.approx(kept, rel=1e-3)
    path.write_bytes(long_log.read_bytes()[: hit.chunk_start_offset + 100])
    with pytest.raises(LogError, match="--salvage"):
        compare_with_logs(small_controller(), [path])
    cut = compare_with_logs(small_controller(), [path], salvage=True)
    assert [each.measured_peak_n for each in cut.contacts] == pytest.approx(peaks[: len(cut.contacts)], rel=0.005)
    assert 0 < len(cut.contacts) < 4
    assert "the end was cut off" in cut.notes[0]


def test_a_part_of_a_long_log_holds_the_contacts_in_it(
    long_log: Path, whole: LogComparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, 11.0)
    found = compare_with_logs(small_controller(), [long_log], span=LogSpan(start=LATER_S))
    assert len(found.contacts) == 3
    first = found.contacts[0].onset_s - whole.contacts[2].onset_s
    assert [each.onset_s - whole.contacts[2 + k].onset_s for k, each in enumerate(found.contacts)] == pytest.approx(
        [first] * 3, abs=0.01
    )


def test_windows_under_another_controller_are_named_and_all_of_them_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, LATER_S)
    law = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=900.0)
    other = simulate_cell(certified_cell(controller=law), PROGRAM, seed=6).recording
    found = compare_with_logs(small_controller(), [written(tmp_path / "both.mcap", recorded(), other)])
    assert len(found.contacts) == 2
    (note,) = found.notes
    assert note.startswith("nothing compared in 0:00:21 to 0:00:42: The log was")
    assert "recorded with another controller" in note
    with pytest.raises(LogError, match="recorded with another controller"):
        compare_with_logs(small_controller(), [written(tmp_path / "other.mcap", other, other)])


def test_of_a_long_log_only_the_strongest_contacts_keep_their_traces(
    long_log: Path, whole: LogComparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A day has thousands of contacts, and a picture shows a few."""
    monkeypatch.setattr(log_windows, "MOST_DRAWN", 1)
    shorten(monkeypatch, 18.0)
    found = compare_with_logs(small_controller(), [long_log])
    assert len(found.contacts) == len(whole.contacts)
    assert [each.share_inside for each in found.contacts] == pytest.approx(
        [each.share_inside for each in whole.contacts]
    )
    traced = [each.measured_peak_n for each in found.contacts if each.trace is not None]
    assert 1 <= len(traced) <= 2  # the strongest may be one that two windows share
    assert max(each.measured_peak_n for each in found.contacts) in traced
    assert all(each.trace is not None for each in whole.contacts)
