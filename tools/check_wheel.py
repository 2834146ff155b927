"""Build the wheel and check that it holds the packages, their types, schemas, pages and templates, and nothing else.

The build runs on a copy of the sources: files left over from an earlier build cannot get in, and none is left behind.
"""

import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("autotune", "identification", "problems")
AROUND = ("pyproject.toml", "README.md", "LICENSE")
TYPED = frozenset(f"{package}/py.typed" for package in PACKAGES)
SCHEMAS = "autotune/formats/schemas/"
PAGES = ("autotune/report/page.*", "autotune/explore/explore.*", "autotune/export/*/*.in")


def expected_files(root: Path) -> frozenset[str]:
    """Return what the wheel must hold beside its metadata, from what lies on disk under `root`."""
    modules = {path for package in PACKAGES for path in (root / package).rglob("*.py")}
    schemas = set((root / SCHEMAS).glob("*.json"))
    page = {path for pattern in PAGES for path in root.glob(pattern)}
    return TYPED | {path.relative_to(root).as_posix() for path in modules | schemas | page}


def build_wheel(root: Path, work: Path) -> Path:
    """Build the wheel from a copy of the sources in `work` and return its path."""
    sources = work / "sources"
    for package in PACKAGES:
        shutil.copytree(root / package, sources / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in AROUND:
        shutil.copy(root / name, sources / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(work), str(sources)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode != 0:
        raise SystemExit(f"The wheel does not build:\n{built.stdout}{built.stderr}")
    (wheel,) = work.glob("*.whl")
    return wheel


def complaints(names: set[str], expected: frozenset[str]) -> list[str]:
    """Return one line per file that is missing from `names`, should not be there, or should exist and does not."""
    content = {name for name in names if not name.split("/", maxsplit=1)[0].endswith(".dist-info")}
    missing = [f"missing: {name}" for name in sorted(expected - content)]
    unexpected = [f"unexpected: {name}" for name in sorted(content - expected)]
    no_schema = [] if any(name.startswith(SCHEMAS) for name in content) else [f"missing: a schema in {SCHEMAS}"]
    return missing + unexpected + no_schema


def main() -> int:
    """Print the verdict; return 0 when the wheel holds what it should."""
    with tempfile.TemporaryDirectory() as work:
        wheel = build_wheel(ROOT, Path(work))
        with zipfile.ZipFile(wheel) as archive:
            names = set(archive.namelist())
    found = complaints(names, expected_files(ROOT))
    if found:
        print(f"{wheel.name}:", *found, sep="\n  ")
        return 1
    print(f"{wheel.name}: {len(names)} files, all as they should be.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
