"""Free swinging after a tap or a release: where it is found, and what it tells."""

import dataclasses

import numpy as np
import pytest

from autotune.simulation.phases import Program
from autotune.simulation.simulate import CellRun, simulate_cell
from autotune.simulation.truth import Cell
from identification.axes.ringing import find_rings
from identification.axes.straight import AxisMotion
from identification.errors import EstimateError
from identification.joint_fit import fit as joint_fit
from identification.joint_fit.fit import identify_joint
from identification.signals.segments import Span
from problems.progress import ProgressSlice
from tests.identification.joint_fit.test_fit import gathered, scores

H_S = 1e-3
# A sweep that ends far below the payload's own 22 Hz tells its mass and little of the spring.
SLOW_SWEEP = Program(jogging_s=0.0, sweep_hz=(0.4, 6.0), contact_count=0, pose_count=5)
TAPPED = dataclasses.replace(SLOW_SWEEP, tap_count=3)


def ringing(start: int, samples: int, amplitude: float) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """A decaying oscillation of 20 Hz from `start` on, nothing before."""
    t = np.maximum(np.arange(samples) - start, 0) * H_S
    return np.asarray(amplitude * np.exp(-8.0 * t) * np.sin(2.0 * np.pi * 20.0 * t))


def on_axis(force: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> AxisMotion:
    return AxisMotion(name="x", direction_B=np.eye(3)[0], position_m=np.zeros(len(force)), force_n=force, spans=())


def test_a_ring_begins_when_the_tap_is_over_and_ends_before_the_next() -> None:
    force = ringing(1000, 4000, 40.0) + ringing(2000, 4000, 30.0)
    first, second = find_rings(on_axis(force), [Span(start=990, stop=3000)], [], [], 0.1, H_S)
    # The highest force comes a quarter of a period (12 ms) after each beginning; 25 ms later a hand is off.
    assert first.start == pytest.approx(1000 + 12 + 25, abs=3)
    assert first.stop == pytest.approx(2000 + 12 - 25, abs=3)
    assert second.start == pytest.approx(2000 + 12 + 25, abs=3)


def test_what_is_free_anyway_or_no_louder_than_noise_is_not_told_twice() -> None:
    span = Span(start=990, stop=3000)
    assert find_rings(on_axis(ringing(1000, 4000, 40.0)), [span], [span], [], 0.1, H_S) == ()
    assert find_rings(on_axis(ringing(1000, 4000, 0.5)), [span], [], [], 0.1, H_S) == ()


def test_after_a_hold_the_payload_is_free_where_the_force_changes_its_sign() -> None:
    force = np.concatenate([np.full(1000, -20.0), np.linspace(-20.0, 5.0, 500), np.full(1000, 5.0)])
    (ring,) = find_rings(on_axis(force), [Span(start=1000, stop=2400)], [], [Span(start=200, stop=1000)], 0.1, H_S)
    assert ring.start == 1000 + round(500 * 20.0 / 25.0) + 25
    assert ring.stop == 2400
    pressed = np.full(2500, -20.0)
    assert find_rings(on_axis(pressed), [Span(start=1000, stop=2400)], [], [Span(start=200, stop=1000)], 0.1, H_S) == ()


@pytest.fixture(scope="module")
def tapped() -> CellRun:
    return simulate_cell(Cell(), TAPPED, seed=5)


def test_taps_tell_the_spring_where_a_slow_sweep_does_not(tapped: CellRun) -> None:
    slow = identify_joint(gathered(simulate_cell(Cell(), SLOW_SWEEP, seed=5).recording))
    fit = identify_joint(gathered(tapped.recording))
    # 4.4 deviations: the quantile of 1e-4 for six values.
    for found in (slow, fit):
        assert np.max(np.abs(scores(found, Cell()))) < 4.4
    assert fit.diagnostics.used == (1 + TAPPED.tap_count, 0)
    for name, gain in (("stiffness_n_per_m", 3.0), ("damping_n_s_per_m", 50.0)):
        assert fit.value(name)[1] < slow.value(name)[1] / gain


def test_a_delay_of_whole_samples_is_not_surer_than_its_two_readings_allow(tapped: CellRun) -> None:
    """The demo's delay is 3 samples: the force may be read before or after the command's step."""
    fit = identify_joint(gathered(tapped.recording))
    period = tapped.cell.sample_time_s
    delay, std = fit.value("delay_s")
    assert abs(delay - 3.0 * period) < 4.4 * std
    assert std >= 1e-3 * period


def test_taps_alone_tell_the_spring_with_the_mass_from_gravity() -> None:
    """Taps and contacts, and no free motion that shows the payload's mass: the weight stands in for it."""
    cell = Cell()
    data = gathered(simulate_cell(cell, dataclasses.replace(TAPPED, contact_count=3), seed=5).recording)
    data = dataclasses.replace(data, free=(), weighed=(cell.payload_mass_kg, 2e-3 * cell.payload_mass_kg))
    fit = joint_fit._identify(data, joint_fit._ringing_alone, ProgressSlice())
    assert np.max(np.abs(scores(fit, cell))) < 4.4
    assert fit.value("stiffness_n_per_m")[1] < 5e-3 * cell.coupling.stiffness_n_per_m
    # One tap is no witness.
    with pytest.raises(EstimateError, match="No two spans"):
        joint_fit._identify(dataclasses.replace(data, rings=data.rings[:1]), joint_fit._ringing_alone, ProgressSlice())


def test_where_free_motion_tells_nothing_taps_are_asked() -> None:
    cell = Cell()
    data = gathered(simulate_cell(cell, dataclasses.replace(TAPPED, contact_count=3), seed=5).recording)
    deaf = dataclasses.replace(data, free=(), coupling=np.array([5e6, 0.0, 0.0, 1.0]))
    with pytest.raises(EstimateError):
        identify_joint(deaf)
    fit = identify_joint(dataclasses.replace(deaf, weighed=(cell.payload_mass_kg, 2e-3 * cell.payload_mass_kg)))
    assert fit.is_weighed
    assert fit.value("stiffness_n_per_m")[0] == pytest.approx(cell.coupling.stiffness_n_per_m, rel=0.01)
