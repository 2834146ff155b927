"""How `autotune explore` ends."""

import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from autotune.cli.main import main
from autotune.explore import server, source
from autotune.explore.saving import Target
from autotune.formats.controller import write_controller
from tests.autotune.tuning.cases import small_controller

Ready = Callable[[str], None]


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    write_controller(tmp_path / "old.yaml", small_controller())
    return ["explore", str(tmp_path / "old.yaml"), "-o", str(tmp_path / "tried.yaml"), "--no-open"]


@pytest.mark.parametrize(
    ("is_there", "is_cut_short", "code", "message"),
    [(True, False, 0, "Ended."), (False, False, 130, "Interrupted."), (True, True, 130, "is not written.")],
)
def test_an_interrupt_is_good_only_where_nothing_was_under_way(
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    is_there: bool,
    is_cut_short: bool,
    code: int,
    message: str,
) -> None:
    def serve(_exploration: object, target: Target, *, port: int, ready: Ready) -> None:
        assert port == 0
        if is_there:
            ready("address")
        target.is_cut_short = is_cut_short
        raise KeyboardInterrupt

    monkeypatch.setattr(server, "serve", serve)
    assert main(arguments) == code
    assert message in capsys.readouterr().err


def test_an_interrupt_that_something_swallows_is_not_lost(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = source.read_exploration

    def swallowing(*given: Any) -> Any:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return read(*given)

    monkeypatch.setattr(source, "read_exploration", swallowing)
    monkeypatch.setattr(server, "serve", lambda *_, **__: pytest.fail("served"))
    assert main(arguments) == 130
    assert capsys.readouterr().err == "autotune: Interrupted.\n"


def test_what_a_save_would_replace_is_reported(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_controller(arguments[3], small_controller())

    def serve(_exploration: object, target: Target, *, port: int, ready: Ready) -> None:
        del target, port
        ready("address")

    monkeypatch.setattr(server, "serve", serve)
    assert main(arguments) == 0
    assert f"Saving replaces {arguments[3]}, the controller of checksum " in capsys.readouterr().err


def test_the_file_that_is_read_is_not_the_one_that_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_controller(tmp_path / "controller.yaml", small_controller())
    seen: list[Path] = []

    def serve(_exploration: object, target: Target, *, port: int, ready: Ready) -> None:
        del port
        seen.append(target.path)
        ready("address")

    monkeypatch.setattr(server, "serve", serve)
    # As the next lines of predict and map name it.
    assert main(["explore", "controller.yaml", "--no-open"]) == 0
    assert [path.name for path in seen] == ["tried.yaml"]
    assert main(["explore", "controller.yaml", "-o", "controller.yaml", "--no-open"]) == 2
    assert "controller.yaml is what is read" in capsys.readouterr().err
