"""Processes of their own, forked from one that has imported what they need: a new interpreter takes 2 s for that."""

import os
import signal
from collections.abc import Callable
from multiprocessing import forkserver, get_context
from pathlib import Path
from typing import Any

IMPORTED = ("tests.autotune.campaign.sharing", "tests.autotune.studies.small", "autotune.tuning.schedule")
FORKED = get_context("forkserver")
FORKED.set_forkserver_preload([*IMPORTED])


def stop_server() -> None:
    """End the process from which the others are forked, if there is one."""
    forkserver._forkserver._stop()  # type: ignore[attr-defined]


class OwnProcess:
    """`main(*arguments)` in a process of its own, what it prints in files of `folder`; used as one of `subprocess`."""

    def __init__(self, folder: Path, main: Callable[..., None], *arguments: Any) -> None:
        name = f"process{len(list(folder.glob('process*.out')))}"
        self.out, self._errors = folder / f"{name}.out", folder / f"{name}.err"
        self.out.touch()
        self._process = FORKED.Process(target=_printed, args=(self.out, self._errors, main, *arguments))
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float = 60.0) -> tuple[str, str]:
        """Wait for its end, and return what it printed."""
        self._process.join(timeout)
        assert self.returncode is not None, f"did not end within {timeout} s"
        return self.out.read_text(encoding="utf-8"), self._errors.read_text(encoding="utf-8")


def _printed(out: Path, errors: Path, main: Callable[..., None], *arguments: Any) -> None:
    for number, path in ((1, out), (2, errors)):
        with path.open("w", encoding="utf-8") as file:
            os.dup2(file.fileno(), number)
    main(*arguments)
