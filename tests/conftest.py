"""Fixtures that every part of the tests may use."""

import contextlib
import fcntl
import gc
import hashlib
import importlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# As the command line does: the matrices are small, and threads that wait for each other cost tenfold.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The tests run beside each other already: processes inside a test would import everything once more.
os.environ.setdefault("PYTHON_CPU_COUNT", "1")

# What is printed in tests is printed to a pipe, whatever their user likes to see.
for _name in ("NO_COLOR", "FORCE_COLOR", "CLICOLOR", "CLICOLOR_FORCE", "COLUMNS"):
    os.environ.pop(_name, None)

# A test that passed passes again; HYPOTHESIS_PROFILE=random looks for cases that nobody has seen.
# That it is slow says how busy the machine is.
_BUSY = [HealthCheck.too_slow]
settings.register_profile("same", derandomize=True, suppress_health_check=_BUSY)
settings.register_profile("random", derandomize=False, suppress_health_check=_BUSY)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# What is imported and collected lives as long as the process: looking through it for garbage finds none.
gc.disable()

ROOT = Path(__file__).resolve().parent.parent

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files of slow tests: one that is begun last is what the other processes then wait for."""
    slow = {item.path for item in items if item.get_closest_marker("slow") is not None}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection(session: pytest.Session) -> None:
    """Let every other process import the tests from the last to the first: two share what a clean checkout lacks.

    Each writes the bytecode of what it imports, and reads that of what the other one has been through already.
    """
    worker = getattr(session.config, "workerinput", {}).get("workerid", "gw0")
    if int(worker.removeprefix("gw")) % 2:
        folders = [each for each in map(Path, session.config.args) if each.is_dir()]
        for path in sorted((path for each in folders for path in each.rglob("test_*.py")), reverse=True):
            # What cannot be imported is reported where it is collected.
            with contextlib.suppress(Exception, pytest.skip.Exception):
                importlib.import_module(".".join(path.resolve().relative_to(ROOT).with_suffix("").parts))


def pytest_collection_finish() -> None:
    """Look for garbage among what the tests make, and leave out what there was before."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The recorded logs beside the checkout; tests that need them are skipped where they are absent."""
    path = ROOT.parent / "shared" / "data"
    if not path.is_dir():
        pytest.skip("needs the recorded logs in ../shared/data")
    return path


@pytest.fixture(scope="session", autouse=True)
def _kernels_compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let the processes of a clean checkout wait for a kernel that another one compiles, and read it from the cache.

    Who waits holds the kernels that call it and nobody the other way round, so that no two wait for each other.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        yield
        return
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    folder, honest, held = tmp_path_factory.getbasetemp().parent, Dispatcher.compile, set[str]()

    def compile_once(self: Any, signature: Any) -> Any:
        kernel = hashlib.sha256(f"{self.py_func.__module__}.{self.py_func.__qualname__}".encode()).hexdigest()
        if kernel in held:
            return honest(self, signature)
        with global_compiler_lock, (folder / f"{kernel}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            held.add(kernel)
            try:
                return honest(self, signature)
            finally:
                held.remove(kernel)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dispatcher, "compile", compile_once)
        yield


@pytest.fixture
def run_cli(tmp_path: Path) -> RunCli:
    """Run `autotune ARGUMENTS` in this process, in an empty directory; importing it anew would take 2 s each time."""

    def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
        from autotune.cli.main import main

        out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
        with contextlib.chdir(tmp_path), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([*map(str, arguments)])
        return subprocess.CompletedProcess(arguments, code, *(_written(stream) for stream in (out, err)))

    return run


def _written(stream: io.TextIOWrapper) -> str:
    stream.seek(0)
    return stream.read()


@pytest.fixture
def run_process(tmp_path: Path) -> RunCli:
    """Run `python -m autotune ARGUMENTS` as its own process, as users do, in an empty directory."""

    def run(*arguments: str | Path, timeout_s: float = 120.0) -> "subprocess.CompletedProcess[str]":
        ours = ("_AUTOTUNE", "PYTHON_CPU_COUNT")
        environment = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
        environment["PYTHONPATH"] = str(ROOT)
        return subprocess.run(
            [sys.executable, "-m", "autotune", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=timeout_s,
            check=False,
        )

    return run
