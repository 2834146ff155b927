"""What a killed run leaves is swept by the next one: its own, and nothing else. Folders trade places in one step."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats import atomic
from autotune.formats.atomic import (
    _where,
    exchange,
    sweep_leftovers,
    temporary_beside,
    write_atomic,
    write_folder_atomic,
)

DAY_S = 86400.0
# Writes a file and a folder in turn for ever; prints a line first so that the test knows when it has begun.
_FOR_EVER = """
import sys
from pathlib import Path
from autotune.formats.atomic import write_atomic, write_folder_atomic
folder = Path(sys.argv[1])
print("begun", flush=True)
while True:
    for text in ("old", "new"):
        write_atomic(folder / "file", text * 4096)
        write_folder_atomic(folder / "both", {"a": text, "b": text})
"""


def named(folder: Path, where: str, process: int, end: str = "tmp", mark: str = "0" * 16) -> Path:
    return folder / f".autotune-{where}-{process}-{mark}.{end}"


@pytest.fixture(scope="module")
def ended() -> int:
    """The number of a process that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return process.pid


def test_only_what_is_certainly_left_is_swept(tmp_path: Path, ended: int) -> None:
    mine, others = _where(), "0" * 8
    left = [named(tmp_path, mine, ended), named(tmp_path, mine, ended, mark="1" * 16), named(tmp_path, others, ended)]
    kept = [
        named(tmp_path, mine, os.getpid()),
        named(tmp_path, others, ended, mark="2" * 16),
        tmp_path / f".autotune-{'0' * 16}.tmp",
        tmp_path / ".autotune-notes.tmp",
        tmp_path / "notes",
    ]
    for path in (*left[:1], left[2], *kept):
        path.write_text("x")
    left[1].mkdir()
    (left[1] / "controller.yaml").write_text("x")
    os.utime(left[2], (time.time() - 2.0 * DAY_S,) * 2)
    link = named(tmp_path, mine, ended, mark="3" * 16)
    link.symlink_to(tmp_path / "notes")
    # A former folder whose successor never took its place is all that there is of it.
    pair = [named(tmp_path, mine, ended, end, mark="4" * 16) for end in ("tmp", "old")]
    for path in pair:
        path.mkdir()
    sweep_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([*kept, link, *pair])
    sweep_leftovers(tmp_path / "not there")


@pytest.mark.parametrize("can", [True, False])
def test_a_folder_takes_the_place_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can: bool) -> None:
    if not can:
        monkeypatch.setattr(atomic, "exchange", lambda *_: False)
    for text in ("old", "new"):
        write_folder_atomic(tmp_path / "both", {"a": text, text: text})
    assert {path.name: path.read_text() for path in (tmp_path / "both").iterdir()} == {"a": "new", "new": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["both"]


@pytest.mark.parametrize("can", [True, False])
def test_a_folder_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can: bool
) -> None:
    write_folder_atomic(tmp_path / "both", {"a": "old"})
    if not can:
        monkeypatch.setattr(atomic, "exchange", lambda *_: False)
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if self.suffix == ".tmp":
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    if can:
        monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(5, "Input/output error")))
    with pytest.raises(UsageError, match="cannot be written"):
        write_folder_atomic(tmp_path / "both", {"a": "new"})
    assert [path.name for path in tmp_path.iterdir()] == ["both"]
    assert (tmp_path / "both" / "a").read_text() == "old"


@pytest.mark.skipif(sys.platform != "linux", reason="renameat2")
def test_two_names_trade_places(tmp_path: Path) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "is").write_text(name)
    if not exchange(tmp_path / "one", tmp_path / "other"):
        pytest.skip("the file system cannot")
    assert (tmp_path / "one" / "is").read_text() == "other"
    assert not exchange(tmp_path / "one", tmp_path / "none")
    assert (tmp_path / "one").is_dir()


def test_a_name_says_whose_it_is(tmp_path: Path) -> None:
    new, former = temporary_beside(tmp_path / "a")
    assert new.parent == tmp_path
    assert new.name == f".autotune-{_where()}-{os.getpid()}-{new.name[-20:-4]}.tmp"
    assert former.name == f"{new.name[:-3]}old"
    assert temporary_beside(tmp_path / "a")[0] != new


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_runs_killed_at_random_moments_leave_whole_files_and_the_next_one_nothing_else(
    tmp_path: Path, repository: Path
) -> None:
    rng = random.Random(3)
    for _ in range(int(os.environ.get("AUTOTUNE_KILLS", "10"))):
        with subprocess.Popen(
            [sys.executable, "-c", _FOR_EVER, str(tmp_path)], cwd=repository, stdout=subprocess.PIPE
        ) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"begun\n"
            time.sleep(rng.uniform(0.0, 0.03))
            writer.send_signal(signal.SIGKILL)
        # At most what the last one was about: those before were swept.
        assert sum(path.name.startswith(".autotune-") for path in tmp_path.iterdir()) <= 1
        if (tmp_path / "file").exists():
            assert (tmp_path / "file").read_text() in ("old" * 4096, "new" * 4096)
        if (tmp_path / "both").exists():
            texts = [(tmp_path / "both" / name).read_text() for name in ("a", "b")]
            assert texts in (["old", "old"], ["new", "new"])
    write_atomic(tmp_path / "file", "end")
    write_folder_atomic(tmp_path / "both", {"a": "end"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["both", "file"]
