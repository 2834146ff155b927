"""What is said of header stamps."""

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.logs.stamps import report_stamps, stamp_faults
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
    assert report.rate_hz == pytest.approx(1250.0, rel=1e-12)
    assert report.jitter_std_s == report.jitter_worst_s == 0.0


@pytest.mark.parametrize(("missing", "lost", "first"), [([100], 1, "0.079"), ([500, 501, 502, 900], 4, "0.399")])
def test_lost_messages_are_counted_and_told_with_their_time(missing: list[int], lost: int, first: str) -> None:
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


def test_jitter_is_measured_and_told() -> None:
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
