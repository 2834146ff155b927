"""A folder of controllers: written whole, read only if everything in it fits together, and never over other files."""

import os
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import CertificateError, UsageError
from autotune.formats import atomic
from autotune.formats.canonical import checksum
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.schedule import (
    Schedule,
    ScheduleClass,
    Tuned,
    check_schedule_target,
    is_schedule,
    read_schedule,
    write_schedule,
)
from autotune.formats.yaml12 import dump_yaml, load_yaml
from problems.design.objectives import CONTACT_FORCE
from tests.autotune.formats.samples import make_controller

LIGHT, HEAVY = (14.0, 18.0), (18.0, 18.0)
PROVENANCE = {
    "tool": "autotune 0.1.0",
    "identified": {"path": "identified.yaml", "sha256": "0" * 64},
    "options": {"seed": 1, "payload_mass_kg": [14.0, 18.0], "environment_stiffness_n_per_m": None, "compare": None},
}


def certified(mass: tuple[float, float]) -> Controller:
    """Return a controller of x and rz that says to be certified for these payloads along x."""
    controller = replace(make_controller(), provenance=PROVENANCE)
    domain = dict(controller.certificate.domain)
    domain["x"] = replace(domain["x"], payload_mass_kg=mass)
    return replace(controller, certificate=replace(controller.certificate, domain=domain))


def make_schedule() -> Schedule:
    tuned = tuple(
        Tuned(
            of=ScheduleClass(payload_mass_kg=mass),
            controller=certified(mass),
            peaks={"x": 93.1, "rz": 93.1},
            peaks_with_common={"x": 93.1 + cost, "rz": 93.1},
        )
        for mass, cost in ((LIGHT, 9.31), (HEAVY, 0.0))
    )
    return Schedule(
        tuned=tuned,
        hull=ScheduleClass(payload_mass_kg=LIGHT),
        common=certified(LIGHT),
        common_refusal="",
        objective=CONTACT_FORCE,
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_schedule(tmp_path / "cell", make_schedule())
    return tmp_path / "cell"


def resealed(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change `schedule.yaml` and give it the checksum of its new content."""
    tree = load_yaml(folder / "schedule.yaml")
    change(tree)
    tree["checksum"] = checksum(tree)
    (folder / "schedule.yaml").write_text(dump_yaml(tree), encoding="utf-8")


def test_what_is_written_is_read_back_with_its_controllers(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["all.yaml", "m14-18.yaml", "m18.yaml", "schedule.yaml"]
    read = read_schedule(folder / "schedule.yaml")
    assert {name: file.controller for name, file in read.controllers.items()} == {
        "m14-18": certified(LIGHT),
        "m18": certified(HEAVY),
        "all": certified(LIGHT),
    }
    # 18 kg is an end of the other class: the union is one range.
    assert read.tree["covered"] == {"payload_mass_kg": [[14.0, 18.0]]}
    first = read.tree["classes"][0]
    assert first["axes"]["x"]["cost_percent"] == pytest.approx(10.0)
    assert first["axes"]["rz"] == {
        "peak_torque_n_m": 93.1,
        "peak_with_common_n_m": 93.1,
        "cost_n_m": 0.0,
        "cost_percent": 0.0,
    }
    assert first["checksum"] == read_controller(folder / "m14-18.yaml").checksum
    # The classes say the mass, so the options do not.
    assert read.tree["provenance"]["options"] == {"seed": 1, "environment_stiffness_n_per_m": None}


def test_a_schedule_is_reported_from_a_controller(folder: Path) -> None:
    assert is_schedule(folder / "schedule.yaml")
    assert not is_schedule(folder / "all.yaml")
    assert not is_schedule(folder / "absent.yaml")


def _swap(folder: Path) -> None:
    """Give each class the other one's file, with right checksums everywhere."""
    light, heavy = (read_controller(folder / name).controller for name in ("m14-18.yaml", "m18.yaml"))
    digests = write_controller(folder / "m14-18.yaml", heavy), write_controller(folder / "m18.yaml", light)
    resealed(folder, lambda t: [c.update(checksum=d) for c, d in zip(t["classes"], digests, strict=True)])


def _edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return edit


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (_edit("schedule.yaml", "peak_force_n: 93.1", "peak_force_n: 83.1"), r"schedule\.yaml.*the file is altered"),
        (
            _edit("m18.yaml", "velocity_rad_per_s: 120.0", "velocity_rad_per_s: 121.0"),
            r"m18\.yaml.*the file is altered",
        ),
        (lambda f: (f / "m18.yaml").unlink(), r"m18\.yaml cannot be read"),
        (lambda f: (f / "all.yaml").unlink(), r"all\.yaml cannot be read"),
        (lambda f: write_controller(f / "m18.yaml", certified((17.0, 18.0))), r"m18\.yaml must have the checksum"),
        (_swap, r"classes\[0\]|m14-18\.yaml is certified for 18 to 18 on axis x"),
        (
            lambda f: resealed(f, lambda t: t["classes"][0]["axes"]["x"].update(peak_force_n=83.1)),
            r"the peaks of m14-18 are not those",
        ),
        (
            lambda f: resealed(f, lambda t: t["classes"][0].update(payload_mass_kg=[8.0, 18.0])),
            r"certified for 14 to 18",
        ),
        (lambda f: resealed(f, lambda t: t["classes"][1].update(name="m14-18")), r"a name and file of its own"),
        (lambda f: resealed(f, lambda t: t["classes"][1].update(file="../m18.yaml")), r"plain file name"),
        (lambda f: resealed(f, lambda t: t.update(classes=[])), r"classes must be at least 1"),
    ],
    ids=["sum", "controller", "absent", "no common", "other", "swapped", "peak", "range", "name", "path", "empty"],
)
def test_what_does_not_fit_together_is_refused(folder: Path, harm: Callable[[Path], object], message: str) -> None:
    harm(folder)
    with pytest.raises(CertificateError, match=message):
        read_schedule(folder / "schedule.yaml")


def test_a_former_schedule_is_replaced_and_its_other_classes_go(folder: Path) -> None:
    schedule = make_schedule()
    write_schedule(folder, replace(schedule, tuned=schedule.tuned[:1], common=None, common_refusal="why"))
    assert sorted(path.name for path in folder.iterdir()) == ["m14-18.yaml", "schedule.yaml"]
    assert [path.name for path in folder.parent.iterdir()] == ["cell"]
    assert read_schedule(folder / "schedule.yaml").tree["common"]["refusal"] == "why"


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda f: (f / "notes.txt").write_text("mine", encoding="utf-8"), "holds notes.txt beside its schedule"),
        (_edit("m18.yaml", "velocity_rad_per_s: 120.0", "velocity_rad_per_s: 121.0"), "the file is altered"),
        (lambda f: (f / "schedule.yaml").unlink(), "holds no schedule"),
    ],
)
def test_a_folder_with_anything_else_is_left_alone(folder: Path, harm: Callable[[Path], object], message: str) -> None:
    harm(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for refuse in (check_schedule_target, lambda f: write_schedule(f, make_schedule())):
        with pytest.raises(UsageError, match=message):
            refuse(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_file_and_a_missing_parent_are_refused_and_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with pytest.raises(UsageError, match="is a file"):
        check_schedule_target(tmp_path / "file")
    with pytest.raises(UsageError, match="does not exist"):
        check_schedule_target(tmp_path / "missing" / "cell")
    (tmp_path / "cell").mkdir()
    write_schedule(tmp_path / "cell", make_schedule())
    assert len(read_schedule(tmp_path / "cell" / "schedule.yaml").controllers) == 3


@pytest.mark.parametrize("fail_at", ["first file", "second file", "folder"])
@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failure_leaves_the_former_schedule_and_nothing_else(
    folder: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, fail_at: str
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    schedule = replace(make_schedule(), tuned=make_schedule().tuned[:1], common=None)
    honest_rename, honest_fsync, files = os.rename, os.fsync, list[int]()

    def rename(self: Path, target: Path) -> Path:
        if self.name.endswith(".tmp") and target.name == "cell" and fail_at == "folder":
            raise failure
        honest_rename(self, target)
        return target

    def fsync(descriptor: int) -> None:
        # That of a folder may fail: not every system can.
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            files.append(descriptor)
            if f"{('first', 'second')[len(files) - 1]} file" == fail_at:
                raise failure
        honest_fsync(descriptor)

    # On a system whose folders do not trade places, the step is a rename.
    monkeypatch.setattr(atomic, "exchange", lambda *_: False)
    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(UsageError if isinstance(failure, OSError) else type(failure)):
        write_schedule(folder, schedule)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["cell"]
