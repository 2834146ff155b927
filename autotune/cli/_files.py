"""File names on the command line, completed by kind."""

from pathlib import Path
from typing import Any

import click
from click.shell_completion import BashComplete, CompletionItem, add_completion_class

SETTINGS = (".yaml", ".yml")
LOGS = (".mcap", ".bag", ".db3", ".csv", ".parquet")
KEYS = (".pem", ".pub", ".key")


class FilePath(click.Path):
    """A file whose name ends in one of `endings`; the shell proposes those, and folders on the way to them."""

    def __init__(self, *endings: str, **options: Any) -> None:
        super().__init__(path_type=Path, **{"dir_okay": False, **options})
        self.endings = endings

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the files of the kind that begin with `incomplete`, and leave the folders to the shell."""
        del ctx, param
        folder, _, begin = incomplete.rpartition("/")
        lead = incomplete[: len(incomplete) - len(begin)]
        where = Path(folder or ("/" if lead else ".")).expanduser()
        try:
            names = sorted(each.name for each in where.iterdir() if self._fits(each, begin))
        except OSError:
            names = []
        # The script for bash forgets what came before a folder, so that comes first.
        return [CompletionItem(incomplete, type="dir"), *(CompletionItem(lead + name) for name in names)]

    def _fits(self, path: Path, begin: str) -> bool:
        is_shown = begin.startswith(".") or not path.name.startswith(".")
        return is_shown and path.name.startswith(begin) and path.suffix.lower() in self.endings and path.is_file()


class BothComplete(BashComplete):
    """Completion for bash that proposes folders beside names, where click's own would do so instead of them."""

    # As file names, a blank in one of them is quoted.
    source_template = BashComplete.source_template.replace("compopt -o dirnames", "compopt -o plusdirs -o filenames")


def register() -> None:
    """Let bash be completed by `BothComplete`."""
    add_completion_class(BothComplete, "bash")
