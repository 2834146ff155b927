"""The one file that the pages may write: what it replaces is told, and once the server ends it is not written."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.explore.saving import SaveInterruptedError, Target
from autotune.formats.canonical import short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from tests.autotune.tuning.cases import small_controller

Progress = Callable[[float], None]


def other_controller() -> Controller:
    controller = small_controller()
    return replace(controller, axes={"x": replace(controller.axes["x"], deadband=2.0)})


def make(_progress: Progress) -> Controller:
    return small_controller()


def test_it_is_reported_which_file_was_replaced(tmp_path: Path) -> None:
    target = Target(tmp_path / "controller.yaml")
    assert target.existing() == ""
    first = target.save(make, "")
    assert first.replaced == ""
    assert target.existing() == f"the controller of checksum {first.checksum}"
    second = target.save(lambda _progress: other_controller(), target.existing())
    assert second.replaced == f"the controller of checksum {first.checksum}"
    assert short(read_controller(target.path).checksum) == second.checksum != first.checksum


def test_a_file_that_is_no_whole_controller_is_called_so(tmp_path: Path) -> None:
    target = Target(tmp_path / "controller.yaml")
    write_controller(target.path, small_controller())
    text = target.path.read_text(encoding="utf-8")
    for content in (text.replace("damping: ", "damping: 1", 1), "format: autotune/identified\n", ""):
        target.path.write_text(content, encoding="utf-8")
        assert target.existing() == "a file that is no whole controller"


def test_a_file_that_changed_after_it_was_reported_is_not_replaced(tmp_path: Path) -> None:
    target = Target(tmp_path / "controller.yaml")
    reported = target.existing()
    checksum = short(write_controller(target.path, other_controller()))
    with pytest.raises(UsageError, match=f"was not there, now it is the controller of checksum {checksum}"):
        target.save(make, reported)
    assert short(read_controller(target.path).checksum) == checksum
    assert target.save(make, target.existing()).replaced.endswith(checksum)


@pytest.mark.parametrize("asks", [True, False])
def test_nothing_is_written_once_it_has_ended(tmp_path: Path, asks: bool) -> None:
    target = Target(tmp_path / "controller.yaml")
    went_on = False

    def interrupted(progress: Progress) -> Controller:
        nonlocal went_on
        target.end()
        if asks:
            progress(0.5)
        went_on = True
        return small_controller()

    with pytest.raises(SaveInterruptedError):
        target.save(interrupted)
    # Whoever tells of progress is stopped there, and needs not finish.
    assert went_on is not asks
    assert target.is_cut_short
    assert not target.path.exists()
    with pytest.raises(SaveInterruptedError):
        target.save(make)


def test_an_end_without_a_save_under_way_cuts_nothing_short(tmp_path: Path) -> None:
    target = Target(tmp_path / "controller.yaml")
    target.save(make)
    with pytest.raises(UsageError):
        target.save(make, "another one")
    target.end()
    assert not target.is_cut_short
