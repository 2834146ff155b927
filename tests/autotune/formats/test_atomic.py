import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.atomic import check_target, write_atomic


def test_text_is_written_as_utf8_without_translation(tmp_path: Path) -> None:
    write_atomic(tmp_path / "a.yaml", "é: 1\n")
    assert (tmp_path / "a.yaml").read_bytes() == b"\xc3\xa9: 1\n"


def test_an_old_file_is_replaced_and_nothing_else_remains(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old, and longer", encoding="utf-8")
    write_atomic(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_the_mode_follows_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        write_atomic(tmp_path / "a", "x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o666 & ~umask


@pytest.mark.parametrize("call", ["fsync", "write"])
@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(28, "No space left on device"), MemoryError])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, failure: BaseException | type[BaseException]
) -> None:
    (tmp_path / "a").write_text("old", encoding="utf-8")

    def fail(*_: object) -> None:
        raise failure

    if call == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        monkeypatch.setattr(Path, "replace", fail)
    expected = UsageError if isinstance(failure, OSError) else failure
    with pytest.raises(expected):  # type: ignore[arg-type]  # a class in every case
        write_atomic(tmp_path / "a", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there" / "a")
    write_atomic(tmp_path / "link", "x")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "a").read_text(encoding="utf-8") == "x"


def test_a_device_is_written_directly() -> None:
    write_atomic("/dev/null", "x")
    assert not Path("/dev/null").is_file()


@pytest.mark.parametrize("place", [lambda folder: folder, lambda folder: folder / "missing" / "a"])
def test_an_impossible_target_is_a_usage_error_that_names_it(tmp_path: Path, place: Callable[[Path], Path]) -> None:
    target = place(tmp_path)
    with pytest.raises(UsageError, match=r"cannot be written") as caught:
        write_atomic(target, "x")
    assert str(target) in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_what_is_read_is_not_replaced(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(b"\x89MCAP0")
    (tmp_path / "link.yaml").symlink_to(log)
    for target in (log, tmp_path / "link.yaml"):
        with pytest.raises(UsageError, match="is what is read"):
            check_target(target, [log])


def test_another_programs_file_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "notes.txt"
    target.write_text("what I saw today")
    with pytest.raises(UsageError, match="no file of this tool"):
        check_target(target, [])
    check_target(target)
    target.write_bytes(b"\x89MCAP0 library autotune/0.1 topic /autotune/wrench")
    with pytest.raises(UsageError, match="no file of this tool"):
        check_target(target, [])
    target.write_text('{"format": "autotune/plan"}')
    check_target(target, [])
    target.write_text("format: autotune/plan\nversion: 1\n")
    check_target(target, [])
    target.write_text("")
    check_target(target, [])
    check_target(tmp_path / "new.yaml", [target])
