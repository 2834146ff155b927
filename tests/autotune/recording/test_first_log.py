"""The program of a first log: what it commands, and what it does with the force."""

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.signal import cont2discrete, lfilter

from autotune.recording import FirstLog, FirstLogCommand, PlainAdmittance
from autotune.recording.first_log import Three
from problems.errors import ParameterError

H = 2e-3
WEIGHT = (3.0, -4.0, -160.0, 0.0, 0.0, 0.0)
BRIEF: dict[str, Any] = {
    "rest_s": 0.2, "pose_count": 3, "pose_move_s": 0.2, "pose_hold_s": 0.2, "sweep_s": 4.0, "sweep_hz": (1.0, 20.0),
    "contact_count": 2, "contact_hold_s": 0.8,
}  # fmt: skip


def run(program: FirstLog, wrench: Callable[[FirstLogCommand], tuple[float, ...]]) -> list[FirstLogCommand]:
    commands = program.commands(period_s=H)
    found = [next(commands)]
    try:
        while True:
            found.append(commands.send(wrench(found[-1])))
    except StopIteration:
        return found


def wall(stiffness: float, distance: float) -> Callable[[FirstLogCommand], tuple[float, ...]]:
    """Return the wrench of a robot that follows at once and touches a spring in the way of z."""

    def wrench(command: FirstLogCommand) -> tuple[float, ...]:
        force = -stiffness * max(0.0, command.displacement_m[2] - distance)
        return (*WEIGHT[:2], WEIGHT[2] + force, *WEIGHT[3:])

    return wrench


def test_the_phases_come_in_order_and_every_step_is_small() -> None:
    found = run(FirstLog(axis="z", **BRIEF), wall(2e4, 0.01))
    order = [each.phase for k, each in enumerate(found) if k == 0 or found[k - 1].phase != each.phase]
    assert order == ["rest", "poses", "sweep", "rest", "contacts", "rest", "contacts", "rest"]
    place = np.array([each.displacement_m for each in found])
    turned = np.array([each.rotation_rad for each in found])
    # The sweep's 5 mm/s grows by 20/3 towards 20 Hz; a minimum-jerk move is at most 1.875 times as fast as its mean.
    assert np.abs(np.diff(place, axis=0)).max() < 0.005 * math.hypot(1.0, 20.0 / 3.0) * H * 1.1
    assert np.abs(np.diff(turned, axis=0)).max() < 1.875 * 1.1 / 0.2 * H * 1.05
    assert not place[:, :2].any()


def test_the_poses_are_tilted_within_the_asked_angles_and_differ() -> None:
    found = run(FirstLog(axis="z", **BRIEF | {"pose_count": 8, "contact_count": 0}), lambda _: WEIGHT)
    turned = np.array([each.rotation_rad for each in found])
    resting = turned[:-1][np.all(np.diff(turned, axis=0) == 0.0, axis=1)]
    poses = np.unique(resting[np.any(resting != 0.0, axis=1)], axis=0)
    assert len(poses) == 8
    tilts = np.linalg.norm(poses, axis=1)
    assert tilts.min() >= 0.5 * (1.0 - 1e-12)
    assert tilts.max() <= 1.1
    # Mass, centre and bias: the directions of gravity in the tool must span space. Tilts of 2 degrees give 1e-3.
    gravity = np.column_stack(
        [np.sin(tilts) * poses[:, 1] / tilts, -np.sin(tilts) * poses[:, 0] / tilts, np.cos(tilts)]
    )
    assert np.linalg.svd(gravity - gravity.mean(axis=0), compute_uv=False)[2] > 0.1


def test_the_sweep_moves_a_slow_robot_at_one_speed() -> None:
    program = FirstLog(axis="x", **BRIEF | {"contact_count": 0, "sweep_s": 8.0, "robot_bandwidth_hz": 3.0})
    place = np.array([each.displacement_m[0] for each in run(program, lambda _: WEIGHT) if each.phase == "sweep"])
    pole = math.exp(-2.0 * math.pi * 3.0 * H)
    flange = np.zeros(len(place))
    for k in range(1, len(place)):
        flange[k] = pole * flange[k - 1] + (1.0 - pole) * place[k - 1]
    speed = np.abs(np.diff(flange)) / H
    peaks = [part.max() for part in np.array_split(speed[len(speed) // 10 : -len(speed) // 10], 8)]
    # The hold of 2 ms at 20 Hz takes 0.3 %, peaks between samples 1 %, the edge of a piece a little more.
    np.testing.assert_allclose(peaks, 0.005, rtol=0.04)


def test_each_contact_touches_presses_with_the_desired_force_and_backs_off() -> None:
    program = FirstLog(axis="z", **BRIEF, contact_force_n=25.0)
    sensed = wall(2e4, 0.01)
    found = run(program, sensed)
    force = np.array([WEIGHT[2] - sensed(each)[2] for each in found])
    pressed = [k for k, each in enumerate(found) if each.phase == "contacts" and force[k] > 0.0]
    gaps = 1 + sum(later - earlier > 1 for earlier, later in pairwise(pressed))
    assert gaps == 2
    # At rest the admittance holds F = F^d: 0.8 s are eight times B_a/K_e.
    assert force.max() == pytest.approx(25.0, rel=0.02)
    last = [each.displacement_m[2] for each in found if each.phase == "contacts"][-1]
    assert last < 0.01 + 25.0 / 2e4 - 0.01 + 1e-3


def test_without_a_wall_the_approach_ends_after_its_time() -> None:
    program = FirstLog(axis="z", **BRIEF | {"contact_count": 1}, approach_s=1.0)
    contacts = [each.displacement_m[2] for each in run(program, lambda _: WEIGHT) if each.phase == "contacts"]
    # 30 N on 2000 N·s/m for 1 + 0.8 s, after M_a/B_a of gathering speed.
    assert max(contacts) == pytest.approx(0.015 * (1.8 - 0.01), rel=0.01)


def test_a_force_beyond_the_limit_holds_the_command_and_ends_the_program() -> None:
    program = FirstLog(axis="z", **BRIEF, stop_force_n=60.0)
    found = run(program, lambda c: (60.1 + WEIGHT[0], *WEIGHT[1:]) if c.phase == "sweep" else WEIGHT)
    stopped = [each for each in found if each.phase == "stopped"]
    assert len(stopped) == round(0.2 / H)
    assert found[-1].phase == "stopped"
    assert {each.displacement_m for each in stopped} == {found[-len(stopped) - 1].displacement_m}


def test_the_plain_admittance_is_the_tustin_form() -> None:
    admittance = PlainAdmittance(mass_kg=20.0, damping_n_s_per_m=2000.0, period_s=H)
    force = np.random.default_rng(3).standard_normal(400)
    ours = [admittance.step(each) for each in force]
    numerator, denominator, _ = cont2discrete(([1.0], [20.0, 2000.0, 0.0]), H, "bilinear")
    theirs = lfilter(numerator[0], denominator, force)
    # The expanded denominator rounds a pole at 1, which sums up to 1e-9 in 400 steps.
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-8 * np.abs(theirs).max())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"axis": "rz"}, "axis must be x, y or z"),
        ({"sweep_hz": (5.0, 1.0)}, "an increasing pair above 0"),
        ({"tilts_rad": (0.5, 2.0)}, "between 0 and π/2"),
        ({"contact_force_n": 0.0}, "a finite number above 0"),
        ({"stop_force_n": 20.0}, "above contact_force_n = 30.0"),
        ({"tap_count": -1}, "not below 0"),
    ],
)
def test_a_program_that_cannot_be_run_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        FirstLog(**changes)


def test_a_loop_that_sends_no_wrench_is_told_so() -> None:
    commands = FirstLog().commands(period_s=H)
    next(commands)
    with pytest.raises(ParameterError, match="not next"):
        next(commands)


class _Cell:
    """The cell of the page's example: it stands where it is sent, in front of a spring."""

    period_s = H

    def __init__(self) -> None:
        self.ticks, self.sent = 0, (0.0, 0.0, 0.0)

    def send(self, displacement: Three, _rotation: Three) -> tuple[float, ...]:
        self.sent = displacement
        return self.pose()

    def wait_for_next_period(self) -> None:
        self.ticks += 1

    def time_s(self) -> float:
        return self.ticks * H

    def raw_wrench(self) -> tuple[float, ...]:
        return wall(2e4, 0.01)(FirstLogCommand("", self.sent, (0.0, 0.0, 0.0)))

    def pose(self) -> tuple[float, ...]:
        return (*self.sent, 0.0, 0.0, 0.0, 1.0)


def test_the_example_of_the_page_records_a_whole_log(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = (repository / "docs" / "recording.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    exec(page.partition("```python\n")[2].partition("```")[0], names)
    names["record"](_Cell())
    with Path("run7.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count > 3 * 30.0 / H
