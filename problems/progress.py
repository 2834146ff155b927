"""Progress of a long computation, reported as the share of the work that was done since the last call."""

from collections.abc import Callable

Progress = Callable[[float], None]
"""Takes the share of the whole work (0 to 1) that was done since the last call; the shares add up to 1 at the end."""


def no_progress(_: object) -> None:
    """Ignore a share of work, or the name of a step: the default where nobody waits."""


class ProgressSlice:
    """One part of a longer computation: shares of the part, passed on as shares of the whole.

    Parameters
    ----------
    progress
        Where shares of the whole are reported; None reports nowhere.
    share
        What the part counts for in the whole, 0 to 1. Never more than this is reported.

    """

    def __init__(self, progress: Progress | None = None, share: float = 1.0) -> None:
        self._progress, self._share, self._done = progress or no_progress, share, 0.0

    def __call__(self, done: float) -> None:
        """Report a share of the part that was done since the last call."""
        self.advance_to(self._done + done)

    def advance_to(self, done: float) -> None:
        """Report that a share of the part is done in all; what was reported before is not taken back."""
        done = min(done, 1.0)
        if done > self._done:
            step, self._done = done - self._done, done
            self._progress(step * self._share)

    def part(self, share: float) -> "ProgressSlice":
        """Return a part of this part, which counts for `share` of it."""
        return ProgressSlice(self, share)

    def finish(self) -> None:
        """Report whatever of the part was not reported yet."""
        self.advance_to(1.0)
