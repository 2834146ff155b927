"""The whole chain on logs that the official ROS 2 writer made, with other topics, rates and clocks than our own."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from autotune.formats.controller import read_controller
from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.logs.roles.registry import POSE_STAMPED as POSE
from identification.logs.roles.registry import WRENCH_STAMPED as WRENCH
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from tests.autotune.simulation.runs import silent
from tests.autotune.simulation.test_identified_again import at_other_rates
from tests.identification.logs.log_builder import Options, Stream, write_mcap
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
PROMISED = 0.05
PROGRAM = Program(
    pose_count=6, pose_hold_s=0.8, pose_move_s=0.6, jogging_s=0.0, sweep_s=8.0, contact_count=3, contact_hold_s=0.8
)
# Two of the four variables, and a band that is quick to measure: what is shown here is the chain, not the search.
PROBLEM = """\
bounds: {mass: [6, 6], damping: [900, 1600], lead_s: [0.005, 0.03], feedback_damping_s: [0.005, 0.005]}
requirements:
  free_space_admittance: {min_m_s_per_n: 6.0e-4, band_hz: [1, 2]}
"""


@dataclass(frozen=True, kw_only=True)
class Topics:
    wrench: str
    pose: str
    command: str


PLAIN = Topics(wrench="/wrist/ft_raw", pose="/arm/tcp_pose", command="/servo/target_pose")
# Two wrenches, and no word in the poses' topics that says which is the command.
OPAQUE = Topics(wrench="/ft/left", pose="/tf/a", command="/tf/b")


def stream(topic: str, signal: WrenchSignal | PoseSignal, rng: np.random.Generator) -> Stream:
    """Messages that are recorded up to a millisecond late, so not in the order of their stamps."""
    if isinstance(signal, WrenchSignal):
        name, values = WRENCH, np.hstack([signal.force_n, signal.torque_n_m])
    else:
        name, values = POSE, np.hstack([signal.position_m, signal.quaternion_xyzw])
    late: NDArray[np.int64] = rng.integers(100_000, 1_100_000, len(values))
    # One connection delivers in order: only the channels among each other are out of order.
    recorded = np.maximum.accumulate(signal.stamp_ns + late)
    return Stream(
        topic=topic,
        type_name=name,
        stamp_ns=signal.stamp_ns,
        values=values,
        log_ns=recorded,
        frame_id=signal.frame_id,
    )


def streams(recording: Recording, topics: Topics) -> list[Stream]:
    rng = np.random.default_rng(9)
    assert recording.command is not None
    return [
        stream(topics.wrench, recording.wrench, rng),
        stream(topics.pose, recording.pose, rng),
        stream(topics.command, recording.command, rng),
    ]


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Wrench at 1000 Hz, pose at 500 Hz, command at the control rate; noise is added after the interpolation."""
    run = simulate_cell(silent(SimulatedCell()), PROGRAM, seed=5)
    return at_other_rates(run, wrench_hz=1000.0, pose_hz=500.0)


@pytest.fixture(scope="module")
def plain_log(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Path:
    return write_mcap(tmp_path_factory.mktemp("plain") / "run7.mcap", streams(recording, PLAIN))


@pytest.fixture(scope="module")
def opaque_log(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Path:
    parts = streams(recording, OPAQUE)
    second = Stream(
        topic="/ft/right",
        type_name=WRENCH,
        stamp_ns=parts[0].stamp_ns[::100],
        values=parts[0].values[::100] * 0.0 + 1.0,
        log_ns=parts[0].log_ns[::100],
    )
    options = Options(extra=(("/camera/front/image_raw", "sensor_msgs/msg/Image"),), chunk_size=256 * 1024)
    return write_mcap(tmp_path_factory.mktemp("opaque") / "run8.mcap", [*parts, second], options)


def json_of(done: "subprocess.CompletedProcess[str]") -> dict[str, Any]:
    assert (done.returncode, done.stderr) == (0, "")
    tree: dict[str, Any] = json.loads(done.stdout)
    return tree


def weak_percent(tree: dict[str, Any]) -> str:
    damping = tree["axes"]["x"]["coupling"]["damping_n_s_per_m"]
    return f"{100.0 * damping['std'] / damping['value']:.0f}"


def check_identified(tree: dict[str, Any]) -> None:
    cell, axis = SimulatedCell(), tree["axes"]["x"]
    for found, truth in (
        (tree["payload"]["mass_kg"], cell.payload_mass_kg),
        (axis["coupling"]["stiffness_n_per_m"], cell.coupling.stiffness_n_per_m),
        (axis["environments"][0]["stiffness_n_per_m"], cell.environment.stiffness_n_per_m),
    ):
        assert found["status"] == "identified"
        assert found["value"] == pytest.approx(truth, rel=PROMISED)
    # The command's clock is the controller's, whatever the sensors run at.
    assert tree["sample_time_s"]["value"] == pytest.approx(cell.sample_time_s, rel=1e-6)


def test_a_damaged_chunk_costs_a_log_that_chunk_alone(run_cli: RunCli, tmp_path: Path, recording: Recording) -> None:
    path = write_mcap(tmp_path / "run.mcap", streams(recording, PLAIN), Options(chunk_size=256 * 1024))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    damaged, data = summary.chunk_indexes[len(summary.chunk_indexes) // 2], bytearray(path.read_bytes())
    data[damaged.chunk_start_offset + damaged.chunk_length // 2] ^= 0x10
    path.write_bytes(data)
    found = json_of(run_cli("identify", path, "--json", "-o", tmp_path / "found.yaml"))
    check_identified(found)
    said = {finding["code"]: finding["message"] for finding in found["findings"]}
    start = 1e-9 * (damaged.message_start_time - min(each.message_start_time for each in summary.chunk_indexes))
    assert f"damaged: bytes {damaged.chunk_start_offset} to " in said["salvaged"]
    assert f", recorded {start:.3f} to " in said["salvaged"]
    assert {"hole", "salvaged-span"} & said.keys() == {"hole"}
    inspected = json_of(run_cli("inspect", path, "--json"))
    assert said["salvaged"] in {finding["message"] for finding in inspected["findings"]}
    assert sorted(f["code"] for f in found["findings"] if f["code"] in ("salvaged", "hole")) == ["hole", "salvaged"]
    # As does a flipped bit in its head, which the summary lists.
    head = bytearray(data)
    head[damaged.chunk_start_offset + damaged.chunk_length // 2] ^= 0x10
    head[damaged.chunk_start_offset + 3] ^= 0x10
    path.write_bytes(head)
    beside = json_of(run_cli("inspect", path, "--json"))
    assert f"damaged: bytes {damaged.chunk_start_offset} to " in str(beside["findings"])
    assert beside["channels"] == inspected["channels"]
    # With its end cut off nobody knows what is missing.
    path.write_bytes(data[:-20])
    refused = run_cli("identify", path, "-o", tmp_path / "refused.yaml")
    assert (refused.returncode, (tmp_path / "refused.yaml").exists()) == (3, False)
    salvaged = json_of(run_cli("identify", path, "--salvage", "--json", "-o", tmp_path / "salvaged.yaml"))
    check_identified(salvaged)
    assert salvaged["provenance"]["options"]["salvage"] is True
    assert {"salvaged", "salvaged-span", "hole"} <= {finding["code"] for finding in salvaged["findings"]}
    # Where what is lost was needed, the refusal says so.
    path.write_bytes(data[: 6 * len(data) // 10])
    refused = run_cli("identify", path, "--salvage", "-o", tmp_path / "refused.yaml")
    assert (refused.returncode, (tmp_path / "refused.yaml").exists()) == (4, False)
    assert "no contact" in refused.stderr
    assert f"Noticed: {path.name} is damaged: " in refused.stderr
    assert f"What is left of {path.name} spans " in refused.stderr


@pytest.mark.slow
def test_from_a_log_to_an_exported_controller(
    run_process: RunCli, run_cli: RunCli, tmp_path: Path, plain_log: Path
) -> None:
    # `validate` alone has a process of its own here, `identify` and `optimize` have one in tests/autotune/cli.
    inspected = json_of(run_cli("inspect", plain_log, "--json"))
    assert inspected["missing"] == []
    rates = {c["topic"]: c["rate_hz"] for c in inspected["channels"] if c["roles"]}
    assert rates == {
        PLAIN.wrench: pytest.approx(1000.0, rel=1e-3),
        PLAIN.pose: pytest.approx(500.0, rel=1e-3),
        PLAIN.command: pytest.approx(1250.0, rel=1e-3),
    }
    identified = json_of(run_cli("identify", plain_log, "--json"))
    check_identified(identified)
    assert identified["provenance"]["channels"] == {
        "wrench": PLAIN.wrench,
        "pose": PLAIN.pose,
        "command": PLAIN.command,
    }
    (tmp_path / "problem.yaml").write_text(PROBLEM, encoding="utf-8")
    asked = ("--problem", "problem.yaml", "--proof-budget", "1")
    tuned = run_cli("optimize", "identified.yaml", *asked, "--json")
    # What sensors of 500 and 1000 Hz leave open of a part of the payload is in the deviation of B_s, and said.
    assert tuned.returncode == 0
    assert tuned.stderr in ("", f"identified.yaml: warning: Axis x: B_s (± {weak_percent(identified)} %): weak.\n")
    optimized: dict[str, Any] = json.loads(tuned.stdout)
    domain = optimized["certificate"]["domain"]["x"]
    assert domain["environment_stiffness_n_per_m"][0] < SimulatedCell().environment.stiffness_n_per_m
    assert domain["environment_stiffness_n_per_m"][1] > SimulatedCell().environment.stiffness_n_per_m
    validated = json_of(run_process("validate", "controller.yaml", "--identified", "identified.yaml", "--json"))
    assert validated["passed"]
    exported = json_of(run_cli("export", "controller.yaml", "--target", "json", "-o", "cell.json", "--json"))
    assert exported["checksum"] == validated["checksum"] == optimized["checksum"]
    assert read_controller(tmp_path / "cell.json").checksum == exported["checksum"]


def test_topics_that_show_nothing_are_asked_for_and_taken_from_the_options(
    run_cli: RunCli, tmp_path: Path, opaque_log: Path
) -> None:
    refused = run_cli("identify", opaque_log)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (3, "", 1)
    assert all(part in refused.stderr for part in ("/ft/left (", "/ft/right (", "say which one with --wrench-topic"))
    still = run_cli("identify", opaque_log, "--wrench-topic", OPAQUE.wrench)
    assert still.returncode == 3
    assert "--pose-topic" in still.stderr
    assert list(tmp_path.iterdir()) == []
    named = ["--wrench-topic", OPAQUE.wrench, "--pose-topic", OPAQUE.pose, "--command-topic", OPAQUE.command]
    check_identified(json_of(run_cli("identify", opaque_log, *named, "--json")))


@pytest.mark.parametrize("name", ["single_mode_middle.bag", "yellow_table_1.bag"])
def test_recorded_bags_are_described_truly_and_refused_with_a_reason(
    run_cli: RunCli, tmp_path: Path, shared_data: Path, name: str
) -> None:
    """These hold the state of the robot and of its controller in unnamed fields, the force behind a deadband."""
    log = shared_data / "nj60" / name
    if not log.is_file():
        pytest.skip(f"needs {name}")
    output = run_cli("inspect", log)
    assert output.returncode == 0
    assert is_next_alone(output.stderr)
    for expected in (
        "/robot_state is a JointState with 6 position, ",
        "a layout has to be declared in cell.yaml before it can serve as pose or wrench",
        "So many exact zeros are what a deadband applied before recording leaves",
        "samples cut to zero hold nothing of gravity and bias",
        "has no channel for the wrench",
        "has no channel for the commanded pose",
    ):
        assert expected in output.stdout
    refused = run_cli("identify", log)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (3, "", 1)
    assert "no channel for the wrench: it needs geometry_msgs/msg/WrenchStamped" in refused.stderr
    assert "deadband" in refused.stderr
    assert list(tmp_path.iterdir()) == []
