"""What the shell proposes for a file, through click and through bash itself."""

import importlib
import os
import pty
import shutil
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

from autotune.cli._options import LOGS, SETTINGS, FilePath
from autotune.cli.main import COMMANDS, main

WRITTEN = {"annotate", "out", "data", "report", "start_path", "plot"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("controller.yaml", "copy of cell.yml", "cell.mcap", "notes.txt", ".hidden.yaml"):
        (tmp_path / name).write_text("", encoding="utf-8")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "CELL.YAML").write_text("", encoding="utf-8")
    (tmp_path / "folder.yaml").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def proposed(kind: FilePath, begun: str) -> list[str]:
    context = click.Context(click.Command("tiny"))
    first, *files = kind.shell_complete(context, click.Argument(["file"]), begun)
    assert (first.value, first.type) == (begun, "dir")  # folders are the shell's part
    assert {each.type for each in files} <= {"plain"}
    return [each.value for each in files]


@pytest.mark.parametrize(
    ("begun", "files"),
    [
        ("", ["controller.yaml", "copy of cell.yml"]),
        ("con", ["controller.yaml"]),
        ("runs/", ["runs/CELL.YAML"]),
        ("./c", ["./controller.yaml", "./copy of cell.yml"]),
        (".h", [".hidden.yaml"]),
        ("nowhere/x", []),
        ("note", []),
    ],
)
@pytest.mark.usefixtures("folder")
def test_files_of_the_kind_are_proposed(begun: str, files: list[str]) -> None:
    assert proposed(FilePath(*SETTINGS), begun) == files


def test_an_absolute_beginning_and_the_home_stay_as_typed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(folder))
    assert proposed(FilePath(*LOGS, dir_okay=True), f"{folder}/c") == [f"{folder}/cell.mcap"]
    assert proposed(FilePath(*SETTINGS), "~/con") == ["~/controller.yaml"]


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "demo"])
def test_every_file_that_is_read_is_proposed_by_kind(name: str) -> None:
    command = importlib.import_module(COMMANDS[name].module).command
    read = [each for each in command.params if each.name not in WRITTEN]
    assert [each.name for each in read if type(each.type) is click.Path] == []


@pytest.mark.parametrize(
    ("shell", "position", "answer"),
    [("zsh", "2", "dir\ncon\n_\nplain\ncontroller.yaml\n_\n"), ("fish", "con", "dir,con\nplain,controller.yaml\n")],
)
@pytest.mark.usefixtures("folder")
def test_the_other_shells_are_reported_files_and_folders(
    shell: str, position: str, answer: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COMP_WORDS", "autotune validate con")
    monkeypatch.setenv("COMP_CWORD", position)
    monkeypatch.setenv("_AUTOTUNE_COMPLETE", f"{shell}_complete")
    assert main([]) == 0
    output = capsys.readouterr().out
    # Newer versions of click write another word for "no help", or none.
    assert [line for line in output.split() if line != "_"] == [line for line in answer.split() if line != "_"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_files_of_the_kind_and_folders(folder: Path, repository: Path) -> None:
    program = folder / "bin" / "autotune"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m autotune "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("_AUTOTUNE")},
        "PYTHONPATH": str(repository),
        "PATH": f"{program.parent}:{os.environ['PATH']}",
        "INPUTRC": os.devnull,
        "PS1": "$ ",
        "TERM": "dumb",
    }
    script = subprocess.run(
        [program, "completion", "bash"], env=environment, capture_output=True, text=True, check=True
    ).stdout
    (folder / "script.sh").write_text(f"{script}\necho() {{ printf '<%s>' \"$@\"; }}\n", encoding="utf-8")
    typed = {
        "autotune val\t": ["validate"],
        "autotune validate con\t": ["validate", "controller.yaml"],
        "autotune validate cop\t": ["validate", "copy of cell.yml"],
        "autotune validate ru\tCE\t": ["validate", "runs/CELL.YAML"],
        "autotune identify ce\t": ["identify", "cell.mcap"],
    }
    ours, theirs = pty.openpty()
    bash = subprocess.Popen(
        ["bash", "--norc", "--noprofile", "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder, env=environment
    )
    os.close(theirs)
    output = ""
    try:
        again = "complete -o nosort -F _autotune_completion autotune"
        _type(ours, f'source script.sh; autotune() {{ echo "$@"; }}; {again}\n')
        output = _until(ours, "$ ", 2)
        for line, words in typed.items():
            expected = "".join(f"<{word}>" for word in words)
            _type(ours, line)
            _until(ours, words[-1].split()[-1], 1)
            _type(ours, "\n")
            output = _until(ours, expected, 1)
            assert expected in output, (line, output)
    finally:
        bash.kill()
        bash.wait(timeout=60)
        os.close(ours)


def _type(terminal: int, text: str) -> None:
    os.write(terminal, text.encode())


def _until(terminal: int, expected: str, count: int, timeout_s: float = 30.0) -> str:
    """Read what bash shows until `expected` was there `count` times, or time is up."""
    os.set_blocking(terminal, False)
    reported, end = "", time.monotonic() + timeout_s
    while reported.count(expected) < count and time.monotonic() < end:
        try:
            reported += os.read(terminal, 65536).decode(errors="replace")
        except BlockingIOError:
            time.sleep(0.02)
    return reported
