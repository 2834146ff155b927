"""The SHA-256 of logs is made once for all hosts, and never kept of what may have changed."""

import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

from autotune.campaign import checksums
from autotune.campaign.checksums import Checksums
from autotune.campaign.manifest import read_manifest
from autotune.campaign.run import work_on_runs
from autotune.campaign.state import open_state
from autotune.campaign.work import digest_of
from identification.logs.containers.formats import sha256_of
from tests.autotune.campaign.sharing import written_logs

SHARED = "sqlite:///{}"


def reader(module: ModuleType) -> Callable[[Path], str]:
    """What makes checksums there now."""
    found: Callable[[Path], str] = vars(module)["sha256_of"]
    return found


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Names of the files of which a checksum is made, and files count as old at once."""
    found: list[Path] = []

    def counted(path: Path) -> str:
        found.append(path)
        return sha256_of(path)

    monkeypatch.setattr(checksums, "sha256_of", counted)
    monkeypatch.setattr(checksums, "_RESTED_NS", -1)
    return found


@contextmanager
def opened(folder: Path) -> Iterator[Checksums]:
    with open_state(None, folder) as state:
        yield state.checksums


def digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()


def test_a_log_is_read_once_for_all_that_ask(made: list[Path], tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(b"some")
    for _ in range(3):
        with opened(tmp_path / "out") as known:
            assert known.find(log) == digest(b"some")
    assert made == [log]


def test_hosts_that_begin_together_share_the_checksums(
    made: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, counted = written_logs(tmp_path / "logs", 24), reader(checksums)
    begun = threading.Barrier(2)

    def slowly(path: Path) -> str:
        time.sleep(0.02)
        return counted(path)

    def host(out: Path) -> int:
        begun.wait()
        with ThreadPoolExecutor(1) as executor:
            return len(work_on_runs(runs, out, executor=executor, storage=SHARED.format(tmp_path / "state.db")))

    monkeypatch.setattr(checksums, "sha256_of", slowly)
    runs = read_manifest(logs)
    with ThreadPoolExecutor(2) as hosts:
        assert list(hosts.map(host, [tmp_path / "one", tmp_path / "two"])) == [24, 24]
    # Each log at least once; twice only what both were at in the same moment.
    assert {path for path in made if path.suffix == ".csv"} == {run.logs[0] for run in runs}
    assert len(made) < 1.5 * len(runs)


@pytest.mark.parametrize("text", [b"more than before", b"else"])
def test_what_has_changed_is_read_again_also_where_its_times_are_set_back(
    made: list[Path], tmp_path: Path, text: bytes
) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes(b"some")
    before = log.stat()
    with opened(tmp_path / "out") as known:
        assert known.find(log) == digest(b"some")
        log.write_bytes(text)
        os.utime(log, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert known.find(log) == digest(text)
        assert known.find(log) == digest(text)
    assert made == [log, log]


def test_another_file_of_the_same_size_and_age_in_its_place_is_read(made: list[Path], tmp_path: Path) -> None:
    log, other = tmp_path / "run.mcap", tmp_path / "other.mcap"
    for path, text in ((log, b"some"), (other, b"else")):
        path.write_bytes(text)
        os.utime(path, ns=(10**18, 10**18))
    with opened(tmp_path / "out") as known:
        assert known.find(log) == digest(b"some")
        other.rename(log)
        assert known.find(log) == digest(b"else")
    assert made == [log, log]


def test_what_was_just_written_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that counts in full seconds shows no difference within one."""
    log = tmp_path / "run.mcap"
    log.write_bytes(b"some")
    coarse = checksums._look_at(log)
    monkeypatch.setattr(checksums, "_look_at", lambda _: coarse)
    with opened(tmp_path / "out") as known:
        assert known.find(log) == digest(b"some")
        log.write_bytes(b"else")
        assert known.find(log) == digest(b"else")


def test_what_grows_while_it_is_read_is_not_kept(
    made: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, counted = tmp_path / "run.mcap", reader(checksums)
    log.write_bytes(b"some")

    def growing(path: Path) -> str:
        found = counted(path)
        with path.open("ab") as stream:
            stream.write(b" more")
        return found

    with opened(tmp_path / "out") as known:
        monkeypatch.setattr(checksums, "sha256_of", growing)
        assert known.find(log) == digest(b"some")
        monkeypatch.setattr(checksums, "sha256_of", counted)
        assert known.find(log) == digest(b"some more")
    assert made == [log, log]


def test_of_a_bag_only_the_file_that_changed_is_read_again(made: list[Path], tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "bag_0.db3", "bag_1.db3"):
        (bag / name).write_text(name, encoding="utf-8")
    with opened(tmp_path / "out") as known:
        first = known.find(bag)
        assert first == digest_of(bag)
        made.clear()
        (bag / "bag_1.db3").write_text("other", encoding="utf-8")
        assert known.find(bag) not in (first, "")
    assert made == [bag / "bag_1.db3"]
