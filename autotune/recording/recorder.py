"""Record wrench, measured pose and command of a control loop, and write them when it ends."""

import json
import math
import time
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from autotune.errors import UsageError
from autotune.formats.atomic import write_atomic
from problems.errors import ParameterError

from .mcap_log import StampedChannel, StampedKind, write_channels
from .motions import check_above_zero

_UNIT_WITHIN = 1e-3
_END_NS = 2**31 * 10**9


class Recorder:
    """Record a log as docs/recording.md asks, from any loop.

    What is recorded is kept in memory (184 bytes a period with all three channels, 21 MB in 90 s at 1250 Hz), so that a
    period never waits for the disk, and is written as a ROS 2 MCAP when the recorder is closed: at the end of `with`,
    after an exception or Ctrl-C too, with what was recorded until then. A process that is killed leaves no file.

    Parameters
    ----------
    path
        The file, which must not exist: a log of an experiment is not replaced.
    start_ns
        Stamp of the time 0 [ns since 1970]; that of now unless it is said, 0 where times are Unix times.
    wrench_topic, pose_topic, command_topic
        Names of the channels.
    sensor_frame, base_frame
        Frames of the wrench and of both poses.
    period_s
        Period of the controller [s], where it holds each command until the next one. It is an entry of the
        `cell.yaml` that is written beside the log (`run7.cell.yaml` beside `run7.mcap`), with which `identify` knows
        the delay and the stiffness of what is touched to the last digit that the log shows.

    Raises
    ------
    UsageError
        The log or its cell.yaml exists, or the folder does not.
    ParameterError
        A period that is not above 0.

    Examples
    --------
    >>> from autotune.recording import Recorder
    >>> pose = (0.8, 0.1, 0.9, 1.0, 0.0, 0.0, 0.0)
    >>> with Recorder("run.mcap") as log:
    ...     for k in range(5):
    ...         log.write(k * 8e-4, wrench=(0.0, 0.0, -157.0, 0.1, 0.0, 0.0), pose=pose, command=pose)

    """

    def __init__(
        self,
        path: str | Path,
        *,
        start_ns: int | None = None,
        wrench_topic: str = "/ft_sensor/wrench",
        pose_topic: str = "/flange/pose",
        command_topic: str = "/flange/command",
        sensor_frame: str = "ft_sensor",
        base_frame: str = "base",
        period_s: float | None = None,
    ) -> None:
        self.path, self._period_s = Path(path), period_s
        for file in (self.path, self.cell_path):
            if file.exists():
                raise UsageError(f"{file} exists, and a log is not replaced; name another file.")
        if not self.path.parent.is_dir():
            raise UsageError(f"{self.path} needs a folder that exists, and {self.path.parent} does not; make it first.")
        if period_s is not None:
            check_above_zero("period_s", period_s)
        if len({wrench_topic, pose_topic, command_topic}) < 3:
            raise UsageError(f"Topics must differ, found {wrench_topic}, {pose_topic}, {command_topic}.")
        self._start_ns = time.time_ns() if start_ns is None else start_ns
        self._tracks = {
            "wrench": _Track(wrench_topic, sensor_frame, StampedKind.WRENCH),
            "pose": _Track(pose_topic, base_frame, StampedKind.POSE),
            "command": _Track(command_topic, base_frame, StampedKind.POSE),
        }
        self._is_open = True

    @property
    def cell_path(self) -> Path:
        """The cell.yaml that is written beside the log."""
        return self.path.with_suffix(".cell.yaml")

    def write(
        self,
        time_s: float,
        *,
        wrench: Sequence[float] | None = None,
        pose: Sequence[float] | None = None,
        command: Sequence[float] | None = None,
    ) -> None:
        """Record what was measured and commanded at one time; what is left out has no sample then.

        Parameters
        ----------
        time_s
            When it was measured, or the command sent [s], of one clock for all channels, later than the last sample
            of each.
        wrench
            (6,) the raw sensor: force that the payload puts on the flange [N], torque about the sensor's origin [N·m],
            along its axes, with gravity and bias.
        pose
            (7,) measured pose of the flange in the base frame: x y z [m], quaternion x y z w.
        command
            (7,) the pose that the robot is sent in this period.

        Raises
        ------
        ParameterError
            A time that does not rise, another count of numbers, one that is not finite, or no unit quaternion.
        UsageError
            The recorder is closed.

        """
        if not self._is_open:
            raise UsageError(f"{self.path} is written, and takes no more samples; begin another recorder.")
        if not math.isfinite(time_s):
            raise ParameterError("time_s", time_s, "a finite number of seconds")
        stamp = self._start_ns + round(time_s * 1e9)
        if not 0 < stamp < _END_NS:
            must = "a time that a ROS header holds, from 1970 to 2038, counted from start_ns (0 for Unix times)"
            raise ParameterError("time_s", time_s, must)
        given = [
            (name, row) for name, row in (("wrench", wrench), ("pose", pose), ("command", command)) if row is not None
        ]
        checked = [(self._tracks[name], self._tracks[name].checked(name, stamp, row)) for name, row in given]
        for track, numbers in checked:
            track.stamps.append(stamp)
            track.rows.extend(numbers)

    def close(self) -> None:
        """Write the log and its cell.yaml; closing again does nothing.

        Raises
        ------
        UsageError
            Nothing was recorded, or a file of that name was made meanwhile.
        OSError
            The disk does not take it.

        """
        if not self._is_open:
            return
        self._is_open = False
        channels = [track.channel() for track in self._tracks.values() if track.stamps]
        if not channels:
            raise UsageError(f"Nothing was recorded, so {self.path} is not written.")
        for file in (self.path, self.cell_path):
            if file.exists():
                raise UsageError(f"{file} was made by somebody else while this log was recorded; nothing is written.")
        write_channels(channels, self.path)
        topics = {name: track.topic for name, track in self._tracks.items() if track.stamps}
        write_atomic(self.cell_path, _cell_text(topics, self._period_s))

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None or any(track.stamps for track in self._tracks.values()):
            self.close()


def _cell_text(topics: Mapping[str, str], period_s: float | None) -> str:
    """Return what the recorder knows of a log and the log does not say; JSON's quotes mean the same to YAML."""
    if period_s is None:
        period = (
            "# The controller's period in s, if it holds each command until the next one.\n# sample_time_s: 0.001\n"
        )
    else:
        period = f"sample_time_s: {period_s!r}  # the controller holds each command until the next one\n"
    raw = ", exerted_by: payload, expressed_in: sensor, gravity_compensated: false"
    entries = [f"{name}: {{topic: {json.dumps(topic)}{raw * (name == 'wrench')}}}\n" for name, topic in topics.items()]
    return "".join(["format: autotune/cell\nversion: 1\n", period, *entries])


class _Track:
    """The samples of one channel."""

    def __init__(self, topic: str, frame_id: str, kind: StampedKind) -> None:
        self.topic, self.frame_id, self.kind = topic, frame_id, kind
        self.stamps, self.rows = array("q"), array("d")

    def checked(self, name: str, stamp: int, row: Sequence[float]) -> list[float]:
        if self.stamps and stamp <= self.stamps[-1]:
            raise ParameterError("time_s", (stamp - self.stamps[-1]) * 1e-9, f"later than the last sample of {name}")
        numbers = [float(each) for each in row]
        if len(numbers) != self.kind.width or not all(map(math.isfinite, numbers)):
            raise ParameterError(name, tuple(numbers), f"{self.kind.width} finite numbers")
        if self.kind is StampedKind.POSE and abs(math.hypot(*numbers[3:]) - 1.0) > _UNIT_WITHIN:
            raise ParameterError(name, tuple(numbers), "x y z and a quaternion x y z w of length 1")
        return numbers

    def channel(self) -> StampedChannel:
        width = self.kind.width
        return StampedChannel(
            topic=self.topic,
            frame_id=self.frame_id,
            kind=self.kind,
            stamps_ns=self.stamps,
            row=lambda i: self.rows[width * i : width * (i + 1)],
        )
