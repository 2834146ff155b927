"""Work on the runs of a campaign side by side, by any executor of `concurrent.futures`, and on none twice."""

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import AbstractContextManager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from random import Random

from autotune.errors import UsageError
from autotune.formats.atomic import name_of_process
from autotune.processes import check_start, worker_pool
from problems.errors import AutotuneError

from .dask_pool import MOST_DEATHS, DaskPool
from .manifest import LoggedRun
from .options import RunOptions
from .state import CampaignState, Sight, open_state
from .text import counted, left_text
from .work import RunOutcome, RunTask, build_task, work_on, written_before

Phase = Callable[[str, int], AbstractContextManager[Callable[..., None]]]
"""Shows how far a part of the work is, as `Output.progress` of the command line does."""
_LOOK_S, _WAIT_S = 5.0, 1.0
_CONTROLLER = "controller.yaml"
_KILLED = (
    f"The process that worked on it alone ended {MOST_DEATHS} times without an answer: killed, or out of memory. It "
    "is tried again by the next campaign."
)


def work_on_runs(
    runs: Sequence[LoggedRun],
    folder: Path,
    options: RunOptions | None = None,
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    storage: str | None = None,
    progress: Phase | None = None,
    note: Callable[[str], None] | None = None,
    is_another_look: bool = False,
) -> tuple[RunOutcome, ...]:
    """Return what came of every run, in their order; work only on those of which nothing is known yet.

    Each run is one task, which reads its files, works, and writes `folder/cells/CELL/RUN` in one step. Its key is the
    SHA-256 of the version, the options and the bytes of its files: what the state says of it under that key is the
    result, as long as the files in the folder are those that it says. So a campaign that was killed goes on where it
    was, processes with the same state share the runs, and none is done twice.

    Parameters
    ----------
    runs
        From `read_manifest`.
    folder
        Where the files of the results are.
    options
        What holds of every run.
    jobs
        How many processes of this machine, or with an `executor` how many tasks it is given at a time.
    executor
        Any executor whose workers see the same files, such as that of a Dask client (`client.get_executor()`).
    storage
        URL of a database for the state, by which several hosts share the work; `campaign.sqlite` in the folder else.
    progress
        Is entered with what is done ("checksums" of the files, then "campaign") and the number of runs of which it is
        to be done, and gives what is called with 1 and the run's name for each.
    note
        Is called with a sentence about runs that are done already, are done again, or that others work on.
    is_another_look
        Whether this process has worked on such runs before: what is done already is then no news.

    Raises
    ------
    UsageError
        A file cannot be read, a result cannot be written, the state cannot be kept, or controllers in the folder would
        be removed and not made again.
    """
    check_start()
    progress = progress or (lambda *_: nullcontext(_nothing))
    with open_state(storage, folder) as state:
        tasks: dict[str, RunTask] = {}
        with progress("checksums", len(runs)) as advance:
            # Hosts each in an order of its own, so that of those that begin together one reads what others have not.
            for run in runs if storage is None else Random(name_of_process()).sample(runs, len(runs)):
                tasks[run.name] = build_task(run, folder, options or RunOptions(), state.checksums.find)
                advance(1, run.name)
        work = _Work(state, folder, [tasks[run.name] for run in runs], note or _nothing)
        work.look()
        if work.done and not is_another_look:
            work.note(left_text(len(work.left), len(runs)))
        with progress("campaign", max(len(work.left), 1)) as work.advance:
            if not work.left:
                work.advance(1)
            while work.left:
                work.do_what_is_free(executor, jobs)
                work.look()
                if work.left and not work.free:
                    work.wait()
    return tuple(work.done[run.name] for run in runs)


def _nothing(*_: object) -> None:
    return None


class _Work:
    """The runs that are left, and what came of the others."""

    def __init__(
        self, state: CampaignState, folder: Path, tasks: Sequence[RunTask], note: Callable[[str], None]
    ) -> None:
        self._state, self.folder, self.note = state, folder, note
        self.advance: Callable[..., None] = _nothing
        self.left = {task.run.name: task for task in tasks}
        self.free: deque[RunTask] = deque()
        self.done: dict[str, RunOutcome] = {}
        self._is_shared = False
        self._hosts = ""
        self._noted: set[str] = set()

    def look(self) -> None:
        """Take what the state knows; `free` are then the tasks that nobody works on."""
        sight = self._state.look(list(self.left.values())) if self.left else Sight()
        for task, outcome in sight.known:
            self._keep(task, outcome)
        self.free.clear()
        self.free.extend(sight.free)
        self._hosts = ", ".join(sorted(sight.hosts))
        self._replace(
            [(task, outcome.files) for task, outcome in sight.older],
            "inputs, options or version are not those of their results in the folder, which are replaced",
        )
        unknown = [(task, written_before(task.folder)) for task in sight.unknown]
        self._replace(
            [(task, files) for task, files in unknown if files],
            "the state of this campaign knows nothing of their results in the folder, which are replaced",
        )
        if lost := ", ".join(name for name in sight.lost if name not in self._noted):
            self._noted.update(sight.lost)
            self.note(f"Done again, since files of their results are missing or altered: {lost}.")

    def _replace(self, older: Sequence[tuple[RunTask, Collection[str]]], reason: str) -> None:
        """Say which results, with these files, will be replaced, and why.

        Raises UsageError where a controller would go and none take its place.
        """
        gone = [task.run.name for task, files in older if _CONTROLLER in files and not task.options.optimize]
        if gone:
            raise UsageError(
                f"{self.folder} has controllers of {counted(len(gone), 'run')} that would be removed, and not made "
                f"again without optimizing: {', '.join(gone)}. Name another folder with -o, or leave --no-optimize out."
            )
        if names := [task.run.name for task, _ in older if task.run.name not in self._noted]:
            self._noted.update(names)
            self.note(f"Done again, since {reason}: {', '.join(names)}.")

    def wait(self) -> None:
        """Wait a moment for what others work on, and say so once."""
        if self._hosts not in self._noted:
            self._noted.add(self._hosts)
            self.note(f"Waiting for {self._hosts} to finish {counted(len(self.left), 'run')}.")
        time.sleep(_WAIT_S)

    def do_what_is_free(self, executor: Executor | None, jobs: int) -> None:
        """Work on the tasks that are free, as far as they can be claimed."""
        suspects: deque[RunTask] = deque()
        deaths: Counter[str] = Counter()
        while self.free or suspects:
            # One by one, what had a worker when one died: so only the run that ends its process is counted.
            queue, most = (suspects, 1) if suspects else (self.free, jobs + 1)
            with worker_pool(jobs) if executor is None else nullcontext(executor) as workers:
                lost = self._drain(workers, queue, most)
            if lost and executor is None and not deaths:
                _check_beginning()
            for task in lost:
                deaths[task.run.name] += most == 1
                if deaths[task.run.name] < MOST_DEATHS:
                    suspects.append(task)
                else:
                    self._finish(task, task.refused("killed", _KILLED))

    def _drain(self, workers: Executor, queue: deque[RunTask], most: int) -> list[RunTask]:
        """Work on at most so many tasks at a time until the workers are gone; return what they then had in work."""
        running: dict[Future[RunOutcome], RunTask] = {}
        lost: list[RunTask] = []
        try:
            while queue or running:
                while queue and len(running) < most:
                    if self._state.claim(queue[0]):
                        running[workers.submit(work_on, queue[0])] = queue[0]
                    else:
                        self._is_shared = True
                    queue.popleft()
                done = wait(running, _LOOK_S, return_when=FIRST_COMPLETED).done or _look_after(workers)
                for future in [each for each in running if each in done]:  # in the order of the runs, not of the set
                    try:
                        outcome = future.result()
                    except (AutotuneError, BrokenExecutor):
                        raise
                    except Exception:  # noqa: BLE001 - what is no answer of the work is a worker's end, as Dask says it
                        lost.append(running.pop(future))
                    else:
                        self._finish(running.pop(future), outcome)
                if self._state.renew() and self._is_shared:
                    self.look()
        except BrokenExecutor:
            if not running:
                lost.append(queue.popleft())  # what workers that had nothing to do do not take
            lost += running.values()
        return lost

    def _finish(self, task: RunTask, outcome: RunOutcome) -> None:
        if self._state.finish(task, outcome):
            self._keep(task, outcome)

    def _keep(self, task: RunTask, outcome: RunOutcome) -> None:
        del self.left[task.run.name]
        self.done[task.run.name] = outcome
        self.advance(1, task.run.name)


def _check_beginning() -> None:
    """Raise UsageError where a process of this machine ends, and is not killed, before it begins with any work."""
    context = get_context("spawn")
    begun = context.Event()
    process = context.Process(target=begun.set)
    process.start()
    process.join()
    if not begun.is_set() and (process.exitcode or 0) >= 0:
        raise UsageError(
            "The processes that are to work on the runs end before they begin, for the reason above. Each imports the "
            'script that calls them: it must be a file, and have what it does under `if __name__ == "__main__":`.'
        )


def _look_after(workers: Executor) -> tuple[Future[RunOutcome], ...]:
    """Look whether the scheduler of a cluster is still there; nothing is done yet."""
    if isinstance(workers, DaskPool):
        workers.look_after()
    return ()
