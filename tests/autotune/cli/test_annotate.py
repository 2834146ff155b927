"""Messages for Foxglove and PlotJuggler, read back by another library and held against the log itself."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from tests.autotune.simulation.runs import SHORT_LOG
from tests.conftest import RunCli

WRENCH = "/ft_sensor/wrench"


def _messages(path: Path, topic: str | None = None) -> dict[str, list[tuple[int, Any]]]:
    """Return stamps [ns] and messages by topic, of one or of all."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        links = [link for link in reader.connections if topic in (None, link.topic)]
        for link, stamp, raw in reader.messages(links):
            found.setdefault(link.topic, []).append((stamp, reader.deserialize(raw, link.msgtype)))
    return found


def test_the_log_and_its_annotations_have_the_same_times_and_forces(
    run_cli: RunCli, good_log: Path, tmp_path: Path
) -> None:
    done = run_cli("identify", good_log, "--annotate", "seen.mcap", "--json")
    assert done.returncode == 0, done.stderr
    timeline = json.loads(done.stdout)["timelines"][0]
    messages, logged = _messages(tmp_path / "seen.mcap"), _messages(good_log, WRENCH)
    assert set(messages) == {f"/autotune/{name}" for name in ("wrench", "predicted_wrench", "phase", "contacts")}
    raw = logged[WRENCH]
    measured = messages["/autotune/wrench"]
    assert [stamp for stamp, _ in measured] == [stamp for stamp, _ in raw]
    # At the first rest nothing but the weight pulls: without it the noise is left.
    first_rest = np.array([message.wrench.force.x for _, message in measured[:500]])
    assert abs(np.mean(first_rest)) < 0.1
    assert abs(np.mean([message.wrench.force.x for _, message in raw[:500]])) > 1.0
    # The model predicts the force from the command to the sensor's noise of 0.14 N.
    force = {stamp: message.wrench.force.x for stamp, message in measured}
    left = [force[stamp] - message.wrench.force.x for stamp, message in messages["/autotune/predicted_wrench"]]
    assert len(left) > 1000
    assert np.std(left) == pytest.approx(0.14, rel=0.1)
    start = raw[0][0]
    phases = [((stamp - start) / 1e9, message.data) for stamp, message in messages["/autotune/phase"]]
    assert [text.split()[0] for _, text in phases] == [phase["kind"] for phase in timeline["phases"]]
    np.testing.assert_allclose(
        [time for time, _ in phases], [each["start_s"] for each in timeline["phases"]], atol=1e-6
    )
    walls = [message.msg for _, message in messages["/autotune/contacts"]]
    assert [wall.split(",")[0].split()[:3] for wall in walls] == [["wall", "along", "+x"]] * 2
    layout = json.loads((tmp_path / "seen.foxglove.json").read_text(encoding="utf-8"))
    paths = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])]
    assert {"/" + "/".join(path.split(".")[0].split("/")[1:]) for path in paths} <= set(messages)


def test_times_are_those_of_the_log_where_the_pose_begins_later(run_cli: RunCli, tmp_path: Path) -> None:
    recording = simulate_cell(SimulatedCell(), SHORT_LOG, seed=2).recording
    late = 1000  # samples, 0.8 s
    pose = recording.pose
    later = replace(
        pose,
        stamp_ns=pose.stamp_ns[late:],
        position_m=pose.position_m[late:],
        quaternion_xyzw=pose.quaternion_xyzw[late:],
    )
    write_mcap(replace(recording, pose=later), tmp_path / "late.mcap")
    assert run_cli("identify", "late.mcap", "--annotate", "seen.mcap").returncode == 0
    messages = _messages(tmp_path / "seen.mcap")
    logged_wrenches = _messages(tmp_path / "late.mcap", WRENCH)[WRENCH]
    raw = {stamp: message.wrench.force.x for stamp, message in logged_wrenches}
    # Where a contact presses hardest in the log itself, the annotated force does too.
    (first, _), *_ = messages["/autotune/contacts"]
    span = range(first - 200_000_000, first + 200_000_000)
    logged = min((stamp for stamp in raw if stamp in span), key=lambda stamp: raw[stamp])
    seen = {stamp: message.wrench.force.x for stamp, message in messages["/autotune/wrench"] if stamp in span}
    assert abs(min(seen, key=lambda stamp: seen[stamp]) - logged) <= 800_000
    assert messages["/autotune/wrench"][0][0] == later.stamp_ns[0]


def test_only_annotations_are_replaced(run_cli: RunCli, good_log: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.mcap"
    own.write_bytes(good_log.read_bytes())
    (tmp_path / "text.mcap").write_text("hello\n")
    for target, reported in (
        ("own.mcap", "own.mcap exists"),
        ("text.mcap", "text.mcap exists"),
        ("seen.bag", "must end in .mcap"),
        ("no/seen.mcap", "folder"),
    ):
        done = run_cli("identify", good_log, "--annotate", target)
        assert (done.returncode, done.stdout) == (2, "")
        assert reported in done.stderr
        assert not (tmp_path / "identified.yaml").exists()
    assert own.read_bytes() == good_log.read_bytes()
    assert (tmp_path / "text.mcap").read_text() == "hello\n"
    for _ in range(2):
        assert run_cli("identify", good_log, "--annotate", "seen.mcap", "--quiet").returncode == 0
