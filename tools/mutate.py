"""Change random places of the code, one at a time, and see whether the tests notice.

Each change goes into a copy of the checkout, in which the kernels are compiled already. Groups of tests run up to the
first that fails: those of the changed module and those of its room that import it, those elsewhere that import it and
the rest of its room, those that import a module that imports it, those that reach it by more imports, and the slow ones
of the first two groups. What none has noticed within the processor time for a group counts as survived; a
test that does not end has noticed it. Functions are changed in their source, not wrapped at run time as mutation
libraries do: the compiler of the kernels would not take a wrapped one.
"""

import argparse
import ast
import math
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("problems", "identification", "autotune")
# Of two that are ordered both the bound itself and the side are changed.
_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult
}  # fmt: skip
# A text or a list with another operator between fails wherever it runs: that a line runs is what coverage shows.
_NOT_NUMBERS = (ast.JoinedStr, ast.List, ast.ListComp, ast.Tuple, ast.Set, ast.Dict)
_LIMIT, _SILENCE = "MUTATE_LIMIT_S", "MUTATE_SILENCE_S"
# A test that waits for ever uses no processor time: what has not used it up in so many times as long waits.
_WAITING = 10.0
# What is smaller guards against rounding or a division by zero: twice as much of it guards as well. 1e-9 is a unit.
_SMALLEST = 1e-9
_DOTTED = re.compile(rf"({'|'.join(FLOORS)})(\.\w+)+")
_NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One change: `path` in the checkout, the text from `start` to `stop`, and what stands there instead."""

    path: Path
    line: int
    start: int
    stop: int
    before: str
    after: str
    kind: str

    def applied(self, source: bytes) -> bytes:
        return source[: self.start] + self.after.encode() + source[self.stop :]

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.before} -> {self.after}"


def find_mutants(path: Path, source: bytes) -> list[Mutant]:
    """Return every change that can be made to a module: operators, comparisons, conditions and numbers."""
    tree = ast.parse(source)
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in _executed(tree):
        for after in _changed(node):
            assert isinstance(node, ast.expr)
            start = starts[node.lineno - 1] + node.col_offset
            stop = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
            before = source[start:stop].decode()
            kind = type(node).__name__
            found.append(
                Mutant(path=path, line=node.lineno, start=start, stop=stop, before=before, after=after, kind=kind)
            )
    return found


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that decide what is computed: no annotation, text, message of an error or import for types."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.Raise | ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or (
                isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
            ):
                continue
            yield child
            yield from _executed(child)


def _changed(node: ast.AST) -> Iterator[str]:
    """Yield the texts that may stand instead of a node."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        for other in _COMPARISONS[type(node.ops[0])]:
            yield _text(ast.Compare(node.left, [other()], node.comparators))
    elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS and _is_of_numbers(node):
        yield _text(ast.BinOp(node.left, _OPERATORS[type(node.op)](), node.right))
    elif isinstance(node, ast.BoolOp):
        yield _text(ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield _text(node.operand)
    elif isinstance(node, ast.IfExp):
        yield _text(ast.IfExp(node.test, node.orelse, node.body))
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        if node.value == 0 or node.value >= _SMALLEST:
            yield repr(2 * node.value or 1)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _NAMES:
        yield _text(ast.Call(ast.Name(_NAMES[node.func.id]), node.args, node.keywords))


def _is_of_numbers(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    texts = any(isinstance(each, ast.Constant) and isinstance(each.value, str | bytes) for each in sides)
    return not texts and not any(isinstance(each, _NOT_NUMBERS) for each in sides)


def _text(node: ast.expr) -> str:
    return f"({ast.unparse(ast.fix_missing_locations(node))})"


def files_of_tests(path: Path) -> tuple[list[Path], ...]:
    """Return the groups of files of tests of a module, nearest first; all relative to the checkout.

    The room is the folder of the tests for the module's package or, where there is none, for the package around it.
    """
    room = next(folder for each in path.parents if (ROOT / (folder := "tests" / each)).is_dir())
    steps = _steps_to(_module(path))

    def group(test: Path) -> int:
        if test == room / f"test_{path.name}":
            return 0
        count = steps.get(_module(test), 0)
        if test.is_relative_to(room):
            return 0 if count == 1 else 1
        return min(count, 4) if count else 5

    def rank(test: Path) -> tuple[bool, int, bool, Path]:
        count = steps.get(_module(test), len(steps))
        return test != room / f"test_{path.name}", count, not test.is_relative_to(room), test

    tests = sorted((test for test in _files("tests") if test.name.startswith("test_")), key=rank)
    return tuple([test for test in tests if group(test) in each] for each in ((0,), (1,), (2,), (3, 4)))


def _steps_to(name: str) -> dict[str, int]:
    """Return by how many imports each module that reaches `name` does so."""
    steps, newest = {name: 0}, {name}
    while newest:
        newest = {each for found in newest for each in _importers().get(found, ())} - steps.keys()
        steps |= dict.fromkeys(newest, 1 + max(steps.values()))
    return steps


@cache
def _importers() -> dict[str, frozenset[str]]:
    """Return the modules that import each one, in all of the checkout."""
    found: dict[str, set[str]] = {}
    for file in _files(*FLOORS, "tests", "tools", "benchmarks", "examples"):
        for name in _imports(file):
            found.setdefault(name, set()).add(_module(file))
    return {name: frozenset(files) for name, files in found.items()}


def _files(*folders: str) -> list[Path]:
    return [file.relative_to(ROOT) for folder in folders for file in sorted((ROOT / folder).rglob("*.py"))]


def _module(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


@cache
def _imports(path: Path) -> frozenset[str]:
    """Return the modules that a file imports, now or later by a name in a text, and what else it imports from them."""
    found = set[str]()
    for node in ast.walk(ast.parse((ROOT / path).read_bytes())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = path.parts[: -node.level] if node.level else ()
            source = ".".join((*above, *filter(None, [node.module])))
            found |= {source, *(f"{source}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _DOTTED.fullmatch(node.value):
            found |= {node.value, node.value.rpartition(".")[0]}
    return frozenset(found)


class Verdict(StrEnum):
    """What became of a change."""

    CAUGHT = "caught"
    SURVIVED = "SURVIVED"
    OUT_OF_TIME = "SURVIVED so far"
    """The tests had not ended when their time was over."""


def judge(mutant: Mutant, root: Path, limit_s: float, silence_s: float) -> Verdict:
    """Run the tests on the copy `root`, which is changed for good: each group, and the slow ones, for `limit_s`."""
    target = root / mutant.path
    source = target.read_bytes()
    # The file may be linked from another copy.
    target.unlink()
    target.write_bytes(mutant.applied(source))
    verdicts = []
    groups = files_of_tests(mutant.path)
    slow = [file for file in groups[0] + groups[1] if b"mark.slow" in (root / file).read_bytes()]
    for files, marked in (*((group, "not slow") for group in groups), (slow, "slow")):
        if files:
            verdicts.append(run_tests(files, root, limit_s, silence_s, marked))
            if verdicts[-1] is Verdict.CAUGHT:
                return Verdict.CAUGHT
    return Verdict.OUT_OF_TIME if Verdict.OUT_OF_TIME in verdicts else Verdict.SURVIVED


def run_tests(files: list[Path], root: Path, limit_s: float, silence_s: float, marked: str = "not slow") -> Verdict:
    """Run files of tests in their order up to the first that fails; both times are processor times of their process."""
    # A file that is not there would end the run as a change that cannot be imported does.
    if missing := [str(file) for file in files if not (root / file).is_file()]:
        raise FileNotFoundError(f"no tests in {root}: {', '.join(missing)}")
    options = ("-q", "-x", "-m", marked, "-n", "0", "--no-header", "--tb=no", "-p", "no:cacheprovider")
    with subprocess.Popen(
        [sys.executable, "-m", "pytest", "-p", "tools.mutate", *options, *(str(root / file) for file in files)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), _LIMIT: str(limit_s), _SILENCE: str(silence_s)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as run:
        try:
            code = run.wait(_WAITING * limit_s)
        except subprocess.TimeoutExpired:
            return Verdict.CAUGHT
        finally:
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGKILL)
    if code == -signal.SIGXCPU:
        return Verdict.OUT_OF_TIME
    return Verdict.SURVIVED if code in (0, pytest.ExitCode.NO_TESTS_COLLECTED) else Verdict.CAUGHT


def pytest_configure() -> None:
    """Let the system end this process, as a plugin of pytest, after the processor time for one change."""
    seconds = math.ceil(float(os.environ[_LIMIT]))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def pytest_runtest_logstart() -> None:
    """Let it be ended by another signal where one test uses the processor time after which it does not end."""
    signal.setitimer(signal.ITIMER_PROF, float(os.environ[_SILENCE]))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Restore the order of the files: those with slow tests come first elsewhere."""
    rank = {Path(file): i for i, file in enumerate(config.args)}
    items.sort(key=lambda item: rank[item.path])


def _prepared(folder: Path) -> Path:
    """Return a copy of the checkout with compiled kernels, and the recorded logs beside it where there are any."""
    ignored = shutil.ignore_patterns(".git", ".venv", "*.egg-info", ".mypy_cache", "autotune-demo", "site")
    copy = folder / "checkout"
    shutil.copytree(ROOT, copy, ignore=ignored)
    if (ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
    command = (sys.executable, "-m", "autotune", "warm", "--quiet")
    subprocess.run(command, cwd=copy, env={**os.environ, "PYTHONPATH": str(copy)}, check=True)
    return copy


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "modules", nargs="*", type=Path, help="modules to change, relative to the checkout (default: all)"
    )
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="how many changes at a time, each in a copy of its own")
    parser.add_argument(
        "--limit",
        type=float,
        default=150.0,
        help="processor seconds for each group of tests of a change",
    )
    parser.add_argument("--silence", type=float, default=60.0, help="those after which a test does not end")
    options = parser.parse_args()
    mutants = drawn(options.modules, options.count, random.Random(options.seed))
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as threads:
        ready = _prepared(Path(folder))

        def judged(mutant: Mutant) -> tuple[Verdict, float]:
            begun = time.monotonic()
            # Beside the logs; links take no time, and what a change makes of the caches ends with its copy.
            with tempfile.TemporaryDirectory(dir=folder) as copy:
                shutil.copytree(ready, copy, copy_function=os.link, dirs_exist_ok=True)
                return judge(mutant, Path(copy), options.limit, options.silence), time.monotonic() - begun

        verdicts, running = dict[str, list[Verdict]](), {threads.submit(judged, mutant): mutant for mutant in mutants}
        for i, done in enumerate(as_completed(running)):
            verdict, lasted_s = done.result()
            verdicts.setdefault(running[done].kind, []).append(verdict)
            print(f"{i + 1:3d} {verdict:15s} {lasted_s:5.0f} s  {running[done]}", flush=True)
    counts = {kind: (each.count(Verdict.CAUGHT), len(each)) for kind, each in sorted(verdicts.items())}
    print(", ".join(f"{kind} {caught} of {drawn}" for kind, (caught, drawn) in counts.items()))
    caught = sum(each for each, _ in counts.values())
    print(f"{caught} of {options.count} caught ({100.0 * caught / options.count:.0f} %)")
    return 0


def drawn(modules: list[Path], count: int, draw: random.Random) -> list[Mutant]:
    """Draw changes, each of a module drawn among those given, or among all."""
    pool = {path: find_mutants(path, (ROOT / path).read_bytes()) for path in modules or _files(*FLOORS)}
    pool = {path: mutants for path, mutants in pool.items() if mutants}
    return [draw.choice(pool[draw.choice(list(pool))]) for _ in range(count)]


if __name__ == "__main__":
    sys.exit(main())
