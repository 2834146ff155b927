"""Names out of a log or a file, told in a message that stays readable however many there are."""

from collections.abc import Iterable

MOST_TOLD = 10


def listed(names: Iterable[object], *, empty: str = "none") -> str:
    """Return the first ten names with commas between, and how many more there are; `empty` where there is none."""
    told = [str(name) for name in names]
    more = len(told) - MOST_TOLD
    return ", ".join(told[:MOST_TOLD]) + (f", … and {more} more" if more > 0 else "") or empty
