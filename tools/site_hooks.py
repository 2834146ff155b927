"""What the site of the pages adds while it is built: the help of every command, links into the source."""

import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
_MARK = "<!-- help of every command -->"


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    """Return a page's text with the commands' help at its mark, and links out of the folder leading to the source."""
    del files
    if page.file.src_uri == "commands.md":
        if _MARK not in markdown:
            raise ValueError(f"docs/commands.md must hold the mark {_MARK}, at which the help of the commands goes.")
        markdown = markdown.replace(_MARK, help_of_commands())
    return re.sub(r"\]\(\.\./([^)]+)\)", rf"]({config['extra']['source']}/blob/main/\1)", markdown)


def help_of_commands() -> str:
    """Return a section for each command, with what its `--help` prints at 100 columns."""
    sys.path.insert(0, str(ROOT))
    from autotune.cli.main import COMMANDS, PROGRAM, build_cli

    os.environ["NO_COLOR"] = "1"
    group = build_cli()
    sections = []
    with group.make_context(PROGRAM, [], resilient_parsing=True, terminal_width=100) as context:
        for name in COMMANDS:
            command = group.get_command(context, name)
            assert command is not None
            with command.make_context(name, [], parent=context, resilient_parsing=True) as inside:
                sections.append(f"## {name}\n\n```\n{command.get_help(inside).rstrip()}\n```\n")
    return "\n".join(sections)
