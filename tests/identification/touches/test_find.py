"""Touches of an admittance that drives into a wall, is stopped by a hand, or is led by one."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, lsim

from identification.errors import EstimateError, LogError
from identification.fitted_timeline import is_driven_alone
from identification.partial import identify_partial
from identification.result import TouchCause
from identification.signals.recording import GainsSignal, PoseSignal, Recording, WrenchSignal
from identification.touches.find import find_touches
from identification.touches.signals import axis_signals, offset_findings
from identification.touches.signs import check_force_sign
from identification.touches.surfaces import identify_touches, no_contact
from identification.verdicts import unidentifiable
from problems.arrays import FloatArray

MASS_KG, DAMPING_N_S_PER_M, DESIRED_N = 10.0, 500.0, 15.0
STEP_S = 1e-4


@dataclass(frozen=True, kw_only=True)
class Program:
    """What meets an admittance: the force on the flange, of time [s], travel [m] and speed [m/s]."""

    force_n: Callable[[float, float, float], float]
    desired_n: float = DESIRED_N
    rate_hz: float = 1000.0
    length_s: float = 6.0
    start_s: float = 0.5
    turned_s: float = np.inf


def recorded(program: Program, offset_n: float = 0.0) -> Recording:
    """Integrate M_a dv/dt + B_a v = F + F^d, with F^d from `start_s` to `turned_s` and −F^d then, logged along z."""
    count = int(program.length_s / STEP_S)
    travel, force = np.zeros(count), np.zeros(count)
    place = speed = 0.0
    for k in range(count):
        time = k * STEP_S
        force[k] = program.force_n(time, place, speed)
        travel[k] = place
        driven = program.desired_n if time > program.start_s else 0.0
        driven *= -1.0 if time > program.turned_s else 1.0
        speed += STEP_S * (force[k] + driven - DAMPING_N_S_PER_M * speed) / MASS_KG
        place += STEP_S * speed
    every = round(1.0 / program.rate_hz / STEP_S)
    return logged(travel[::every], force[::every] + offset_n, every * STEP_S, program.desired_n)


def logged(travel: FloatArray, force: FloatArray, step_s: float, desired_n: float) -> Recording:
    n = len(travel)
    stamps = np.round(1e9 * step_s * np.arange(n)).astype(np.int64)
    along = np.array([0.0, 0.0, 1.0])
    return Recording(
        wrench=WrenchSignal(
            topic="w",
            frame_id="",
            stamp_ns=stamps,
            force_n=force[:, None] * along,
            torque_n_m=np.zeros((n, 3)),
            gravity_compensated=True,
        ),
        pose=PoseSignal(
            topic="p",
            frame_id="",
            stamp_ns=stamps,
            position_m=travel[:, None] * along,
            quaternion_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        ),
        command=None,
        gains=GainsSignal(
            topic="g", stamp_ns=stamps[:1], mass=np.full((1, 6), MASS_KG), damping=np.full((1, 6), DAMPING_N_S_PER_M)
        ),
        desired_force=WrenchSignal(
            topic="d",
            frame_id="",
            stamp_ns=stamps[:1],
            force_n=desired_n * along[None],
            torque_n_m=np.zeros((1, 3)),
        ),
    )


def wall(stiffness: float, at_m: float, damping: float = 100.0) -> Callable[[float, float, float], float]:
    return lambda _, x, v: -max(stiffness * (x - at_m) + damping * v, 0.0) if x > at_m else 0.0


def with_command(recording: Recording) -> Recording:
    return replace(recording, command=replace(recording.pose, topic="c"), gains=None, desired_force=None)


def flipped(recording: Recording) -> Recording:
    return replace(recording, wrench=replace(recording.wrench, force_n=-recording.wrench.force_n))


@given(stiffness=st.floats(2e3, 4e4), at_m=st.floats(0.02, 0.04))
@settings(max_examples=5, deadline=None)
def test_a_wrench_of_the_other_sign_is_refused_where_a_wall_held_the_tool(stiffness: float, at_m: float) -> None:
    log = recorded(Program(force_n=wall(stiffness, at_m)))
    with pytest.raises(EstimateError, match=r"pushes where the tool goes and then stands still.*exerted_by: sensor"):
        identify_touches(flipped(log))
    # One hold that is as a wall's shows the sign.
    right, wrong = axis_signals(log), axis_signals(flipped(log))
    check_force_sign((*right, *wrong))


def test_a_wrench_of_the_other_sign_is_refused_where_the_tool_swings_on_the_wall_all_the_time() -> None:
    """It is never still for 0.4 s, but stays where it met what pushes with 12 to 28 N."""
    time = np.arange(0.0, 4.0, 1e-3)
    held = np.clip((time - 1.5) / 0.1, 0.0, 1.0)
    travel = 0.02 * np.minimum(time, 1.5) + 2e-4 * held * np.sin(2.0 * np.pi * 4.0 * time)
    force = held * (20.0 + 8.0 * np.sin(2.0 * np.pi * 4.0 * time))
    with pytest.raises(EstimateError, match=r"stands still.*exerted_by: sensor"):
        identify_touches(logged(travel, force, 1e-3, 0.0))
    identify_touches(logged(travel, -force, 1e-3, 0.0))
    # What is pushed on and on is led by a hand.
    identify_touches(logged(0.02 * time, force, 1e-3, 0.0))


@pytest.mark.parametrize("stiffness", [5e3, 4e4])
def test_a_desired_force_of_the_other_sign_is_refused_where_it_would_drive_as_fast(stiffness: float) -> None:
    log = recorded(Program(force_n=wall(stiffness, 0.02)))
    desired = log.desired_force
    assert desired is not None
    with pytest.raises(EstimateError, match=r"found -15 N along z .* in \+z at (29\.|30).* turn the sign of"):
        identify_touches(replace(log, desired_force=replace(desired, force_n=-desired.force_n)))
    # At another speed than F^d/B_a something else drives: no sign is shown, and no wall either.
    other = replace(log, desired_force=replace(desired, force_n=-2.0 * desired.force_n))
    assert [each.cause for each in identify_touches(other).timeline.touches] == [TouchCause.UNDETERMINED]


def test_a_hand_that_rests_on_the_tool_after_leading_it_is_not_taken_for_a_wrong_sign() -> None:
    """Six newtons within the deadband of the admittance: along the motion first, then at rest."""
    time = np.arange(0.0, 5.0, 1e-3)
    found = identify_touches(logged(0.02 * np.minimum(time, 2.0), np.where(time > 1.0, 6.0, 0.0), 1e-3, 0.0))
    assert all(touch.cause is not TouchCause.WALL for touch in found.timeline.touches)


@pytest.mark.parametrize(("share", "every"), [(0.1, 1), (0.7, 8), (1.5, 8)])
def test_a_touch_is_withdrawn_where_the_desired_force_turns_before_its_peak(share: float, every: int) -> None:
    """What is touched for as long as the loading takes is a whole blow, and a second log says how long that is."""
    meets = Program(force_n=wall(1.5e4, 0.02), length_s=2.0, rate_hz=1000.0 / every)
    (whole,) = identify_touches(with_command(recorded(meets))).timeline.touches
    assert whole.onset_s is not None
    assert not whole.is_withdrawn
    turned = whole.onset_s + share * (whole.peak_s - whole.onset_s)
    found = identify_touches(with_command(recorded(replace(meets, turned_s=turned))))
    (touch,) = found.timeline.touches
    assert touch.is_withdrawn is (share < 1.0)
    assert any(each.code == "touch-withdrawn" for each in found.findings) is (share < 1.0)
    assert ("z" in found.surfaces) is (share > 1.0)
    # It is met by no hand all the same.
    assert found.shows_a_wall
    assert "shows no whole blow of what it touches" in no_contact(found).message


def test_a_logged_desired_force_that_turns_before_the_peak_shows_a_withdrawn_touch() -> None:
    log = recorded(Program(force_n=wall(1e4, 0.02), length_s=2.0, turned_s=1.25))
    (unseen,) = identify_touches(log).timeline.touches
    desired = log.desired_force
    assert desired is not None
    assert not unseen.is_withdrawn
    turned = replace(
        desired,
        stamp_ns=np.array([0, round(1.25e9)]),
        force_n=np.outer([DESIRED_N, -DESIRED_N], [0.0, 0.0, 1.0]),
        torque_n_m=np.zeros((2, 3)),
    )
    found = identify_touches(replace(log, desired_force=turned))
    assert found.timeline.touches[0].is_withdrawn
    assert found.surfaces == {}


@given(stiffness=st.floats(3e3, 3e4), at_m=st.floats(0.02, 0.05), offset=st.sampled_from((0.0, 30.0)))
@settings(max_examples=8, deadline=None)
def test_a_wall_is_met_as_it_is(stiffness: float, at_m: float, offset: float) -> None:
    """The speed is F^d/B_a, the hold F^d, the loading the spring; an offset of the sensor changes nothing."""
    found = identify_touches(recorded(Program(force_n=wall(stiffness, at_m)), offset))
    (touch,) = found.timeline.touches
    assert (touch.axis, touch.sign, touch.cause, touch.is_led) == ("z", 1, TouchCause.WALL, False)
    assert touch.onset_s == pytest.approx(
        0.5 + MASS_KG / DAMPING_N_S_PER_M + at_m * DAMPING_N_S_PER_M / DESIRED_N, abs=0.05
    )
    assert touch.approach_speed == pytest.approx(DESIRED_N / DAMPING_N_S_PER_M, rel=0.02)
    assert touch.held_force == pytest.approx(DESIRED_N, rel=0.02)
    assert touch.desired_force == DESIRED_N
    (surface,) = found.surfaces["z"]
    assert touch.surface == surface.name == "z1"
    # The wall's damping is in the loading, which lags behind by no more than 100 N·s/m times the speed.
    secant = surface.secant_stiffness_n_per_m
    assert secant.value is not None
    assert secant.std is not None
    assert abs(secant.value - stiffness) < 2.0 * secant.std


@pytest.mark.parametrize(("force_n", "is_alone"), [(DESIRED_N, True), (2.0 * DESIRED_N, False), (0.0, False)])
def test_a_speed_of_the_desired_force_over_the_damping_shows_no_hand(force_n: float, is_alone: bool) -> None:
    (signals,) = (each for each in axis_signals(recorded(Program(force_n=wall(2e4, 0.05)))) if each.axis == "z")
    (touch,) = identify_touches(recorded(Program(force_n=wall(2e4, 0.05)))).timeline.touches
    assert touch.onset_s is not None
    onset = int(np.searchsorted(signals.time_s, touch.onset_s))
    other = replace(signals, desired_n=np.full(len(signals.time_s), force_n))
    assert is_driven_alone(other, onset, 1) is is_alone
    assert not is_driven_alone(other, onset, -1)


def test_a_constant_force_across_the_motion_hides_no_wall() -> None:
    recording = recorded(Program(force_n=wall(2e4, 0.05)))
    wrench = recording.wrench
    beside = np.tile([3.0, 0.0, 0.0], (len(wrench.stamp_ns), 1))
    noise = 0.1 * np.random.default_rng(3).standard_normal((len(beside), 1)) * [1.0, 0.0, 0.0]
    moved = replace(recording, wrench=replace(wrench, force_n=wrench.force_n + beside + noise))
    (touch,) = identify_touches(moved).timeline.touches
    (expected,) = identify_touches(recording).timeline.touches
    assert touch.cause is TouchCause.WALL
    assert touch.peak_force == pytest.approx(expected.peak_force)
    signals = {each.axis: each for each in axis_signals(moved)}
    assert signals["x"].offset_n == pytest.approx(3.0, abs=0.05)
    assert "+3 N along x" in offset_findings(tuple(signals.values()), "w")[0].message


@pytest.mark.parametrize(("drift_n_per_s", "held_n"), [(0.3, 0.0), (0.0, 0.0), (0.0, 20.0)])
def test_a_zero_that_drifts_is_said(drift_n_per_s: float, held_n: float) -> None:
    """The flange goes 3 cm out and back and rests where it began; what presses there in the end is no drift."""
    time = np.arange(0.0, 10.0, 1e-2)
    travel = np.interp(time, [0.0, 1.0, 3.0, 6.0, 8.0, 10.0], [0.0, 0.0, 0.03, 0.03, 0.0, 0.0])
    force = drift_n_per_s * time + np.where(time > 8.5, held_n, 0.0)
    force += 0.1 * np.random.default_rng(1).standard_normal(len(time))
    drift = [
        each.message
        for each in offset_findings(axis_signals(logged(travel, force, 1e-2, 0.0)), "w")
        if each.code == "wrench-drift"
    ]
    assert len(drift) == (drift_n_per_s > 0.0)
    assert not drift or "N along z at first, +2.9 N at 10.0 s" in drift[0]


@pytest.mark.parametrize(("stiffness", "mass"), [(2e4, 16.0), (2e4, 0.5), (5e3, 16.0)])
def test_travel_counts_from_where_a_payload_on_a_coupling_meets_the_wall(stiffness: float, mass: float) -> None:
    """K_s and K_e in series hold F^d, though the sensor of M (s² + ω_e²)/(s² + 2ζω s + ω²) feels the wall late."""
    coupling, damping = 3e5, 0.1 * np.sqrt(3e5 * mass)
    series, speed = 1.0 / (1.0 / coupling + 1.0 / stiffness), 0.01
    time = np.arange(-1.0, 3.0, 1e-4)
    depth = DESIRED_N / series
    # The flange comes to rest from its speed, and begins to without a jump of its acceleration.
    since = np.maximum(time, 0.0) * 2.0 * speed / depth
    flange = np.where(time < 0.0, speed * time, depth * (1.0 - np.exp(-since) * (1.0 + 0.5 * since)))
    velocity = speed * np.exp(-since) * (1.0 + since)
    behind = StateSpace(
        [[0.0, 1.0], [-(coupling + stiffness) / mass, -damping / mass]],
        [[0.0, 0.0], [coupling / mass, damping / mass]],
        [[-coupling, -damping]],
        [[coupling, damping]],
    )
    touched = time >= 0.0
    pressing = np.zeros(len(time))
    pushed = np.column_stack([flange, velocity])[touched]
    pressing[touched] = lsim(behind, pushed, time[touched], X0=[0.0, speed])[1]
    rng, every = np.random.default_rng(3), 20
    force = 0.1 * rng.standard_normal(len(time[::every])) - pressing[::every]
    travel = flange[::every] + 5e-6 * rng.standard_normal(len(force))
    log = replace(logged(travel, force, 2e-3, DESIRED_N), gains=None)
    (surface,) = identify_touches(log).surfaces["z"]
    held = surface.relaxed_stiffness_n_per_m
    assert held is not None
    assert held.value is not None
    assert held.std is not None
    # A tenth, by which one contact is taken to differ from the next, is more than the zero leaves open.
    assert abs(held.value - series) < held.std
    assert surface.secant_stiffness_n_per_m.value == pytest.approx(series, rel=0.1)


@pytest.mark.parametrize("bias_n", [0.0, -3.0, 6.0])
def test_noise_and_a_bias_make_no_touch_and_hide_none(bias_n: float) -> None:
    """An external wrench that is estimated from joint torques: 0.4 N of noise on a bias, and 20 µm on the pose."""
    rng = np.random.default_rng(7)
    clean = recorded(Program(force_n=wall(1e4, 0.03)))
    n = len(clean.wrench.stamp_ns)
    noisy = logged(
        clean.pose.position_m[:, 2] + 2e-5 * rng.standard_normal(n),
        clean.wrench.force_n[:, 2] + bias_n + 0.4 * rng.standard_normal(n),
        1e-3,
        DESIRED_N,
    )
    (touch,) = identify_touches(noisy).timeline.touches
    assert touch.cause is TouchCause.WALL
    assert touch.approach_speed == pytest.approx(DESIRED_N / DAMPING_N_S_PER_M, rel=0.03)
    assert touch.held_force == pytest.approx(DESIRED_N, rel=0.1)


def test_drag_on_the_way_is_no_touch() -> None:
    """Drag of 300 N·s/m takes 5.6 N of the 15 N: the approach is slower, and the force before it is not zero."""
    stop = wall(2e4, 0.03)

    def both(time: float, x: float, v: float) -> float:
        return -300.0 * v + stop(time, x, v)

    (touch,) = identify_touches(recorded(Program(force_n=both))).timeline.touches
    assert touch.cause is TouchCause.WALL
    assert touch.approach_speed == pytest.approx(DESIRED_N / (DAMPING_N_S_PER_M + 300.0), rel=0.02)


def test_a_hand_that_drives_the_flange_back_is_no_wall() -> None:
    def hand(time: float, _: float, __: float) -> float:
        return -60.0 if time > 2.0 else 0.0

    (touch,) = identify_touches(recorded(Program(force_n=hand))).timeline.touches
    assert touch.cause is TouchCause.HAND
    assert touch.surface is None


def test_a_payload_that_swings_while_it_is_taken_off_a_wall_is_no_hand() -> None:
    """The force swings about zero on the way back; a hand's presses all along."""
    time = np.arange(0.0, 6.0, 2e-3)
    speed = np.where(time < 2.0, 0.03, np.where(time < 3.0, 0.0, np.where(time < 4.0, -0.03, 0.0)))
    travel = np.cumsum(speed) * 2e-3
    pressing = np.where((time >= 2.0) & (time < 3.0), 30.0, 0.0)
    off = time >= 3.0
    swing = 12.0 * np.exp(-(time[off] - 3.0) / 0.3) * np.sin(2.0 * np.pi * 20.0 * (time[off] - 3.0))
    for way_back, cause in ((swing, TouchCause.WALL), (np.where(time[off] < 3.8, 15.0, 0.0), TouchCause.HAND)):
        pressing[off] = way_back
        first = identify_touches(logged(travel, -pressing, 2e-3, 0.0)).timeline.touches[0]
        assert first.cause is cause
        assert first.onset_s == pytest.approx(2.0, abs=0.01)


def test_a_pose_without_orientation_is_that_of_a_tool_that_does_not_turn() -> None:
    time = np.arange(0.0, 4.0, 4e-3)
    travel = np.minimum(0.03 * time, 0.061)
    whole = logged(travel, -2e4 * np.maximum(travel - 0.06, 0.0), 4e-3, 15.0)
    unturned = np.full((len(time), 4), np.nan)
    lacking = replace(whole, pose=replace(whole.pose, quaternion_xyzw=unturned, measured_axes=("x", "y", "z")))
    period = unidentifiable()
    found, without = (identify_partial(each, period) for each in (whole, lacking))
    assert [t.cause for t in found.timelines[0].touches] == [TouchCause.WALL]
    assert without.timelines == found.timelines
    assert {"no-orientation"} == {f.code for f in without.findings} - {f.code for f in found.findings}


def test_a_hand_that_leads_is_no_touch() -> None:
    def hand(time: float, _: float, __: float) -> float:
        return 20.0 * np.sin(np.pi * time) ** 2 if time > 1.0 else 0.0

    found = identify_touches(recorded(Program(force_n=hand, desired_n=0.0)))
    assert found.timeline.touches == ()
    assert not found.surfaces


@pytest.mark.parametrize(("second", "count"), [(3e4, 2), (1.15e4, 1)])
def test_what_is_put_where_another_surface_was_is_another_surface(second: float, count: int) -> None:
    """One surface is taken away, a hand draws the tool back, and another surface is put to the same place."""
    one, other = wall(1e4, 0.03), wall(second, 0.03)

    def changed(time: float, x: float, v: float) -> float:
        if time < 3.0:
            return one(time, x, v)
        if time < 5.0:
            return -45.0 if time > 3.6 else 0.0
        return other(time, x, v)

    found = identify_touches(recorded(Program(force_n=changed, length_s=10.0)))
    surfaces = [each.secant_stiffness_n_per_m.value for each in found.surfaces["z"]]
    assert [each.contacts for each in found.surfaces["z"]] == ([1, 1] if count == 2 else [2])
    # One contact is taken to differ by a tenth from the next one.
    assert surfaces == pytest.approx([1e4, second] if count == 2 else [0.5 * (1e4 + second)], rel=0.1)


def test_a_hand_that_leads_into_a_stiff_wall_cannot_turn_so_fast() -> None:
    stop = wall(2e5, 0.05, damping=2000.0)

    def both(time: float, x: float, v: float) -> float:
        return (40.0 if time > 1.0 else 0.0) + stop(time, x, v)

    found = identify_touches(recorded(Program(force_n=both, desired_n=0.0)))
    touches = found.timeline.touches
    assert touches[0].cause is TouchCause.WALL
    assert touches[0].is_led is True
    about = next(f for f in found.findings if f.code == "wall-beside-hand")
    assert f"{touches[0].peak_force:.1f} N, led with up to 40.0 N" in about.message
    assert touches[0].approach_speed == pytest.approx(40.0 / DAMPING_N_S_PER_M, rel=0.02)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 500.0])
def test_the_peak_lies_in_its_interval_at_any_rate(rate_hz: float) -> None:
    """The logger's samples are those of a finer log: the true peak is known."""
    force_n = wall(2e4, 0.0301, damping=0.0)
    (fine,) = identify_touches(recorded(Program(force_n=force_n, rate_hz=5000.0))).timeline.touches
    (coarse,) = identify_touches(recorded(Program(force_n=force_n, rate_hz=rate_hz))).timeline.touches
    assert coarse.peak_interval is not None
    low, high = coarse.peak_interval
    assert high is not None
    assert low <= fine.peak_force <= high


def test_without_gains_or_orientation_less_is_known() -> None:
    whole = recorded(Program(force_n=wall(2e4, 0.03)))
    pose = PoseSignal(
        topic="p",
        frame_id="",
        stamp_ns=whole.pose.stamp_ns,
        position_m=whole.pose.position_m,
        quaternion_xyzw=np.full((len(whole.pose.stamp_ns), 4), np.nan),
        measured_axes=("x", "y", "z"),
    )
    bare = Recording(wrench=whole.wrench, pose=pose, command=None)
    (touch,) = identify_touches(bare).timeline.touches
    assert touch.cause is TouchCause.UNDETERMINED
    assert touch.approach_speed is touch.damping is touch.desired_force is None


def test_no_axis_no_touch() -> None:
    assert find_touches(()) == ()
    apart = recorded(Program(force_n=wall(2e4, 0.03)))
    later = PoseSignal(
        topic="p",
        frame_id="",
        stamp_ns=apart.pose.stamp_ns + 100_000_000_000,
        position_m=apart.pose.position_m,
        quaternion_xyzw=apart.pose.quaternion_xyzw,
    )
    assert axis_signals(Recording(wrench=apart.wrench, pose=later, command=None)) == ()


def test_times_in_milliseconds_that_are_read_as_seconds_are_refused() -> None:
    time = np.arange(0.0, 400.0, 5.0)
    with pytest.raises(
        LogError, match=r"a sample every 5 s; record at .* recorded 200 times a second, its times are in ms"
    ):
        identify_partial(logged(3e-5 * time, np.zeros(80), 5.0, 0.0), unidentifiable())


def test_times_in_seconds_that_are_read_as_milliseconds_are_refused() -> None:
    time = 2e-6 * np.arange(2000)
    with pytest.raises(LogError, match=r"a sample every 2 µs; check the unit of its times"):
        identify_partial(logged(np.array(30.0 * time), np.zeros(2000), 2e-6, 0.0), unidentifiable())
