"""Work side by side: the results of one after the other, and an end when one fails or is interrupted."""

import os
import signal
import subprocess
import sys
import time
import warnings
from multiprocessing import current_process
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.processes import count_processors, map_in_processes, worker_pool
from identification.errors import EstimateError
from problems.frozen import FrozenDict

# Work that another process can import: at the top of a module, and of none that pytest rewrites.
_PIDS = """
import os, sys, time
from multiprocessing.process import BaseProcess
from pathlib import Path
from autotune.processes import map_in_processes

def linger(path):
    path.with_suffix(".half").write_text(str(os.getpid()))
    path.with_suffix(".half").rename(path)
    time.sleep(60.0)

if __name__ == "__main__":
    map_in_processes(linger, [Path(name) for name in sys.argv[1:]], 2)
"""
_PATIENCE_S = 30.0


def refuse(number: int) -> int:
    """Fail at once on 1 and later on any other number."""
    if number != 1:
        time.sleep(_PATIENCE_S)
    raise EstimateError(f"number {number}")


def same(value: object) -> object:
    """Hand back what was handed over."""
    return value


def halve_quietly(number: int) -> float:
    """Warn as a numerical library does."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn(f"half of {number}", RuntimeWarning, stacklevel=1)
    return number / 2


def own_pid(_: int) -> int:
    """Tell which process this is."""
    return os.getpid()


def waited_for(condition: object, until_s: float = _PATIENCE_S) -> bool:
    assert callable(condition)
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > until_s:
            return False
        time.sleep(0.02)
    return True


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A process that ended and was not waited for still has a number.
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text(encoding="ascii")


def test_results_stand_in_the_order_of_the_tasks() -> None:
    numbers = [-3, 2, -1, 7, -9]
    assert map_in_processes(abs, numbers, 2) == [abs(number) for number in numbers]


@pytest.mark.parametrize(("tasks", "processes"), [([1, 2, 3], 1), ([1], 4), ([], 4)])
def test_one_task_or_one_process_stays_in_this_one(tasks: list[int], processes: int) -> None:
    assert map_in_processes(own_pid, tasks, processes) == [os.getpid()] * len(tasks)


def test_two_tasks_leave_this_process() -> None:
    assert os.getpid() not in map_in_processes(own_pid, [1, 2], 2)


def test_what_a_task_warns_of_is_warned_of_here_and_not_printed_there(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(RuntimeWarning) as seen:
        assert map_in_processes(halve_quietly, [3, 4], 2) == [1.5, 2.0]
    assert sorted(str(each.message) for each in seen) == ["half of 3", "half of 4"]
    assert "half of" not in capfd.readouterr().err


def test_a_failure_ends_what_still_runs() -> None:
    begin = time.monotonic()
    with pytest.raises(EstimateError, match="number 1"):
        map_in_processes(refuse, [1, 2], 2)
    # Far less than the other task takes, far more than two processes need to begin.
    assert time.monotonic() - begin < 0.7 * _PATIENCE_S


@pytest.mark.parametrize("message", [None, "", "0", "-2", "many"])
def test_at_least_one_processor_serves(monkeypatch: pytest.MonkeyPatch, message: str | None) -> None:
    if message is None:
        monkeypatch.delenv("PYTHON_CPU_COUNT", raising=False)
    else:
        monkeypatch.setenv("PYTHON_CPU_COUNT", message)
    assert count_processors() == len(os.sched_getaffinity(0))


def test_the_environment_may_allow_another_number_of_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHON_CPU_COUNT", "3")
    assert count_processors() == 3


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
@pytest.mark.parametrize("to_the_group", [True, False])
def test_an_interrupt_ends_the_processes(tmp_path: Path, *, to_the_group: bool) -> None:
    script, reported = tmp_path / "linger.py", [tmp_path / "first.pid", tmp_path / "second.pid"]
    script.write_text(_PIDS, encoding="utf-8")
    command = [sys.executable, str(script), *map(str, reported)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert waited_for(lambda: all(path.exists() for path in reported))
            # A terminal interrupts all of its processes, a supervisor only the one that it started.
            os.killpg(process.pid, signal.SIGINT) if to_the_group else process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=_PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == -signal.SIGINT
    assert errors.rstrip().endswith("KeyboardInterrupt")
    pids = [int(path.read_text(encoding="ascii")) for path in reported]
    assert waited_for(lambda: not any(is_alive(pid) for pid in pids), 5.0)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
def test_a_kill_of_the_one_that_waits_ends_the_processes(tmp_path: Path) -> None:
    script, reported = tmp_path / "linger.py", [tmp_path / "first.pid", tmp_path / "second.pid"]
    script.write_text(_PIDS, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), *map(str, reported)]) as process:
        assert waited_for(lambda: all(path.exists() for path in reported))
        process.kill()
    pids = [int(path.read_text(encoding="ascii")) for path in reported]
    assert waited_for(lambda: not any(is_alive(pid) for pid in pids), 5.0)


def test_read_only_mappings_pass_both_ways() -> None:
    tasks = [FrozenDict({"a": index}) for index in range(2)]
    assert map_in_processes(same, tasks, 2) == tasks


@pytest.mark.parametrize("processes", [1, 2])
def test_each_finished_task_is_reported(processes: int) -> None:
    reported: list[int] = []
    map_in_processes(abs, [1, 2, 3], processes, each=lambda: reported.append(1))
    assert len(reported) == 3


def test_workers_end_with_an_interrupt_in_the_midst_of_their_work() -> None:
    """A worker leaves the interrupt to the process that waits, which then ends it."""
    workers: list[BaseProcess] = []

    def interrupted() -> None:
        with worker_pool(1) as pool:
            future = pool.submit(time.sleep, 600.0)
            while not future.running():
                time.sleep(0.01)
            workers.extend(pool._processes.values())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    (worker,) = workers
    # The pool's own thread waits for it too; who comes second sees its exit code a moment later.
    assert waited_for(lambda: worker.exitcode is not None)
    assert worker.exitcode == -signal.SIGTERM


def test_a_script_that_works_again_while_it_is_imported_to_work_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(current_process(), "_inheriting", True, raising=False)
    with pytest.raises(UsageError, match='under `if __name__ == "__main__":`'), worker_pool(1):
        pytest.fail("a pool was started")


def test_what_a_worker_prints_is_not_lost_at_its_end(tmp_path: Path) -> None:
    """It ends without taking Python down, which would write out what is left in its buffers."""
    script = tmp_path / "printing.py"
    script.write_text(
        "from autotune.processes import map_in_processes\n"
        "if __name__ == '__main__':\n    map_in_processes(print, ['one', 'two', 'three'], 2)\n"
    )
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    found = subprocess.run([sys.executable, script], env=buffered, capture_output=True, text=True, check=True)
    assert sorted(found.stdout.split()) == ["one", "three", "two"]
