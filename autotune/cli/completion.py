"""`autotune completion`: the script that teaches a shell to complete commands, options and file names."""

import click

from ._options import GroupedCommand

COMPLETE_VARIABLE = "_AUTOTUNE_COMPLETE"
_EPILOG = """\b
Examples:
  autotune completion bash > ~/.local/share/bash-completion/completions/autotune
  autotune completion zsh > ~/.zfunc/_autotune
  autotune completion fish > ~/.config/fish/completions/autotune.fish

\b
For zsh, ~/.zfunc must be on fpath before compinit: fpath+=~/.zfunc in ~/.zshrc. Files are proposed by kind: yaml
where a controller or an identified cell is meant, logs where a log is.
"""


@click.command(cls=GroupedCommand, epilog=_EPILOG)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print the completion script for a shell.

    Put the script where the shell looks for completions, or evaluate it in the shell's start-up file.
    """
    from click.shell_completion import get_completion_class

    from ._options import register

    register()
    complete = get_completion_class(shell)
    if complete is None:
        raise click.UsageError(f"click knows no completion for {shell!r}; choose bash, zsh or fish.")
    root = context.find_root()
    click.echo(complete(root.command, {}, "autotune", COMPLETE_VARIABLE).source())
