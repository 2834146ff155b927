"""Verdicts and findings about rests whose sensor is wrong in a known way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.payload.gravity import GravityFit, identify_gravity
from identification.payload.gravity_verdicts import com_estimate, gravity_findings, load_growth_findings, mass_estimate
from identification.payload.pose_fit import ResidualTerm, TermKind
from identification.payload.static_poses import StaticPose
from identification.result import Status
from tests.identification.rests import Truth, poses_at
from tests.identification.synthetic import tilted


def rests(seed: int, *, mass_kg: float = 16.2, count: int = 12) -> tuple[StaticPose, ...]:
    rng = np.random.default_rng(seed)
    return poses_at(tilted(count, 1.1), rng, truth=Truth(mass_kg=mass_kg), noise_n=0.6, torque_noise_n_m=0.03)


def term(fit: GravityFit, kind: TermKind) -> ResidualTerm:
    return next(each for each in fit.terms if each.kind is kind)


def curved(mass_kg: float, per_n: float, seed: int = 0) -> tuple[StaticPose, ...]:
    """A sensor that shows w + q w|w| for the load w on each axis."""
    found = []
    for pose in rests(seed, mass_kg=mass_kg):
        load = mass_kg * pose.gravity_S_m_s2
        found.append(replace(pose, force_S_n=pose.force_S_n + per_n * load * np.abs(load)))
    return tuple(found)


@pytest.mark.parametrize("seed", range(8))
def test_a_sound_sensor_gives_no_findings(seed: int) -> None:
    fit = identify_gravity(rests(seed))
    assert gravity_findings(fit) == ()
    assert mass_estimate(fit).status is Status.IDENTIFIED
    assert com_estimate(fit).status is Status.IDENTIFIED


def test_drift_is_reported_per_axis_and_widens_the_bias() -> None:
    drift = np.array([0.03, -0.02, 0.0])
    fit = identify_gravity(tuple(replace(pose, force_S_n=pose.force_S_n + drift * pose.time_s) for pose in rests(1)))
    found = term(fit, TermKind.DRIFT)
    assert found.is_significant
    # Twelve rests over 22 s of 0.02 N each: the drift is known to 0.02 / (√12 · 7) N/s; four deviations.
    np.testing.assert_allclose(found.coefficient, drift, rtol=0.0, atol=4.0 * 0.02 / (np.sqrt(12.0) * 7.0))
    assert found.effect_n[0] == pytest.approx(0.03 * 22.0, rel=0.1)
    assert found.rms_after_n < 0.3 * found.rms_before_n
    assert "force-follows-drift" in {finding.code for finding in gravity_findings(fit)}
    # The bias that is stated is the middle one; the ends are half the drift away and within two deviations of it.
    assert fit.force_bias_std_n[0] > 0.25 * found.effect_n[0]


def test_axes_that_show_other_masses_are_reported_and_widen_the_mass() -> None:
    gain = np.array([1.0, 1.01, 0.99])
    fit = identify_gravity(
        tuple(replace(p, force_S_n=p.force_S_n + (gain - 1.0) * 16.2 * p.gravity_S_m_s2) for p in rests(2))
    )
    found = term(fit, TermKind.AXIS_GAIN)
    assert found.is_significant
    np.testing.assert_allclose(found.coefficient, 16.2 * gain, rtol=2e-3)
    assert "force-follows-axis-gain" in {finding.code for finding in gravity_findings(fit)}
    assert abs(fit.mass_kg - 16.2) < 3.0 * fit.mass_std_kg
    assert fit.mass_std_kg > 2.0 * identify_gravity(rests(2)).mass_std_kg


def test_a_load_curve_is_reported_and_widens_the_mass() -> None:
    per_n = 1e-4
    fit = identify_gravity(curved(50.0, per_n))
    found = term(fit, TermKind.LOAD_CURVE)
    assert found.is_significant
    # The load that the term is formed with is the plain fit's, a few per cent off.
    np.testing.assert_allclose(found.coefficient[:2], per_n, rtol=0.2)
    assert "force-follows-load-curve" in {finding.code for finding in gravity_findings(fit)}
    assert abs(fit.mass_kg - 50.0) < 3.0 * fit.mass_std_kg


def test_a_large_residual_is_reported_as_a_share_of_the_load() -> None:
    rng = np.random.default_rng(5)
    fit = identify_gravity(
        tuple(replace(p, force_S_n=p.force_S_n + 23.0 * rng.standard_normal(3)) for p in rests(5, mass_kg=50.0))
    )
    (found,) = (each for each in gravity_findings(fit) if each.code == "gravity-residual")
    share = 100.0 * fit.residual_rms_n / (fit.mass_kg * 9.80665)
    assert f"{fit.residual_rms_n:.2f} N rms, {share:.1f} % of a load" in found.message


def test_a_residual_that_outgrows_the_load_is_reported() -> None:
    light, heavy = identify_gravity(curved(16.0, 3e-5)), identify_gravity(curved(50.0, 3e-4))
    loads = [(fit.mass_kg, fit.residual_rms_n) for fit in (heavy, light)]
    (found,) = load_growth_findings(loads)
    assert "From 16." in found.message
    assert load_growth_findings(loads[:1]) == ()
    # The paper's two payloads; in proportion to the load is no nonlinearity.
    assert len(load_growth_findings([(16.0, 1.1), (50.0, 23.3)])) == 1
    assert load_growth_findings([(16.0, 1.1), (50.0, 3.4)]) == ()


def test_a_sensor_that_bends_with_the_load_conflict_the_scale_of_every_force() -> None:
    """q w|w| has the slope 2 q w: 30 % of a load of 50 kg for q = 3e-4 1/N."""
    assert identify_gravity(curved(50.0, 3e-4)).gain_error_share == pytest.approx(2.0 * 3e-4 * 50.0 * 9.81, rel=0.2)
    assert identify_gravity(rests(1)).gain_error_share < 1e-3


def test_a_centre_that_one_tilt_does_not_show_has_no_value() -> None:
    down = Rotation.from_euler("x", np.pi)
    one_axis = down * Rotation.from_rotvec(np.outer(np.linspace(-0.35, 0.35, 8), [1.0, 0.0, 0.0]))
    estimate = com_estimate(identify_gravity(poses_at(one_axis)))
    assert estimate.status is Status.UNIDENTIFIABLE
    assert estimate.value is None
    assert "two axes" in estimate.note


def test_a_vague_centre_is_weak() -> None:
    rng = np.random.default_rng(7)
    shaken = tuple(replace(p, torque_S_n_m=p.torque_S_n_m + 1.2 * rng.standard_normal(3)) for p in rests(7, count=9))
    fit = identify_gravity(shaken)
    assert com_estimate(fit).status is Status.WEAK
    assert 5e-3 < float(np.max(fit.com_std_m)) < 25e-3


def test_contacts_and_a_tare_are_reported() -> None:
    step = np.array([3.0, -4.0, 0.0])
    poses = [replace(p, force_S_n=p.force_S_n + (step if i >= 6 else 0.0)) for i, p in enumerate(rests(3))]
    poses[9] = replace(poses[9], force_S_n=poses[9].force_S_n + np.array([0.0, 0.0, 30.0]))
    codes = {finding.code: finding.message for finding in gravity_findings(identify_gravity(tuple(poses)))}
    assert set(codes) == {"rests-with-contact", "bias-step"}
    assert codes["rests-with-contact"].startswith("1 rests")
    assert "between 10.00 and 12.00 s" in codes["bias-step"]
