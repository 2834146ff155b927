"""The compiler's one place: what the disk cache compares, and that compiled functions are their Python."""

import importlib
import inspect
import os
import pkgutil
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
import pytest

import problems
from problems import compiled as compiled_module
from problems import compiling
from problems.design.batch_kernel import judge_stability
from problems.model.controller import blocks_of, controller_blocks, needed_states
from problems.model.hold import squarings_for
from problems.model.sampled import controller_matrices
from problems.stability.margin_kernel import (
    EVERY_MARGIN,
    MARGINS,
    PolynomialLoop,
    differences_at,
    find_loop_margins,
    plant_at,
    squared_distance,
)
from problems.stability.margins import loop_polynomials, margin_grid, response_polynomials
from problems.stability.polynomials import (
    CONTROLLER_POWERS,
    controller_polynomials,
    hurwitz,
    loop_polynomial,
    plant_polynomials,
)
from tests.problems.axes import PERIOD_S
from tests.problems.random_loops import random_controller, random_plant, sampled_of, stable_loops

PACKAGE = "stand_in"

BASE = {
    "__init__.py": "",
    "deep.py": """
        from typing import NamedTuple

        from .compiled import equation

        FACTOR = 2.0
        WEIGHTS = (1.0, 3.0)
        UNUSED = 5.0

        class Two(NamedTuple):
            first: float
            second: float

        @equation
        def deepest(x):
            return FACTOR * x + WEIGHTS[1] + Two(x, 0.0).second

        @equation
        def never_called(x):
            return 7.0 * x
        """,
    "middle.py": """
        from .compiled import compiled, equation
        from .deep import deepest

        @equation
        def middle(x):
            return deepest(x) + 1.0

        @compiled
        def helper(x):
            return x * 10.0
        """,
    "kernel.py": """
        from .compiled import compiled
        from .middle import helper, middle

        @compiled
        def kernel(x):
            return middle(x) + helper(x)
        """,
}


class Package:
    """A package of small modules beside a copy of `problems.compiled`, imported anew after every change."""

    def __init__(self, root: Path) -> None:
        self.folder = root / PACKAGE
        self.folder.mkdir()
        for module in (compiled_module, compiling):
            shutil.copy(str(module.__file__), self.folder)
        for name, text in BASE.items():
            self.write(name, text)

    def write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(inspect.cleandoc(text) + "\n", encoding="utf-8")

    def change(self, name: str, old: str, new: str) -> None:
        text = inspect.cleandoc(BASE[name])
        assert text.count(old) == 1
        self.write(name, text.replace(old, new))

    def kernel(self) -> Any:
        """Import everything from the files and return the kernel."""
        for name in [name for name in sys.modules if name.split(".")[0] == PACKAGE]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return importlib.import_module(f"{PACKAGE}.kernel").kernel

    def stamp(self) -> str:
        return str(self.kernel()._cache._cache_file._source_stamp)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Package]:
    # Python's own bytecode cache looks at whole seconds and sizes: two changes within one would be one.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield Package(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == PACKAGE]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        pytest.param("deep.py", "FACTOR * x", "FACTOR / x", id="an operation two modules down"),
        pytest.param("deep.py", "WEIGHTS[1]", "WEIGHTS[0]", id="a number inside an equation"),
        pytest.param("deep.py", "FACTOR = 2.0", "FACTOR = 2.5", id="a constant of the module"),
        pytest.param("deep.py", "WEIGHTS = (1.0, 3.0)", "WEIGHTS = (1.0, 4.0)", id="a tuple of the module"),
        pytest.param("middle.py", "+ 1.0", "+ 1.5", id="an equation one module down"),
        pytest.param("middle.py", "deepest(x) + 1.0", "x + 1.0", id="what an equation calls"),
        pytest.param("middle.py", "x * 10.0", "x * 11.0", id="another kernel"),
        pytest.param("deep.py", "first: float\n    second", "second: float\n    first", id="fields of a named tuple"),
    ],
)
def test_the_stamp_changes_with_what_is_compiled_into_a_kernel(package: Package, name: str, old: str, new: str) -> None:
    before = package.stamp()
    package.change(name, old, new)
    assert package.stamp() != before


def test_the_stamp_changes_when_a_function_that_is_called_moves(package: Package) -> None:
    before = package.stamp()
    package.write("elsewhere.py", inspect.cleandoc(BASE["deep.py"]))
    package.change("middle.py", "from .deep import", "from .elsewhere import")
    assert package.stamp() != before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        pytest.param("deep.py", "7.0 * x", "8.0 * x", id="a function that nobody calls"),
        pytest.param("deep.py", "UNUSED = 5.0", "UNUSED = 6.0", id="a constant that nobody reads"),
        pytest.param("deep.py", "FACTOR * x +", "FACTOR * x  +  ", id="white space"),
        pytest.param("deep.py", "UNUSED = 5.0", "# Why.\nUNUSED = 5.0", id="a comment"),
    ],
)
def test_the_stamp_stays_with_what_is_not(package: Package, name: str, old: str, new: str) -> None:
    before = package.stamp()
    package.change(name, old, new)
    assert package.stamp() == before


def run_kernel(package: Package, *lines: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Import the kernel in a process of its own and run `lines` with it."""
    given = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    return subprocess.run(
        [sys.executable, "-c", "\n".join([f"from {PACKAGE}.kernel import kernel", *lines])],
        env={**given, "PYTHONPATH": str(package.folder.parent), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_where_no_folder_can_be_written_kernels_are_compiled_for_the_run_and_that_is_said_once(
    package: Package, tmp_path: Path
) -> None:
    # Root may write everywhere, so the folders are made impossible: a file stands where each would be.
    (package.folder / "__pycache__").write_text("", encoding="utf-8")
    (tmp_path / "file").write_text("", encoding="utf-8")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    blocked = str(tmp_path / "file" / "cache")
    run = run_kernel(package, "print(kernel(1.5))", XDG_CACHE_HOME=blocked, HOME=blocked, TMPDIR=str(temporary))
    assert (run.returncode, run.stdout.strip()) == (0, str(2.0 * 1.5 + 3.0 + 1.0 + 15.0)), run.stderr
    assert run.stderr.count("compiled for this run only") == 1
    assert list(temporary.iterdir()) == []


def test_without_a_compiler_a_kernel_is_its_python(package: Package) -> None:
    lines = ("print(kernel(1.5))", "print(kernel.py_func(1.5), type(kernel).__name__)")
    run = run_kernel(package, *lines, NUMBA_DISABLE_JIT="1")
    assert run.stdout.split() == ["22.0", "22.0", "function"], run.stderr


def test_the_stamp_is_the_same_for_the_same_files(package: Package) -> None:
    assert package.stamp() == package.stamp()


def test_a_changed_equation_is_compiled_again_and_an_unchanged_one_is_read(package: Package) -> None:
    first = package.kernel()
    assert first(1.5) == 2.0 * 1.5 + 3.0 + 1.0 + 15.0
    assert sum(first.stats.cache_misses.values()) == 1
    again = package.kernel()
    assert again(1.5) == first(1.5)
    assert (sum(again.stats.cache_hits.values()), sum(again.stats.cache_misses.values())) == (1, 0)
    package.change("deep.py", "FACTOR = 2.0", "FACTOR = 4.0")
    changed = package.kernel()
    assert changed(1.5) == 4.0 * 1.5 + 3.0 + 1.0 + 15.0
    assert sum(changed.stats.cache_hits.values()) == 0


def test_an_equation_is_plain_python_and_a_kernel_keeps_its_own(package: Package) -> None:
    kernel = package.kernel()
    module = importlib.import_module(f"{PACKAGE}.middle")
    assert isinstance(module.middle, FunctionType)
    assert module.middle(np.array([1.0, 2.0])).tolist() == [6.0, 8.0]
    assert kernel.py_func(1.5) == kernel(1.5)


def test_recursion_and_mutual_calls_end(package: Package) -> None:
    package.write(
        "middle.py",
        """
        from .compiled import compiled, equation

        @equation
        def middle(x):
            return x if x < 1.0 else middle(x - 1.0)

        @compiled
        def helper(x):
            return x
        """,
    )
    assert package.stamp()


def modules() -> list[ModuleType]:
    found = pkgutil.walk_packages(problems.__path__, "problems.")
    return [importlib.import_module(each.name) for each in found if not each.ispkg]


def reachable() -> dict[str, FunctionType]:
    """Return every kernel of this floor and all that is compiled into one, by name."""
    out: dict[str, FunctionType] = {}
    waiting = [value.py_func for module in modules() for value in vars(module).values() if hasattr(value, "py_func")]
    while waiting:
        function = waiting.pop()
        name = f"{function.__module__}.{function.__qualname__}"
        if name in out:
            continue
        out[name] = function
        for called in function.__code__.co_names:
            value = function.__globals__.get(called)
            value = getattr(value, "py_func", value)
            if isinstance(value, FunctionType) and value.__module__.startswith("problems."):
                waiting.append(value)
    return out


def test_nothing_that_a_kernel_reads_escapes_the_stamp() -> None:
    """What the stamp cannot see must not be there: arrays as constants, defaults, closures, code inside code."""
    found = reachable()
    assert len(found) > 40
    for name, function in found.items():
        assert function.__defaults__ is None, name
        assert function.__kwdefaults__ is None, name
        assert function.__closure__ is None, name
        assert not [part for part in function.__code__.co_consts if isinstance(part, CodeType)], name
        for read in function.__code__.co_names:
            value = function.__globals__.get(read)
            seen = value is None or hasattr(value, "py_func") or isinstance(value, int | float | tuple | FunctionType)
            assert seen or isinstance(value, type) or value is np, (name, read)


def test_numba_is_named_in_one_place() -> None:
    for module in modules():
        if module is not compiled_module:
            names = [value.__name__ for value in vars(module).values() if isinstance(value, ModuleType)]
            assert not [name for name in names if name.split(".")[0] == "numba"], module.__name__


def both(function: Any, *arguments: Any) -> tuple[Any, Any]:
    return function(*arguments), function.py_func(*arguments)


def assert_same(found: tuple[Any, Any]) -> None:
    # Sums in another order and complex products by another rule: rounding, over some cancellation.
    np.testing.assert_allclose(*found, rtol=1e-11, atol=1e-13)


def test_compiled_functions_are_their_python() -> None:
    rng = np.random.default_rng(91)
    for sampled, controller in stable_loops(rng, 6):
        parameters, blocks = controller.parameters(), controller_blocks(controller, PERIOD_S)
        cases: list[tuple[Any, tuple[Any, ...]]] = [
            (squarings_for, (sampled.rate,)),
            (blocks_of, (parameters, PERIOD_S, controller.theta, controller.is_ideal)),
            (controller_matrices, (blocks, needed_states(blocks))),
            (plant_at, (response_polynomials(sampled), 0.3j)),
            (plant_at, (response_polynomials(sampled), 40.0j)),
            (squared_distance, (0.3 + 0.4j, True)),
            (squared_distance, (0.3 + 0.4j, False)),
        ]
        for function, arguments in cases:
            assert_same(both(function, *arguments))
        outputs = np.array([[*sampled.c_position, 0.0, 0.0], [*sampled.c_force, sampled.d_force, 0.0]])
        delay = (sampled.whole_delay, sampled.chain_length, sampled.fraction)
        one, other = both(plant_polynomials, sampled.phi, sampled.gamma, sampled.gamma_old, outputs, delay, False)
        # The lowest coefficients of F in free space are differences of nearly equal numbers.
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10 * np.max(np.abs(other)))


def written(function: Callable[..., Any], size: tuple[int, ...], *arguments: Any) -> tuple[Any, Any]:
    """Run a kernel that fills an array, compiled and not; return both arrays, what it returned at their end."""
    out = []
    for form in (function, function.py_func):  # type: ignore[attr-defined]
        array = np.zeros(size)
        answer = form(*arguments, array)
        out.append(np.append(array, 0.0 if answer is None else float(answer)))
    return out[0], out[1]


def test_kernels_that_fill_arrays_are_their_python() -> None:
    rng = np.random.default_rng(92)
    for sampled, controller in stable_loops(rng, 4):
        parameters, theta = controller.parameters(), controller.theta
        assert_same(written(controller_polynomials, (3, CONTROLLER_POWERS), parameters, controller.is_ideal))
        factors = np.zeros((3, CONTROLLER_POWERS))
        degree = controller_polynomials(parameters, controller.is_ideal, factors)
        plant = loop_polynomials(sampled)
        size = plant.shape[1] + CONTROLLER_POWERS
        one, other = written(loop_polynomial, (size,), plant, factors, degree, PERIOD_S, theta)
        np.testing.assert_allclose(one, other, rtol=1e-10)
        total = int(other[-1])
        first = 0 if sampled.plant.environment.is_anchored else 1
        assert hurwitz(other[:-1], total, first) == hurwitz.py_func(other[:-1], total, first)  # type: ignore[attr-defined]
        response = response_polynomials(sampled)
        np.testing.assert_allclose(
            *both(differences_at, PolynomialLoop(response, factors, degree, PERIOD_S, theta), 100.0), rtol=1e-10
        )
        margins = written(
            find_loop_margins,
            (MARGINS,),
            PolynomialLoop(response, factors, degree, PERIOD_S, theta),
            margin_grid(sampled),
            EVERY_MARGIN,
        )
        np.testing.assert_allclose(*margins, rtol=1e-9)


def test_verdicts_are_those_of_python() -> None:
    rng = np.random.default_rng(93)
    plants = [sampled_of(random_plant(rng, order=2, delay_s=2.0 * PERIOD_S)) for _ in range(4)]
    polynomials = np.array([loop_polynomials(plant) for plant in plants])
    first = np.array([0 if plant.plant.environment.is_anchored else 1 for plant in plants])
    sizes = np.array([polynomials.shape[2]] * 4)
    designs = np.array([random_controller(rng, compensations=("none",)).parameters() for _ in range(4)])
    one, other = both(judge_stability, (polynomials, sizes, first), designs, PERIOD_S, 0.5, False)
    np.testing.assert_array_equal(one, other)
