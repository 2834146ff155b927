"""Parts of the fit of a clock offset: the rigid body's force, derivatives by differences, turns and blocks of rows."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from identification.logs.checks.offset_fit import (
    NoEstimate,
    OffsetEstimate,
    _cross,
    _fitting,
    _judged,
    _least_squares,
    _mount_lag,
    _number_turns,
    _standard_deviation,
    _Turning,
)
from problems.arrays import FloatArray

PERIOD_S = 1.0 / 240.0
TIME_S = np.arange(0.0, 6.0, PERIOD_S)
GRAVITY = np.array([0.0, 0.0, -9.80665])


def turn_of(time_s: FloatArray) -> Rotation:
    """A tool that tilts to and fro about two axes."""
    angles = np.stack([0.6 * np.sin(2.0 * time_s), 0.5 * np.cos(3.0 * time_s), 0.3 * np.sin(time_s)], axis=-1)
    return Rotation.from_rotvec(angles)


def motion(time_s: FloatArray) -> dict[str, FloatArray]:
    """Return the motion in the sensor frame by differences of the orientation alone; the origin moves on a curve."""
    step = 1e-4

    def rate(at: FloatArray) -> FloatArray:
        return np.asarray((turn_of(at - step).inv() * turn_of(at + step)).as_rotvec() / (2.0 * step))

    back = turn_of(time_s).inv()
    velocity = np.stack([0.2 * np.cos(2.0 * time_s), -0.1 * np.sin(time_s), 0.05 * np.cos(5.0 * time_s)], axis=-1)
    change = np.stack([-0.4 * np.sin(2.0 * time_s), -0.1 * np.cos(time_s), -0.25 * np.sin(5.0 * time_s)], axis=-1)
    return {
        "gravity": np.asarray(back.apply(GRAVITY)),
        "acceleration": np.asarray(back.apply(change)),
        "velocity": np.asarray(back.apply(velocity)),
        "rate": rate(time_s),
        "spin_up": (rate(time_s + step) - rate(time_s - step)) / (2.0 * step),
        "axes": np.asarray(back.as_matrix()),
    }


def turning(force: FloatArray | None = None, turns: Any = 0) -> _Turning:
    """Return the motion as the fit takes it; the ramp goes from −1 to 1 over six seconds."""
    at, count = motion(TIME_S), len(TIME_S)
    spin = _cross(at["rate"])
    parts = [at["gravity"] - at["acceleration"], (_cross(at["spin_up"]) + spin @ spin).reshape(-1, 9)]
    signals = np.concatenate([*parts, at["velocity"], at["rate"], at["axes"].reshape(-1, 9)], axis=1)
    inside = (TIME_S > 0.5) & (TIME_S < 5.5)
    return _Turning(
        signals=make_interp_spline(TIME_S, signals, k=3),
        ramp=2.0 / 6.0,
        time_s=TIME_S[inside],
        force_n=np.zeros((np.count_nonzero(inside), 3)) if force is None else force[inside],
        turn=np.broadcast_to(turns, count)[inside].astype(np.int64),
    )


def parameters() -> dict[str, FloatArray]:
    rng = np.random.default_rng(4)
    found = {name: rng.normal(size=3) for name in ("bias", "drift", "com", "drag", "turning_drag")}
    return {**found, "gains": 2.0 * np.eye(3) + 0.1 * rng.normal(size=(3, 3))}


def theta(of: dict[str, FloatArray]) -> FloatArray:
    names = ("bias", "drift", "gains", "com", "drag", "turning_drag")
    return np.concatenate([of[name].ravel() for name in names])


def body_force(of: dict[str, FloatArray], time_s: FloatArray, driven: bool = False) -> FloatArray:
    """Return b + ḃ t + G (g − a) − α × mc − ω × (ω × mc) − D v − ω × d; only what moves the payload where `driven`."""
    at = motion(time_s)
    inertia = -np.cross(at["spin_up"], of["com"]) - np.cross(at["rate"], np.cross(at["rate"], of["com"]))
    own = (at["gravity"] - at["acceleration"]) @ of["gains"].T + inertia
    if driven:
        return np.asarray(own)
    bias = of["bias"] + np.outer(time_s / 3.0 - 1.0, of["drift"])
    return np.asarray(bias + own - of["drag"] * at["velocity"] - np.cross(at["rate"], of["turning_drag"]))


@pytest.mark.parametrize("offset_s", [0.0, 0.03, -0.02])
def test_the_rows_are_the_force_of_a_rigid_body_at_the_poses_clock(offset_s: float) -> None:
    of, log = parameters(), turning()
    found = (log.rows(offset_s) @ theta(of)).reshape(-1, 3)
    # A cubic spline at 240 Hz, of motion below 1 Hz.
    np.testing.assert_allclose(found, body_force(of, log.time_s - offset_s), atol=1e-5)
    step = 1e-4
    slope = (body_force(of, log.time_s - offset_s + step) - body_force(of, log.time_s - offset_s - step)) / (2.0 * step)
    np.testing.assert_allclose((log.rows(offset_s, 1) @ theta(of)).reshape(-1, 3), slope, atol=1e-3)


def test_the_columns_of_offset_and_lags_are_derivatives_of_the_force() -> None:
    """By T the force changes by −dF/dt; a lag along an axis of the base takes dF/dt of what drives the payload."""
    of, log, step = parameters(), turning(), 1e-4
    joint = log.joint(0.01, theta(of))
    assert joint.shape == (3 * len(log.time_s), 28)
    np.testing.assert_array_equal(joint[:, :24], log.rows(0.01))
    by_offset = ((log.rows(0.01 + step) - log.rows(0.01 - step)) @ theta(of)) / (2.0 * step)
    np.testing.assert_allclose(joint[:, 24], by_offset, atol=1e-4)
    at = log.time_s - 0.01
    in_base = [np.asarray(turn_of(t).apply(body_force(of, t, driven=True))) for t in (at - step, at + step)]
    change = (in_base[1] - in_base[0]) / (2.0 * step)
    for axis in range(3):
        lagging = -np.asarray(turn_of(at).inv().apply(change * np.eye(3)[axis]))
        np.testing.assert_allclose(joint[:, 25 + axis], lagging.ravel(), atol=1e-3)


def test_solution_residual_and_turns_that_do_not_fit() -> None:
    """A payload's force is explained to rounding of the spline; a hand that presses in one of three turns is found."""
    of, turns = parameters(), np.searchsorted([2.0, 4.0], TIME_S)
    force = body_force(of, TIME_S)
    log = turning(force, turns)
    none = np.concatenate([log.solve(0.0), np.zeros(4)])
    assert np.max(np.abs(log.residual(0.0, none))) < 1e-5
    assert np.all(_fitting(log, 0.0, none))
    pressed = turning(force + np.outer(2.0 * (turns == 1), [1.0, 0.0, 0.0]), turns)
    kept = _fitting(pressed, 0.0, none)
    assert np.array_equal(kept, pressed.turn != 1)
    np.testing.assert_allclose(np.abs(pressed.residual(0.0, none)[:, 0]), 2.0 * (pressed.turn == 1), atol=1e-5)


def test_the_deviation_is_that_of_offsets_that_are_fitted_to_noise() -> None:
    """White noise of the filter's band, over 40 draws; the factor that few turns need makes it wider, never less."""
    of, rng, turns = parameters(), np.random.default_rng(2), np.searchsorted(np.arange(1.0, 5.0), TIME_S)
    clean, errors, stds = body_force(of, TIME_S), [], []
    for _ in range(40):
        coarse = rng.normal(scale=0.2, size=(len(TIME_S) // 15 + 2, 3))
        noise = np.repeat(coarse, 15, axis=0)[: len(TIME_S)]
        log = turning(clean + noise, turns)
        joint = np.column_stack([log.joint(0.0, theta(of)), log.force_n.ravel()])
        found = np.linalg.lstsq(joint[:, :-1], joint[:, -1], rcond=None)[0]
        errors.append(found[24])
        residual = log.force_n - (joint[:, :-1] @ found).reshape(-1, 3)
        stds.append(_standard_deviation(log, 0.0, theta(of), residual))
    scatter = float(np.std(errors))
    assert 0.8 * scatter < float(np.median(stds)) < 2.0 * scatter


@pytest.mark.parametrize("omega", [1.0, 4.0])
def test_a_mount_delays_with_the_square_of_the_frequency_of_the_weight(omega: float) -> None:
    """Damped by a tenth with its resonance at 10 Hz: 2 ζ ω²/ω_n³."""
    signals = np.zeros((len(TIME_S), 27))
    signals[:, 0], signals[:, 1] = np.sin(omega * TIME_S), np.cos(omega * TIME_S)
    whole = np.ones(len(TIME_S), dtype=np.int64)
    log = _Turning(
        signals=make_interp_spline(TIME_S, signals, k=5), ramp=0.0, time_s=TIME_S, force_n=signals[:, :3], turn=whole
    )
    assert _mount_lag(log, 0.0) == pytest.approx(0.2 * omega**2 / (20.0 * np.pi) ** 3, rel=1e-3)


def test_turns_are_numbered_with_a_tenth_of_a_second_around_and_small_ones_are_none() -> None:
    rate = np.zeros((len(TIME_S), 3))

    def turned(start_s: float, stop_s: float, speed: float) -> None:
        rate[(start_s <= TIME_S) & (stop_s > TIME_S), 1] = speed

    turned(1.0, 1.5, 0.5)  # 14 degrees
    turned(1.55, 2.0, -0.5)  # after a pause too short to part them
    turned(3.0, 3.3, 0.1)  # 1.7 degrees
    turned(4.0, 4.6, 0.4)  # 14 degrees
    number = _number_turns(rate, PERIOD_S)
    assert set(number.tolist()) == {-1, 0, 1}
    # The low-pass of 8 Hz, and the threshold on its flank, move the ends by less than 0.1 s.
    for index, (start_s, stop_s) in enumerate([(0.9, 2.1), (3.9, 4.7)]):
        there = TIME_S[number == index]
        assert (there[0], there[-1]) == (pytest.approx(start_s, abs=0.1), pytest.approx(stop_s, abs=0.1))
        assert len(there) == round((there[-1] - there[0]) / PERIOD_S) + 1
    assert np.all(_number_turns(np.zeros((100, 3)), PERIOD_S) == -1)


@given(seed=st.integers(0, 1000), rank=st.sampled_from([3, 5]))
@settings(max_examples=20, deadline=None)
def test_rows_in_blocks_have_the_solution_of_all_rows_of_least_norm(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(40, rank)) @ rng.normal(size=(rank, 5))
    values = rng.normal(size=40)
    blocks = np.split(np.column_stack([rows, values]), [7, 8, 25])
    expected = np.linalg.lstsq(rows, values, rcond=1e-10)[0]
    np.testing.assert_allclose(_least_squares(blocks), expected, rtol=1e-6, atol=1e-8)


def test_the_matrix_of_a_vector_is_its_cross_product() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 10, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", _cross(a), b), np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize(
    ("offset_s", "noise_share", "kept_turns", "reason"),
    [
        (0.094, 0.1, 5, ""),
        (-0.096, 0.1, 5, r"no offset within 0\.10 s explains the force while turning"),
        (0.0, 0.315, 5, "(29|30|31) % of the force while turning is no payload's weight"),
        (0.0, 0.1, 2, "the force follows the weight of one payload in 2 of 5 turns"),
        (0.0, 0.1, 3, ""),
    ],
)
def test_what_is_no_payloads_weight_is_no_estimate(
    offset_s: float, noise_share: float, kept_turns: int, reason: str
) -> None:
    """Half of the turns and three at least, an offset inside the range, 15 % at most of something else."""
    turns = np.searchsorted(np.arange(1.0, 5.0), TIME_S)
    force = body_force(parameters(), TIME_S - offset_s)
    spread = float(np.sqrt(np.mean(np.sum((force - force.mean(axis=0)) ** 2, axis=1)) / 3.0))
    noise = noise_share * spread * np.random.default_rng(3).normal(size=force.shape)
    log = turning(force + noise, turns)
    found = _judged(log, log.part(log.turn < kept_turns), offset_s, 0.1)
    if reason:
        assert isinstance(found, NoEstimate)
        assert re.fullmatch(reason, found.reason)
    else:
        assert isinstance(found, OffsetEstimate)
        assert (found.offset_s, found.spans) == (offset_s, kept_turns)
        kept = log.part(log.turn < kept_turns)
        assert found.std_s > _mount_lag(kept, offset_s)
