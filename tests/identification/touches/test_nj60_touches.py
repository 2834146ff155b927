"""Touches that a person sees in plots of pose and force of the public logs, beside those that are found."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.cell import read_cell
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, GainsSource
from identification.result import PhaseKind, TouchCause
from identification.signals.recording import Recording
from identification.touches.surfaces import Touched, identify_touches

WALL, OPEN = TouchCause.WALL, TouchCause.UNDETERMINED


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A touch as read off a plot: when it begins, along which axis it presses, how hard, and what it was.

    `bounces` is how often it visibly leaves the surface, None where that cannot be counted; `later` are the blows with
    which it comes back at 5 mm/s and more: when [s], how fast [m/s] and the peak [N]. `release_s` is when the force is
    back at zero, or another force leads the flange away.
    """

    onset_s: float
    axis: str
    peak_n: float
    cause: TouchCause
    speed_m_s: float | None = None
    bounces: int | None = None
    later: tuple[tuple[float, float, float], ...] = ()
    release_s: float | None = None


SEEN = {
    "hard_low_1.bag": (
        Seen(
            onset_s=8.62,
            axis="+z",
            peak_n=92.0,
            cause=WALL,
            speed_m_s=0.028,
            bounces=4,
            later=((8.80, 0.0135, 63.4), (8.94, 0.006, 38.0)),
        ),
    ),
    "hard_low_2.bag": (
        Seen(
            onset_s=7.84,
            axis="+z",
            peak_n=83.0,
            cause=WALL,
            speed_m_s=0.028,
            bounces=4,
            later=((8.01, 0.0135, 76.0), (8.17, 0.008, 40.0)),
        ),
    ),
    "soft_low_1.bag": (Seen(onset_s=6.83, axis="+z", peak_n=40.0, cause=WALL, speed_m_s=0.028, bounces=0),),
    "man_00.bag": (Seen(onset_s=2.46, axis="+z", peak_n=36.5, cause=WALL, speed_m_s=0.068, release_s=3.5),),
    "man_00_contact.bag": (Seen(onset_s=0.03, axis="+z", peak_n=36.5, cause=WALL, speed_m_s=0.069),),
    # A hand leads throughout. At 11.1 s the motion along x is turned back, at 12.7 s and 15.7 s the tool is knocked
    # sideways, at 19.6 s it stands on the ground.
    "single_mode_middle.bag": (
        Seen(onset_s=11.1, axis="-x", peak_n=14.5, cause=OPEN, speed_m_s=0.006, release_s=11.5),
        Seen(onset_s=12.65, axis="-y", peak_n=14.5, cause=OPEN),
        Seen(onset_s=15.72, axis="+x", peak_n=17.0, cause=OPEN),
        Seen(onset_s=19.56, axis="+z", peak_n=8.0, cause=OPEN),
    ),
    # The robot stops at 36.47 s, and what pushes it no longer moves it.
    "yellow_table_1.bag": (
        Seen(onset_s=36.47, axis="+x", peak_n=27.0, cause=OPEN, release_s=38.15),
        Seen(onset_s=36.47, axis="-z", peak_n=41.7, cause=OPEN, release_s=38.2),
    ),
    # It slides along x, and what it slides on pushes across, along z in a ripple. After 18.7 s it is not let off.
    "acc_rail_slide.bag": (
        Seen(onset_s=3.95, axis="+y", peak_n=4.9, cause=OPEN, release_s=6.2),
        Seen(onset_s=5.6, axis="+z", peak_n=3.3, cause=OPEN, release_s=7.05),
        Seen(onset_s=14.15, axis="+z", peak_n=3.2, cause=OPEN, release_s=16.6),
        Seen(onset_s=17.75, axis="+y", peak_n=4.7, cause=OPEN, release_s=19.1),
        Seen(onset_s=18.7, axis="+z", peak_n=3.4, cause=OPEN),
    ),
    "yellow_feet_imco.csv": (Seen(onset_s=0.015, axis="+z", peak_n=55.6, cause=WALL, speed_m_s=0.034, bounces=1),),
    "yellow_feet_coll.csv": (Seen(onset_s=0.003, axis="+z", peak_n=54.0, cause=WALL, speed_m_s=0.037),),
    "flex_jt_imco.csv": (Seen(onset_s=0.01, axis="+z", peak_n=34.4, cause=WALL, speed_m_s=0.032),),
    "flex_jt_coll.csv": (Seen(onset_s=0.005, axis="+z", peak_n=17.2, cause=WALL, speed_m_s=0.033),),
}


def read(repository: Path, path: Path) -> Recording:
    folder = repository / "examples" / "nj60"
    cell = read_cell(folder / ("traces.yaml" if path.suffix == ".csv" else "cell.yaml")).cell
    return read_recording(path, without_gains(cell) if path.name.startswith("man_") else cell)


def without_gains(cell: Cell) -> Cell:
    """Return the cell of a log that holds nothing but the state, under a topic without a slash."""
    assert cell.wrench is not None
    assert cell.pose is not None
    assert cell.twist is not None
    return replace(
        cell,
        wrench=replace(cell.wrench, topic="robot_state"),
        pose=replace(cell.pose, topic="robot_state"),
        twist=replace(cell.twist, topic="robot_state"),
        gains=None,
        desired_force=None,
    )


@pytest.fixture(scope="module")
def touched(repository: Path, shared_data: Path) -> dict[str, Touched]:
    return {name: identify_touches(read(repository, shared_data / "nj60" / name)) for name in SEEN}


@pytest.mark.parametrize("name", SEEN)
def test_every_touch_that_a_person_sees_is_found(touched: dict[str, Touched], name: str) -> None:
    found = list(touched[name].timeline.touches)
    for seen in SEEN[name]:
        near = [
            touch
            for touch in found
            if f"{'+' if touch.sign > 0 else '-'}{touch.axis}" == seen.axis
            and touch.onset_s is not None
            and abs(touch.onset_s - seen.onset_s) < 0.1
        ]
        assert len(near) == 1, (seen, [(touch.axis, touch.onset_s, touch.peak_s) for touch in found])
        (touch,) = near
        found.remove(touch)
        assert touch.cause is seen.cause
        assert touch.peak_force == pytest.approx(seen.peak_n, rel=0.05)
        if seen.speed_m_s is not None:
            assert touch.approach_speed == pytest.approx(seen.speed_m_s, rel=0.15)
        elif touch.is_led is None and seen.cause is OPEN:
            assert touch.approach_speed is None  # the flange does not go towards it
        if seen.release_s is not None:
            assert touch.release_s == pytest.approx(seen.release_s, abs=0.1)
        if seen.bounces is not None:
            assert len(touch.bounces_s) == pytest.approx(seen.bounces, abs=2)
        fast = [blow for blow in touch.later_blows if blow.approach_speed >= 5e-3]
        for (onset_s, speed_m_s, peak_n), blow in zip(seen.later, fast, strict=False):
            assert blow.onset_s == pytest.approx(onset_s, abs=0.02)
            assert blow.approach_speed == pytest.approx(speed_m_s, rel=0.2)
            assert blow.peak_force == pytest.approx(peak_n, rel=0.02)
        assert len(fast) == len(seen.later) or not seen.later
        assert all(touch.onset_s is not None and blow.onset_s > touch.onset_s + 0.05 for blow in touch.later_blows)
    # What nobody would point at in the plot is small.
    assert all(touch.peak_force < 5.0 for touch in found)


@pytest.mark.parametrize("name", SEEN)
def test_the_time_line_has_no_gaps_and_holds_the_touches(touched: dict[str, Touched], name: str) -> None:
    line = touched[name].timeline
    assert line.phases[0].start_s == 0.0
    assert all(one.stop_s == other.start_s for one, other in zip(line.phases, line.phases[1:], strict=False))
    for touch in line.touches:
        assert any(phase.start_s <= touch.peak_s < phase.stop_s for phase in line.phases)
    walls = [touch for touch in line.touches if touch.cause is WALL]
    phases = [phase.contact for phase in line.phases if phase.contact is not None]
    assert {touch.peak_s for touch in walls} <= {contact.peak_s for contact in phases}


def test_a_wall_is_told_by_the_gains_that_are_said(repository: Path, shared_data: Path) -> None:
    """15 N over 500 N·s/m is the speed of the approach, whatever gains cell.yaml holds; over 2000 N·s/m it is not."""
    cell = read_cell(repository / "examples" / "nj60" / "cell.yaml").cell
    wrong = replace(cell, gains=GainsSource(mass=(10.0,) * 6, damping=(2e3,) * 6))
    right = wrong.with_gains({"damping": 500.0})
    found = [identify_touches(read_recording(shared_data / "nj60" / "hard_low_1.bag", of)) for of in (wrong, right)]
    causes = [[touch.cause for touch in each.timeline.touches] for each in found]
    assert WALL not in causes[0]
    assert WALL in causes[1]


def test_an_approach_under_a_desired_force_is_no_hand(touched: dict[str, Touched]) -> None:
    """F^d/B_a = 15 N over 500 N·s/m."""
    for name in ("hard_low_1.bag", "hard_low_2.bag", "soft_low_1.bag"):
        (touch,) = touched[name].timeline.touches
        assert touch.desired_force == pytest.approx(15.0, abs=0.1)
        assert touch.damping == 500.0
        assert touch.is_led is False
        assert touch.surface == "z1"
        assert touch.held_force == pytest.approx(15.0, rel=0.15)


@pytest.mark.parametrize("name", ["hard_low_1.bag", "hard_low_2.bag", "man_00.bag"])
def test_a_surface_without_a_stiffness_says_why(touched: dict[str, Touched], name: str) -> None:
    (surface,) = touched[name].surfaces["z"]
    assert surface.secant_stiffness_n_per_m.value is None
    (why,) = (finding.message for finding in touched[name].findings if finding.code == "no-stiffness")
    assert "Surface z1: its stiffness cannot be determined: " in why


def test_a_hand_that_leads_away_ends_a_touch(touched: dict[str, Touched]) -> None:
    assert touched["man_00.bag"].timeline.phases[-1].kind is PhaseKind.HAND_LED_MOTION


def test_a_narrow_peak_says_what_it_may_be(touched: dict[str, Touched]) -> None:
    """Five repeats of the hard surface peaked between 83 and 125 N."""
    for name in ("hard_low_1.bag", "hard_low_2.bag"):
        (touch,) = touched[name].timeline.touches
        assert touch.peak_interval is not None
        low, high = touch.peak_interval
        assert high is not None
        assert 80.0 < low < 1.2 * low < high < 150.0
        # One line, however many peaks there are.
        (finding,) = (f for f in touched[name].findings if f.code == "peak-between-samples")
        assert f"the peak may be {low:.1f} to {high:.1f} N" in finding.message


@pytest.mark.parametrize("surface", ["yellow_feet", "flex_jt"])
def test_two_logs_of_one_surface_agree_within_their_deviations(touched: dict[str, Touched], surface: str) -> None:
    """Their secants over the whole trace lie 60 % apart, told as ± 2 %."""
    estimates = [touched[f"{surface}_{kind}.csv"].surfaces["z"][0] for kind in ("imco", "coll")]
    for pair in (
        [each.secant_stiffness_n_per_m for each in estimates],
        [each.impact_n_s_per_m for each in estimates],
    ):
        values = [each.value for each in pair if each is not None and each.value is not None]
        stds = [each.std for each in pair if each is not None and each.std is not None]
        assert len(values) == len(stds) == 2
        assert abs(values[0] - values[1]) < 1.5 * float(np.linalg.norm(stds))
        assert all(std > 0.09 * value for value, std in zip(values, stds, strict=True))


def test_the_loading_is_what_the_peak_needs(touched: dict[str, Touched]) -> None:
    (imco,), (coll,) = (touched[f"yellow_feet_{kind}.csv"].surfaces["z"] for kind in ("imco", "coll"))
    assert imco.secant_stiffness_n_per_m.value == pytest.approx(17.5e3, rel=0.05)
    assert coll.secant_stiffness_n_per_m.value == pytest.approx(17.9e3, rel=0.05)
    assert imco.relaxed_stiffness_n_per_m is not None
    assert imco.relaxed_stiffness_n_per_m.value == pytest.approx(11.1e3, rel=0.06)
