"""`problem.yaml`: what the user asks of the controller."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from autotune.errors import UsageError
from problems.contact import Approach
from problems.design import AdmittanceTarget, Objective, Requirements
from problems.errors import ParameterError

from .canonical import Place
from .schema import check_document
from .yaml12 import Document, load_document

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ProblemSpec:
    """Everything that `problem.yaml` may say; None or empty where it says nothing and the default holds."""

    axis: str | None = None
    bounds: Mapping[str, Interval] = field(default_factory=dict)
    approach: Approach | None = None
    environment_stiffness_n_per_m: Interval | None = None
    payload_mass_kg: Interval | None = None
    requirements: Requirements = field(default_factory=Requirements)
    objective: Objective = "contact_force"

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", MappingProxyType(dict(self.bounds)))


def read_problem(path: Path) -> ProblemSpec:
    """Read `problem.yaml`; raises UsageError with file, line and reason for anything unknown or out of range."""
    document = load_document(path, error=UsageError)
    check_document(document, "problem")
    tree = document.tree
    for place in _intervals(tree):
        _check_order(document, place)
    try:
        return ProblemSpec(
            axis=tree.get("axis"),
            bounds={name: _pair(value) for name, value in tree.get("bounds", {}).items()},
            approach=Approach(**tree["approach"]) if "approach" in tree else None,
            environment_stiffness_n_per_m=_optional_pair(tree.get("environment_stiffness_n_per_m")),
            payload_mass_kg=_optional_pair(tree.get("payload_mass_kg")),
            requirements=_requirements(tree.get("requirements", {})),
            objective=tree.get("objective", "contact_force"),
        )
    except ParameterError as error:
        raise UsageError(f"{path}: {error}") from error


def _requirements(tree: Mapping[str, Any]) -> Requirements:
    known = dict(tree)
    target = known.pop("free_space_admittance", False)
    if target is None:
        known["free_space_admittance"] = None
    elif target is not False:
        known["free_space_admittance"] = AdmittanceTarget(
            min_m_s_per_n=target["min_m_s_per_n"], band_hz=_pair(target["band_hz"])
        )
    return Requirements(**known)


def _intervals(tree: Mapping[str, Any]) -> list[Place]:
    places: list[Place] = [("bounds", name) for name in tree.get("bounds", {})]
    places += [(name,) for name in ("environment_stiffness_n_per_m", "payload_mass_kg") if name in tree]
    if (tree.get("requirements") or {}).get("free_space_admittance"):
        places.append(("requirements", "free_space_admittance", "band_hz"))
    return places


def _check_order(document: Document, place: Place) -> None:
    value: Any = document.tree
    for key in place:
        value = value[key]
    if value[0] > value[1]:
        document.refuse(place, f"{'.'.join(map(str, place))} must be [low, high], found {value[0]} above {value[1]}.")


def _pair(value: list[float]) -> Interval:
    return float(value[0]), float(value[1])


def _optional_pair(value: list[float] | None) -> Interval | None:
    return None if value is None else _pair(value)
