"""Work on the runs of a campaign side by side, by any executor of `concurrent.futures`, and on none twice."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path

from autotune.errors import UsageError
from autotune.processes import prepare_worker
from problems.errors import require_extra

from .manifest import LoggedRun
from .work import RunOptions, RunOutcome, RunTask, build_task, read_outcome, work_on

_MOST_DEATHS = 5


def run_campaign(
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
        A result cannot be written; or a run has ended its process five times.
    """
    options = options or RunOptions()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be made: {error.strerror or error}.") from error
    done: dict[str, RunOutcome] = {}
    tasks = [build_task(run, folder, options) for run in runs]
    missing: deque[RunTask] = deque()

    def finish(task: RunTask, outcome: RunOutcome) -> None:
        done[task.run.name] = outcome
        if each is not None:
            each(outcome)

    for task in tasks:
        known = read_outcome(task.folder)
        if known is not None and known.key == task.key:
            finish(task, known)
        else:
            missing.append(task)
    deaths: Counter[str] = Counter()
    while missing:
        with _workers(executor, jobs) as workers:
            for died in _drain(workers, missing, jobs, finish):
                deaths[died.run.name] += 1
                missing.append(died)
        worst = next((name for name, count in deaths.items() if count >= _MOST_DEATHS), None)
        if worst is not None:
            raise UsageError(
                f"{worst}: the process that worked on it ended {_MOST_DEATHS} times without an answer (killed, or out "
                "of memory). What is finished is kept; leave that run out, or give it more memory."
            )
    return tuple(done[task.run.name] for task in tasks)


def _drain(
    workers: Executor, missing: deque[RunTask], jobs: int, finish: Callable[[RunTask, RunOutcome], None]
) -> list[RunTask]:
    """Work until nothing is missing or the workers are gone; return the tasks that they had then."""
    running: dict[Future[RunOutcome], RunTask] = {}
    try:
        while missing or running:
            # One more than there are workers, so that none waits; few, because all of them are lost with the pool.
            while missing and len(running) <= jobs:
                task = missing.popleft()
                running[workers.submit(work_on, task)] = task
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                finish(running[future], future.result())
                del running[future]
    except BrokenExecutor:
        # A worker may have written its folder and died before it answered.
        lost = [task for task in running.values() if not _is_written(task, finish)]
        return [task for task in lost if task not in missing]
    return []


def _is_written(task: RunTask, finish: Callable[[RunTask, RunOutcome], None]) -> bool:
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
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list((pool._processes or {}).values()):  # noqa: SLF001 - kill_workers() is of Python 3.14
            process.terminate()
        raise
    pool.shutdown(cancel_futures=True)


@contextmanager
def dask_executor(scheduler: str, jobs: int) -> Iterator[tuple[Executor, str]]:
    """Yield the executor of a Dask cluster and its dashboard's address: `dask` starts one here, else its own address.

    Raises MissingExtraError without Dask, UsageError where the cluster does not answer.
    """
    require_extra("--scheduler", "distributed", "dask")
    from distributed import Client, LocalCluster  # noqa: PLC0415 - takes a second

    with ExitStack() as stack:
        try:
            if scheduler == "dask":
                cluster = stack.enter_context(LocalCluster(n_workers=jobs, threads_per_worker=1, processes=True))  # type: ignore[no-untyped-call]
                client = stack.enter_context(Client(cluster))  # type: ignore[no-untyped-call]
            else:
                client = stack.enter_context(Client(scheduler, timeout="10s"))  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise UsageError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error}).") from error
        yield client.get_executor(pure=False, retries=_MOST_DEATHS), str(client.dashboard_link)
