"""Options that are a number with or without its unit."""

from typing import Any

import click


class QuantityRange(click.FloatRange):
    """A number of a kind (`autotune.quantity`) between bounds in SI."""

    def __init__(self, kind: str, *, least: float, most: float) -> None:
        super().__init__(min=least, max=most)
        self.kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number in SI, inside the bounds."""
        from autotune.quantity import parse_quantity

        if isinstance(value, str):
            try:
                value = parse_quantity(value, self.kind).value
            except ValueError as error:
                self.fail(str(error), param, ctx)
        return super().convert(value, param, ctx)
