"""Coupling, drag and mass from exact responses that scipy integrates."""

import numpy as np
import pytest
from scipy.signal import lsim

from identification.errors import EstimateError
from identification.robot.coupling import (
    FreeMotion,
    Noise,
    felt_impedance,
    identify_coupling,
    impedance_gradients,
    prediction_error,
)
from tests.identification.synthetic import Load, felt_force, ramp, sweep, tapered

RATE_HZ = 1000.0
H_S = 1.0 / RATE_HZ
NO_NOISE = Noise(force_rms_n=1e-3, position_rms_m=1e-9)

LOADS = [
    Load(),
    Load(stiffness=8e4, damping=300.0, drag=600.0, mass=30.0),
    Load(stiffness=9e5, damping=60.0, drag=90.0, mass=6.0),
    Load(stiffness=3e5, damping=0.0, drag=630.0, mass=16.0),  # the paper's example
]


def swept(load: Load, seconds: float = 6.0) -> FreeMotion:
    """Computed on a clock eight times finer, so that the integration's own error stays out of the comparison."""
    position = sweep(seconds, 8.0 * RATE_HZ)
    return FreeMotion(position_m=position[::8], force_n=felt_force(position, H_S / 8.0, load)[::8])


def jogged(load: Load, hand_n: float = 0.0) -> FreeMotion:
    """Slow moves over 4 s that end elsewhere; `hand_n` pushes the payload on top."""
    samples = round(4.0 * 8.0 * RATE_HZ)
    t = np.arange(samples) * H_S / 8.0
    position = 0.02 * np.sin(2.0 * np.pi * 2.2 * t) * tapered(samples, samples // 6) + 0.03 * ramp(samples)
    hand = hand_n * np.sin(2.0 * np.pi * 1.3 * t) * tapered(samples, samples // 6)
    return FreeMotion(position_m=position[::8], force_n=felt_force(position, H_S / 8.0, load, hand)[::8])


@pytest.mark.parametrize("load", LOADS)
def test_exact_responses_give_the_parameters_back(load: Load) -> None:
    fit = identify_coupling([swept(load)], H_S, RATE_HZ, NO_NOISE)
    # The sampled spectrum of a sweep up to 50 Hz folds next to nothing into the band: parts of a thousand.
    assert fit.stiffness_n_per_m == pytest.approx(load.stiffness, rel=2e-3)
    assert fit.mass_kg == pytest.approx(load.mass, rel=2e-3)
    assert fit.drag_n_s_per_m == pytest.approx(load.drag, rel=5e-3)
    # A damping matters beside the critical one: parts of a thousand of that.
    critical = 2.0 * np.sqrt(load.stiffness * load.mass)
    assert fit.damping_n_s_per_m == pytest.approx(load.damping, abs=1e-3 * critical)
    assert fit.fit_error < 0.01


@pytest.mark.parametrize(
    "noise", [Noise(force_rms_n=0.2, position_rms_m=2e-6), Noise(force_rms_n=0.1, position_rms_m=2e-5)]
)
def test_stated_deviations_are_those_that_repetition_shows(noise: Noise) -> None:
    """With a coarse encoder too: its noise is in the regressor, and ordinary weights would bias K_s by tenths."""
    load, rng = LOADS[0], np.random.default_rng(8)
    clean, scores = swept(load), []
    for _ in range(60):
        motion = FreeMotion(
            position_m=clean.position_m + noise.position_rms_m * rng.standard_normal(len(clean.position_m)),
            force_n=clean.force_n + noise.force_rms_n * rng.standard_normal(len(clean.force_n)),
        )
        fit = identify_coupling([motion], H_S, RATE_HZ, noise)
        truth = load.vector()
        found = np.array([fit.stiffness_n_per_m, fit.damping_n_s_per_m, fit.drag_n_s_per_m, fit.mass_kg])
        scores.append((found - truth) / fit.std)
    spread, offset = np.std(scores, axis=0), np.mean(scores, axis=0)
    # A spread over 60 draws is known to 9 %, a mean to 0.13 deviations: four times that.
    assert np.all(np.abs(spread - 1.0) < 0.4)
    assert np.all(np.abs(offset) < 0.6)


def test_a_spring_that_the_encoders_noise_hides_is_not_mistaken_for_a_softer_one() -> None:
    """A slow robot, a stiff gripper, a light load: linear equations start at a spring a hundred times too soft."""
    load, noise = Load(stiffness=4.0e5, damping=90.0, drag=390.0, mass=5.9), Noise(force_rms_n=0.2, position_rms_m=1e-5)
    command = np.concatenate([sweep(10.0, 8.0 * RATE_HZ), np.zeros(4000)])
    _, position, _ = lsim(([454.0], [1.0, 43.0, 454.0]), command, np.arange(len(command)) * H_S / 8.0)
    clean = FreeMotion(position_m=position[::8], force_n=felt_force(position, H_S / 8.0, load)[::8])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        motion = FreeMotion(
            position_m=clean.position_m + noise.position_rms_m * rng.standard_normal(len(clean.position_m)),
            force_n=clean.force_n + noise.force_rms_n * rng.standard_normal(len(clean.force_n)),
        )
        fit = identify_coupling([motion], H_S, RATE_HZ, noise)
        assert abs(fit.stiffness_n_per_m - load.stiffness) < 5.0 * fit.std[0]
        assert fit.stiffness_n_per_m == pytest.approx(load.stiffness, rel=0.15)
        # A mass that is shown by the slow half of the sweep: a few percent, whatever the spring.
        assert fit.mass_kg == pytest.approx(load.mass, rel=0.03)


def test_the_felt_impedance_is_what_the_equations_of_motion_say() -> None:
    load = LOADS[0]
    s = 2j * np.pi * np.array([0.3, 5.0, 20.0, 80.0])
    for value, at in zip(felt_impedance(load.vector(), s), s, strict=True):
        # Unknowns x_p and F for x = 1: F = C(x_p − 1), (M s² + B_p s) x_p = −F.
        c = load.damping * at + load.stiffness
        equations = np.array([[c, -1.0], [load.mass * at**2 + load.drag * at, 1.0]])
        force = np.linalg.solve(equations, np.array([c, 0.0]))[1]
        assert value == pytest.approx(force, rel=1e-12)


def test_the_impedances_slopes_are_its_differences() -> None:
    parameters, s = np.array([3e5, 40.0, 25.0, 16.0]), 2j * np.pi * np.array([0.3, 5.0, 21.8, 60.0])
    slopes = impedance_gradients(parameters, s)
    for index, size in enumerate(parameters):
        step = 1e-4 * size * np.eye(4)[index]
        near = felt_impedance(parameters + step, s) - felt_impedance(parameters - step, s)
        far = felt_impedance(parameters + 2.0 * step, s) - felt_impedance(parameters - 2.0 * step, s)
        assert slopes[index] == pytest.approx((8.0 * near - far) / (12e-4 * size), rel=1e-8)


def test_a_span_with_a_hand_in_it_is_outvoted() -> None:
    load = LOADS[0]
    sound = [swept(load), jogged(load)]
    alone = identify_coupling(sound, H_S, RATE_HZ, NO_NOISE)
    pushed = jogged(load, hand_n=60.0)
    together = identify_coupling([pushed, *sound], H_S, RATE_HZ, NO_NOISE)
    assert prediction_error(alone, pushed, H_S, NO_NOISE) > 0.3
    # The pushed span is not used at all, so nothing may differ but the order of sums.
    assert together.stiffness_n_per_m == pytest.approx(alone.stiffness_n_per_m, rel=1e-9)
    assert together.mass_kg == pytest.approx(alone.mass_kg, rel=1e-9)


def test_a_span_with_a_contact_in_it_is_outvoted() -> None:
    load = LOADS[0]
    sound = swept(load)
    slow = jogged(load)
    wall = np.minimum(0.0, -1.0e4 * (slow.position_m - 0.02))
    touched = FreeMotion(position_m=slow.position_m, force_n=slow.force_n + wall)
    alone = identify_coupling([sound], H_S, RATE_HZ, NO_NOISE)
    together = identify_coupling([touched, sound], H_S, RATE_HZ, NO_NOISE)
    assert prediction_error(alone, touched, H_S, NO_NOISE) > 0.3
    assert together.stiffness_n_per_m == pytest.approx(alone.stiffness_n_per_m, rel=1e-9)


def test_spans_of_the_same_payload_are_used_together() -> None:
    load, noise = LOADS[0], Noise(force_rms_n=0.2, position_rms_m=2e-6)
    rng = np.random.default_rng(3)
    motions = [
        FreeMotion(
            position_m=motion.position_m + 2e-6 * rng.standard_normal(len(motion.position_m)),
            force_n=motion.force_n + 0.2 * rng.standard_normal(len(motion.force_n)),
        )
        for motion in (swept(load, 3.0), swept(load, 6.0))
    ]
    both = identify_coupling(motions, H_S, RATE_HZ, noise)
    for motion in motions:
        assert np.all(both.std < identify_coupling([motion], H_S, RATE_HZ, noise).std)


def test_short_spans_are_refused_and_reported() -> None:
    with pytest.raises(EstimateError, match=r"of 1 spans none lasts that long\. Record a commanded sweep"):
        identify_coupling([swept(LOADS[0], 1.0)], H_S, RATE_HZ, NO_NOISE)


def test_no_span_at_all_is_refused_and_reported() -> None:
    with pytest.raises(EstimateError, match="of 0 spans none lasts that long"):
        identify_coupling([], H_S, RATE_HZ, NO_NOISE)


def test_a_force_that_no_payload_explains_is_refused() -> None:
    motion = swept(LOADS[0])
    unrelated = FreeMotion(position_m=motion.position_m, force_n=motion.force_n[::-1].copy())
    with pytest.raises(
        EstimateError, match=r"the best is explained to \d+ %.*Record a commanded sweep of 0.5 to 50 Hz"
    ):
        identify_coupling([unrelated], H_S, RATE_HZ, NO_NOISE)


def test_a_slow_pose_narrows_the_band() -> None:
    fit = identify_coupling([swept(LOADS[0])], H_S, 250.0, NO_NOISE)
    assert fit.band_hz[1] == pytest.approx(30.0)
