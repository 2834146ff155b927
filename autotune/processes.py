"""Independent pieces of work side by side, each in a process of its own."""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import current_process, get_context, parent_process
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import TypeVar

from autotune.errors import UsageError

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

# Plants that a validation simulates at most, all of whose peaks are kept: ten minutes of two processors for the demo's.
MOST_SAMPLES = 10_000_000

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
# Left to itself, glibc keeps the holes that large arrays of a long log leave; with a threshold of its own it would give
# back and ask again for what smaller arrays take by turns.
_MALLOC = {"MALLOC_MMAP_THRESHOLD_": "4000000", "MALLOC_TRIM_THRESHOLD_": "8000000"}
_ENVIRONMENT = {**dict.fromkeys(_THREADS, "1"), **_MALLOC}


def count_processors() -> int:
    """Return how many processors this process may use; PYTHON_CPU_COUNT overrules it, as from Python 3.13 on."""
    limit = os.environ.get("PYTHON_CPU_COUNT", "")
    if limit.isdecimal() and int(limit) > 0:
        return int(limit)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_in_processes(
    work: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    processes: int,
    *,
    each: Callable[[], None] | None = None,
) -> list[_Result]:
    """Return `work` of every task, in their order, by at most `processes` at a time.

    One process, or one task, is done here. Otherwise `work`, tasks and results are pickled, `work` is at the top of
    a module, and a script that calls this guards its own start (`if __name__ == "__main__"`). What a task raises is
    raised here, of several the first in order; that, or an interrupt, ends all processes at once. What a task warns of
    is warned of here. `each` is called,
    perhaps from another thread, whenever a task is done.
    """
    done = each if each is not None else _nothing
    count = min(processes, len(tasks))
    if count < 2:
        return [_done(work(task), done) for task in tasks]
    with worker_pool(count) as pool:
        futures = [pool.submit(_with_warnings, work, task) for task in tasks]
        for future in futures:
            future.add_done_callback(lambda _: done())
        return [_warned_again(*future.result()) for future in futures]


def check_start() -> None:
    """Raise UsageError in a process that imports a script to work for it, where the script does its work again."""
    if getattr(current_process(), "_inheriting", False):
        raise UsageError(
            "A script that works in several processes is imported by each of them: put what it does under "
            '`if __name__ == "__main__":`.'
        )


@contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes of this machine; what is raised meanwhile, or an interrupt, ends them at once."""
    check_start()
    # A fork would copy the threads' locks of the libraries that are loaded already.
    pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=prepare_worker)
    try:
        with worker_environment():
            yield pool
    except BaseException:
        processes = list((pool._processes or {}).values())  # noqa: SLF001 - kill_workers() is of Python 3.14
        pool.shutdown(wait=False, cancel_futures=True)  # which forgets its processes
        for process in processes:
            process.terminate()
        raise
    pool.shutdown(cancel_futures=True)


_Warned = tuple[type[Warning], str, str, int]


def _with_warnings(work: Callable[[_Task], _Result], task: _Task) -> tuple[_Result, list[_Warned]]:
    """Do the work in a process of its own, and hand on what was warned of instead of printing it there."""
    with warnings.catch_warnings(record=True) as seen:
        result = work(task)
    return result, [(each.category, str(each.message), each.filename, each.lineno) for each in seen]


def _warned_again(result: _Result, seen: Sequence[_Warned]) -> _Result:
    for category, message, file, line in seen:
        warnings.warn_explicit(message, category, file, line)
    return result


def _nothing() -> None:
    return None


def _done(result: _Result, done: Callable[[], None]) -> _Result:
    done()
    return result


@contextmanager
def worker_environment() -> Iterator[None]:
    """Let processes that are started meanwhile have one thread each and give memory back, unless the user says so.

    A worker that imports its caller's script has loaded its libraries before `prepare_worker` is called.
    """
    missing = {name: value for name, value in _ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


def prepare_worker() -> None:
    """Leave an interrupt to the process that waits, and the other processors to the other processes.

    It ends with the process that waits, however that ends: a pool's workers would wait for ever after a kill.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if (waiting := parent_process()) is not None:
        threading.Thread(target=_end_with, args=(waiting,), daemon=True).start()
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    Finalize(None, _leave, exitpriority=-100)  # as the last of what a process of multiprocessing does at its end


def _leave() -> None:
    """End this worker here: Python would take down one by one what it has loaded, which takes half a second."""
    sys.stdout.flush()
    os._exit(0)


def _end_with(other: BaseProcess) -> None:
    other.join()
    os._exit(1)
