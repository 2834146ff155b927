"""Work on the runs of a campaign side by side, by any executor of `concurrent.futures`, and on none twice."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from autotune.errors import UsageError
from autotune.processes import prepare_worker, worker_environment
from problems.errors import AutotuneError

from .dask_pool import MOST_DEATHS, DaskPool
from .manifest import LoggedRun
from .options import RunOptions
from .work import RunOutcome, RunTask, build_task, read_outcome, work_on

_LOOK_S = 5.0
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
    each: Callable[[RunOutcome], None] | None = None,
) -> tuple[RunOutcome, ...]:
    """Return what came of every run, in their order; work only on those of which nothing is there yet.

    Each run is one task, which reads its files, works, and writes `folder/cells/CELL/RUN` in one step. Its key is the
    SHA-256 of the version, the options and the bytes of its files: where a folder bears it, that is the result. So a
    campaign that was killed goes on where it was, and none is done twice.

    Parameters
    ----------
    runs
        From `read_manifest`.
    folder
        Where the results are.
    options
        What holds of every run.
    jobs
        How many processes of this machine, or with an `executor` how many tasks it is given at a time.
    executor
        Any executor whose workers see the same files, such as that of a Dask client (`client.get_executor()`).
    each
        Is called with every outcome as it is known, those that were there first.

    Raises
    ------
    UsageError
        A file cannot be read, or a result cannot be written.
    """
    options = options or RunOptions()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be made: {error.strerror or error}.") from error
    done: dict[str, RunOutcome] = {}

    def finish(task: RunTask, outcome: RunOutcome) -> None:
        done[task.run.name] = outcome
        if each is not None:
            each(outcome)

    tasks = [build_task(run, folder, options) for run in runs]
    missing = deque(task for task in tasks if not _is_written(task, finish))
    suspects: deque[RunTask] = deque()
    deaths: Counter[str] = Counter()
    while missing or suspects:
        # One by one, what had a worker when one died: so only the run that ends its process is counted.
        queue, most = (suspects, 1) if suspects else (missing, jobs + 1)
        with _workers(executor, jobs) as workers:
            for task in _drain(workers, queue, most, finish):
                deaths[task.run.name] += most == 1
                if deaths[task.run.name] < MOST_DEATHS:
                    suspects.append(task)
                else:
                    finish(task, task.refused("killed", _KILLED))
    return tuple(done[task.run.name] for task in tasks)


def _drain(
    workers: Executor, queue: deque[RunTask], most: int, finish: Callable[[RunTask, RunOutcome], None]
) -> list[RunTask]:
    """Work on at most so many tasks at a time until the workers are gone; return what they then had in work."""
    running: dict[Future[RunOutcome], RunTask] = {}
    lost: list[RunTask] = []
    try:
        while queue or running:
            while queue and len(running) < most:
                running[workers.submit(work_on, queue[0])] = queue[0]
                queue.popleft()
            for future in wait(running, _LOOK_S, return_when=FIRST_COMPLETED).done or _look_after(workers):
                task = running[future]
                try:
                    finish(task, future.result())
                except (AutotuneError, BrokenExecutor):
                    raise
                except Exception:  # noqa: BLE001 - what is no answer of the work is a worker's end, as Dask says it
                    lost.append(task)
                del running[future]
    except BrokenExecutor:
        if not running:
            lost.append(queue.popleft())  # what workers that had nothing to do do not take
        # A worker may have written its folder and died before it answered.
        lost += [task for task in running.values() if not _is_written(task, finish)]
    return lost


def _is_written(task: RunTask, finish: Callable[[RunTask, RunOutcome], None]) -> bool:
    """Return whether the task's folder holds its result, which is then known."""
    known = read_outcome(task.folder)
    if known is None or known.key != task.key:
        return False
    finish(task, known)
    return True


@contextmanager
def _workers(executor: Executor | None, jobs: int) -> Iterator[Executor]:
    """Yield the executor that is given, else processes of this machine; those end with an interrupt."""
    if executor is not None:
        yield executor
        return
    # A fork would copy the threads' locks of the libraries that are loaded already.
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=prepare_worker)
    try:
        with worker_environment():
            yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list((pool._processes or {}).values()):  # noqa: SLF001 - kill_workers() is of Python 3.14
            process.terminate()
        raise
    pool.shutdown(cancel_futures=True)


def _look_after(workers: Executor) -> tuple[Future[RunOutcome], ...]:
    """Look whether the scheduler of a cluster is still there; nothing is done yet."""
    if isinstance(workers, DaskPool):
        workers.look_after()
    return ()
