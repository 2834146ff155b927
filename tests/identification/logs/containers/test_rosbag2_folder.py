"""Folders of rosbag2: as rosbags writes them, split, packed, and with parts or words that do not belong together."""

import io
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from ruamel.yaml import YAML

from identification.errors import LogError
from identification.logs.containers import zstd
from identification.logs.containers.formats import open_container
from tests.identification.logs.containers.database import write_db3
from tests.identification.logs.containers.stored import (
    START_NS,
    TYPES,
    Stored,
    channels_of,
    codes,
    read_all,
    reported,
    several,
    write_bag,
    write_folder,
)

SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
MODES = [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]
ENDING = {SQLITE: ".db3", MCAP: ".mcap"}


def metadata_of(messages: list[list[Stored]], names: list[str], version: int) -> str:
    """The `metadata.yaml` of parts, by hand."""
    every = [message for part in messages for message in part]
    topics = [
        {
            "topic_metadata": {
                "name": topic, "type": TYPES[topic], "serialization_format": "cdr", "offered_qos_profiles": "",
            },
            "message_count": len(each),
        }
        for topic, each in reported(every).items()
    ]  # fmt: skip
    tree: dict[str, object] = {
        "version": version,
        "storage_identifier": "sqlite3",
        "relative_file_paths": names,
        "duration": {"nanoseconds": every[-1].log_ns - every[0].log_ns},
        "starting_time": {"nanoseconds_since_epoch": every[0].log_ns},
        "message_count": len(every),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
    }
    stream = io.StringIO()
    YAML(typ="safe", pure=True).dump({"rosbag2_bagfile_information": tree}, stream)
    return stream.getvalue()


def split_folder(path: Path, parts: int = 12, version: int = 5) -> tuple[Path, list[list[Stored]]]:
    """A recording in several files, more than ten so that their order is not that of their names."""
    messages = several(240)
    pieces = [messages[at : at + 240 // parts] for at in range(0, 240, 240 // parts)]
    path.mkdir()
    names = [f"run_{index}.db3" for index in range(parts)]
    for name, piece in zip(names, pieces, strict=True):
        write_db3(path / name, piece)
    (path / "metadata.yaml").write_text(metadata_of(pieces, names, version))
    return path, pieces


def edit(path: Path, change: Callable[[dict[str, object]], object]) -> Path:
    yaml = YAML(typ="safe", pure=True)
    tree = yaml.load((path / "metadata.yaml").read_text())
    change(tree["rosbag2_bagfile_information"])
    with (path / "metadata.yaml").open("w") as file:
        yaml.dump(tree, file)
    return path


@pytest.mark.parametrize("storage", [SQLITE, MCAP])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("salvage", [False, True])
def test_every_storage_and_compression_gives_the_messages_that_were_written(
    tmp_path: Path, storage: StoragePlugin, mode: CompressionMode, salvage: bool
) -> None:
    messages = several()
    path = write_folder(tmp_path / "bag", messages, storage, mode)
    before = {each.name: each.read_bytes() for each in path.iterdir()}
    container = open_container(path, salvage=salvage)
    assert read_all(container) == reported(messages)
    survey = container.survey()
    assert {held.channel.topic: (held.count, held.first_message) for held in survey.held} == {
        topic: (len(each), each[0][1]) for topic, each in reported(messages).items()
    }
    assert (survey.start_ns, survey.end_ns) == (messages[0].log_ns, messages[-1].log_ns)
    assert ("sqlite3" if storage == SQLITE else "mcap") in survey.container
    assert codes(container) == ["crc-absent"]
    assert container.lost() == ()
    assert {each.name: each.read_bytes() for each in path.iterdir()} == before


def test_a_packed_file_on_its_own_is_read(tmp_path: Path) -> None:
    messages = several()
    for storage in (SQLITE, MCAP):
        path = write_folder(tmp_path / storage.name, messages, storage, CompressionMode.FILE)
        file = path / f"{path.name}{ENDING[storage]}.zstd"
        assert read_all(open_container(file)) == reported(messages)


def test_parts_follow_each_other_in_the_listed_order_as_one_log(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag")
    messages = [message for piece in pieces for message in piece]
    container = open_container(path)
    assert read_all(container) == reported(messages)
    assert set(channels_of(container)) == set(TYPES)
    assert read_all(open_container(path), "/pose") == {"/pose": reported(messages)["/pose"]}
    edit(path, lambda tree: tree.update(relative_file_paths=[f"run_{index}.db3" for index in reversed(range(12))]))
    reverse = [message for piece in reversed(pieces) for message in piece]
    assert read_all(open_container(path)) == reported(reverse)


def test_old_metadata_name_the_folder_before_the_file(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag", 2, version=3)
    names = ["bag/run_0.db3", "bag/run_1.db3"]
    edit(path, lambda tree: tree.update(relative_file_paths=names))
    renamed = path.rename(tmp_path / "renamed")
    assert read_all(open_container(renamed)) == reported([*pieces[0], *pieces[1]])


def test_the_metadata_may_name_a_file_that_was_packed_or_unpacked_since(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag", 2)
    packed = path / "run_0.db3.zstd"
    packed.write_bytes(zstandard.compress((path / "run_0.db3").read_bytes()))
    (path / "run_0.db3").unlink()
    container = open_container(path)
    assert read_all(container) == reported([*pieces[0], *pieces[1]])
    assert codes(container) == ["crc-absent"]


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag", 4)
    (path / "run_2.db3").unlink()
    with pytest.raises(LogError, match=r"bag lacks run_2\.db3, which its metadata\.yaml lists.*--salvage"):
        open_container(path)
    container = open_container(path, salvage=True)
    assert read_all(container) == reported([*pieces[0], *pieces[1], *pieces[3]])
    assert "run_2.db3 is missing" in container.lost()[0]


def test_a_file_that_is_not_listed_is_left_out_and_named(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag", 2)
    write_db3(path / "run_2.db3", several(10))
    (path / "notes.txt").write_text("by hand")
    container = open_container(path)
    assert read_all(container) == reported([*pieces[0], *pieces[1]])
    findings = container.survey().findings
    assert [finding.code for finding in findings] == ["unlisted-files", "crc-absent"]
    assert "run_2.db3" in findings[0].message
    assert "notes.txt" not in findings[0].message


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda tree: tree.update(message_count=241), "240 of 241 messages in all"),
        (lambda tree: tree["topics_with_message_count"].pop(0), r"\d+ of 0 messages of /"),
        (lambda tree: tree["topics_with_message_count"][0].update(message_count=3), r"\d+ of 3 messages of /"),
        (
            lambda tree: tree.update(files=[{"path": "run_1.db3", "message_count": 7}]),
            r"120 of 7 messages in run_1\.db3",
        ),
    ],
)
def test_counts_that_do_not_agree_are_refused(
    tmp_path: Path, change: Callable[[dict[str, object]], object], complaint: str
) -> None:
    path, pieces = split_folder(tmp_path / "bag", 2)
    edit(path, change)
    with pytest.raises(LogError, match=complaint):
        open_container(path).survey()
    with pytest.raises(LogError, match=complaint):
        list(open_container(path).read([], lambda batch: batch))
    container = open_container(path, salvage=True)
    assert read_all(container) == reported([*pieces[0], *pieces[1]])
    assert codes(container) == ["crc-absent"]
    assert re.search(complaint, "; ".join(container.lost()))


def test_a_folder_without_metadata_is_read_in_natural_order_and_says_so(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag")
    (path / "metadata.yaml").unlink()
    container = open_container(path)
    assert read_all(container) == reported([message for piece in pieces for message in piece])
    finding = container.survey().findings[0]
    assert (finding.code, finding.severity) == ("metadata-absent", "warning")
    assert "run_0.db3, run_1.db3, run_2.db3" in finding.message


def test_split_ros1_bags_in_a_folder_are_one_log(tmp_path: Path) -> None:
    messages = several(60)
    for index in range(3):
        write_bag(tmp_path / f"run_{index}.bag", messages[20 * index : 20 * index + 20])
    assert read_all(open_container(tmp_path)) == reported(messages)


def test_folders_that_hold_no_log_or_several_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"is a folder without a log: it holds neither metadata\.yaml nor"):
        open_container(tmp_path)
    write_db3(tmp_path / "monday.db3", several(5))
    assert read_all(open_container(tmp_path)) == reported(several(5))
    write_db3(tmp_path / "tuesday.db3", several(5))
    with pytest.raises(LogError, match=r"holds several logs \(monday\.db3, tuesday\.db3\); name one of them"):
        open_container(tmp_path)
    (tmp_path / "tuesday.db3").unlink()
    (tmp_path / "monday.mcap").write_bytes(b"")
    with pytest.raises(LogError, match="holds several logs"):
        open_container(tmp_path)


def test_a_damaged_part_is_refused_and_left_out_by_salvage(tmp_path: Path) -> None:
    path, pieces = split_folder(tmp_path / "bag", 3)
    (path / "run_1.db3").write_bytes(b"SQLite format 3\0" + bytes(5000))
    with pytest.raises(LogError, match=r"run_1\.db3"):
        open_container(path).survey()
    container = open_container(path, salvage=True)
    assert read_all(container) == reported([*pieces[0], *pieces[2]])
    assert "run_1.db3 is damaged" in container.lost()[0]


def nested(depth: int) -> bytes:
    return b"rosbag2_bagfile_information: " + b"[" * depth + b"]" * depth


BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "the document must be a mapping"),
    "list": (b"- 1", "the document must be a mapping"),
    "other root": (b"a: 1", "rosbag2_bagfile_information must be a mapping"),
    "no yaml": (b"a: [1", "is damaged: line"),
    "no text": (b"\xff\xfe\xfd", "is damaged: 'utf-8' codec"),
    "deep": (nested(5000), "nested more than 50 levels"),
    "deep blocks": (b"".join(b" " * i + b"a:\n" for i in range(1200)), "is damaged: "),
    "tag": (b"rosbag2_bagfile_information: !!python/object:os.system {}", "is damaged: line 1"),
    "duplicate": (b"rosbag2_bagfile_information: {version: 1, version: 2}", "is damaged: line 1"),
    "merge": (b"a: &a {b: 1}\nc: {<<: *a}", "merge key"),
    "huge": (b"#" * (2**20 + 1), "larger than 1048576 bytes"),
    "two documents": (b"a: 1\n---\nb: 2\n", "is damaged"),
}


@pytest.mark.parametrize("name", BAD)
def test_metadata_that_are_none_are_refused_and_left_out_by_salvage(tmp_path: Path, name: str) -> None:
    path, pieces = split_folder(tmp_path / "bag", 2)
    data, complaint = BAD[name]
    (path / "metadata.yaml").write_bytes(data)
    with pytest.raises(LogError, match=complaint) as caught:
        open_container(path)
    assert str(caught.value).startswith("bag/metadata.yaml")
    assert "\n" not in str(caught.value)
    container = open_container(path, salvage=True)
    assert read_all(container) == reported([*pieces[0], *pieces[1]])
    assert codes(container) == ["metadata-absent", "crc-absent"]
    assert re.search(complaint, "; ".join(container.lost()))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"version": "five"}, "version must be a whole number"),
        ({"storage_identifier": "rosbag_v2"}, "names the storage 'rosbag_v2'"),
        ({"compression_mode": "FILE", "compression_format": "lz4"}, "names the compression 'lz4' in mode 'file'"),
        ({"compression_mode": "twice"}, "in mode 'twice'"),
        ({"relative_file_paths": []}, "lists no file"),
        ({"relative_file_paths": "run_0.db3"}, "relative_file_paths must be a list"),
        ({"relative_file_paths": ["run_0.db3", "run_0.db3"]}, "lists a file twice"),
        ({"relative_file_paths": ["../bag/run_0.db3"]}, r"'\.\./bag/run_0\.db3', which is no file in this folder"),
        ({"relative_file_paths": ["/etc/passwd"]}, "which is no file in this folder"),
        ({"relative_file_paths": [".."]}, "which is no file in this folder"),
        ({"relative_file_paths": [5]}, "which is no file in this folder"),
        ({"message_count": -1}, "message_count must be a whole number of zero or more"),
        ({"message_count": 2.5}, "message_count must be a whole number of zero or more"),
        ({"topics_with_message_count": [1]}, "must be a mapping"),
        ({"files": 3}, "files must be a list"),
    ],
)
def test_metadata_that_say_what_cannot_be_are_refused(
    tmp_path: Path, changes: dict[str, object], complaint: str
) -> None:
    path, _ = split_folder(tmp_path / "bag", 2)
    edit(path, lambda tree: tree.update(changes))
    with pytest.raises(LogError, match=complaint):
        open_container(path)


def test_packed_files_that_are_damaged_or_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = several(400)
    write_db3(tmp_path / "run.db3", messages)
    packed = zstandard.ZstdCompressor(write_checksum=True).compress((tmp_path / "run.db3").read_bytes())
    path = tmp_path / "run.db3.zstd"
    for size in (5, 100, len(packed) // 2, len(packed) - 1):
        path.write_bytes(packed[:size])
        with pytest.raises(LogError, match=r"run\.db3\.zstd is damaged: .*breaks off.*--salvage"):
            open_container(path)
    damaged = bytearray(packed)
    damaged[len(packed) // 2] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(LogError, match=r"run\.db3\.zstd is damaged"):
        open_container(path)
    path.write_bytes(zstandard.compress(bytes(2**28)))
    with pytest.raises(LogError, match="over 100 times its size, which no recording does"):
        open_container(path)
    path.write_bytes(zstandard.compress(packed))
    with pytest.raises(LogError, match="compressed with zstd twice"):
        open_container(path)
    path.write_bytes(packed)
    monkeypatch.setattr(zstd, "_SPARE_BYTES", 2**62)
    with pytest.raises(LogError, match="more than the 0 bytes that temporary files may take"):
        open_container(path)


def test_a_packed_file_is_salvaged_up_to_its_cut_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    messages = several(3000)
    write_db3(tmp_path / "run.db3", messages, page_bytes=4096)
    packed = zstandard.compress((tmp_path / "run.db3").read_bytes())
    path = tmp_path / "run.db3.zstd"
    path.write_bytes(packed[: len(packed) // 2])
    container = open_container(path, salvage=True)
    assert [each.name for each in temporary.rglob("*.db3")] == ["run.db3"]
    found = read_all(container)
    assert sum(map(len, found.values())) > 1000
    assert all(each == reported(messages)[topic][: len(each)] for topic, each in found.items())
    assert "its zstd data cannot be unpacked behind" in " ".join(container.lost())
    assert list(temporary.iterdir()) == []
    with pytest.raises(LogError):
        open_container(path)
    assert list(temporary.iterdir()) == []


def test_frames_may_follow_each_other_in_a_packed_file(tmp_path: Path) -> None:
    messages = several(50)
    data = write_db3(tmp_path / "run.db3", messages).read_bytes()
    path = tmp_path / "two.db3.zst"
    path.write_bytes(zstandard.compress(data[:5000]) + zstandard.compress(data[5000:]))
    assert read_all(open_container(path)) == reported(messages)


def test_a_compressed_message_that_is_damaged_is_refused_in_an_mcap_part(tmp_path: Path) -> None:
    messages = [Stored(topic="/ft", log_ns=START_NS + i, data=bytes([0, i])) for i in range(20)]
    path = write_folder(tmp_path / "bag", messages, MCAP, CompressionMode.MESSAGE)
    file = path / "bag.mcap"
    assert zstandard.compress(bytes([0, 7])) in file.read_bytes()
    plain = file.read_bytes().replace(b"\x28\xb5\x2f\xfd", b"\x29\xb5\x2f\xfd")
    file.write_bytes(plain)
    with pytest.raises(LogError, match="message of topic /ft cannot be unpacked"):
        read_all(open_container(path))


@pytest.mark.parametrize("name", ["metadata.yaml", "run_0.mcap", "notes.txt"])
@pytest.mark.parametrize("salvage", [False, True])
def test_a_link_that_leads_out_of_the_folder_is_refused_and_not_quoted(
    tmp_path: Path, name: str, salvage: bool
) -> None:
    (tmp_path / "secret").write_text("hunter2: [\n", encoding="utf-8")
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / name).symlink_to(tmp_path / "secret")
    with pytest.raises(LogError, match=rf"run/{name} is a symbolic link that leads out of the folder") as caught:
        open_container(folder, salvage=salvage)
    assert "hunter2" not in str(caught.value)
