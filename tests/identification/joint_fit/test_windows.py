"""Motions that hold a hand, a sweep and a contact in one, on a cell integrated apart from the project's code."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.linalg import expm
from scipy.signal import lfilter

from identification.joint_fit.data import HeldCommand, JointData
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.result import JointFit
from identification.joint_fit.segments import Segment
from identification.joint_fit.windows import informative_pieces, joined, outside, windows_of
from identification.signals.segments import Span
from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from tests.identification.synthetic import sweep

H_S = 2e-3
SUB = 4
OMEGA, DELAY_SAMPLES = 38.0, 2
K_S, B_S, B_P, M_P = 3e5, 630.0, 60.0, 16.0
K_E, GAP_M = 1.1e4, 0.012
M_A, B_A, DESIRED_N = 14.0, 1200.0, 30.0
NOISE_N, JITTER_M = 0.1, 2e-6
SWEEP_S, HAND_S = 8.0, 4.0
# Those of docs/accuracy.md, but for the delay: 14 % of a sample.
TARGETS = {"stiffness_n_per_m": 0.04, "damping_n_s_per_m": 0.15, "drag_n_s_per_m": 0.15, "mass_kg": 0.005}
TRUTH = dict(zip(TARGETS, (K_S, B_S, B_P, M_P), strict=True))


@dataclass(frozen=True, kw_only=True)
class Story:
    """What drives the cell tick by tick: a program, or F^d and force through an admittance; and a hand's force."""

    program_m: list[FloatArray] = field(default_factory=list)
    desired_n: list[FloatArray] = field(default_factory=list)
    hand_n: list[FloatArray] = field(default_factory=list)
    drag_n_s_per_m: float = B_P
    is_felt_first: bool = False  # the force of a tick is that before the command's step, which makes the speed jump

    def add(
        self,
        seconds: float,
        *,
        program: FloatArray | None = None,
        desired: float | None = None,
        hand: FloatArray | None = None,
    ) -> "Story":
        """Go on; where neither program nor F^d is said the command rests."""
        count = round(seconds / H_S)
        steps = np.zeros(count) if program is None else np.diff(program, prepend=0.0)
        self.program_m.append(steps)
        self.desired_n.append(np.full(count, np.nan if desired is None else desired))
        self.hand_n.append(np.zeros(count) if hand is None else hand)
        return self

    def run(self, wall_m: float = np.inf) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return flange, felt force and command (n,): x' = ω (u − x), exact but for when it touches."""
        program, desired, hand = (np.concatenate(each) for each in (self.program_m, self.desired_n, self.hand_n))
        # x, x_p, v_p; then command, hand and 1.
        felt = np.array([-K_S + B_S * OMEGA, K_S, B_S, -B_S * OMEGA, 0.0, 0.0])
        rows = np.zeros((6, 6))
        rows[0, [0, 3]], rows[1, 2] = (-OMEGA, OMEGA), 1.0
        rows[2] = -felt / M_P
        rows[2, 2] -= self.drag_n_s_per_m / M_P
        rows[2, 4] = 1.0 / M_P
        touching = rows.copy()
        if np.isfinite(wall_m):
            touching[2, [1, 5]] += np.array([-K_E, K_E * wall_m]) / M_P
        free, touched = (expm(each * H_S / SUB)[:3] for each in (rows, touching))
        state, shown, commands = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.empty((len(hand), 2)), np.zeros(len(hand))
        speed = 0.0
        for k in range(len(hand)):
            state[3] = commands[max(k - DELAY_SAMPLES - self.is_felt_first, 0)]
            shown[k] = state[0], felt @ state
            if np.isnan(desired[k]):
                speed, step = 0.0, float(program[k])
            else:
                speed = (M_A * speed + H_S * (desired[k] + shown[k, 1])) / (M_A + H_S * B_A)
                step = H_S * speed
            commands[k] = (commands[k - 1] if k else 0.0) + step
            state[3:5] = commands[max(k - DELAY_SAMPLES, 0)], hand[k]
            for _ in range(SUB):
                state[:3] = (touched if state[1] > wall_m else free) @ state
        return shown[:, 0], shown[:, 1], commands


def push(seconds: float, size_n: float) -> FloatArray:
    """A hand that begins and ends with no force and works all the time."""
    count = round(seconds / H_S)
    noise = np.random.default_rng(3).standard_normal(count)
    slow = lfilter([0.02**2], np.poly([0.98, 0.98]), noise)
    return np.asarray(size_n * slow / np.std(slow) * np.minimum(1.0, np.linspace(0.0, 20.0, count)))


def data_of(story: Story, rest_s: float, *, wall_m: float = np.inf, holds: tuple[Span, ...] = ()) -> JointData:
    """What the stages hand on: one motion between two rests, start values off by a tenth, a mass of twice its error."""
    position, force, command = story.run(wall_m)
    rng = np.random.default_rng(5)
    rest, count = round(rest_s / H_S), len(position)
    moving = Span(start=rest, stop=holds[0].start if holds else count - rest)
    omega = 2.0 * np.pi * 25.0
    guess = (
        0.9 if story.is_felt_first else 1.1
    )  # on the side of the whole sample where the force jumps too early or late
    return JointData(
        period_s=H_S,
        position_m=position + JITTER_M * rng.standard_normal(count),
        force_n=force + NOISE_N * rng.standard_normal(count),
        command=HeldCommand(command_m=command, shift_s=0.0),
        rests=(Span(start=0, stop=rest - 50),),
        moving=(moving,),
        free=(),
        mixed=(moving,),
        holds=holds,
        coupling=np.array([M_P * omega**2, 0.1 * M_P * omega, 200.0, M_P]),
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=1.02 * OMEGA, delay_s=guess * DELAY_SAMPLES * H_S),
        mass_kg=1.01 * M_P,
    )


def commanded_sweep() -> FloatArray:
    return 4.0 * sweep(SWEEP_S, 1.0 / H_S)


def guided_then_swept(pause_s: float) -> JointData:
    story = (
        Story(is_felt_first=pause_s > 0.0)
        .add(1.5)
        .add(HAND_S, desired=0.0, hand=push(HAND_S, 25.0))
        .add(pause_s, desired=0.0)
    )
    return data_of(story.add(SWEEP_S, program=commanded_sweep()).add(1.5), 1.5)


def held_in_sweep() -> JointData:
    hand = np.zeros(round(SWEEP_S / H_S))
    first, last = round(2.5 / H_S), round(4.0 / H_S)
    hand[first:last] = push(1.5, 25.0)
    return data_of(Story().add(1.5).add(SWEEP_S, program=commanded_sweep(), hand=hand).add(1.5), 1.5)


def swept_then_pressed(drag_n_s_per_m: float) -> JointData:
    """A sweep that goes over into an approach, a hold, and the way back from it, a motion of its own."""
    story = Story(drag_n_s_per_m=drag_n_s_per_m).add(1.5).add(SWEEP_S, program=commanded_sweep()).add(0.1)
    wall = float(story.add(0.0).run()[0][-1]) + GAP_M
    story = story.add(4.0, desired=DESIRED_N)
    end = sum(map(len, story.hand_n))
    story = story.add(1.2, program=np.linspace(0.0, -0.03, round(1.2 / H_S))).add(1.5)
    hold = Span(start=end - round(1.0 / H_S), stop=end)
    back = Span(start=end, stop=end + round(1.8 / H_S))
    data = data_of(story, 1.5, wall_m=wall, holds=(hold,))
    return replace(data, moving=(*data.moving, back), free=(back,))


def off(fit: JointFit, drag_n_s_per_m: float = B_P) -> dict[str, float]:
    """Errors as shares of their targets."""
    truth = {**TRUTH, "drag_n_s_per_m": drag_n_s_per_m}
    found = {name: abs(fit.value(name)[0] / truth[name] - 1.0) / target for name, target in TARGETS.items()}
    return {**found, "delay_s": abs(fit.value("delay_s")[0] - DELAY_SAMPLES * H_S) / (0.14 * H_S)}


def touched_by(fit: JointFit, first_s: float, last_s: float) -> list[float]:
    """Begin of the spans in free motion that reach into a time [s]."""
    spans = [(s.start * H_S, (s.start + len(s.measured)) * H_S) for s in fit.spans if s.surface is None]
    return [begin for begin, end in spans if begin < last_s and first_s < end]


@pytest.mark.parametrize("pause_s", [0.0, 0.25])
def test_a_hand_that_goes_over_into_a_sweep_leaves_the_sweep_to_be_used(pause_s: float) -> None:
    data = guided_then_swept(pause_s)
    fit = identify_joint(data)
    assert max(off(fit).values()) < 1.0, off(fit)
    for name, truth in TRUTH.items():
        value, std = fit.value(name)
        assert abs(value - truth) < 3.5 * std, name  # eight values, all of them with 99.6 %
    assert touched_by(fit, 1.5, 1.5 + HAND_S) == []
    used = sum(len(span.measured) for span in fit.spans) * H_S
    assert used > SWEEP_S - 1.0


def test_a_hand_during_a_part_of_a_sweep_costs_that_part_only() -> None:
    data = held_in_sweep()
    fit = identify_joint(data)
    assert max(off(fit).values()) < 1.0, off(fit)
    assert touched_by(fit, 4.0, 5.5) == []
    assert sum(len(span.measured) for span in fit.spans) * H_S > SWEEP_S - 1.5 - 1.5
    assert fit.quality.noise_ratio_free < 1.5


def test_a_sweep_that_runs_into_a_contact_shows_payload_and_surface() -> None:
    """The way back from the surface alone, in which drag is most of the force, looks like another payload."""
    drag_n_s_per_m = 300.0
    fit = identify_joint(swept_then_pressed(drag_n_s_per_m))
    assert max(off(fit, drag_n_s_per_m).values()) < 1.0, off(fit, drag_n_s_per_m)
    assert fit.value("environment1_stiffness_n_per_m")[0] == pytest.approx(K_E, rel=0.05)
    # No sample is in free motion and in contact at once.
    (contact,) = [span for span in fit.spans if span.surface is not None]
    begin, end = contact.start * H_S, (contact.start + len(contact.measured)) * H_S
    assert touched_by(fit, begin, end) == []


def test_windows_divide_a_span_and_join_to_what_they_came_from() -> None:
    span = Segment(start=17, stop=2017)
    windows = windows_of([span], H_S)
    assert [len(w) for w in windows] == [250] * 8
    assert joined(windows, H_S) == [span]
    assert joined(windows[:1] + windows[2:4] + windows[6:], H_S) == [
        Segment(start=517, stop=1017),
        Segment(start=1517, stop=2017),
    ]
    assert outside(span, [Span(start=0, stop=17), Span(start=2017, stop=2018)])
    assert not outside(span, [Span(start=0, stop=18)])


def test_the_pieces_that_show_are_those_that_nothing_drives() -> None:
    """A hand does F dx > 0 all along, a payload takes and gives back: F = −M a."""
    time = np.arange(2000) * H_S
    position = 0.01 * np.sin(2.0 * np.pi * 1.0 * time)
    speed, acceleration = np.gradient(position, H_S), np.gradient(np.gradient(position, H_S), H_S)
    force = np.where(time < 2.0, 300.0 * speed, -16.0 * acceleration)
    pieces = informative_pieces([Segment(start=0, stop=2000)], position, np.asarray(force), H_S)
    assert_array_equal([(piece.start, piece.stop) for piece in pieces], [(1000, 2000)])
