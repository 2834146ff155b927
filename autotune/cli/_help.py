"""What `--help` looks like: options in groups, the width of the terminal, examples as they are typed."""

from collections.abc import Mapping, Sequence
from typing import Any

import click

from problems.frozen import FrozenDict

_WIDEST = 100
_COMMON = ("--json", "--quiet", "--debug", "--help")
_LAST = "Messages and output"


class GroupedCommand(click.Command):
    """A command whose help puts its options under headings.

    `groups` maps a heading to the names of its parameters; what is in none of them comes first, under "Options", and
    what every command has comes last, under "Messages and output". Raises ValueError for a name that is no option.
    """

    def __init__(self, name: str | None, *, groups: Mapping[str, Sequence[str]] | None = None, **options: Any) -> None:
        super().__init__(name, **options)
        self.context_settings = {"max_content_width": _WIDEST, **self.context_settings}
        self.groups = FrozenDict(groups or {})
        known = {parameter.name for parameter in self.params if isinstance(parameter, click.Option)}
        unknown = [name for names in self.groups.values() for name in names if name not in known]
        if unknown:
            raise ValueError(f"The command {self.name} has no option {unknown[0]}.")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups, each in the order in which its options were declared."""
        heading_of = {name: heading for heading, names in self.groups.items() for name in names}
        sections: dict[str, list[tuple[str, str]]] = {heading: [] for heading in ("Options", *self.groups, _LAST)}
        for option in (each for each in self.get_params(ctx) if isinstance(each, click.Option)):
            record = option.get_help_record(ctx)
            heading = _LAST if option.opts[-1] in _COMMON else heading_of.get(option.name or "", "Options")
            if record is not None:
                sections[heading].append(record)
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)
