"""What a newcomer reads when the machine cannot make a virtual environment."""

import subprocess
import sys
from pathlib import Path


def _make_venv(repository: Path, *arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    command = ["sh", str(repository / "tools" / "make_venv.sh"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def _fake_python(folder: Path, script: str) -> Path:
    path = folder / "fake-python"
    path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def test_a_python_that_is_too_old_is_named_with_a_way_out(repository: Path, tmp_path: Path) -> None:
    old = _fake_python(tmp_path, "exit 1")
    done = _make_venv(repository, tmp_path / "venv", old)
    assert done.returncode == 1
    assert "needs Python 3.11 or later" in done.stderr
    assert str(old) in done.stderr
    assert "make PYTHON=" in done.stderr
    assert not (tmp_path / "venv").exists()


def test_a_missing_ensurepip_is_reported_with_the_package_that_brings_it(repository: Path, tmp_path: Path) -> None:
    bare = _fake_python(tmp_path, f'case "$2" in *ensurepip*) exit 1;; esac; exec "{sys.executable}" "$@"')
    done = _make_venv(repository, tmp_path / "venv", bare)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert done.returncode == 1
    assert f"apt-get install python{version}-venv" in done.stderr
    assert not (tmp_path / "venv").exists()


def test_a_failure_half_way_leaves_no_environment_behind(repository: Path, tmp_path: Path) -> None:
    half = _fake_python(
        tmp_path, f'if [ "$2" = venv ]; then mkdir -p "$4/bin"; exit 1; fi; exec "{sys.executable}" "$@"'
    )
    done = _make_venv(repository, tmp_path / "venv", half)
    assert done.returncode == 1
    assert "could not be made" in done.stderr
    assert not (tmp_path / "venv").exists()
