"""What can go wrong between a log and plant parameters."""

from collections.abc import Iterable

from problems.errors import AutotuneError

MOST_TOLD = 10


class LogError(AutotuneError):
    """The log cannot be used: damaged, empty, wrong type, missing or ambiguous channel."""


class EstimateError(AutotuneError):
    """The log is sound but does not tell what was asked of it."""


def listed(names: Iterable[object], *, empty: str = "none") -> str:
    """Return the first ten names with commas between, and how many more there are; `empty` where there is none."""
    told = [str(name) for name in names]
    more = len(told) - MOST_TOLD
    return ", ".join(told[:MOST_TOLD]) + (f", … and {more} more" if more > 0 else "") or empty
