"""Guarded moves against a wall that is a spring: where they stop, how hard they press, and where they go back to."""

from dataclasses import dataclass

import numpy as np
import pytest

from autotune.recording.guarded_contacts import GuardedContacts
from problems.arrays import FloatArray

H_S, FORCE_N, HOLD_S, SPEED_M_S, FASTEST_M_S = 2e-3, 20.0, 0.5, 5e-3, 0.04


@dataclass
class Wall:
    """A spring behind `place_m`, with a drag that pushes back all the time."""

    stiffness_n_per_m: float = 2e4
    place_m: float = 0.01
    drag_n: float = 0.0

    def force(self, place: float) -> float:
        """Return the force at a place."""
        return self.stiffness_n_per_m * max(place - self.place_m, 0.0)

    def play(self, guarded: GuardedContacts) -> tuple[FloatArray, FloatArray]:
        """Return what one contact commands and what is felt (n,)."""
        steps, sensed = guarded.contact(), None
        way, force = list[float](), list[float]()
        while True:
            try:
                place, turn = steps.send(sensed) if sensed is not None else next(steps)
            except StopIteration:
                return np.array(way), np.array(force)
            assert turn == (0.0, 0.0, 0.0)
            pressed = self.force(place) + self.drag_n
            way.append(place)
            force.append(pressed)
            sensed = -pressed


def guarded(**changes: float) -> GuardedContacts:
    given = {
        "force_n": FORCE_N,
        "hold_s": HOLD_S,
        "speed_m_s": SPEED_M_S,
        "fastest_m_s": FASTEST_M_S,
        "approach_m": 0.05,
        "retract_m": 4e-3,
        "period_s": H_S,
    }
    return GuardedContacts(**(given | changes))


def rests_of(way: FloatArray) -> list[tuple[float, float]]:
    """Return place [m] and duration [s] of every time that the command rests."""
    still = np.concatenate([[False], np.diff(way) == 0.0, [False]])
    starts, stops = np.flatnonzero(~still[:-1] & still[1:]), np.flatnonzero(still[:-1] & ~still[1:])
    return [(float(way[i]), float((j - i) * H_S)) for i, j in zip(starts, stops, strict=True) if j - i > 10]


@pytest.mark.parametrize("stiffness", [5e3, 2e4, 5e4])
def test_a_contact_stops_at_a_quarter_presses_with_all_and_backs_off(stiffness: float) -> None:
    moves = guarded()
    way, force = Wall(stiffness).play(moves)
    speed = np.diff(way) / H_S
    # Up to speed in 0.2 s, and on at one speed.
    assert np.all(np.diff(way[:100]) > 0.0)
    assert speed[100:300] == pytest.approx(SPEED_M_S, rel=1e-9)
    (touched, settling_s), (held, hold_s) = rests_of(way)
    assert settling_s == pytest.approx(0.25, abs=2.0 * H_S)
    assert hold_s == pytest.approx(HOLD_S, abs=2.0 * H_S)
    # A touch is felt with a lag of 10 ms: a quarter of the force, and what 10 ms and two ticks add.
    felt = stiffness * (touched - 0.01)
    assert 0.25 * FORCE_N <= felt <= 0.25 * FORCE_N + stiffness * SPEED_M_S * (0.01 + 2.0 * H_S)
    assert stiffness * (held - 0.01) == pytest.approx(FORCE_N, rel=0.1)
    assert np.max(force) < 1.1 * FORCE_N
    assert moves.has_touched
    assert moves.place == way[-1] == pytest.approx(touched - 4e-3, abs=1e-12)
    back = way[len(way) - int(np.argmax(way[::-1])) :]
    assert np.all(np.diff(back) <= 0.0)
    # At the mean speed of half of the fastest; minimum jerk is 1.875 times as fast in the middle.
    assert 0.9 * FASTEST_M_S < np.max(np.abs(np.diff(back))) / H_S <= 0.5 * 1.88 * FASTEST_M_S


def test_a_contact_that_presses_too_hard_at_once_moves_back() -> None:
    way, force = Wall(1e6).play(guarded(speed_m_s=0.02))
    (_, _), (held, _) = rests_of(way)
    assert np.max(force) > 1.5 * FORCE_N
    assert abs(1e6 * (held - 0.01) - FORCE_N) < 0.6 * FORCE_N
    assert held < np.max(way)


def test_where_nothing_is_met_it_goes_back_to_where_it_began() -> None:
    moves = guarded(retract_m=0.5)
    way, _ = Wall(place_m=1.0).play(moves)
    assert not moves.has_touched
    # Half of the 0.2 s in which it starts are missing.
    assert np.max(way) == pytest.approx(0.05 - 0.1 * SPEED_M_S, rel=1e-3)
    assert way[-1] == pytest.approx(0.0, abs=1e-12)
    assert rests_of(way) == []


@pytest.mark.parametrize(("stiffness", "factor"), [(5e3, 3.0), (1e6, 1.0 / 3.0)])
def test_the_next_contact_is_as_fast_as_its_force_runs_on_and_three_times_at_most(
    stiffness: float, factor: float
) -> None:
    moves = guarded(speed_m_s=0.02 if factor < 1.0 else SPEED_M_S)
    first = moves._speed
    Wall(stiffness).play(moves)
    assert moves._speed == pytest.approx(factor * first)
    # Never faster than it may be.
    for _ in range(4):
        way, _ = Wall(stiffness, place_m=0.012).play(moves)
        assert np.max(np.abs(np.diff(way))) / H_S <= FASTEST_M_S * (1.0 + 1e-9)
    assert moves._speed <= FASTEST_M_S


def test_drag_that_reaches_an_eighth_of_the_force_makes_the_next_one_slower() -> None:
    moves = guarded()
    Wall(5e3, drag_n=4.0).play(moves)
    # An eighth of 20 N over the 4 N that drag it at this speed.
    assert moves._speed == pytest.approx(SPEED_M_S * 2.5 / 4.0, rel=0.05)


@dataclass
class Push(Wall):
    """A wall that pushes with one force, however deep the tool is."""

    push_n: float = 14.0

    def force(self, place: float) -> float:
        return self.push_n if place > self.place_m else 0.0


@pytest.mark.parametrize("push_n", [11.0, 14.0])
def test_it_moves_on_as_slowly_as_the_force_ran_on_behind_the_resting_command(push_n: float) -> None:
    """What is left of a swing is felt by 50 ms, P (1 − e^(−t/50 ms)); it may run on by a quarter of F^d."""
    way, force = Push(push_n=push_n).play(guarded())
    touched, steps = int(np.argmax(force > 0.0)), np.diff(way)
    resting = int(np.flatnonzero(steps == 0.0)[0])
    first = resting + int(np.flatnonzero(steps[resting:] > 0.0)[0])
    count = first + 1 - touched
    # Odd and even, so that nothing that swings from tick to tick looks like it.
    assert count % 2 == (push_n == 11.0)
    felt = push_n * -np.expm1(-count * H_S / 0.05)
    speed = 0.25 * FORCE_N * SPEED_M_S / (felt - 0.25 * FORCE_N)
    # F^d is never reached.
    assert steps[first : first + 500] / H_S == pytest.approx(speed, rel=1e-9)
