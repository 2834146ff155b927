"""A campaign in a process of its own, each run of which takes a while and is written down once it is worked on."""

import os
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from autotune.campaign import work
from autotune.campaign.manifest import read_manifest
from autotune.campaign.run import work_on_runs
from autotune.campaign.tables import write_tables
from autotune.campaign.work import RunOutcome, RunTask
from tests.autotune.own_process import OwnProcess

PLANT = "format: autotune/identified\n"


def written_logs(folder: Path, count: int) -> Path:
    """Tables that `identify` refuses at once: what is tried here is the work around it."""
    for i in range(count):
        (folder / f"cell{i % 4}").mkdir(parents=True, exist_ok=True)
        (folder / f"cell{i % 4}" / f"run{i:02}.csv").write_text(f"t,a\n0,{i}\n1,2\n", encoding="utf-8")
    return folder


def table(folder: Path, outcomes: tuple[RunOutcome, ...]) -> str:
    folder.mkdir()
    write_tables(folder, outcomes)
    return (folder / "campaign.csv").read_text(encoding="utf-8")


def until(holds: Callable[[], bool], limit_s: float = 60.0) -> None:
    end = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < end, "took too long"
        time.sleep(0.01)


def identified_at_once(task: RunTask, files: dict[str, str]) -> RunOutcome:
    """Stands for the work on a log: two files, one of some length, that follow from it."""
    files["identified.yaml"] = f"{PLANT}key: {task.key}\n"
    files["controller.yaml"] = "format: autotune/controller\n" + f"cell: {task.run.name}\n" * 500
    return RunOutcome(cell=task.run.cell, run=task.run.run, key=task.key, values={"m": (1.0, 0.1)})


def campaign(logs: Path, out: Path, **options: Any) -> tuple[RunOutcome, ...]:
    """Work on the runs in this process, one after the other, and with `names` write down which."""
    with Slow(0.0, options.pop("names", None)) as executor:
        return work_on_runs(read_manifest(logs), out, executor=executor, **options)


class Slow(ThreadPoolExecutor):
    """One worker that takes `pause_s` for each run, and writes its name down where that is asked."""

    def __init__(self, pause_s: float, names: Path | None) -> None:
        super().__init__(1)
        self._pause_s, self._names = pause_s, names

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        def do() -> Any:
            time.sleep(self._pause_s)
            if self._names is not None:
                with self._names.open("a", encoding="utf-8") as stream:
                    stream.write(f"{os.getpid()} {args[0].run.name}\n")
            return fn(*args, **kwargs)

        return super().submit(do)


def start_campaign(logs: Path, out: Path, storage: str, tables: Path, pause_s: float) -> OwnProcess:
    """Start it; it begins when the folder `tables` is there, and writes its table there."""
    return OwnProcess(out.parent, _work, logs, out, storage, tables, pause_s)


def worked(tables: Path) -> list[tuple[int, str]]:
    """Return process and name of each run that was worked on, in their order."""
    path = tables / "worked"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [(int(line.split(" ", 1)[0]), line.split(" ", 1)[1]) for line in lines]


def _work(logs: Path, out: Path, storage: str, tables: Path, pause_s: float) -> None:
    work._identify_and_tune = identified_at_once
    print("ready", flush=True)
    until(tables.is_dir)
    with Slow(pause_s, tables / "worked") as executor:
        outcomes = work_on_runs(read_manifest(logs), out, executor=executor, storage=storage or None)
    (own := tables / str(os.getpid())).mkdir()
    write_tables(own, outcomes)
