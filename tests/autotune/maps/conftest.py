"""Files to read, written once."""

import shutil
from pathlib import Path

import pytest

from autotune.formats.controller import write_controller
from autotune.formats.identified import write_identified
from tests.autotune.formats.samples import make_controller, make_identified
from tests.autotune.maps.map_cases import controller_file, identified


@pytest.fixture(scope="module")
def written_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sources")
    write_controller(path / "controller.yaml", controller_file())
    write_controller(path / "two.yaml", make_controller(("x", "rz")))
    write_identified(path / "identified.yaml", identified(), {})
    write_identified(path / "sample.yaml", make_identified(), {})
    return path


@pytest.fixture
def folder(tmp_path: Path, written_once: Path) -> Path:
    """A folder of one's own with the files that are read."""
    shutil.copytree(written_once, tmp_path, dirs_exist_ok=True)
    return tmp_path
