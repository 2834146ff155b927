"""An export replaces what the same export made, and leaves every other file alone."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.export.export import check_files, export_controller
from autotune.export.fzi_cartesian import FziOptions
from autotune.export.ros2_control import Ros2Options
from autotune.export.targets import TARGETS
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from tests.autotune.export.peer_cases import MDK_CASES, PLAIN, peer_controller, requirements, translated
from tests.autotune.formats.samples import make_controller
from tests.autotune.tuning.cases import small_controller

pytestmark = pytest.mark.usefixtures("unchecked_law")

FILE_TARGETS = tuple(name for name, target in TARGETS.items() if not target.is_folder)
SAME_LAW = tuple(name for name in FILE_TARGETS if TARGETS[name].runs_same_law)
FOREIGN = {
    "a text": "thesis, chapter 3\n",
    "a log": "\x89MCAP0\r\n binary",
    "JSON of another program": '{"format": "theirs"}\n',
    "JSON that ends early": '{"format": "autotune/controller", ',
    "parameters of a colleague": "admittance_controller:\n  ros__parameters:\n    joints: [a]\n",
}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_controller(tmp_path / "controller.yaml", make_controller())
    return tmp_path / "controller.yaml"


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return what each target writes, of C the source; bytes that are no text as surrogates."""
    folder = tmp_path_factory.mktemp("texts")
    path = folder / "controller.yaml"
    write_controller(path, small_controller())
    for target in SAME_LAW:
        export_controller(path, target, folder / f"{target}.c")
    found = {target: (folder / f"{target}.c").read_bytes().decode(errors="surrogateescape") for target in SAME_LAW}
    easy = folder / "easy.yaml"
    write_controller(easy, peer_controller({"x": PLAIN}, requirements(2.5e-4)))
    read = read_controller(easy)
    level = FziOptions(orientation=(0.0, 0.0, 0.0, 1.0))
    for name, controller in MDK_CASES.items():
        write_controller(easy, controller)
        options = {"orientation": (0.0, 0.0, 0.0, 1.0)} if name in ("crisp", "lbr_fri_ros2") else {}
        export_controller(easy, name, folder / name, options=options)
        found[name] = (folder / name).read_text(encoding="utf-8")
    return found | {"ros2_control": translated(read, Ros2Options()).text, "fzi_cartesian": translated(read, level).text}


@pytest.mark.parametrize("what", FOREIGN)
@pytest.mark.parametrize("target", SAME_LAW)
def test_the_file_of_somebody_else_is_left_alone(source: Path, target: str, what: str) -> None:
    out = source.with_name("out.c")
    out.write_text(FOREIGN[what], encoding="utf-8")
    with pytest.raises(UsageError, match=rf"is no export to {target}( \(controller\))?, so it is not replaced"):
        export_controller(source, target, out)
    assert out.read_text(encoding="utf-8") == FOREIGN[what].replace("\r\n", "\n")
    assert {path.name for path in source.parent.iterdir()} == {"controller.yaml", "out.c"}


def test_another_controller_is_no_export(source: Path) -> None:
    """A controller.yaml that a search wrote is like a cell file but for the line that names the latter."""
    other = source.with_name("other.yaml")
    write_controller(other, replace(make_controller(), delay_samples=4.0))
    for target in ("cell", "json"):
        with pytest.raises(UsageError, match="is no export to"):
            export_controller(source, target, other)
    assert read_controller(other).controller.delay_samples == 4.0


@pytest.mark.parametrize("target", SAME_LAW)
def test_what_is_read_is_not_replaced(tmp_path: Path, target: str) -> None:
    write_controller(tmp_path / "cell.c", make_controller())
    (tmp_path / "link.c").symlink_to(tmp_path / "cell.c")
    for name in ("cell.c", "link.c"):
        with pytest.raises(UsageError, match=rf"{name} is what is read"):
            export_controller(tmp_path / "cell.c", target, tmp_path / name)


@pytest.mark.parametrize("target", SAME_LAW)
def test_an_export_is_replaced_by_the_same_one(source: Path, target: str) -> None:
    out = source.with_name("out.c")
    export_controller(source, target, out)
    kind = TARGETS[target]
    assert check_files(kind, kind.files(out), source) == kind.files(out)
    first = out.read_bytes()
    changed: Controller = replace(make_controller(), delay_samples=4.0)
    write_controller(source, changed)
    export_controller(source, target, out)
    assert out.read_bytes() != first


@pytest.mark.parametrize("made_by", FILE_TARGETS)
def test_every_target_takes_its_own_file_and_no_other_s(source: Path, texts: dict[str, str], made_by: str) -> None:
    out = source.with_name("out.c")
    out.write_text(texts[made_by], encoding="utf-8", errors="surrogateescape")
    for target in FILE_TARGETS:
        if target == made_by:
            check_files(TARGETS[target], TARGETS[target].files(out), source)
        else:
            with pytest.raises(UsageError, match=r"name another (file|one) with -o"):
                check_files(TARGETS[target], TARGETS[target].files(out), source)


def test_a_header_of_somebody_else_keeps_the_pair_from_being_written(source: Path) -> None:
    source.with_name("out.h").write_text("/* format: mine */\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"out\.h exists and is no export to c"):
        export_controller(source, "c", source.with_name("out.c"))
    assert not source.with_name("out.c").exists()


def test_an_empty_file_and_a_device_hold_nothing_that_could_be_lost(source: Path) -> None:
    empty = source.with_name("empty")
    empty.touch()
    assert check_files(TARGETS["json"], (empty,), source) == ()
    export_controller(source, "json", empty)
    assert check_files(TARGETS["json"], (Path(os.devnull),), source) == ()
    assert read_controller(empty).controller == make_controller()


def test_another_controller_s_parameters_are_refused_before_anything_is_certified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out = tmp_path / "easy.yaml", tmp_path / "ur10.yaml"
    write_controller(source, peer_controller({"x": PLAIN}, requirements(2.5e-4)))
    out.write_text(FOREIGN["parameters of a colleague"], encoding="utf-8")
    monkeypatch.setattr("autotune.export.third_party.translate_controller", None)
    for target in ("ros2_control", "fzi_cartesian"):
        with pytest.raises(UsageError, match="is no export to"):
            export_controller(source, target, out)
