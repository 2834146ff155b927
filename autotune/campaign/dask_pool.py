"""A Dask cluster as an executor of `concurrent.futures` that notices when the scheduler is gone."""

import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from autotune.errors import UsageError
from problems.errors import require_extra

MOST_DEATHS = 5
"""So often the process that works on a run may end before the run is given up."""
_ANSWERS_WITHIN_S = 10.0
_Result = TypeVar("_Result")


class DaskPool(Executor):
    """Hands tasks to a Dask client; `scheduler` is how messages name the cluster.

    What the scheduler has forgotten, since it was started again, is broken; so is all where it stays away.
    """

    def __init__(self, client: Any, scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        self._open: dict[Any, Future[Any]] = {}

    def submit(self, fn: Callable[..., _Result], /, *args: Any, **kwargs: Any) -> "Future[_Result]":
        """Give a task to the cluster."""
        self.look_after()
        asked: Future[_Result] = Future()
        given = self._client.submit(fn, *args, pure=False, retries=MOST_DEATHS, **kwargs)
        self._open[given] = asked
        given.add_done_callback(self._finish)
        return asked

    def look_after(self) -> None:
        """Break the tasks of which the scheduler knows nothing any more.

        Raises UsageError where it is gone: nothing that is finished is lost, and the same command goes on.
        """
        if self._client.status in ("closing", "closed"):
            raise UsageError(
                f"--scheduler {self._scheduler}: the Dask scheduler is gone. What is finished is kept; start the "
                "scheduler and its workers again, and the same command does the rest."
            )
        for given in [each for each in list(self._open) if each.status in ("cancelled", "lost")]:
            self._finish(given)

    def _finish(self, given: Any) -> None:
        asked = self._open.pop(given, None)
        if asked is None:
            return
        if given.status == "finished":
            asked.set_result(given.result())
        elif given.status == "error":
            asked.set_exception(given.exception())
        else:
            asked.set_exception(BrokenExecutor("the scheduler knows nothing of it"))


@contextmanager
def dask_executor(scheduler: str, jobs: int) -> Iterator[tuple[Executor, str]]:
    """Yield the executor of a Dask cluster and its dashboard's address: `dask` starts one here, else its own address.

    Raises MissingExtraError without Dask, UsageError for what is neither, or where the cluster does not answer.
    """
    if scheduler != "dask" and "://" not in str(scheduler):
        raise UsageError(f"--scheduler must be dask, or an address as in tcp://head:8786; found {scheduler}.")
    require_extra("--scheduler", "distributed", "dask")
    from distributed import Client, LocalCluster  # noqa: PLC0415 - takes a second

    with ExitStack() as stack:
        try:
            if scheduler == "dask":
                with warnings.catch_warnings():
                    # The dashboard of another cluster has the usual port; where this one's is, is printed.
                    warnings.filterwarnings("ignore", message=r"(?s).*Port \d+ is already in use")
                    cluster = LocalCluster(n_workers=jobs, threads_per_worker=1, processes=True)  # type: ignore[no-untyped-call]
                    stack.enter_context(cluster)
                client = stack.enter_context(Client(cluster))  # type: ignore[no-untyped-call]
            else:
                client = stack.enter_context(Client(scheduler, timeout=_ANSWERS_WITHIN_S))  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise UsageError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error}).") from error
        yield DaskPool(client, scheduler), str(client.dashboard_link)
