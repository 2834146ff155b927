"""What is left of a damaged log: where its times count from, and when its last wrench is."""

from datetime import UTC, datetime

from ...result import Finding
from ...signals.recording import StampArray

_LATE_NS = 10**8


def start_left(start_ns: int, first_ns: int) -> tuple[Finding, ...]:
    """Report that wrench and pose of a damaged log begin at `first_ns`, well after its start; both as recorded."""
    if first_ns - start_ns < _LATE_NS:
        return ()
    return (
        Finding.warning(
            "start-lost",
            f"The first wrench and pose that are left were recorded {1e-9 * (first_ns - start_ns):.3f} s after the "
            "log's start: from there count the times of phases and contacts, --from and --to.",
            "Add that to compare them with the times of another reading of the log.",
        ),
    )


def span_left(name: str, stamp_ns: StampArray) -> tuple[Finding, ...]:
    """Report from when to when a salvaged log still holds a wrench, by its stamps (n,)."""
    first, last = (int(stamp_ns[i]) for i in (0, -1))
    ends = datetime.fromtimestamp(last // 10**9, tz=UTC)
    return (
        Finding.warning(
            "salvaged-span",
            f"What is left of {name} spans {1e-9 * (last - first):.3f} s: the last wrench is stamped "
            f"{ends:%Y-%m-%d %H:%M:%S}.{last // 10**6 % 1000:03d} UTC.",
            "What was recorded after that, if anything, is not in the result.",
        ),
    )
