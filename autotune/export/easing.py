"""Find which easing of the requirements is enough for another controller's structure, as a part of `problem.yaml`.

The free-space admittance alone if that is enough, else all that are missed by what the nearest design misses; each was
met by numbers whose certificate holds.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.certificate_record import Requirement
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.plugins import find_requirement
from autotune.validation.law import LawCertificate
from problems.design.requirements import AdmittanceTarget

from .retune import ControllerStructure, nearest_design, retune

ADMITTANCE = "free_space_admittance"
# What is asked is easier by these shares than what was reached: our own law must reach it too, and a search again.
_EASIER = (0.03, 0.1, 0.2)
_DIGITS = 3
# A slow hand [m/s or rad/s], and by what factor less admittance makes leading by hand another thing.
_HAND_SPEED, _HEAVIER = 0.1, 3.0


@dataclass(frozen=True, kw_only=True)
class Easing:
    """Requirements of one axis that are enough to ease, by name as asked and eased, and what was found with them."""

    axis: str
    asked: Mapping[str, Requirement]
    eased: Mapping[str, Requirement]
    certificate: LawCertificate

    def __str__(self) -> str:
        said = " and ".join(f"{name} {to:g} instead of {asked:g}" for name, asked, to in self.relaxations())
        targets = [each.get(ADMITTANCE) for each in (self.asked, self.eased)]
        asked, eased = (each.min_m_s_per_n if isinstance(each, AdmittanceTarget) else None for each in targets)
        heavy = "" if asked is None or eased is None else heavier_hand(self.axis, asked, eased)
        return f"{said}, with which {heavy}" if heavy else said

    def relaxations(self) -> tuple[tuple[str, float, float], ...]:
        """Return name, asked and enough, as `InfeasibleError` holds them."""
        return tuple(
            (name, _threshold(name, self.asked[name]), _threshold(name, to)) for name, to in self.eased.items()
        )

    def tree(self) -> dict[str, Any]:
        """Return the part of `problem.yaml` that says so."""
        said = {name: record_tree(value, name) for name, value in self.eased.items()}
        tree = rename_axis_keys(self.axis, {"requirements": said}, reading=False)
        return {"rotational": tree} if self.axis in ROTATIONAL_AXES else tree


def heavier_hand(axis: str, asked: float, found: float) -> str:
    """Return what a hand needs in free space where the admittance [m/s/N] is far below what was asked, else ""."""
    if found * _HEAVIER >= asked:
        return ""
    units = axis_units(axis)
    forces = (_HAND_SPEED / each for each in (found, asked))
    needed, wanted = (f"{force:.0f}" if force >= 100.0 else f"{force:.3g}" for force in forces)
    return (
        f"a hand needs up to {needed} {units.force} at {_HAND_SPEED:g} {units.speed} instead of {wanted}: no longer "
        "hand guiding"
    )


def find_easing(structure: ControllerStructure) -> Easing | None:
    """Return an easing with which the structure has a design whose certificate holds; None where none was found."""
    task = structure.task
    for goal in (ADMITTANCE, None):
        if goal is not None and goal not in task.asked:
            continue
        ratios = nearest_design(structure, goal)
        if ratios is None:
            continue
        for share in _EASIER:
            eased = {
                name: _eased(name, task.asked[name], max(ratio, 1.0), share)
                for name, ratio in ratios.items()
                if ratio > 1.0 or goal is not None
            }
            easier = dataclasses.replace(task, asked={**task.asked, **eased})
            try:
                _, found = retune(easier, dataclasses.replace(structure, task=easier))
            except (InfeasibleError, CertificateError):
                continue
            return Easing(axis=task.axis, asked=task.asked, eased=eased, certificate=found)
    return None


def _threshold(name: str, asked: Requirement) -> float:
    requirement = find_requirement(name)
    assert requirement is not None  # it was evaluated
    return requirement.threshold(asked)


def _eased(name: str, asked: Requirement, ratio: float, share: float) -> Requirement:
    """Return what is asked with the threshold that was reached, easier by a share, three digits on that side."""
    requirement = find_requirement(name)
    assert requirement is not None  # it was evaluated
    upper, threshold = requirement.is_upper_limit, requirement.threshold(asked)
    reached = threshold * ratio * (1.0 + share) if upper else threshold / ratio * (1.0 - share)
    unit = 10.0 ** (math.floor(math.log10(reached)) - _DIGITS + 1)
    steps = math.ceil(reached / unit) if upper else math.floor(reached / unit)
    found: Requirement = requirement.with_threshold(asked, float(f"{steps * unit:.{_DIGITS}g}"))
    return found


def merged(easings: Sequence[Easing]) -> dict[str, Any]:
    """Return one part of `problem.yaml` for several axes; of two straight axes the easier number holds."""
    tree: dict[str, Any] = {}
    for each in easings:
        kind = each.axis in ROTATIONAL_AXES
        others = [other for other in easings if (other.axis in ROTATIONAL_AXES) == kind]
        easiest = {
            name: _easiest(name, [other.eased[name] for other in others if name in other.eased])
            for name in dict.fromkeys(name for other in others for name in other.eased)
        }
        tree |= dataclasses.replace(each, eased=easiest).tree()
    return tree


def _easiest(name: str, values: Sequence[Requirement]) -> Requirement:
    requirement = find_requirement(name)
    assert requirement is not None  # it was evaluated
    ordered = sorted(values, key=requirement.threshold)
    return ordered[-1] if requirement.is_upper_limit else ordered[0]


def easing_message(easings: Sequence[Easing]) -> str:
    """Return a sentence that names what is enough, and what was found with it."""
    found = (f"{each} (axis {each.axis}, with a peak force of {_peak(each):.4g})" for each in easings)
    return f"Enough would be: {'; '.join(found)}."


def _peak(each: Easing) -> float:
    assert each.certificate.worst is not None  # a certificate that holds has one
    return each.certificate.worst.peak_contact_force_n
