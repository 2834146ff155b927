"""A payload whose centre of mass is off the axis, and which turns on its coupling: simulated finely by other code."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import sosfiltfilt

from identification.axis_findings import payload_findings
from identification.joint_fit.data import JointData, usual_coupling
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.result import JointFit
from identification.joint_fit.segments import Segment
from identification.joint_fit.turning_payload import _as_path, _low_pass, _weights
from identification.payload.turning import turning_force
from identification.signals.segments import Span
from problems.arrays import FloatArray
from problems.compiled import compiled
from tests.identification.joint_fit.fine_cell import FINER, PERIOD_S, sweep

STIFFNESS, DAMPING, DRAG, MASS = 3e5, 600.0, 20.0, 16.0
OFF_M, INERTIA, TURNING, TURNING_DAMPING = 0.02, 0.25, 2.2e4, 8.0
NOISE_N, NOISE_N_M = 0.1, 0.01


def run(x: FloatArray, off_m: float, drag: float) -> tuple[FloatArray, FloatArray]:
    """Return force and torque (n,) of the coupling under a flange's path given FINER times a sample.

    z and θ are those of the coupling point, θ about y with the centre of mass off along x:
    F + B_p z' + m (z'' − c θ'') = 0 and τ = (I_C + m c²) θ'' − m c z'' with F = K_s (z − x) + …, τ = −K_t θ − …
    """
    dt, v = PERIOD_S / FINER, np.gradient(x, PERIOD_S / FINER)
    masses = np.array([[MASS, -MASS * off_m], [-MASS * off_m, INERTIA + MASS * off_m**2]])
    force, torque = _turned(x, v, dt, np.linalg.inv(masses), drag)
    return force, torque


@compiled
def _turned(x: FloatArray, v: FloatArray, dt: float, inverse: FloatArray, drag: float) -> FloatArray:
    """Return force and torque (2, n) for a flange at x with the speed v."""
    z, theta, v_z, v_t = x[0], 0.0, 0.0, 0.0
    out = np.empty((2, len(x)))
    for i in range(len(x)):
        force = STIFFNESS * (z - x[i]) + DAMPING * (v_z - v[i])
        torque = TURNING * theta + TURNING_DAMPING * v_t
        out[0, i], out[1, i] = force, torque
        down, back = -force - drag * v_z, -torque
        v_z += dt * (inverse[0, 0] * down + inverse[0, 1] * back)
        v_t += dt * (inverse[1, 0] * down + inverse[1, 1] * back)
        z, theta = z + dt * v_z, theta + dt * v_t
    return out


def logged(off_m: float, *, shows_torque: bool = True, drag: float = DRAG) -> JointData:
    rng, x = np.random.default_rng(3), sweep()
    force, torque = (each[::FINER] for each in run(x, off_m, drag))
    count, rest = len(force), round(2.0 / PERIOD_S)
    force = force + NOISE_N * rng.standard_normal(count)
    torque = torque + NOISE_N_M * rng.standard_normal(count)
    com, none = np.array([off_m, 0.0, 0.0]), np.zeros(count)
    tensor = INERTIA * np.eye(3) + MASS * (com @ com * np.eye(3) - np.outer(com, com))
    turning = turning_force(
        np.column_stack([none, none, force]), np.column_stack([none, torque, none]), MASS, com, tensor
    )
    moving = (Span(start=rest, stop=count - rest),)
    return JointData(
        period_s=PERIOD_S,
        position_m=x[::FINER] + 5e-7 * rng.standard_normal(count),
        force_n=force,
        command=None,
        rests=(Span(start=0, stop=rest - 300), Span(start=count - rest + 500, stop=count)),
        moving=moving,
        free=moving,
        holds=(),
        coupling=usual_coupling(MASS),
        robot=None,
        mass_kg=MASS,
        turning_n=turning[:, 2] if shows_torque else None,
    )


@cache
def without_torque() -> JointFit:
    return identify_joint(logged(OFF_M, shows_torque=False))


def test_the_coupling_is_that_of_a_payload_that_does_not_turn() -> None:
    fit = identify_joint(logged(OFF_M))
    truth = np.array([STIFFNESS, DAMPING, DRAG, MASS])
    assert fit.values[[0, 1, 3]] == pytest.approx(truth[[0, 1, 3]], rel=0.002)
    assert np.all(np.abs(fit.values - truth) < 2.0 * fit.std)
    # 0.3 % of a path that is smooth by assumption, as where nothing turns, and not that of a misfit.
    assert fit.std[0] < 0.01 * STIFFNESS
    assert fit.quality.noise_ratio_free < 0.8 * without_torque().quality.noise_ratio_free
    assert fit.part is None
    (said,) = payload_findings("z", fit)
    assert said.code == "payload-turns"
    # By the first order K_s² c²/K_t, and more towards the frequency of the turn.
    assert STIFFNESS**2 * OFF_M**2 / TURNING < fit.turned_n_per_m < 3.0 * STIFFNESS**2 * OFF_M**2 / TURNING


def test_without_torque_it_looks_like_a_part_that_swings() -> None:
    """Of m c²/(I_C + m c²) of the mass, at the frequency of the turn about a coupling that is held along the axis."""
    fit, about_coupling = without_torque(), INERTIA + MASS * OFF_M**2
    assert fit.turned_n_per_m == 0.0
    assert fit.part is not None
    assert fit.part.mass_share[0] == pytest.approx(MASS * OFF_M**2 / about_coupling, rel=0.1)
    assert fit.part.frequency_hz[0] == pytest.approx(np.sqrt(TURNING / about_coupling) / (2.0 * np.pi), rel=0.02)


def test_drag_off_the_centre_of_mass_is_none_of_the_turn() -> None:
    """It turns the payload by a torque that the sensor does not feel: 400 N·s/m would be 410 here."""
    fit = identify_joint(logged(OFF_M, drag=400.0))
    assert fit.turned_n_per_m > 0.0
    assert fit.value("drag_n_s_per_m")[0] == pytest.approx(400.0, rel=0.003)
    assert fit.values[0] == pytest.approx(STIFFNESS, rel=0.002)


def test_a_payload_that_does_not_turn_is_fitted_as_it_was() -> None:
    """The torque's noise alone changes no digit."""
    data = logged(0.0)
    com_is_thought_off = replace(data, turning_n=0.01 * np.random.default_rng(5).standard_normal(len(data.force_n)))
    assert np.array_equal(
        identify_joint(com_is_thought_off).values, identify_joint(replace(data, turning_n=None)).values
    )


def test_what_is_most_of_the_force_is_no_correction() -> None:
    data = logged(OFF_M)
    assert data.turning_n is not None
    large = replace(data, turning_n=20.0 * data.turning_n)
    assert np.array_equal(identify_joint(large).values, without_torque().values)


@pytest.mark.parametrize("cutoff_hz", [5.0, 147.2, 588.0])
def test_a_mode_faster_than_a_slow_log_shows_is_no_reason_to_end(cutoff_hz: float) -> None:
    sections = _low_pass(cutoff_hz, 1.0 / 294.3)
    assert np.all(np.isfinite(sections))
    np.testing.assert_allclose(sosfiltfilt(sections, np.ones(400)), 1.0, atol=1e-9)


@pytest.mark.parametrize("period_s", [5e-4, 1e-3, 2e-3])
def test_what_turns_comes_and_goes_by_ramps_around_the_spans(period_s: float) -> None:
    first, second = Segment(start=200, stop=300), Segment(start=600, stop=601)
    problem = SimpleNamespace(signals=SimpleNamespace(period_s=period_s), segments=(first, second))
    weights = _weights(cast(Any, problem), 900)
    assert bool(np.all(weights[first.slice] == pytest.approx(1.0)))
    # 8 ms around a span, and ramps of 4 ms about that end: no step is larger than a sample is of a ramp.
    assert np.max(np.abs(np.diff(weights))) == pytest.approx(period_s / 4e-3)
    assert np.sum(weights) == pytest.approx(101 + 4 * 8e-3 / period_s)
    assert np.flatnonzero(weights)[0] == pytest.approx(200 - 10e-3 / period_s, abs=1)


@pytest.mark.parametrize("omega", [5.0, 40.0])
def test_a_force_over_the_coupling_is_a_path_with_its_derivatives(omega: float) -> None:
    """Of e^{jωt} it is 1/(K_s + jω B_s) of that, its n-th derivative per sample (jωh)ⁿ, over n factorial."""
    count = 4000
    wave = np.exp(1j * omega * PERIOD_S * np.arange(count))
    found = _as_path(wave.real, np.array([STIFFNESS, DAMPING]), PERIOD_S)
    held = wave / (STIFFNESS + 1j * omega * DAMPING)
    # The start from 0 decays with B_s/K_s = 2 ms; the spline's third derivative is good to some thousandths.
    inside = slice(1000, count - 100)
    for order, over in enumerate((1.0, 1.0, 2.0, 6.0)):
        exact = (held * (1j * omega * PERIOD_S) ** order).real / over
        np.testing.assert_allclose(found[inside, order], exact[inside], atol=5e-3 * float(np.max(np.abs(exact))))
