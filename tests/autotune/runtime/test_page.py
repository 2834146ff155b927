"""What the page on the runtime shows works as it stands."""

import re
import shutil
import subprocess
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from autotune.export.export import export_controller
from autotune.formats.controller import write_controller
from autotune.formats.signature import sign_file
from tests.autotune.formats.samples import make_controller


def block(repository: Path, language: str) -> str:
    page = (repository / "docs" / "runtime.md").read_text(encoding="utf-8")
    (found,) = re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)
    return str(found)


pytestmark = pytest.mark.usefixtures("unchecked_law")
RESTING = 125
"""The first readings, 0.1 s at 0.8 ms, which a file without limits holds against rest."""


class StandingCell:
    """Rests, stands still under a push for three periods, and then tells a number that is none."""

    period_s, payload_mass_kg, payload_inertia_kg_m2, public_key = 8e-4, 16.0, {"rz": 16.0}, None

    def __init__(self, agreed_checksum: str) -> None:
        self.agreed_checksum, self.is_stopped = agreed_checksum, False
        self.sent: list[tuple[float, ...]] = []

    def is_running(self) -> bool:
        return not self.is_stopped

    def raw_wrench(self) -> list[float]:
        weight = 16.0 * 9.80665
        resting = [1.5, -0.25, 3.0 - weight, 0.1 + 0.02 * weight, 0.2 + 0.01 * weight, 0.0]
        if len(self.sent) < RESTING:
            return resting
        return [each + 50.0 if len(self.sent) < RESTING + 3 else float("nan") for each in resting]

    def period_count(self) -> int:
        return len(self.sent)

    def position(self) -> list[float]:
        return [0.0, 0.0, 0.0]

    def orientation(self) -> list[list[float]]:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

    def send_twist(self, twist_S: tuple[float, ...]) -> None:
        self.sent.append(twist_S)

    def stop(self) -> None:
        self.is_stopped = True


def test_the_python_loop_runs(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digest = write_controller(tmp_path / "controller.yaml", make_controller())
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (tmp_path / "pub.pem").write_bytes(public)
    sign_file(tmp_path / "controller.yaml", key, sha256((tmp_path / "controller.yaml").read_bytes()).hexdigest())
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(block(repository, "python"), "runtime.md", "exec"), names)
    cell = StandingCell(digest)
    names["run"](cell)
    assert [twist[0] > 0.0 for twist in cell.sent] == [False] * RESTING + [True, True, True, False]
    assert cell.sent[0] == cell.sent[-1] == (0.0,) * 6


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_the_c_loop_compiles(repository: Path, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", replace(make_controller(), provenance={}))
    export_controller(tmp_path / "controller.yaml", "c", tmp_path / "cell.c")
    (tmp_path / "loop.c").write_text(block(repository, "c"), encoding="utf-8")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only"]
    done = subprocess.run(
        ["gcc", *strict, "loop.c", "cell.c"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
