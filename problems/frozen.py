"""Frozen records: dictionaries that cannot be changed, a short text of what was said, what a file asks of a field."""

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from typing import Annotated, Any, NoReturn, TypeVar

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class FrozenDict(dict[_Key, _Value]):
    """A dictionary whose items are those it was made of; whatever would change it raises TypeError.

    Unlike `types.MappingProxyType` it is a copy, can be hashed whatever its values are, and `pickle`, `copy.deepcopy`
    and `dataclasses.asdict` take it.
    """

    __slots__ = ()

    def _refuse(self, *_arguments: Any, **_named: Any) -> NoReturn:
        raise TypeError(f"{type(self).__name__} cannot be changed; make a new one from dict(...)")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self) -> tuple[type["FrozenDict[_Key, _Value]"], tuple[dict[_Key, _Value]]]:
        """Build it anew from an ordinary dictionary: item by item it cannot be filled."""
        return FrozenDict, (dict(self),)

    def __repr__(self) -> str:
        return dict.__repr__(self)

    def __hash__(self) -> int:  # type: ignore[override] # a frozen record that holds one is hashed
        # Equal ones have equal keys; values may be lists, as in a provenance.
        return hash(frozenset(self))


def freeze(record: object, *names: str) -> None:
    """Replace mappings in the fields `names` of a frozen dataclass by frozen copies, in its `__post_init__`."""
    for name in names:
        content: Mapping[Any, Any] | Iterable[tuple[Any, Any]] = getattr(record, name)
        object.__setattr__(record, name, FrozenDict(content))


def said_fields(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that are not at their defaults."""
    said = {}
    for each in fields(record):
        default = each.default if each.default_factory is MISSING else each.default_factory()
        value = getattr(record, each.name)
        if each.repr and value != default:
            said[each.name] = value
    return said


def short_repr(record: Any, name: str) -> str:
    """Return the `repr` of a dataclass under a name, with the fields that are not at their defaults alone."""
    return f"{name}({', '.join(f'{field}={value!r}' for field, value in said_fields(record).items())})"


class Rule(dict[str, Any]):
    """Words of JSON Schema that the schema of a file adds to the type of an entry, in `Annotated`.

    `turning` holds those that are others about rx, ry, rz, None where these have no such entry; `record` names a record
    that reads otherwise here. What a whole record is asked is its class variable `RULE`; a field with `NO_ENTRY` is in
    no file.
    """

    def __hash__(self) -> int:  # type: ignore[override] # the types of a union are hashed
        return hash(tuple(sorted(self)))


AboveZero = Annotated[float, Rule(exclusiveMinimum=0)]
NotNegative = Annotated[float, Rule(minimum=0)]
Count = Annotated[int, Rule(minimum=1)]
Text = Annotated[str, Rule(minLength=1)]
NO_ENTRY = Rule(entry=False)
"""Of a field that no file has an entry for."""
