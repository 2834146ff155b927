"""A dictionary that cannot be changed, for the fields of frozen records: it compares, copies and pickles as one."""

from collections.abc import Iterable, Mapping
from typing import Any, NoReturn, TypeVar

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class FrozenDict(dict[_Key, _Value]):
    """A dictionary whose items are those it was made of; whatever would change it raises TypeError.

    Unlike `types.MappingProxyType` it is a copy, and `pickle`, `copy.deepcopy` and `dataclasses.asdict` take it.
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


def freeze(record: object, *names: str) -> None:
    """Replace mappings in the fields `names` of a frozen dataclass by frozen copies, in its `__post_init__`."""
    for name in names:
        content: Mapping[Any, Any] | Iterable[tuple[Any, Any]] = getattr(record, name)
        object.__setattr__(record, name, FrozenDict(content))
