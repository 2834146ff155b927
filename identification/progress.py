"""How far a long computation is, told to whoever waits."""

from collections.abc import Callable

Reach = Callable[[float], None]


def unwatched(_: float) -> None:
    """Take a share that nobody waits for."""


class Progress:
    """Turn the shares of a piece of work that are reached, however often, into what was done since the last time."""

    def __init__(self, report: Callable[[float], None], size: float) -> None:
        """Tell `report` parts of `size`, what the whole piece counts for."""
        self._report, self._size, self._reached = report, size, 0.0

    def __call__(self, share: float) -> None:
        """Note that a share (0 to 1) of the piece is reached; what was reached before counts no more."""
        if share > self._reached:
            self._report((share - self._reached) * self._size)
            self._reached = share


def part_of(reach: Reach, start: float, stop: float) -> Reach:
    """Return what is told the shares reached of a part that lasts from one share of the whole to another."""
    return lambda share: reach(start + share * (stop - start))
