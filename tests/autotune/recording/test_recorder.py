"""What is recorded is read back with the official reader, and by `autotune inspect`."""

import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from autotune.errors import UsageError
from autotune.formats.cell import read_cell
from autotune.recording import Recorder
from problems.errors import ParameterError
from tests.conftest import RunCli

WRENCH = (1.5, -2.25, -157.0, 0.125, 0.0, -3.0)
POSE = (0.8, 0.1, 0.9, 0.6, 0.0, 0.8, 0.0)
H = 8e-4


def test_each_sample_is_one_standard_message_with_its_stamp(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, start_ns=1_700_000_000_000_000_000, sensor_frame="wrist") as log:
        for k in range(3):
            log.write(k * H, wrench=WRENCH, pose=POSE if k != 1 else None, command=POSE)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        decoded = reader.iter_decoded_messages()
        found = [(schema and schema.name, channel.topic, value) for schema, channel, _, value in decoded]
    wrenches = [value for name, _, value in found if name == "geometry_msgs/msg/WrenchStamped"]
    poses = [value for _, topic, value in found if topic == "/flange/pose"]
    assert [each.header.stamp.nanosec for each in wrenches] == [0, 800_000, 1_600_000]
    assert [each.header.stamp.nanosec for each in poses] == [0, 1_600_000]
    assert {each.header.stamp.sec for each in wrenches} == {1_700_000_000}
    first, pose = wrenches[0], poses[0].pose
    assert first.header.frame_id == "wrist"
    assert (first.wrench.force.x, first.wrench.force.y, first.wrench.force.z) == WRENCH[:3]
    assert (first.wrench.torque.x, first.wrench.torque.y, first.wrench.torque.z) == WRENCH[3:]
    assert (pose.position.x, pose.position.y, pose.position.z) == POSE[:3]
    quaternion = pose.orientation
    assert (quaternion.x, quaternion.y, quaternion.z, quaternion.w) == POSE[3:]
    assert {topic for _, topic, _ in found} == {"/ft_sensor/wrench", "/flange/pose", "/flange/command"}


def test_the_channels_are_recognised_by_inspect(run_cli: RunCli, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as log:
        for k in range(500):
            log.write(k * H, wrench=WRENCH, pose=POSE, command=POSE)
    done = run_cli("inspect", path)
    for topic in ("/ft_sensor/wrench", "/flange/pose", "/flange/command"):
        assert topic in done.stdout
    assert "zero" not in done.stdout + done.stderr  # stamps of a clock that begins at 0 would be no stamps


def test_an_exception_in_the_loop_leaves_a_whole_log_of_what_was_before(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def loop() -> None:
        with Recorder(path) as log:
            log.write(0.0, wrench=WRENCH)
            raise RuntimeError("protective stop")

    with pytest.raises(RuntimeError, match="protective stop"):
        loop()
    with path.open("rb") as stream:
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == 1


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"time_s": 0.0}, "time_s must be later than the last sample of wrench"),
        ({"time_s": float("nan")}, "time_s must be a finite number of seconds"),
        ({"time_s": 3e9}, "from 1970 to 2038"),
        ({"wrench": WRENCH[:5]}, "wrench must be 6 finite numbers"),
        ({"wrench": (*WRENCH[:5], float("inf"))}, "wrench must be 6 finite numbers"),
        ({"pose": (0.8, 0.1, 0.9, 0.6, 0.0, 0.0, 0.0)}, "a quaternion x y z w of length 1"),
    ],
)
def test_a_bad_sample_is_refused_and_nothing_of_it_is_kept(
    tmp_path: Path, changes: dict[str, float], sentence: str
) -> None:
    log = Recorder(tmp_path / "run.mcap")
    log.write(0.0, wrench=WRENCH)
    given = {"time_s": H, "wrench": WRENCH, "pose": POSE} | changes
    with pytest.raises(ParameterError, match=sentence):
        log.write(given.pop("time_s"), **given)  # type: ignore[arg-type]
    log.close()
    with (tmp_path / "run.mcap").open("rb") as stream:
        assert len(list(make_reader(stream).iter_messages())) == 1


def test_a_log_is_neither_replaced_nor_made_of_nothing_nor_written_twice(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(UsageError, match="Nothing was recorded"), Recorder(path):
        pass
    assert list(tmp_path.iterdir()) == []
    with Recorder(path) as log:
        log.write(0.0, wrench=WRENCH)
    with pytest.raises(UsageError, match="takes no more samples"):
        log.write(1.0, wrench=WRENCH)
    with pytest.raises(UsageError, match="a log is not replaced"):
        Recorder(path)
    with pytest.raises(UsageError, match="make it first"):
        Recorder(tmp_path / "absent" / "run.mcap")
    with pytest.raises(UsageError, match="Topics must differ"):
        Recorder(tmp_path / "b.mcap", pose_topic="/tcp", command_topic="/tcp")


def test_importing_it_loads_no_heavy_library() -> None:
    heavy = ("numpy", "casadi", "numba", "scipy", "matplotlib", "rosbags", "mcap")
    code = f"import sys, autotune.recording; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("period_s", [None, 0.002])
def test_a_cell_yaml_beside_the_log_declares_what_the_recorder_knows(tmp_path: Path, period_s: float | None) -> None:
    with Recorder(tmp_path / "run.mcap", period_s=period_s, pose_topic='/a "b"') as log:
        log.write(0.0, wrench=WRENCH, pose=POSE)
    cell = read_cell(tmp_path / "run.cell.yaml").cell
    assert cell.sample_time_s == period_s
    assert cell.wrench is not None
    assert (cell.wrench.topic, cell.wrench.exerted_by, cell.wrench.gravity_compensated) == (
        "/ft_sensor/wrench",
        "payload",
        False,
    )
    assert cell.pose is not None
    assert cell.pose.topic == '/a "b"'
    assert cell.command is None  # nothing was recorded of it


def test_a_cell_yaml_that_is_there_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "run.cell.yaml").write_text("mine", encoding="utf-8")
    with pytest.raises(UsageError, match=r"run\.cell\.yaml exists"):
        Recorder(tmp_path / "run.mcap")
    with pytest.raises(ParameterError, match="period_s must be a finite number above 0"):
        Recorder(tmp_path / "other.mcap", period_s=0.0)
