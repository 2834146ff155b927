"""How long something takes when nothing else gets in its way."""

import time
from collections.abc import Callable


def best(run: Callable[[], object], times: int) -> float:
    """Return the shortest [s] of several runs, after one that only warms up."""
    run()
    found = []
    for _ in range(times):
        begin = time.perf_counter()
        run()
        found.append(time.perf_counter() - begin)
    return min(found)
