"""What needs an optional package says so in one sentence before it does anything; nothing else needs one."""

import subprocess
import sys
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.controller import write_controller
from tests.autotune.tuning.cases import small_controller

_WITHOUT = (
    "import sys\n"
    "class Absent:\n"
    "    def find_spec(self, name, path=None, target=None):\n"
    "        if name.split('.')[0] in {'bokeh', 'jinja2', 'pyarrow', 'tornado'}:\n"
    "            raise ModuleNotFoundError(name)\n"
    "sys.meta_path.insert(0, Absent())\n"
    "from autotune.cli.main import main\n"
    "sys.exit(main(sys.argv[1:]))\n"
)


@pytest.fixture
def nothing_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("problems.errors.find_spec", lambda _: None)


@pytest.mark.usefixtures("nothing_optional")
@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["identify", "table.csv", "--cell", "cell.yaml"], "tables"),
        (["identify", "table.parquet", "--cell", "cell.yaml"], "tables"),
        (["identify", "joints.mcap", "--urdf", "arm.urdf", "--tip", "tool0"], "urdf"),
        (["report", "controller.yaml"], "reports"),
        (["validate", "controller.yaml", "--report", "page.html"], "reports"),
        (["explore", "controller.yaml"], "reports"),
    ],
)
def test_a_missing_extra_is_named_and_nothing_is_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    extra: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{0.002 * i:.3f},0.0,0.0,0.0\n" for i in range(50))
    (tmp_path / "table.csv").write_text(f"t,fx,fy,fz\n{rows}", encoding="utf-8")
    (tmp_path / "table.parquet").write_bytes(b"PAR1" + bytes(60) + b"PAR1")
    (tmp_path / "cell.yaml").write_text(
        "format: autotune/cell\nversion: 1\ntable: {time: t}\nwrench: {fields: {force: [fx, fy, fz]}}\n",
        encoding="utf-8",
    )
    (tmp_path / "joints.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "controller.yaml").write_text("", encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.endswith(f"which is not installed: pip install 'robot-autotune[{extra}]'.\n")
    assert sorted(tmp_path.iterdir()) == before


def test_a_log_and_a_controller_need_no_optional_package(tmp_path: Path, good_log: Path) -> None:
    write_controller(tmp_path / "controller.yaml", small_controller())
    for arguments in (["inspect", str(good_log)], ["export", "controller.yaml", "--target", "json", "-o", "c.json"]):
        run = subprocess.run(
            [sys.executable, "-c", _WITHOUT, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, run.stderr
