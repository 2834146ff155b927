"""Turn frozen dataclasses into plain trees and back: field by field, names kept, fields at their default left out."""

import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from problems.errors import ParameterError
from problems.frozen import FrozenDict
from problems.model.axis_kind import rotational_name
from problems.model.plant_parameters import PARAMETERS

from .canonical import Place, plain, spell
from .units import ROTATIONAL_AXES

_Record = TypeVar("_Record")

_RENAMED = (
    *PARAMETERS,
    *("stiffness_n_per_m", "secant_stiffness_n_per_m", "relaxed_stiffness_n_per_m"),
    *("damping_n_s_per_m", "impact_n_s_per_m", "mass_kg", "hand_mass_kg"),
    *("force_n", "speed_m_s", "approach_force_n", "approach_speed_m_s", "force_noise_rms_n", "max_speed_rms_m_s"),
    "position_noise_rms_m",
    *("peak_force_n", "peak_sensor_force_n", "peak_contact_force_n", "max_peak_force_n", "peak_with_common_n"),
    *("cost_n", "soft_n", "min_m_s_per_n", "hand_force_n_per_m_s", "coupling_friction_n", "max_force_n"),
)
ROTATIONAL_KEYS: Mapping[str, str] = FrozenDict(
    {key: rotational_name(key) for key in _RENAMED if rotational_name(key) != key}
)
"""What a key of a translational axis is called on a rotational one (rad, N·m, kg·m²)."""

_TRANSLATIONAL_KEYS = {rotational: key for key, rotational in ROTATIONAL_KEYS.items()}


def record_tree(record: object, name: str = "") -> Any:
    """Return the plain tree of a dataclass; a field that has a default and equals it, or is not compared, is left out.

    Raises ParameterError, with the path of the entry, when a number is not finite or something has no plain form.
    """
    if is_dataclass(record) and not isinstance(record, type):
        pairs = ((field, getattr(record, field.name)) for field in fields(record))
        return {
            field.name: record_tree(value, f"{name}.{field.name}")
            for field, value in pairs
            if field.compare and (field.default is MISSING or value != field.default)
        }
    if isinstance(record, Mapping):
        return {str(key): record_tree(value, f"{name}.{key}") for key, value in record.items()}
    if isinstance(record, tuple | list):
        return [record_tree(item, f"{name}[{index}]") for index, item in enumerate(record)]
    return plain(record, name.lstrip("."))


class EntryError(ParameterError):
    """An entry of a tree that a record refuses; `place` is its path."""

    def __init__(self, place: Place, refusal: ParameterError) -> None:
        super().__init__(spell(place), refusal.value, refusal.must)
        self.place = place


def read_record(kind: type[_Record], tree: Mapping[str, Any], place: Place = ()) -> _Record:
    """Return the dataclass `kind` that `tree` holds; the tree must satisfy the schema of `kind`.

    Raises EntryError when the dataclass refuses a value.
    """
    hints = get_type_hints(kind)
    arguments = {key: _read(hints[key], value, (*place, key)) for key, value in tree.items()}
    try:
        return kind(**arguments)
    except ParameterError as refusal:
        raise EntryError((*place, *refusal.name.split(".")), refusal) from refusal


def _read(hint: Any, value: Any, place: Place) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (types.UnionType, Union):
        return None if value is None else _read(_option(arguments, value), value, place)
    if origin is tuple:
        kinds = (arguments[0],) * len(value) if arguments[-1] is Ellipsis else arguments
        parts = enumerate(zip(kinds, value, strict=True))
        return tuple(_read(item, part, (*place, index)) for index, (item, part) in parts)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: _read(arguments[1], part, (*place, key)) for key, part in value.items()}
    if is_dataclass(hint) and isinstance(hint, type):
        return read_record(hint, value, place)
    return hint(value) if isinstance(hint, type) and issubclass(hint, int | float | Enum) else value


def _option(options: tuple[Any, ...], value: Any) -> Any:
    """Choose the member of a union that `value` is written as."""
    if isinstance(value, bool):
        return bool
    if isinstance(value, int | float):
        return int if int in options and value == int(value) else float
    if isinstance(value, str):
        return next((option for option in options if isinstance(option, type) and issubclass(option, Enum)), str)
    records = [option for option in options if is_dataclass(option) or get_origin(option) is not None]
    fitting = (
        option
        for option in records
        if not is_dataclass(option) or set(value) <= {field.name for field in fields(option)}
    )
    return next(fitting, records[0])


def rename_axis_keys(axis: str, tree: Any, *, reading: bool) -> Any:
    """Rename the keys of one axis subtree to the axis's units, or with `reading` back to those of a translation."""
    if axis not in ROTATIONAL_AXES:
        return tree
    return _rename(tree, _TRANSLATIONAL_KEYS if reading else ROTATIONAL_KEYS)


def _rename(tree: Any, names: Mapping[str, str]) -> Any:
    if isinstance(tree, Mapping):
        return {names.get(key, key): _rename(value, names) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_rename(item, names) for item in tree]
    return tree
