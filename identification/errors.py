"""Errors between a log and plant parameters, and the listing of names in their messages."""

from collections.abc import Iterable

from problems.errors import AutotuneError

MOST_LISTED = 10


class LogError(AutotuneError):
    """The log cannot be used: damaged, empty, wrong type, missing or ambiguous channel."""


class OutsideSpanError(LogError):
    """The log has nothing in the part that is to be read."""


class UntimedError(LogError):
    """A part is asked of a table whose time is not declared."""


class EstimateError(AutotuneError):
    """The log is sound but does not show what was asked of it."""


def listed(names: Iterable[object], *, empty: str = "none") -> str:
    """Return the first ten names with commas between, and how many more there are; `empty` where there is none."""
    texts = [str(name) for name in names]
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f", … and {more} more" if more > 0 else "") or empty
