"""The one error tree of the project; every floor adds its own branches."""


class AutotuneError(Exception):
    """Base of every error that this project raises on purpose.

    The text is one sentence for the user: what must hold, what was found, what to do.
    Subclasses carry the numbers as attributes.
    """


class ParameterError(AutotuneError, ValueError):
    """A model parameter is outside the range in which the equations mean something."""

    def __init__(self, name: str, value: object, must: str) -> None:
        super().__init__(f"{name} must be {must}, found {value!r}.")
        self.name = name
        self.value = value
        self.must = must
