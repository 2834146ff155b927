"""The one error tree of the project; every floor adds its own branches."""

from importlib.util import find_spec
from typing import Any

_LONGEST_SHOWN = 100


class AutotuneError(Exception):
    """Base of every error that this project raises on purpose.

    The text is one sentence for the user: what must hold, what was found, what to do.
    Subclasses carry the numbers as attributes. `to_paste` are parts of the text that are commands, as they stand in it.
    """

    to_paste: tuple[str, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        # Constructors take other arguments than the sentence, which is all that an exception pickles by itself.
        return _restored, (type(self), self.args), vars(self)


def _restored(kind: type[AutotuneError], said: tuple[Any, ...]) -> AutotuneError:
    return kind.__new__(kind, *said)


def shown(value: object) -> str:
    """Return how a sentence names what was found: as Python writes it, what is longer than 100 characters by its type.

    A long text is cut.
    """
    text = repr(value)
    if len(text) <= _LONGEST_SHOWN and "\n" not in text:
        return text
    if isinstance(value, str):
        return f"{text[: _LONGEST_SHOWN - 2]} …"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


class ParameterError(AutotuneError, ValueError):
    """A model parameter is outside the range in which the equations mean something; `hint` ends the sentence."""

    def __init__(self, name: str, value: object, must: str, *, hint: str = "") -> None:
        super().__init__(f"{name} must be {must}, found {shown(value)}{hint}.")
        self.name = name
        self.value = value
        self.must = must


class MissingExtraError(AutotuneError):
    """An optional package is not installed; `extra` is the extra of this project that brings it."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(f"{what} needs {package}, which is not installed: pip install 'robot-autotune[{extra}]'.")
        self.package, self.extra = package, extra


def require_extra(what: str, package: str, extra: str) -> None:
    """Raise MissingExtraError where `package` is not installed."""
    if find_spec(package) is None:
        raise MissingExtraError(what, package, extra)
