import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.paper.modes import Mode, analyse_modes
from problems.arrays import FloatArray
from problems.model.sampled import SampledLoop, build_loop, build_sampled_plant, spectral_radius, stability_matrix
from tests.problems.axes import LAW, PERIOD_S, admittance, between, paper_plant
from tests.problems.random_loops import radius_of, random_controller, random_plant, sampled_of


def constructed(blocks: list[FloatArray], *, anchored: bool, seed: int = 0) -> SampledLoop:
    """Return a loop with these blocks on its diagonal, seen in mixed coordinates; unanchored with an integrator."""
    size = sum(len(block) for block in blocks) + (0 if anchored else 1)
    a, at = np.zeros((size, size)), 0
    for block in blocks:
        a[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    if not anchored:
        a[-1, -1] = 1.0
    mix = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]
    return SampledLoop(
        a=mix @ a @ mix.T,
        b=np.zeros(size),
        b_push=np.zeros(size),
        c_force=np.zeros(size),
        d_force=0.0,
        c_command=np.zeros(size),
        d_command=0.0,
        translation=mix[:, -1].copy(),
        sample_time_s=PERIOD_S,
        is_anchored=anchored,
    )


def oscillator(hertz: float, ratio: float) -> FloatArray:
    """Return the sampled x'' + 2ζω x' + ω² x = 0: a turned and shrunk plane."""
    omega = 2.0 * math.pi * hertz
    angle = omega * math.sqrt(1.0 - ratio**2) * PERIOD_S
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.asarray(math.exp(-ratio * omega * PERIOD_S) * turn)


def by_frequency(modes: tuple[Mode, ...], hertz: float) -> Mode:
    return min(modes, key=lambda mode: abs(math.log(mode.frequency_hz / hertz)))


@LAW
@given(between(0.5, 20.0), between(25.0, 400.0), st.floats(-0.02, 0.9), st.floats(0.01, 0.9), st.booleans())
def test_a_loop_of_chosen_modes_has_them(
    slow_hz: float, fast_hz: float, slow_ratio: float, fast_ratio: float, anchored: bool
) -> None:
    decay = 7.0
    blocks = [
        oscillator(slow_hz, slow_ratio),
        oscillator(fast_hz, fast_ratio),
        np.array([[math.exp(-decay * PERIOD_S)]]),
    ]
    found = analyse_modes(constructed(blocks, anchored=anchored))
    # One per conjugate pair, and no integrator.
    assert len(found.modes) == 3
    real = next(mode for mode in found.modes if mode.z.imag == 0.0)
    pairs = tuple(mode for mode in found.modes if mode is not real)
    # Eigenvalues to rounding, over the distance from z = 1 that the frequency is read from: 1e-15/(ωh), ωh > 2e-3.
    for hertz, ratio in ((slow_hz, slow_ratio), (fast_hz, fast_ratio)):
        mode = by_frequency(pairs, hertz)
        assert mode.frequency_hz == pytest.approx(hertz, rel=1e-9)
        assert mode.damping_ratio == pytest.approx(ratio, abs=1e-9)
        assert mode.oscillation_hz == pytest.approx(hertz * math.sqrt(1.0 - ratio**2), rel=1e-9)
        assert mode.decay_rate_per_s == pytest.approx(2.0 * math.pi * hertz * ratio, abs=1e-8 * hertz)
    assert real.decay_rate_per_s == pytest.approx(decay, rel=1e-9)
    assert (real.oscillation_hz, real.damping_ratio) == (0.0, 1.0)
    assert found.is_stable == (slow_ratio > 0.0) or abs(slow_ratio) < 1e-12
    rates = [mode.decay_rate_per_s for mode in found.modes]
    assert rates == sorted(rates)


def test_a_mode_that_dies_at_once_and_one_that_alternates() -> None:
    found = analyse_modes(constructed([np.array([[0.0]]), np.array([[-0.5]])], anchored=True))
    alternating, gone = found.modes
    # z = −1/2: half a turn and half the size per sample.
    assert alternating.oscillation_hz == pytest.approx(0.5 / PERIOD_S, rel=1e-12)
    assert alternating.decay_rate_per_s == pytest.approx(math.log(2.0) / PERIOD_S, rel=1e-12)
    assert gone.decay_rate_per_s == math.inf or gone.decay_rate_per_s > 30.0 / PERIOD_S
    assert found.distance == pytest.approx(0.5, rel=1e-12)


def test_what_grows_has_a_negative_damping_ratio() -> None:
    found = analyse_modes(constructed([oscillator(12.0, -0.01), oscillator(3.0, 0.5)], anchored=True))
    assert not found.is_stable
    assert found.distance < 0.0
    assert found.modes[0].damping_ratio == pytest.approx(-0.01, abs=1e-9)
    assert found.modes[0].decay_rate_per_s < 0.0


def test_the_onset_of_instability_is_the_papers_payload_mode() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    # docs/method.md, erratum 7: at B_p = 630 instability begins near K_l = 0.047, at 33 Hz.
    before = analyse_modes(build_loop(sampled, admittance(mass=10.0, damping=1000.0, lead=0.0455)))
    after = analyse_modes(build_loop(sampled, admittance(mass=10.0, damping=1000.0, lead=0.0475)))
    assert before.is_stable
    assert not after.is_stable
    assert after.modes[0].oscillation_hz == pytest.approx(33.0, abs=0.5)  # the erratum gives whole hertz
    assert after.modes[0].damping_ratio < 0.0 < before.modes[0].damping_ratio


def test_the_distance_is_that_of_the_spectral_radius_for_random_loops() -> None:
    rng = np.random.default_rng(61)
    for _ in range(60):
        sampled, controller = sampled_of(random_plant(rng)), random_controller(rng)
        loop = build_loop(sampled, controller)
        found = analyse_modes(loop)
        radius = spectral_radius(loop)
        assert found.distance == pytest.approx(1.0 - radius, abs=1e-12)  # rounding of one eigenvalue run
        assert found.is_stable == (radius < 1.0)
        # The logarithm of a number near one keeps its digits: log |z| to 1e-16 of ωh.
        assert found.modes[0].decay_rate_per_s == pytest.approx(-math.log(radius) / PERIOD_S, abs=1e-10 / PERIOD_S)
        values = np.linalg.eigvals(stability_matrix(loop))
        assert len(found.modes) == np.sum(values.imag >= 0.0)
        for mode in found.modes:
            if math.isfinite(mode.frequency_hz):
                s = complex(-mode.decay_rate_per_s, 2.0 * math.pi * mode.oscillation_hz)
                assert np.exp(s * PERIOD_S) == pytest.approx(mode.z, abs=1e-12)
                assert 2.0 * math.pi * mode.frequency_hz * mode.damping_ratio == pytest.approx(
                    mode.decay_rate_per_s, abs=1e-9 * 2.0 * math.pi * mode.frequency_hz
                )


def test_the_dominant_mode_is_what_a_run_ends_in() -> None:
    """Let a loop ring from a random state: late in the run its size falls as the dominant mode says."""
    sampled, controller = sampled_of(paper_plant(stiffness=3e4)), admittance(damping=900.0, lead=0.0)
    loop = build_loop(sampled, controller)
    found, state = analyse_modes(loop), np.random.default_rng(62).standard_normal(len(loop.a))
    rate, hertz = found.modes[0].decay_rate_per_s, found.modes[0].oscillation_hz
    assert hertz > 0.0
    settle = round(12.0 / (found.modes[1].decay_rate_per_s - rate) / PERIOD_S)
    forces = []
    for _ in range(settle + 1000):
        forces.append(float(loop.c_force @ state))
        state = loop.a @ state
    late = np.array(forces[settle:])
    # A decaying oscillation obeys F_{k+2} − 2 r cos(φ) F_{k+1} + r² F_k = 0.
    fitted = np.linalg.lstsq(np.stack([late[1:-1], late[:-2]], axis=1), late[2:], rcond=None)[0]
    size = math.sqrt(-fitted[1])
    # The next mode is down by e^−12 against the first, and the fit sees it over its slope: 6e-6 and room.
    assert -math.log(size) / PERIOD_S == pytest.approx(rate, rel=1e-3)
    assert math.acos(0.5 * fitted[0] / size) / (2.0 * math.pi * PERIOD_S) == pytest.approx(hertz, rel=1e-3)


def test_the_integrator_of_free_space_is_no_mode() -> None:
    rng = np.random.default_rng(63)
    for _ in range(30):
        sampled, controller = sampled_of(random_plant(rng, contact=False)), random_controller(rng)
        loop = build_loop(sampled, controller)
        found = analyse_modes(loop)
        whole = analyse_modes(replace(loop, is_anchored=True))
        # With it there is one eigenvalue more, conjugates counted twice, and that one neither moves nor decays.
        with_it, without_it = (sum(1 + (mode.z.imag > 0.0) for mode in each.modes) for each in (whole, found))
        assert with_it == without_it + 1
        assert min(abs(mode.z - 1.0) for mode in whole.modes) < 1e-9
        if radius_of(sampled, controller) < 0.9999:
            assert min(abs(mode.z - 1.0) for mode in found.modes) > 1e-6
