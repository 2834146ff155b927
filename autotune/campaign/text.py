"""What came of a campaign, in words for people."""

from collections.abc import Sequence

from autotune.formats.units import axis_units
from problems.model.axis_kind import for_people
from problems.model.plant_parameters import PARAMETERS

from .fleet import Change, Unusual, changes, unusual
from .work import RunOutcome

_MASS = "payload.mass_kg"


def outcome_text(outcomes: Sequence[RunOutcome]) -> str:
    """Say in a sentence what came of a campaign."""
    refused, broken = sum(bool(each.refused) for each in outcomes), sum(bool(each.outside) for each in outcomes)
    cells = len({each.cell for each in outcomes})
    parts = [f"{_counted(len(outcomes), 'run')} of {_counted(cells, 'cell')}", f"{refused} refused"]
    if any(each.outside is not None for each in outcomes):
        parts.append(f"{_counted(broken, 'certificate')} no longer valid")
    changed, odd = len(changes(outcomes)), len(unusual(outcomes))
    return f"{', '.join(parts)}; {_counted(changed, 'change')} from run to run, {_counted(odd, 'unusual value')}."


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def parameter_name(name: str) -> tuple[str, float, str]:
    """Return what a parameter is called for people, and factor and unit in which it is shown."""
    axis, _, key = name.rpartition(".")
    if name == _MASS:
        label, unit = "payload mass", "kg"
    elif key in PARAMETERS:
        label, unit = f"{axis}: {PARAMETERS[key].symbol}", axis_units(axis).unit(PARAMETERS[key].kind)
    else:
        label, unit = f"{axis.replace('.', ': ')}: K_e", axis_units(axis.partition(".")[0]).stiffness
    return label, *for_people(unit)


def parameter_text(name: str, *values: float) -> tuple[str, ...]:
    """Return a parameter's name for people, its unit, and the values in that unit."""
    label, scale, unit = parameter_name(name)
    return label, unit, *(f"{scale * value:.4g}" for value in values)


def change_text(change: Change) -> str:
    """Say what changed in a cell in a sentence."""
    label, unit, old, new = parameter_text(change.name, change.old, change.new)
    runs = f"{change.cell}: from {change.before} to {change.after}"
    return f"{runs}, {label} went from {old} to {new} {unit}, {change.stds:.1f} standard deviations."


def unusual_text(found: Unusual) -> str:
    """Say what is unlike the other cells in a sentence."""
    if not found.name:
        return (
            f"{found.cell}: its parameters together are unlike those of the other cells (squared distance "
            f"{found.value:.3g}, limit {found.median:.3g})."
        )
    label, unit, value, median = parameter_text(found.name, found.value, found.median)
    return f"{found.cell}: {label} is {value} {unit}, the cells' median {median}, {found.score:.1f} robust deviations."
