"""The rules of the house that no linter knows."""

import ast
import importlib
import re
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from autotune import __version__

PACKAGES = ("autotune", "identification", "problems")
MOST_LINES_OF_A_MODULE = 450
MOST_LINES_OF_A_FUNCTION = 60
CODE = (*PACKAGES, "tests", "tools", "examples", "benchmarks")


def _modules(repository: Path, folders: tuple[str, ...] = CODE) -> list[Path]:
    return sorted(path for folder in folders for path in (repository / folder).rglob("*.py"))


@cache
def _tree(path: Path) -> ast.Module:
    """Return the syntax tree of a module; to parse them all takes a second."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def _nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(_tree(path)))


def _pyproject(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))


def test_no_module_is_too_long(repository: Path) -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in _modules(repository)}
    assert len(lengths) > 10
    assert {path.name: n for path, n in lengths.items() if n > MOST_LINES_OF_A_MODULE} == {}


def _lines_of_code(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines without the docstring, which of a public function lists every argument."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    first = function.body[0]
    has_docstring = ast.get_docstring(function, clean=False) is not None
    return lines - ((first.end_lineno or 0) - first.lineno + 1 if has_docstring else 0)


def test_no_function_is_too_long(repository: Path) -> None:
    too_long = [
        f"{path.relative_to(repository)}:{node.lineno} {node.name}"
        for path in _modules(repository)
        for node in _nodes(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _lines_of_code(node) > MOST_LINES_OF_A_FUNCTION
    ]
    assert too_long == []


def test_the_listed_packages_are_those_on_disk(repository: Path) -> None:
    on_disk = {path.parent.relative_to(repository) for path in _modules(repository, PACKAGES)}
    listed = _pyproject(repository)["tool"]["setuptools"]["packages"]
    assert listed == sorted(".".join(folder.parts) for folder in on_disk)


def test_every_package_folder_has_an_init_and_every_floor_its_types(repository: Path) -> None:
    folders = {path.parent for path in _modules(repository, PACKAGES)}
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []
    assert [name for name in PACKAGES if not (repository / name / "py.typed").is_file()] == []


@pytest.mark.parametrize("name", ["identification", "problems"])
def test_only_autotune_has_public_names(name: str) -> None:
    """Those of `autotune` are pinned in tests/autotune/test_api.py."""
    assert getattr(importlib.import_module(name), "__all__", None) is None


@pytest.mark.parametrize("command", ["make demo", "make test"])
def test_the_readme_names_a_command_that_the_makefile_has(repository: Path, command: str) -> None:
    readme = (repository / "README.md").read_text(encoding="utf-8")
    makefile = (repository / "Makefile").read_text(encoding="utf-8")
    assert command in readme
    assert re.search(rf"^{command.removeprefix('make ')}:", makefile, flags=re.MULTILINE)


def test_the_installed_command_is_the_main_function(repository: Path) -> None:
    scripts = _pyproject(repository)["project"]["scripts"]
    assert list(scripts) == ["autotune"]
    module, _, function = scripts["autotune"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_the_changelog_has_a_place_for_what_comes_next(repository: Path) -> None:
    changelog = (repository / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## \[(.+?)\]", changelog, flags=re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)


def test_contributing_stays_short(repository: Path) -> None:
    assert len((repository / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines()) < 60


def test_no_path_of_one_machine_is_in_the_project(repository: Path) -> None:
    pattern = re.compile(r"""(?<![\w.])/(home|root|work|Users)/\w""")
    texts = [*_modules(repository), repository / "Makefile", repository / "pyproject.toml"]
    found = [path.name for path in texts if path != Path(__file__) and pattern.search(path.read_text(encoding="utf-8"))]
    assert found == []


@pytest.mark.parametrize(
    ("library", "only"),
    [
        ("casadi", {"problems/design/symbolic.py"}),
        ("control", {"problems/model/python_control.py"}),
        ("cryptography", {"autotune/formats/signature.py"}),
        ("cvxpy", {"autotune/limit/programs.py"}),
        ("flint", {"autotune/certificate/balls.py"}),
        ("optuna", {"autotune/studies/storage.py", "autotune/studies/study.py"}),
        (
            "sqlalchemy",
            {
                *("autotune/campaign/checksums.py", "autotune/campaign/state.py", "autotune/database.py"),
                "autotune/studies/storage.py",
            },
        ),
    ],
)
def test_a_heavy_library_has_one_door(repository: Path, library: str, only: set[str]) -> None:
    """Each takes up to a second to import, which no command should pay that does not need them."""
    found = set()
    for path in _modules(repository, PACKAGES):
        for node in _nodes(path):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
            if library in {name.split(".")[0] for name in names}:
                found.add(path.relative_to(repository).as_posix())
    assert found == only


def test_optuna_is_imported_with_a_study_only(repository: Path) -> None:
    """What imports storage or study at once pays for Optuna too, so that only the study does."""
    importing = {
        path.relative_to(repository).as_posix()
        for path in _modules(repository, PACKAGES)
        for node in _tree(path).body
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[-1] in {"storage", "study"}
    }
    assert importing == {"autotune/studies/study.py"}


@cache
def _imports(repository: Path) -> dict[str, set[str]]:
    """Return which modules of the three roots each of them imports, inside functions and for types alone included."""
    paths = {
        ".".join(path.relative_to(repository).with_suffix("").parts): path for path in _modules(repository, PACKAGES)
    }
    paths = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    found: dict[str, set[str]] = {}
    for name, path in paths.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        imported = found.setdefault(name, set())
        for node in _nodes(path):
            if isinstance(node, ast.Import):
                imported |= {each.name for each in node.names} & paths.keys()
            elif isinstance(node, ast.ImportFrom):
                parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
                source = ".".join([*parents, *filter(None, [node.module])])
                names = {f"{source}.{each.name}" for each in node.names} & paths.keys()
                imported |= names or ({source} & paths.keys())
    return found


def test_no_import_goes_in_a_circle(repository: Path) -> None:
    left = dict(_imports(repository))
    assert len(left) > 100
    while free := {name for name, imported in left.items() if not imported & left.keys()}:
        left = {name: imported for name, imported in left.items() if name not in free}
    # What is left lies in a circle or imports one.
    assert sorted(left) == []


def test_the_picture_of_the_rooms_is_true(repository: Path) -> None:
    """Every room is drawn once, and none imports a room of its floor that is drawn beside or above it."""
    picture = (repository / "docs" / "design.md").read_text(encoding="utf-8").split("```")[1]
    drawn: dict[str, int] = {}
    floor = ""
    for number, line in enumerate(picture.splitlines()):
        floor = next((name for name in PACKAGES if f"  {name}/" in line), floor)
        for room in line[20:69].split():
            if not room.startswith("─"):
                assert drawn.setdefault(f"{floor}.{room}", number) == number
    rooms = {
        path.relative_to(repository).parent for floor in PACKAGES for path in (repository / floor).glob("*/__init__.py")
    }
    assert drawn.keys() == {".".join(room.parts) for room in rooms}
    for name, imported in _imports(repository).items():
        above = ".".join(name.split(".")[:2])
        for other in imported:
            below = ".".join(other.split(".")[:2])
            if above != below and above in drawn and below in drawn and above.split(".")[0] == below.split(".")[0]:
                assert drawn[above] < drawn[below], f"{name} imports {other}"


# `Plant` is a name of the public interface, for the cell's axis as a person writes it, and the model inside.
NAMES_WITH_TWO_MEANINGS = {"Plant"}


def test_a_public_class_name_has_one_meaning(repository: Path) -> None:
    places: dict[str, list[str]] = {}
    for path in _modules(repository, PACKAGES):
        for node in _tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(path.relative_to(repository).as_posix())
    assert len(places) > 100
    shared = {name: found for name, found in places.items() if len(found) > 1}
    assert {name: found for name, found in shared.items() if name not in NAMES_WITH_TWO_MEANINGS} == {}


KERNELS = ("compiled", "equation", "inlined", "released", "unlocked")
# Where a position is what it says: a power of a polynomial or a place in Routh's array; the only entry there is; the
# first of a series.
POSITIONS = {
    "problems/stability/polynomials.py": None,
    "problems/stability/margin_kernel.py": None,
    "problems/contact/kernel.py": {"force[0]"},
    "problems/contact/event_free_steps.py": {"force[0]"},
    "identification/logs/messages/kernel.py": {"bits[0]", "floats[0]"},
    "identification/robot/admittance_motion.py": {"out[0]", "force[0]", "damping[0]"},
}


def _places(of: ast.Subscript) -> list[int]:
    """Return the constant positions of an access."""
    parts = of.slice.elts if isinstance(of.slice, ast.Tuple) else [of.slice]
    numbers = [part.operand if isinstance(part, ast.UnaryOp) else part for part in parts]
    return [each.value for each in numbers if isinstance(each, ast.Constant) and isinstance(each.value, int)]


def _in_rows(function: ast.FunctionDef) -> set[ast.Subscript]:
    """Return the accesses that only take a row apart or put it together: `a, b, c = row[0], row[1], row[2]`."""
    out: set[ast.Subscript] = set()
    for node in ast.walk(function):
        elements = node.elts if isinstance(node, ast.Tuple) else node.args if isinstance(node, ast.Call) else []
        rows: dict[str, list[ast.Subscript]] = {}
        for each in elements:
            if isinstance(each, ast.Subscript) and len(_places(each)) == 1:
                rows.setdefault(re.sub(r"\b\d+\b", "", ast.unparse(each)), []).append(each)
        for accesses in rows.values():
            places = [_places(each)[0] for each in accesses]
            if len(places) > 1 and places == list(range(places[0], places[0] + len(places))):
                out.update(accesses)
    return out


def _unnamed(function: ast.FunctionDef, allowed: set[str]) -> list[str]:
    rows, out = _in_rows(function), []
    for node in (each for statement in function.body for each in ast.walk(statement)):
        if isinstance(node, ast.Subscript) and _places(node) and node not in rows:
            is_shape = isinstance(node.value, ast.Attribute) and node.value.attr == "shape"
            if not is_shape and ast.unparse(node) not in allowed:
                out.append(f"{function.name}: {ast.unparse(node)}")
    return out


def test_kernels_name_what_they_take(repository: Path) -> None:
    """`found[CONTACT_PEAK]` and `wall.stiffness` can be read and debugged; `found[2]` and `wall[0]` cannot."""
    unnamed, count = {}, 0
    for path in _modules(repository, PACKAGES):
        name = path.relative_to(repository).as_posix()
        for function in _nodes(path):
            if not isinstance(function, ast.FunctionDef):
                continue
            allowed, marks = POSITIONS.get(name, set()), {getattr(each, "id", "") for each in function.decorator_list}
            if allowed is not None and marks & set(KERNELS):
                count += 1
                unnamed[f"{name} {function.name}"] = _unnamed(function, allowed)
    assert count > 100
    assert {name: found for name, found in unnamed.items() if found} == {}


def test_an_array_type_is_defined_once(repository: Path) -> None:
    """A second definition of `FloatArray` may mean another width; that of `problems.arrays` is the one."""
    home = repository / "problems" / "arrays.py"
    definition = re.compile(r"^(\w+Array) = NDArray\[", flags=re.MULTILINE)
    names = set(definition.findall(home.read_text(encoding="utf-8")))
    assert "FloatArray" in names
    found = {path: set(definition.findall(path.read_text(encoding="utf-8"))) & names for path in _modules(repository)}
    assert [path for path, again in found.items() if again] == [home]


def test_a_constant_of_a_module_is_set_once(repository: Path) -> None:
    """The second value would be that of all that stands between the two as well."""
    for path in _modules(repository):
        assigned = [target for node in _tree(path).body if isinstance(node, ast.Assign) for target in node.targets]
        names = Counter(
            each.id
            for target in assigned
            for each in (target.elts if isinstance(target, ast.Tuple) else [target])
            if isinstance(each, ast.Name) and each.id.isupper()
        )
        assert {name for name, count in names.items() if count > 1} == set(), path
