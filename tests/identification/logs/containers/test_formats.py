"""The registry of formats: each log is opened by its content, all else is refused in one clear sentence."""

import bz2
import gzip
import hashlib
import lzma
import os
import socket
import subprocess
import zipfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TypeVar

import lz4.frame  # type: ignore[import-untyped]  # the package carries no annotations
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.parquet as pq  # type: ignore[import-untyped]  # the package carries no annotations
import pytest
import zstandard
from rosbags.rosbag2 import StoragePlugin

from identification.errors import LogError
from identification.logs.containers import formats
from identification.logs.containers.channel import Batch, Channel, Container, Held, Survey, pack
from identification.logs.containers.formats import LogFormat, is_table, open_container, sha256_of
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.containers.ros1_bag import Ros1BagContainer
from identification.logs.containers.rosbag2_folder import Rosbag2FolderContainer
from identification.logs.containers.sqlite_bag import SqliteBagContainer
from identification.logs.messages.decode import Wanted
from identification.logs.opened import open_logs
from identification.logs.roles.cell import Cell
from tests.identification.logs.containers.database import write_db3
from tests.identification.logs.containers.stored import several, write_bag, write_folder

T = TypeVar("T")
SENTENCE = {
    "empty.mcap": (b"", "is empty (0 bytes)"),
    "notes.mcap": (b"Monday, third run\n", "is text (it starts with 'Monday, third run"),
    "run.csv": (
        b"t,fx\n0,1\n",
        "is a table: its columns have no types that say what they mean; map them in cell.yaml",
    ),
    "run.TSV": (b"t\tfx\n0\t1\n", "is a table"),
    "latin.csv": ("Zeit,Kraft_ü\n0,1\n".encode("latin-1"), "is a table"),
    "excel.csv": ("t;fx\n0;1\n".encode("utf-16"), "is a table"),
    "no_text.csv": (bytes(range(256)), "is not a log: it starts with the bytes 00 01 02"),
    "run.gz": (gzip.compress(b"x"), "is compressed with gzip"),
    "run.bz2": (bz2.compress(b"x"), "is compressed with bzip2"),
    "run.xz": (lzma.compress(b"x"), "is compressed with xz"),
    "run.lz4": (lz4.frame.compress(b"x"), "is compressed with lz4"),
    "cut.mcap": (b"\x89MCAP", "is truncated within its first 5 bytes"),
    "old.bag": (b"#ROSBAG V1.2\n", "is a ROS 1 bag of version 1"),
    "short.bag": (b"#ROSBAG V2", "is truncated within its first 10 bytes"),
    "bare.db3": (b"SQLite format 3\0", "is damaged or no SQLite log"),
    "noise.bin": (b"\x07\x01\x02\x03", "is not a log: it starts with the bytes 07 01 02 03"),
}


@pytest.mark.parametrize("name", SENTENCE)
def test_what_is_no_log_is_reported_in_one_sentence(tmp_path: Path, name: str) -> None:
    data, complaint = SENTENCE[name]
    (tmp_path / name).write_bytes(data)
    for salvage in (False, True):
        with pytest.raises(LogError) as caught:
            open_container(tmp_path / name, salvage=salvage).survey()
        text = str(caught.value)
        assert text.startswith(name)
        assert complaint in text
        assert "\n" not in text
        assert text.endswith(".")


def test_archives_are_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.writestr("run.mcap", b"x")
    with pytest.raises(LogError, match=r"run\.zip is a ZIP archive.*unpack it"):
        open_container(tmp_path / "run.zip")


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    cases: dict[Path, str] = {
        tmp_path / "absent.mcap": "cannot be read: No such file",
        Path("/dev/zero"): "is not a regular file",
        tmp_path / "nul\0.mcap": "is not a file name|cannot be read",
        tmp_path / ("x" * 300): "cannot be read: File name too long",
        tmp_path / "absent.mcap" / "inside": "cannot be read",
    }
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        os.mkfifo(tmp_path / "pipe")
        cases |= {tmp_path / "socket": "is not a regular file", tmp_path / "pipe": "is not a regular file"}
        for path, complaint in cases.items():
            with pytest.raises(LogError, match=complaint):
                open_container(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.bag", several(5))
    path.chmod(0)
    with pytest.raises(LogError, match="cannot be read: Permission denied"):
        open_container(path)
    tmp_path.chmod(0)
    with pytest.raises(LogError, match="cannot be read: Permission denied"):
        open_container(tmp_path)
    tmp_path.chmod(0o700)


def test_the_content_decides_not_the_name(tmp_path: Path) -> None:
    write_folder(tmp_path / "mcap", several(5), StoragePlugin.MCAP)
    write_folder(tmp_path / "sqlite", several(5))
    kinds: dict[Path, type] = {
        (tmp_path / "mcap" / "mcap.mcap").rename(tmp_path / "one"): McapContainer,
        (tmp_path / "sqlite" / "sqlite.db3").rename(tmp_path / "two.mcap"): SqliteBagContainer,
        write_bag(tmp_path / "three.db3", several(5)): Ros1BagContainer,
    }
    folder = write_folder(tmp_path / "four.bag", several(5))
    for path, kind in {**kinds, folder: Rosbag2FolderContainer}.items():
        container = open_container(path)
        assert isinstance(container, kind)
        container.close()


def test_tables_are_reported_by_their_content(tmp_path: Path) -> None:
    pq.write_table(pa.table({"a": [1.0]}), tmp_path / "any.name")
    assert is_table(tmp_path / "any.name")
    with pytest.raises(LogError, match="is a table"):
        open_container(tmp_path / "any.name")
    assert not is_table(write_bag(tmp_path / "run.csv", several(5)))
    assert not is_table(write_db3(tmp_path / "run.txt", several(5)))
    cut = tmp_path / "cut.csv"
    # The first block that is looked at ends within a character of two bytes.
    cut.write_bytes(b"a" * 4095 + "ü,1\n".encode() * 9)
    assert is_table(cut)


def test_recorded_tables_are_tables(shared_data: Path) -> None:
    assert all(is_table(path) for path in (shared_data / "nj60").glob("*.csv"))


def test_the_digest_is_that_of_the_bytes_and_of_a_folder_that_of_its_list(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "bag", several(20))
    (path / ".hidden").write_bytes(b"x")
    assert sha256_of(path / "bag.db3") == hashlib.sha256((path / "bag.db3").read_bytes()).hexdigest()
    printed = subprocess.run(
        "LC_ALL=C; sha256sum * | sha256sum", shell=True, cwd=path, capture_output=True, text=True, check=True
    )
    before = sha256_of(path)
    assert before == printed.stdout.split()[0]
    (path / "bag.db3").rename(path / "other.db3")
    assert sha256_of(path) != before
    with pytest.raises(LogError, match="cannot be read: No such file"):
        sha256_of(tmp_path / "absent")


class ToyContainer(Container):
    """A log of lines: time in ns, then a JSON message of the topic /toy."""

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        lines = [line.split(" ", 1) for line in path.read_text().splitlines()[1:]]
        self._log_ns = np.array([int(time) for time, _ in lines])
        self._messages = [text.encode() for _, text in lines]
        self._channel = Channel(topic="/toy", type_name="", encoding="json", schema_encoding="", schema=b"")

    def survey(self) -> Survey:
        held = Held(channel=self._channel, count=len(self._messages), first_message=self._messages[0])
        start, end = int(self._log_ns[0]), int(self._log_ns[-1])
        return Survey(container="toy", held=(held,), start_ns=start, end_ns=end, findings=())

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        sizes, data = pack(self._messages)
        starts = np.cumsum(sizes) - sizes
        batch = Batch(channel=self._channel, log_ns=self._log_ns, data=data, starts=starts, sizes=sizes)
        yield from ((channel, handle(batch)) for channel in wanted)


def test_a_format_is_added_by_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container and a line in the registry: files, parts of a folder, zstd and the refusal of others know of it."""
    toy = LogFormat(name="a toy log", magic=b"TOY 1\n", ending=".toy", open=ToyContainer)
    text = b"".join(b'%d {"force": %d.5}\n' % (10**9 + i, i) for i in range(5))
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / "run_0.toy"
    path.write_bytes(toy.magic + text)
    with pytest.raises(LogError, match="is text"):
        open_container(path)
    monkeypatch.setattr(formats, "FORMATS", [*formats.FORMATS, toy])
    (tmp_path / "packed.toy.zst").write_bytes(zstandard.compress(path.read_bytes()))
    for each in (path, path.parent, tmp_path / "packed.toy.zst"):
        with open_logs((each,), Cell(), salvage=False) as logs:
            (channel,) = (info.channel for info in logs.infos)
            series = logs.read({channel: Wanted(fields=("force",), header="")})[channel]
            assert series.values[:, 0].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]
            assert series.log_ns.tolist() == [10**9 + i for i in range(5)]
    (tmp_path / "other.bin").write_bytes(b"\x07\x01\x02\x03")
    with pytest.raises(LogError, match=r"name an MCAP file, .*, a toy log, CSV"):
        open_container(tmp_path / "other.bin")
