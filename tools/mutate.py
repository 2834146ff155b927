"""Change random places of the code, one at a time, and see whether the tests notice.

Each change goes into a copy of the checkout. The tests that import the changed module run first, then those of its
room. Functions are changed in their source, not wrapped at run time as mutation libraries do: the compiler of the
kernels would not take a wrapped one.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("problems", "identification", "autotune")
_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
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
            found.append(Mutant(path=path, line=node.lineno, start=start, stop=stop, before=before, after=after))
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
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPS and len(node.ops) == 1:
        yield _text(ast.Compare(node.left, [_SWAPS[type(node.ops[0])]()], node.comparators))  # type: ignore[list-item]
    elif (
        isinstance(node, ast.BinOp)
        and type(node.op) in _SWAPS
        and not isinstance(node.left, ast.Constant | ast.JoinedStr)
    ):
        yield _text(ast.BinOp(node.left, _SWAPS[type(node.op)](), node.right))  # type: ignore[arg-type]
    elif isinstance(node, ast.BoolOp):
        yield _text(ast.BoolOp(_SWAPS[type(node.op)](), node.values))  # type: ignore[arg-type]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield _text(node.operand)
    elif isinstance(node, ast.IfExp):
        yield _text(ast.IfExp(node.test, node.orelse, node.body))
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield repr(2 * node.value or 1)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _NAMES:
        yield _text(ast.Call(ast.Name(_NAMES[node.func.id]), node.args, node.keywords))


def _text(node: ast.expr) -> str:
    return f"({ast.unparse(ast.fix_missing_locations(node))})"


def files_of_tests(path: Path, root: Path) -> list[list[Path]]:
    """Return the files of tests to run, nearest first: those that import the module, then those of its room."""
    name = ".".join(path.with_suffix("").parts)
    package, _, last = name.rpartition(".")
    marks = (f"from {name} import", f"import {name}", f"from {package} import {last}")
    every = sorted((root / "tests").rglob("test_*.py"))
    near = [test for test in every if any(mark in test.read_text(encoding="utf-8") for mark in marks)]
    room = [test for test in every if test.is_relative_to(root / "tests" / path.parent) and test not in near]
    return [group for group in (near, room) if group]


def survives(mutant: Mutant, root: Path, limit_s: float) -> bool:
    """Run the tests on the changed copy `root`; a run that takes longer than the limit counts as noticed."""
    target = root / mutant.path
    source = target.read_bytes()
    environment = {**os.environ, "PYTHONPATH": str(root)}
    target.write_bytes(mutant.applied(source))
    try:
        for group in files_of_tests(mutant.path, root):
            command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *map(str, group)]
            try:
                run = subprocess.run(
                    command, cwd=root, env=environment, capture_output=True, timeout=limit_s, check=False
                )
            except subprocess.TimeoutExpired:
                return False
            if run.returncode != 0:
                return False
        return True
    finally:
        target.write_bytes(source)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "modules", nargs="*", type=Path, help="modules to change, relative to the checkout (default: all)"
    )
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for the tests of one change")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    modules = options.modules or [
        file.relative_to(ROOT)
        for floor in FLOORS
        for file in sorted((ROOT / floor).rglob("*.py"))
        if file.stat().st_size
    ]
    pool = {path: find_mutants(path, (ROOT / path).read_bytes()) for path in modules}
    pool = {path: mutants for path, mutants in pool.items() if mutants}
    alive = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "checkout"
        ignored = shutil.ignore_patterns(".git", ".venv", "*.egg-info", ".mypy_cache", "autotune-demo")
        shutil.copytree(ROOT, copy, ignore=ignored)
        if (ROOT.parent / "shared").is_dir():
            (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        for i in range(options.count):
            mutant = draw.choice(pool[draw.choice(list(pool))])
            begun = time.monotonic()
            lives = survives(mutant, copy, options.limit)
            alive += [mutant] * lives
            verdict = "SURVIVED" if lives else "caught  "
            print(f"{i + 1:3d} {verdict} {time.monotonic() - begun:5.0f} s  {mutant}", flush=True)
    caught = options.count - len(alive)
    print(f"{caught} of {options.count} caught ({100.0 * caught / options.count:.0f} %)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
