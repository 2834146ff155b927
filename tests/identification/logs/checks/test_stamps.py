"""What is said of header stamps."""

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.logs.checks.stamps import report_stamps, stamp_faults, with_holes_once
from identification.result import Finding

Stamps = NDArray[np.int64]
PERIOD_NS = 800_000


def clock(count: int = 1000) -> Stamps:
    stamps: Stamps = 10**18 + PERIOD_NS * np.arange(count, dtype=np.int64)
    return stamps


def seconds(indices: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(indices * (PERIOD_NS * 1e-9), dtype=np.float64)


def faults(stamps: Stamps) -> list[Finding]:
    return list(stamp_faults("/ft", stamps, seconds(np.arange(len(stamps)))))


def test_a_regular_clock_has_no_fault() -> None:
    assert faults(clock()) == []
    report = report_stamps(clock())
    assert (report.count, report.lost, report.gaps) == (1000, 0, ())
    assert report.period_s == pytest.approx(1.0 / 1250.0, rel=1e-12)
    assert report.jitter_std_s == report.jitter_worst_s == 0.0


@pytest.mark.parametrize(("missing", "lost", "first"), [([100], 1, "0.079"), ([500, 501, 502, 900], 4, "0.399")])
def test_lost_messages_are_counted_and_reported_with_their_time(missing: list[int], lost: int, first: str) -> None:
    kept = np.delete(np.arange(1000), missing)
    (found,) = list(stamp_faults("/ft", clock()[kept], seconds(kept)))
    assert (found.code, found.severity) == ("dropped-samples", "warning")
    assert f"lacks about {lost} messages" in found.message
    assert f"the first {first} s" in found.message


def test_a_hole_of_more_than_twelve_periods_makes_the_channel_unusable() -> None:
    for count, severity in ((11, "warning"), (12, "error")):
        (found,) = faults(np.delete(clock(), np.arange(300, 300 + count)))
        assert (found.code, found.severity) == ("dropped-samples", severity)


def test_late_messages_are_jitter_and_not_lost() -> None:
    stamps = clock()
    stamps[100::50] += int(0.7 * PERIOD_NS)
    report = report_stamps(stamps)
    assert report.lost == 0
    assert report.jitter_worst_s == pytest.approx(0.7 * PERIOD_NS * 1e-9, rel=1e-9)


def test_jitter_is_measured_and_reported() -> None:
    rng = np.random.default_rng(0)
    stamps = clock(20_000) + rng.integers(-150_000, 150_001, 20_000)
    # A step is the difference of two uniform errors: its deviation is 0.3 ms/√6, here from 20 000 samples.
    assert report_stamps(stamps).jitter_std_s == pytest.approx(3e-4 / np.sqrt(6.0), rel=0.02)
    (found,) = faults(stamps)
    assert (found.code, found.severity) == ("stamp-jitter", "warning")
    # A tenth of that is what any driver does.
    assert faults(clock(20_000) + rng.integers(-15_000, 15_001, 20_000)) == []


@pytest.mark.parametrize(
    ("stamps", "code"),
    [
        (np.zeros(5, dtype=np.int64), "constant-stamps"),
        (np.full(5, 10**18), "constant-stamps"),
        (np.concatenate([[0], clock(9)]), "zero-stamps"),
        (clock(10)[[0, 1, 2, 1, 2, 3, 4]], "backwards-stamps"),
        (clock(10)[[0, 1, 2, 2, 3]], "duplicate-stamps"),
        (clock(1), "too-few-messages"),
    ],
)
def test_stamps_that_are_no_clock_are_errors(stamps: Stamps, code: str) -> None:
    found = {each.code: each for each in faults(stamps)}
    assert found[code].severity == "error"
    assert "/ft" in found[code].message


def test_a_clock_set_back_is_named_before_the_stamps_that_it_repeats() -> None:
    raw = clock(3000)
    raw[1000:] -= 375 * PERIOD_NS
    (found,) = faults(raw)
    assert (found.code, found.severity) == ("backwards-stamps", "error")
    assert "go backwards, the first 0.800 s after the start of the log, by up to 0.299200 s" in found.message


@pytest.mark.parametrize("shift_ns", [375 * PERIOD_NS, 375 * PERIOD_NS + PERIOD_NS // 3])
def test_a_clock_set_back_is_named_where_the_recording_clock_went_back_too(shift_ns: int) -> None:
    """In the order of the recording clock the two halves interleave: duplicates, or steps shorter than a period."""
    raw = clock(3000)
    raw[1000:] -= shift_ns
    stamps = np.sort(raw)
    (found,) = list(stamp_faults("/ft", stamps, (stamps - stamps[0]) * 1e-9))
    assert (found.code, found.severity) == ("backwards-stamps", "error")
    message = float(found.message.split("about ")[1].split(" s")[0])
    # From the first message repeated to the last: up to two periods are not seen, and the time is stated in ms.
    assert message == pytest.approx(shift_ns * 1e-9, abs=3.0 * PERIOD_NS * 1e-9)
    assert "from 0.499 to 0.8" in found.message


def test_a_topic_that_is_published_twice_repeats_and_does_not_go_back() -> None:
    assert [each.code for each in faults(np.repeat(clock(), 2))] == ["duplicate-stamps"]


def test_what_was_held_up_did_not_go_back() -> None:
    stamps = clock()
    # Twenty periods late, the backlog comes at half the period.
    stamps[300:340] = stamps[340] - PERIOD_NS // 2 * np.arange(40, 0, -1)
    assert [each.code for each in faults(stamps)] == ["dropped-samples"]


def test_a_long_gap_of_a_salvaged_log_is_a_hole_reported_with_its_place() -> None:
    kept = np.delete(np.arange(1000), [*range(300, 400), 700])
    hole, lost = list(stamp_faults("/ft", clock()[kept], seconds(kept), keeps_holes=True))
    assert (hole.code, hole.severity) == ("hole", "warning")
    assert "0.081 s from 0.239 s" in hole.message
    assert (lost.code, lost.severity) == ("dropped-samples", "warning")
    assert "lacks about 1 messages in 1 gaps" in lost.message


def test_topics_with_the_same_holes_are_named_in_one_warning() -> None:
    def holes(topic: str, *lost: range) -> Finding:
        kept = np.delete(np.arange(1000), np.concatenate(lost))
        return next(stamp_faults(topic, clock()[kept], seconds(kept), keeps_holes=True))

    other = Finding.info("other", "Something else.", "")
    found = with_holes_once(
        [holes("/ft", range(300, 400)), other, holes("/pose", range(302, 405)), holes("/gains", range(800, 850))]
    )
    assert [each.code for each in found] == ["hole", "other", "hole"]
    assert found[0].message.startswith("Topics /ft, /pose have 1 hole(s)")
    # From the last message before of one to the first behind of the other.
    assert "0.085 s from 0.239 s" in found[0].message
    assert found[2].message.startswith("Topic /gains has 1 hole(s)")
