"""What came of a campaign, in words for people."""

from collections.abc import Iterable, Sequence
from typing import TypeVar

from autotune.drift import parameter_text

from .fleet import Unusual, changes, unusual
from .work import RunOutcome

_MOST_NAMES = 3
_Said = TypeVar("_Said")


def outcome_text(outcomes: Sequence[RunOutcome]) -> str:
    """Say in a sentence what came of a campaign."""
    refused = sum(bool(each.refused) for each in outcomes)
    broken = len({each.cell for each in outcomes if each.outside})
    cells = len({each.cell for each in outcomes})
    parts = [f"{counted(len(outcomes), 'run')} of {counted(cells, 'cell')}", f"{refused} refused"]
    if any(each.outside is not None for each in outcomes):
        parts.append(f"{counted(broken, 'certificate')} no longer valid")
    changed, odd = len(changes(outcomes)), len(unusual(outcomes))
    return f"{', '.join(parts)}; {counted(changed, 'change')} from run to run, {counted(odd, 'unusual value')}."


def left_text(left: int, count: int) -> str:
    """Say how many runs of a campaign are to be done, where some are done already."""
    runs, key = f"of {counted(count, 'run')}", "done with these inputs, options and version."
    return f"{left} {runs} to do: {count - left} are {key}" if left else f"Nothing to do: {count} {runs} {key}"


def runs_by_text(said: Iterable[tuple[str, _Said]]) -> dict[_Said, str]:
    """Return what is said of runs, each once and in its order, with their names, of many the first and how many more.

    Where runs share a file, such as that of a controller, the same is said of each.
    """
    found: dict[_Said, list[str]] = {}
    for name, what in said:
        found.setdefault(what, []).append(name)
    return {what: _named(names) for what, names in found.items()}


def _named(names: Sequence[str]) -> str:
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {counted(more, 'more run')}" if more > 0 else "")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def unusual_text(found: Unusual) -> str:
    """Say what is unlike the other cells in a sentence."""
    if not found.name:
        return (
            f"{found.cell}: its parameters together are unlike those of the other cells (squared distance "
            f"{found.value:.3g}, limit {found.median:.3g})."
        )
    label, unit, value, median = parameter_text(found.name, found.value, found.median)
    return f"{found.cell}: {label} is {value} {unit}, the cells' median {median}, {found.score:.1f} robust deviations."
