"""The rule by which recordings go together, against a fit of all their data at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from identification.merging.values import (
    WEIGHED_MASS,
    Merge,
    Normal,
    merge_normals,
    merged_std,
    shared_std,
    with_priors,
)
from identification.payload.gravity import LOCAL_GRAVITY_STD
from identification.result import Estimate, Status
from identification.verdicts import scatter
from problems.arrays import FloatArray
from tests.problems.axes import LAW

NAMES = ("K_s", "B_s", "B_p", "M_p", "x1.K_e")
TRUTH = np.array([3e5, 150.0, 330.0, 16.2, 1.2e5])


@dataclass(frozen=True)
class Log:
    """Force over flange motion at some frequencies [rad/s], free and in contact, with its noise [N/m]."""

    free: FloatArray
    touching: FloatArray
    noise: float
    response: FloatArray


def response(parameters: FloatArray, free: FloatArray, touching: FloatArray) -> FloatArray:
    """Return real and imaginary parts of C L/(C + L): coupling C in series with payload and surface, L."""
    k_s, b_s, b_p, m_p, k_e = parameters
    parts = []
    for omega, spring in ((free, 0.0), (touching, k_e)):
        s = 1j * omega
        coupling, load = k_s + b_s * s, m_p * s**2 + b_p * s + spring
        parts.append(coupling * load / (coupling + load))
    whole = np.concatenate(parts)
    return np.concatenate([whole.real, whole.imag])


def simulated(free_hz: tuple[float, float], touching_hz: tuple[float, float], noise: float, seed: int) -> Log:
    free, touching = (2.0 * np.pi * np.geomspace(*band, 150) for band in (free_hz, touching_hz))
    exact = response(TRUTH, free, touching)
    error = np.random.default_rng(seed).normal(scale=noise, size=len(exact))
    return Log(free=free, touching=touching, noise=noise, response=exact + error)


def fitted(logs: Sequence[Log]) -> Normal:
    """Fit all logs at once by least squares, the logarithms of the parameters being what varies."""

    def residual(logarithms: FloatArray) -> FloatArray:
        parameters = np.exp(logarithms)
        return np.concatenate(
            [(response(parameters, log.free, log.touching) - log.response) / log.noise for log in logs]
        )

    found = least_squares(residual, np.log(TRUTH), x_scale=0.01, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    values = np.exp(found.x)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return Normal(names=NAMES, values=values, matrix=covariance * np.outer(values, values))


@pytest.mark.parametrize("seed", range(5))
def test_two_merged_logs_are_what_one_fit_of_both_shows(seed: int) -> None:
    """One log tells the payload's swing, the other mostly 1/K_s + 1/K_e: each lends the other what it lacks."""
    swinging = simulated((2.0, 30.0), (0.2, 0.5), 6e3, 2 * seed)
    pressing = simulated((2.0, 12.0), (0.2, 12.0), 1.5e3, 2 * seed + 1)
    one, other, both = fitted([swinging]), fitted([pressing]), fitted([swinging, pressing])
    merged = merge_normals([one, other], [(), ()]).normal
    # The merged one adds what no further log takes away.
    shared = np.array([shared_std(name, value) for name, value in zip(NAMES, both.values, strict=True)])
    # Linear to a share of σ/value, which is 0.1 at most here: of the deviation, and of how far the values lie apart.
    assert np.max(both.std / both.values) < 0.1
    np.testing.assert_allclose(merged.std, np.hypot(both.std, shared), rtol=0.1)
    assert np.max(np.abs(merged.values - both.values) / both.std) < 0.2
    # What it is about: no log alone comes near.
    assert both.at("x1.K_e")[1] < 0.7 * min(one.at("x1.K_e")[1], other.at("x1.K_e")[1])
    correlation = merged.matrix / np.outer(merged.std, merged.std)
    expected = both.matrix / np.outer(both.std, both.std)
    # A correlation moves with the shares of variance, twice as much as a deviation.
    np.testing.assert_allclose(correlation, expected, atol=0.2)


@LAW
@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=6), st.floats(0.0, 1.0))
def test_a_shared_part_neither_averages_nor_grows(stds: list[float], shared: float) -> None:
    std = merged_std(stds, shared)
    assert std <= min(stds)
    assert std >= min(shared, *stds)
    assert merged_std([*stds, max(stds)], shared) <= std
    # Without a shared part information adds.
    assert merged_std(stds) == pytest.approx(np.sum(np.array(stds) ** -2.0) ** -0.5, rel=1e-12)


def test_what_is_shared() -> None:
    assert shared_std(WEIGHED_MASS, 16.0) == pytest.approx(16.0 * LOCAL_GRAVITY_STD)
    assert shared_std("T_d", 2.4e-3, gain_share=0.02) == 0.0
    assert shared_std("x1.K_e", 1e5, gain_share=0.02) == pytest.approx(2e3)


def test_a_scale_that_may_be_wrong_in_all_logs_is_as_wrong_in_their_mean() -> None:
    """Two logs whose only deviation is a common 2 % of the force's scale tell K_s and B_s no better together."""
    values, noise = np.array([3e5, 150.0]), np.array([30.0, 0.015])
    matrix = np.diag(noise**2) + np.outer(0.02 * values, 0.02 * values)
    part = Normal(names=("K_s", "B_s"), values=values, matrix=matrix)
    merged = merge_normals([part, part, part], [()] * 3, gain_share=0.02).normal
    # Beside 2 % the noise of 0.01 % and the calibration of 0.03 % are less than a thousandth.
    np.testing.assert_allclose(merged.std, 0.02 * values, rtol=1e-3)
    assert merged.matrix[0, 1] == pytest.approx(0.02**2 * values[0] * values[1], rel=1e-3)


@LAW
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(0.1, 2.0)), min_size=2, max_size=5))
def test_the_variance_beyond_the_noise_makes_the_scatter_usual(seen: list[tuple[float, float]]) -> None:
    values, noise = np.array(seen).T
    square, beyond = scatter(values, noise)
    weights = 1.0 / (noise**2 + beyond)
    left = float(np.sum(weights * (values - np.average(values, weights=weights)) ** 2))
    freedom = len(values) - 1
    assert left == pytest.approx(min(square, freedom), rel=1e-9, abs=1e-12)
    assert (beyond > 0.0) == (square > freedom)


def test_a_prior_moves_what_goes_with_it() -> None:
    """The secant is told, K_s not: who knows K_s knows K_e, 1/K_e = 1/k − 1/K_s."""
    secant, k_s = 8e4, 3e5
    k_e = 1.0 / (1.0 / secant - 1.0 / 2.5e5)
    slopes = np.array([1.0 / 2.5e5**2, 1.0 / k_e**2])
    # K_s to 40 %, the sum of the compliances to 0.1 %.
    basis = np.array([[-1.0 / 2.5e5**2, 0.0], [-slopes[0], -slopes[1]]])
    spread = np.diag([(0.4 / 2.5e5) ** 2, (1e-3 / secant) ** 2])
    inverse = np.linalg.inv(basis)
    known = Normal(names=("K_s", "x1.K_e"), values=np.array([2.5e5, k_e]), matrix=inverse @ spread @ inverse.T)
    found = with_priors(known, {"K_s": (k_s, 1e-6 * k_s)})
    assert found.at("K_s")[0] == pytest.approx(k_s, rel=1e-5)
    # Linear in compliances, so exact for the full step of K_s; to a thousandth of the deviation.
    assert found.at("x1.K_e")[0] == pytest.approx(1.0 / (1.0 / secant - 1.0 / k_s), rel=1e-5)
    assert found.at("x1.K_e")[1] / found.at("x1.K_e")[0] == pytest.approx(
        1e-3 * found.at("x1.K_e")[0] / secant, rel=1e-2
    )


def test_springs_that_contradict_each_other_stay_positive() -> None:
    """A compliance that least squares would make negative: the logarithms are taken instead."""
    matrix = np.array([[1e10, 0.999e9], [0.999e9, 1e8]])
    one = Normal(names=("K_s", "x1.K_e"), values=np.array([1e5, 1e4]), matrix=matrix)
    other = Normal(names=("K_s",), values=np.array([1e9]), matrix=np.array([[1e12]]))
    found = merge_normals([one, other], [(), ()]).normal
    assert np.all(found.values > 0.0)
    assert np.all(np.linalg.eigvalsh(found.matrix / np.outer(found.std, found.std)) > 0.0)


def test_what_differs_by_contact_does_not_average() -> None:
    """Noise of four logs halves; what the next contact will be is no better known for it."""
    logs = [Estimate(value=value, std=2.0, status=Status.WEAK) for value in (19.0, 20.0, 20.0, 21.0)]
    merge = Merge(names=("a", "b", "c", "d"), findings=[])
    assert merge.scalars("a surface", logs).std == pytest.approx(1.0)
    assert merge.scalars("a surface", logs, differs_by_contact=True).std == pytest.approx(2.0)


def test_the_deviation_of_a_mean_holds_what_differs_between_logs() -> None:
    """Seventeen logs that scatter three times as far as their noise: the mean is as sure as that scatter makes it."""
    rng, inside, shares = np.random.default_rng(5), 0, []
    for _ in range(200):
        stds = np.linspace(0.01, 0.03, 17)
        values = 0.7 + 0.06 * rng.standard_normal(17) + stds * rng.standard_normal(17)
        logs = [
            Estimate(value=float(v), std=float(s), status=Status.IDENTIFIED) for v, s in zip(values, stds, strict=True)
        ]
        merged = Merge(names=tuple("abcdefghijklmnopq"), findings=[]).scalars("gain", logs)
        assert merged.value is not None
        assert merged.std is not None
        inside += abs(merged.value - 0.7) < 1.96 * merged.std
        shares.append(merged.std / (np.std(values, ddof=1) / np.sqrt(17.0)))
    # 95 % of 200 less three deviations of a count; the weights make a tenth of difference to the plain mean.
    assert inside >= 0.9 * 200
    assert np.median(shares) == pytest.approx(1.0, abs=0.1)
