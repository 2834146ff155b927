"""The program of a first log: what it commands, and what it does with the force."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from autotune.recording import FirstLog, FirstLogCommand, PlainAdmittance
from autotune.recording.motions import Three
from identification.logs.read import read_recording
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
    # The sweep's 1 cm/s grows by 20/3 towards 20 Hz; a minimum-jerk move is at most 1.875 times as fast as its mean.
    assert np.abs(np.diff(place, axis=0)).max() < 0.01 * math.hypot(1.0, 20.0 / 3.0) * H * 1.1
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
    np.testing.assert_allclose(peaks, 0.01, rtol=0.04)


class _Robot:
    """A robot of first order behind a delay that presses a mass on a spring and damper on a spring: scalars, SI."""

    lag_s, delay_s, mass, coupling, damping, drag = 0.035, 6e-3, 16.0, 3e5, 90.0, 10.0

    def __init__(self, wall: float, distance: float = 0.015) -> None:
        self.wall, self.distance = wall, distance
        self.sent = [0.0] * round(self.delay_s / H)
        self.flange = self.place = self.speed = 0.0
        self.largest_n = 0.0

    def __call__(self, command: FirstLogCommand) -> tuple[float, ...]:
        self.sent.append(command.displacement_m[2])
        steps = 40
        for _ in range(steps):
            dt = H / steps
            rate = (self.sent[-round(self.delay_s / H) - 1] - self.flange) / self.lag_s
            self.flange += dt * rate
            force = self.coupling * (self.place - self.flange) + self.damping * (self.speed - rate)
            touched = self.wall * max(0.0, self.place - self.distance)
            self.speed += dt * (-force - self.drag * self.speed - touched) / self.mass
            self.place += dt * self.speed
            self.largest_n = max(self.largest_n, touched)
        return (*WEIGHT[:2], WEIGHT[2] + force, *WEIGHT[3:])


@pytest.mark.parametrize("stiffness", [1e4, 5e4, 2e5])
def test_a_contact_presses_with_the_desired_force_and_hardly_more_on_a_payload_without_damping(
    stiffness: float,
) -> None:
    # 1.4 % of the critical damping and hardly any drag: an admittance of 20 kg and 2000 N·s/m is unstable here.
    program = FirstLog(axis="z", **BRIEF | {"sweep_s": 0.0, "pose_count": 0, "contact_hold_s": 1.5})
    cell, felt = _Robot(stiffness), []

    def wrench(command: FirstLogCommand) -> tuple[float, ...]:
        row = cell(command)
        felt.append(WEIGHT[2] - row[2])
        return row

    found = run(program, wrench)
    assert [each.phase for each in found].count("stopped") == 0
    assert cell.largest_n < 1.5 * program.contact_force_n
    held = [k for k in range(200, len(felt)) if len({c.displacement_m for c in found[k - 200 : k]}) == 1]
    pressed = [felt[k] for k in held if felt[k] > 5.0]
    assert pressed
    assert min(pressed) > 0.6 * program.contact_force_n
    assert max(pressed) < 1.3 * program.contact_force_n


def test_approaches_get_faster_on_what_is_soft_and_not_on_what_is_stiff() -> None:
    program = FirstLog(axis="z", **BRIEF | {"sweep_s": 0.0, "pose_count": 0, "contact_count": 3})

    def fastest(stiffness: float) -> list[float]:
        place = [each.displacement_m[2] for each in run(program, _Robot(stiffness)) if each.phase == "contacts"]
        steps = np.diff(place) / H
        edges = np.flatnonzero(np.abs(steps) > 0.5)  # the rests in between are left out
        assert not edges.size
        starts = np.flatnonzero((steps[1:] > 1e-4) & (np.abs(steps[:-1]) < 1e-4))
        return [float(steps[a : a + 400].max()) for a in starts]

    soft, stiff = fastest(1e4), fastest(2e5)
    assert max(soft) == pytest.approx(program.fastest_approach_m_s, rel=1e-6)
    assert max(stiff) < 0.6 * program.fastest_approach_m_s


def test_without_a_wall_the_approach_ends_after_its_way_and_no_other_follows() -> None:
    program = FirstLog(axis="z", **BRIEF | {"contact_count": 2}, approach_m=0.01)
    contacts = [each.displacement_m[2] for each in run(program, lambda _: WEIGHT) if each.phase == "contacts"]
    assert max(contacts) == pytest.approx(0.01, rel=0.05)
    assert contacts[-1] == pytest.approx(0.0, abs=1e-9)
    assert len(contacts) < 1.1 * (0.01 / program.approach_speed_m_s + 2.0) / H


def test_the_sweep_is_levelled_where_the_payload_resonates() -> None:
    quality, resonance, mass = 25.0, 2.0 * math.pi * 10.0, 16.0
    state = [0.0, 0.0, 0.0]

    def wrench(command: FirstLogCommand) -> tuple[float, ...]:
        here, moved, speed = command.displacement_m[2], *state[1:]
        for _ in range(20):
            force = -mass * (resonance**2 * (moved - here) + resonance / quality * speed)
            speed += H / 20 * force / mass
            moved += H / 20 * speed
        state[:] = here, moved, speed
        return (*WEIGHT[:2], WEIGHT[2] - force, *WEIGHT[3:])

    program = FirstLog(axis="z", **BRIEF | {"pose_count": 0, "contact_count": 0, "sweep_s": 12.0})
    felt: dict[float, float] = {}
    for limit in (60.0, 190.0):
        state[:] = [0.0, 0.0, 0.0]
        forces: list[float] = []

        def seen(command: FirstLogCommand, forces: list[float] = forces) -> tuple[float, ...]:
            row = wrench(command)
            forces.append(abs(row[2] - WEIGHT[2]))
            return row

        run(replace(program, sweep_force_n=limit), seen)
        felt[limit] = max(forces)
    # A resonance swings on while the sweep gets smaller; 11 % beyond here, at a quality of 25.
    assert felt[60.0] < 1.15 * 60.0
    assert felt[190.0] > 2.0 * felt[60.0]


def test_a_force_beyond_the_limit_holds_the_command_and_ends_the_program() -> None:
    program = FirstLog(axis="z", **BRIEF, stop_force_n=61.0, sweep_force_n=50.0)
    found = run(program, lambda c: (61.1 + WEIGHT[0], *WEIGHT[1:]) if c.phase == "sweep" else WEIGHT)
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
        ({"stop_force_n": 70.0}, "above sweep_force_n = 80.0"),
        ({"fastest_approach_m_s": 1e-3}, "not below approach_speed_m_s = 0.003"),
        ({"tap_count": -1}, "not below 0"),
    ],
)
def test_a_program_that_cannot_be_run_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        FirstLog(**changes)


def test_a_loop_that_sends_no_wrench_is_reported_so() -> None:
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
        pressed = wall(2e4, 0.01)(FirstLogCommand("", self.sent, (0.0, 0.0, 0.0)))
        return tuple(value + 1e-3 * math.sin(self.ticks * (i + 1)) for i, value in enumerate(pressed))

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
    log = read_recording(Path("run7.mcap"))
    assert log.command is not None
    assert len(log.pose.stamp_ns) == len(log.command.stamp_ns) > 30.0 / H
    # The cell is at once where it is sent, and its pose is read a period later.
    assert np.array_equal(log.pose.stamp_ns, log.command.stamp_ns + round(1e9 * H))
    assert np.array_equal(log.pose.position_m, log.command.position_m)
