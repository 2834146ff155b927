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


class PayloadChangedError(LogError):
    """Payload or bias changed within the log, `time_s` after its first sample at `start_ns`; `what` says how.

    Before and after that the log can be used.
    """

    kind = LogError.__name__

    def __init__(self, what: str, advice: str, start_ns: int, time_s: float) -> None:
        super().__init__(f"{what} {advice}")
        self.what, self.advice, self.start_ns, self.time_s = what, advice, start_ns, time_s

    @property
    def stamp_ns(self) -> int:
        """The stamp of the change."""
        return self.start_ns + round(1e9 * self.time_s)

    def __reduce__(self) -> tuple[type["PayloadChangedError"], tuple[str, str, int, float]]:
        """Pickle by what the constructor takes, for errors that pass from process to process."""
        return PayloadChangedError, (self.what, self.advice, self.start_ns, self.time_s)


class EstimateError(AutotuneError):
    """The log is sound but does not show what was asked of it."""


class FewPosesError(EstimateError):
    """The tool rests in too few orientations to separate the payload's weight from the sensor's bias."""

    kind = EstimateError.__name__


def listed(names: Iterable[object], *, empty: str = "none") -> str:
    """Return the first ten names with commas between, and how many more there are; `empty` where there is none."""
    texts = [str(name) for name in names]
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f", … and {more} more" if more > 0 else "") or empty
