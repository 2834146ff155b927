"""Measured frequency responses against closed forms and a simulation of their own, which share no code with them."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import chirp

from identification.measured_response import FrequencyResponse, MeasuredResponse
from identification.robot.frequency_response import (
    GRID_HZ,
    MotionRecord,
    _at,
    _described,
    _Local,
    measure_responses,
)
from problems.arrays import ComplexArray, FloatArray

_H = 2e-3
_HIGHEST_HZ = 50.0


@dataclass(frozen=True)
class Cell:
    """A one-pole robot late by whole samples, and a payload on a spring with a dry contact between both."""

    pole: float = 38.0
    late: int = 3
    stiffness: float = 2.4e5
    damping: float = 120.0
    drag: float = 280.0
    mass: float = 14.0
    friction_n: float = 0.0

    def _rows(self) -> FloatArray:
        """States x, x_p, v_p and the held command and the friction, of which d/dt is zero."""
        k, b, p, m = self.stiffness, self.damping, self.drag, self.mass
        rows = np.zeros((5, 5))
        rows[0] = [-self.pole, 0.0, 0.0, self.pole, 0.0]
        rows[1, 2] = 1.0
        rows[2] = [(k - b * self.pole) / m, -k / m, -(b + p) / m, b * self.pole / m, -1.0 / m]
        return rows

    def _force(self) -> FloatArray:
        k, b = self.stiffness, self.damping
        return np.array([-k + b * self.pole, k, b, -b * self.pole, 1.0])

    def responses(self, frequency_hz: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return what the sampled position and force are of a held command, the hold taken out; without friction."""
        step = expm(self._rows() * _H)
        z = np.exp(2j * np.pi * frequency_hz * _H)
        states = np.linalg.solve(z[:, None, None] * np.eye(3) - step[:3, :3], step[:3, 3][:, None])[..., 0]
        late = z**-self.late
        hold = (1.0 - 1.0 / z) / (2j * np.pi * frequency_hz * _H)
        force = states @ self._force()[:3] + self._force()[3]
        return late * states[:, 0] / hold, late * force / hold

    def run(self, command: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and force (n,) at the ticks, the friction that of the speed between flange and payload."""
        step, rows = expm(self._rows() * _H), self._rows()
        state, out = np.zeros(5), np.zeros((len(command), 2))
        for i in range(len(command)):
            state[3] = command[i - self.late] if i >= self.late else 0.0
            state[4] = self.friction_n * np.tanh((state[2] - rows[0] @ state) / 2e-4)
            out[i] = state[0], self._force() @ state
            state = step @ state
        return out[:, 0], out[:, 1]


def _swept(duration_s: float, size: float) -> FloatArray:
    """Return a sweep from rest to rest [m]."""
    t = np.arange(0.0, duration_s, _H)
    frequency = 0.4 * (_HIGHEST_HZ / 0.4) ** (t / duration_s)
    edge = np.clip(np.minimum(t, duration_s - t) / 0.5, 0.0, 1.0)
    way = size * 0.02 / (1.0 + frequency) * edge**2 * (3.0 - 2.0 * edge)
    rest = np.zeros(round(0.3 / _H))
    return np.concatenate([rest, way * chirp(t, 0.4, duration_s, _HIGHEST_HZ, method="logarithmic", phi=-90), rest])


@cache
def _clean(cell: Cell, sizes: tuple[float, ...]) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
    runs = []
    for size in sizes:
        command = _swept(12.0, size)
        runs.append((command, *cell.run(command)))
    return tuple(runs)


def measured(
    cell: Cell, seed: int, *, sizes: tuple[float, ...] = (1.0,), noise: tuple[float, float] = (2e-6, 0.3)
) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    records = [
        MotionRecord(
            position=position + noise[0] * rng.standard_normal(len(position)),
            force=force + noise[1] * rng.standard_normal(len(force)),
            command=command,
        )
        for command, position, force in _clean(cell, sizes)
    ]
    found = measure_responses(records, _H, 0.4 / _H)
    assert found is not None
    return found


def _all(found: FrequencyResponse) -> tuple[MeasuredResponse, MeasuredResponse, MeasuredResponse]:
    pose, force, felt = found.command_to_pose, found.command_to_force, found.pose_to_force
    assert pose is not None
    assert force is not None
    assert felt is not None
    return pose, force, felt


def _true(cell: Cell, found: FrequencyResponse) -> list[ComplexArray]:
    pose, force, felt = (cell.responses(each.frequency_hz) for each in _all(found))
    return [pose[0], force[1], felt[1] / felt[0]]


@pytest.mark.parametrize("drag", [280.0, 60.0])
def test_without_noise_they_are_the_closed_forms(drag: float) -> None:
    cell = Cell(drag=drag)
    found = measured(cell, 0, noise=(0.0, 0.0))
    for each, true in zip(_all(found), _true(cell, found), strict=True):
        swept = each.frequency_hz < 0.75 * _HIGHEST_HZ
        assert np.count_nonzero(swept) > 30
        # Polynomials of second degree over ±0.55 Hz bend less than a resonance of that damping does.
        error = np.abs(each.values - true)[swept] / np.abs(true)[swept]
        assert np.max(error) < (5e-3 if drag > 100.0 else 2e-2)
        assert np.median(error) < 2e-4


@pytest.mark.parametrize("sizes", [(1.0,), (1.0, 1.0)])
def test_of_the_circles_19_in_20_hold_the_truth(sizes: tuple[float, ...]) -> None:
    cell, draws = Cell(), 200 if len(sizes) == 1 else 60
    inside: list[list[float]] = []
    for seed in range(draws):
        found = measured(cell, seed, sizes=sizes)
        pairs = zip(_all(found), _true(cell, found), strict=True)
        inside.append([float(np.mean(np.abs(each.values - true) <= each.radius_95)) for each, true in pairs])
    share = np.mean(inside, axis=0)
    # Of 34 frequencies that share noise, and of the smallest circle that is ever claimed of the pose.
    assert np.all(share > 0.93)
    assert np.all(share[1:] < 0.99)


def test_a_repeated_sweep_narrows_the_circles() -> None:
    # Of a noise that the smallest circle that is claimed does not hide.
    runs = (_all(measured(Cell(), 3, sizes=sizes, noise=(2e-6, 3.0)))[1] for sizes in ((1.0,), (1.0,) * 4))
    once, four = runs
    assert (once.records, four.records) == (1, 4)
    common = [np.isin(each.frequency_hz, other.frequency_hz) for each, other in ((once, four), (four, once))]
    ratio = four.noise_radius_95[common[1]] / once.noise_radius_95[common[0]]
    assert np.median(ratio) == pytest.approx(0.5, abs=0.08)


def test_dry_friction_is_another_approximation_at_every_size_and_the_circles_say_so() -> None:
    sizes, cell = (0.5, 1.0, 2.0), Cell(friction_n=5.0)
    alone = [_all(measured(cell, 5, sizes=(size,)))[2] for size in sizes]
    together = _all(measured(cell, 5, sizes=sizes))[2]
    linear = _all(measured(Cell(), 5, sizes=sizes))[2]
    # Without friction the sizes differ by no more than noise makes them.
    assert np.median(linear.radius_95 / linear.noise_radius_95) < 1.2
    assert np.median(together.radius_95 / together.noise_radius_95) > 1.5
    for each in alone:
        kept = np.isin(each.frequency_hz, together.frequency_hz)
        back = np.isin(together.frequency_hz, each.frequency_hz)
        # Friction scatters within a sweep too: its harmonics come at other times.
        assert np.median(each.radius_95[kept] / linear.radius_95[: np.count_nonzero(kept)]) > 1.2
        apart = np.abs(each.values[kept] - together.values[back])
        assert np.median(apart / (each.radius_95[kept] + together.radius_95[back])) < 1.5


def test_without_a_command_the_pose_is_the_input() -> None:
    cell = Cell()
    ((_, position, force),) = _clean(cell, (1.0,))
    noise = 0.3 * np.random.default_rng(2).standard_normal(len(force))
    found = measure_responses([MotionRecord(position=position, force=force + noise, command=None)], _H, 0.4 / _H)
    assert found is not None
    assert found.command_to_pose is None
    assert found.pose_to_force is not None
    pose, felt = cell.responses(found.pose_to_force.frequency_hz)
    apart = np.abs(found.pose_to_force.values - felt / pose)
    assert np.mean(apart <= found.pose_to_force.radius_95) > 0.8


def test_rest_shows_nothing() -> None:
    still = np.random.default_rng(1).standard_normal((2, 5000))
    record = MotionRecord(position=1e-6 * still[0], force=0.3 * still[1], command=np.zeros(5000))
    assert measure_responses([record], _H, 0.4 / _H) is None
    assert measure_responses([], _H, 0.4 / _H) is None


def test_the_grid_is_that_of_every_log() -> None:
    assert len(GRID_HZ) == 60
    assert set(_all(measured(Cell(), 1))[0].frequency_hz) <= {float(f"{f:.6g}") for f in GRID_HZ}


def test_no_circle_reaches_half_way_to_zero_and_none_is_narrower_than_a_thousandth() -> None:
    loud = measured(Cell(), 4, noise=(2e-4, 40.0))
    for each in _all(loud):
        shares = each.radius_95 / np.abs(each.values)
        # The circles grow with frequency, so that the widest of those that are left is near the limit.
        assert 0.3 < np.max(shares) < 0.5
        assert np.all(np.isin(each.frequency_hz, _all(measured(Cell(), 4))[0].frequency_hz))
    for each in _all(measured(Cell(), 0, noise=(0.0, 0.0))):
        shares = each.radius_95 / np.abs(each.values)
        assert np.min(shares) == pytest.approx(1e-3, rel=0.05)


def test_the_lowest_frequency_has_seven_bins_of_the_longest_record_below_it() -> None:
    ((command, position, force),) = _clean(Cell(), (1.0,))
    found = measured(Cell(), 0, noise=(0.0, 0.0)).command_to_pose
    assert found is not None
    # The bin of no frequency at all is none of them.
    length_s = (len(command) - 1) * _H
    asked = GRID_HZ[GRID_HZ * length_s >= 8.0]
    assert found.frequency_hz[0] == pytest.approx(asked[0], rel=1e-5)
    record = MotionRecord(position=position, force=force, command=command)
    lower = measure_responses([record], _H, 10.0)
    assert lower is not None
    assert lower.command_to_pose is not None
    assert lower.command_to_pose.frequency_hz[-1] == pytest.approx(10.0, rel=1e-5)


def test_what_is_shorter_than_two_seconds_is_passed_over() -> None:
    ((command, position, force),) = _clean(Cell(), (1.0,))
    records = {
        count: MotionRecord(position=position[:count], force=force[:count], command=command[:count])
        for count in (round(1.9 / _H), round(2.0 / _H), len(command))
    }
    short, enough, whole = records.values()
    assert measure_responses([short], _H, 0.4 / _H) is None
    assert measure_responses([enough], _H, 0.4 / _H) is not None
    assert measure_responses([short, whole], _H, 0.4 / _H) == measure_responses([whole], _H, 0.4 / _H)


def test_a_window_has_seven_bins_of_the_longest_record_each_way_or_two_percent_of_the_frequency() -> None:
    """What is left of the bins when six complex numbers are taken from them is the freedom of the noise."""
    rng = np.random.default_rng(0)

    def spectrum(bins: int) -> tuple[ComplexArray, ComplexArray]:
        both = rng.standard_normal((2, bins, 3)) @ np.array([1.0, 1j, 0.0])
        return both[0], both[1][:, None]

    whole = spectrum(5000)
    for frequency, inside in ((1.0, 15), (3.0, 15), (10.0, 41), (30.0, 121)):
        found = _at(frequency, [whole], [100.0])
        assert found is not None
        assert (found.freedom, found.records) == (inside - 6, 1)
    # A record with fewer than eight bins there takes no part: 7 of one of 48 s, 9 of one of 60 s.
    for length_s, records in ((48.0, 1), (60.0, 2)):
        found = _at(1.0, [whole, spectrum(3000)], [100.0, length_s])
        assert found is not None
        assert found.records == records
    assert _at(1.0, [(np.zeros(500, dtype=complex), np.ones((500, 1), dtype=complex))], [100.0]) is None


def test_what_records_differ_by_is_a_mean_over_five_frequencies() -> None:
    noise = np.eye(1, dtype=complex)
    points = [
        _Local(
            value=np.array([1e3 + 0j]),
            noise=noise,
            between=np.full((1, 1), 11.0 if i in (0, 5) else 0.5, dtype=np.complex128),
            freedom=9,
            records=2,
        )
        for i in range(9)
    ]
    frequency, once = np.arange(1.0, 10.0), np.array([1.0 + 0j])
    found = _described(frequency, points, once)
    assert found is not None
    # F(2, 18) has an upper 5 % point of 9 (20^(1/9) - 1), and nothing is better known than to a thousandth.
    alone = np.hypot(np.sqrt(9.0 * (20.0 ** (1.0 / 9.0) - 1.0)), 1.0)
    excess = np.array([12.0 / 3.0, 12.5 / 4.0, *[13.0 / 5.0] * 5, 12.5 / 4.0, 1.0])
    assert found.noise_radius_95 == pytest.approx(np.full(9, alone), rel=1e-5)
    assert found.radius_95 == pytest.approx(alone * np.sqrt(excess), rel=1e-5)
