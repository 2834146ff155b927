"""A file of another kind, or none, is noticed before any work, with the command that it is for."""

import sys
from pathlib import Path

import pytest

from autotune.cli import _common, _terminal
from autotune.cli._terminal import Screen
from autotune.cli.main import main

FILES = {
    "cell.yaml": b"format: autotune/cell\nversion: 1\n",
    "run 7.mcap": b"\x89MCAP0\r\n rest",
    "run.bag": b"#ROSBAG V2.0\n",
    "identified.yaml": b"format: autotune/identified\nversion: 1\n",
    "controller.json": b'{\n  "format": "autotune/controller",\n',
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, head in FILES.items():
        Path(name).write_bytes(head)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (
            ["optimize", "run 7.mcap"],
            2,
            "is a log, not an identified plant or a plant: run `autotune identify 'run 7.mcap'`.",
        ),
        (
            ["validate", "identified.yaml"],
            2,
            "is an identified plant, not a controller or a schedule: run",
        ),
        (["inspect", "controller.json"], 2, "is a controller, not a log: run `autotune validate controller.json`."),
        (["validate", "controller.json", "--log", "none.mcap"], 3, "none.mcap cannot be read: No such file"),
        (["optimize", "identified.yaml", "--compare", "run.bag"], 2, "is a log, not a controller or a cell.yaml"),
        (["optimize", "identified.yaml", "--compare", ""], 2, "found an empty text"),
        (
            ["optimize", "cell.yaml"],
            2,
            "is a description of a cell, not an identified plant or a plant: run `autotune identify LOG --cell ",
        ),
        (["optimize", "none.yaml"], 2, "none.yaml cannot be read: No such file"),
        (["optimise", "identified.yaml"], 2, "Did you mean `autotune optimize`?"),
        (["run.bag"], 2, "run.bag is a log, not a command: run `autotune identify run.bag`."),
    ],
)
def test_a_wrong_file_names_the_command_that_it_is_for(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    assert main(words) == code
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)


def test_messages_on_a_terminal_are_folded_as_results_are_and_a_command_to_paste_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    narrow = Screen(is_terminal=True, has_colour=False, has_blocks=False, can_redraw=False, columns=40)
    real = _terminal.detect_terminal
    monkeypatch.setattr(_common, "detect_terminal", lambda stream: narrow if stream is sys.stderr else real(stream))
    output, words = _common.Output(), "word " * 30
    output.note(words)
    output.next_command("validate", "a" * 30, "--identified", "b" * 30)
    *folded, command = capsys.readouterr().err.splitlines()
    assert max(map(len, folded)) <= 40
    assert " ".join(" ".join(folded).split()) == words.strip()
    assert command == f"next: autotune validate {'a' * 30} --identified {'b' * 30}"
