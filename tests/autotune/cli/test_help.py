"""What `--help` teaches: examples that the command takes, options under headings."""

import importlib
import inspect
import re
import shlex
from pathlib import Path

import click
import pytest

from autotune.cli._options import GroupedCommand
from autotune.cli.main import COMMANDS, build_cli

NAMES = [name for name in COMMANDS if name != "completion"]


def command_of(name: str) -> click.Command:
    found = importlib.import_module(COMMANDS[name].module).command
    assert isinstance(found, click.Command)
    return found


def examples_in(text: str) -> list[list[str]]:
    """Return the command lines of a text as the shell would split them; what goes to a file is cut off."""
    found = []
    for line in re.findall(r"^\s*(?:\w+:\s+)?(autotune .*)$", text, re.MULTILINE):
        for part in re.split(r"&&|\|", line.partition(" #")[0]):
            words = shlex.split(part.partition(" > ")[0])
            found.append(words[1:])
    return found


def parse(words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command of an example take its words: types, ranges and callbacks included; nothing is run."""
    monkeypatch.chdir(folder)
    command = command_of(words[0])
    command.make_context(words[0], list(words[1:]))


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_example_is_taken_as_it_stands(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    examples = examples_in(command_of(name).epilog or "")
    assert len(examples) >= 2
    assert {words[0] for words in examples} == {name}
    for words in examples:
        parse(words, tmp_path, monkeypatch)


def test_the_examples_of_the_whole_and_of_the_pages_are_taken(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = [repository / "README.md", *sorted((repository / "docs").glob("*.md"))]
    texts = [build_cli().epilog or ""]
    texts += ["\n".join(re.findall(r"```\w*\n(.*?)```", p.read_text(encoding="utf-8"), re.DOTALL)) for p in pages]
    examples = [words for text in texts for words in examples_in(text.replace("\\\n", " ")) if words[0] in COMMANDS]
    assert len(examples) > 20
    for words in examples:
        parse(words, tmp_path, monkeypatch)


def test_a_wrong_example_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (["optimize", "identified.yaml", "--payload", "10:22,x"], ["plan", "--poses", "25"]):
        with pytest.raises(click.UsageError):
            parse(words, tmp_path, monkeypatch)


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_option_stands_once_and_under_one_heading(name: str) -> None:
    command = command_of(name)
    context = click.Context(command, info_name=name, terminal_width=100)
    text = command.get_help(context)
    listed = re.findall(r"^  (?:-\w, )?(--[\w-]+)", text, re.MULTILINE)
    declared = [each.opts[-1] for each in command.get_params(context) if isinstance(each, click.Option)]
    assert sorted(listed) == sorted(declared)
    assert isinstance(command, GroupedCommand)
    grouped = [each for names in command.groups.values() for each in names]
    assert len(grouped) == len(set(grouped))
    assert listed[-1] == "--help"


def test_a_group_of_an_option_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="no option mass"):
        GroupedCommand("tiny", params=[click.Option(["--payload"])], groups={"Of the payload": ["mass"]})


@pytest.mark.parametrize("name", NAMES)
def test_the_help_fits_eighty_columns_but_for_examples(name: str) -> None:
    command = command_of(name)
    output = command.get_help(click.Context(command, info_name=name, terminal_width=80)).partition("Examples:")[0]
    # One word that is longer than a line cannot be split.
    assert [line for line in output.splitlines() if len(line) > 80 and " " in line.strip()] == []
    assert inspect.cleandoc(command.help or "")
