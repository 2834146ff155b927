"""Requirements and objectives of this package and of others: the built-in ones, then what entry points register."""

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from autotune.errors import UsageError
from problems.design.evaluation import CustomRequirement
from problems.design.objectives import BUILT_IN as BUILT_IN_OBJECTIVES
from problems.design.objectives import Objective
from problems.design.requirements import BUILT_IN, FIELDS, Requirement, Requirements

OBJECTIVES = "autotune.objectives"
REQUIREMENTS = "autotune.requirements"


def load_requirement(name: str) -> Requirement[Any]:
    """Return the requirement of this name.

    Raises UsageError when there is none or more than one of that name, when it cannot be imported or made, or is no
    subclass of `Requirement`.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]
    found: Requirement[Any] = load_plugin(REQUIREMENTS, name, Requirement)
    return found


def find_requirement(name: str) -> Requirement[Any] | None:
    """Return the requirement of this name, None where none is installed; raises UsageError for one that fails."""
    return load_requirement(name) if name in BUILT_IN or name in registered(REQUIREMENTS) else None


def build_requirements(
    asked: Mapping[str, Any],
    soft_n: Mapping[str, float],
    *,
    without_defaults: bool = False,
    plugins: tuple[Requirement[Any], ...] = (),
) -> Requirements:
    """Return the requirements of what is asked by name; None asks for nothing.

    Raises UsageError for a name that is neither built in nor registered, ParameterError for a value out of range.
    `without_defaults` asks for nothing that is not said; `plugins` are requirements that are loaded already.
    """
    loaded = {each.name: each for each in plugins}
    fields = {name: asked.get(name) for name in FIELDS if without_defaults or name in asked}
    further = {name: value for name, value in asked.items() if name not in FIELDS and value is not None}
    return Requirements(
        **fields,
        further=further,
        plugins=tuple(loaded.get(name) or load_requirement(name) for name in further if name not in BUILT_IN),
        soft_n=soft_n,
    )


def load_objective(name: str) -> Objective:
    """Return the objective of this name; raises UsageError as `load_requirement` does."""
    if name in BUILT_IN_OBJECTIVES:
        return BUILT_IN_OBJECTIVES[name]
    found: Objective = load_plugin(OBJECTIVES, name, Objective)
    return found


def objective_names() -> tuple[str, ...]:
    """Return the names of all objectives, built in and installed."""
    return tuple(dict.fromkeys((*BUILT_IN_OBJECTIVES, *registered(OBJECTIVES))))


def load_plugin(group: str, name: str, kind: type) -> Any:
    """Import and make what an entry point registers; raises UsageError, see `load_requirement`."""
    known, what = registered(group), "requirement" if group == REQUIREMENTS else "objective"
    if name not in known:
        listed = ", ".join(sorted({*known, *(BUILT_IN if group == REQUIREMENTS else BUILT_IN_OBJECTIVES)})) or "none"
        raise UsageError(f"There is no {what} {name!r} installed; there are: {listed}.")
    entry = known[name]
    try:
        # Other people's code may raise anything.
        found = entry.load()
        plugin: Any = found() if isinstance(found, type) and issubclass(found, kind) else None
    except Exception as error:
        raise UsageError(f"The {what} {name} ({entry.value}) cannot be loaded: {error}.") from error
    if plugin is None or plugin.name != name:
        raise UsageError(
            f"The {what} {name} ({entry.value}) must be a subclass of autotune.studies.plugins.{kind.__name__} whose "
            f"name is {name!r}."
        )
    return plugin


def registered(group: str) -> Mapping[str, EntryPoint]:
    """Return what the installed packages register under `group`, by name; raises UsageError for a name given twice."""
    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda each: (each.name, each.value)):
        if entry.name in found and found[entry.name].value != entry.value:
            raise UsageError(
                f"Two installed packages register {entry.name} in {group}, {found[entry.name].value} and "
                f"{entry.value}; uninstall one."
            )
        found[entry.name] = entry
    return found


__all__ = [
    "OBJECTIVES",
    "REQUIREMENTS",
    "CustomRequirement",
    "build_requirements",
    "find_requirement",
    "load_objective",
    "load_plugin",
    "load_requirement",
    "objective_names",
    "registered",
]
