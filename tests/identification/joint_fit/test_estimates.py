"""Stated 95 % intervals, and verdicts, of a joint fit that is written down by hand."""

from dataclasses import replace

import numpy as np
import pytest

from identification.axis_findings import misfit_findings
from identification.joint_fit.estimates import UNEXPLAINED, JointEstimates, describe_robot, robot_bandwidth
from identification.joint_fit.latency import WrenchLatency
from identification.joint_fit.model import ParameterLayout
from identification.joint_fit.result import JointFit, JointSurface, with_unexplained
from identification.result import Status
from tests.autotune.formats.samples import FIT

VALUES = np.array([3e5, 50.0, 600.0, 16.0, 1e5, 40.0, 1.5])
# 1.5 ± 0.2 kg of a moving mass is weak beside a payload of 16 kg, and so stated with its interval.
MASS_KG, STD_KG = 1.5, 0.2
LOW_KG, HIGH_KG = MASS_KG - 1.96 * STD_KG, MASS_KG + 1.96 * STD_KG


def fit_with(interval: tuple[float, float]) -> JointFit:
    surface = JointSurface(
        sign=1, first_parameter=4, secant_n_per_m=7.5e4, secant_std_n_per_m=100.0, onsets=(100,), peak_force_n=(30.0,)
    )
    return JointFit(
        names=ParameterLayout(robot_order=0, surfaces=1).names,
        values=VALUES,
        covariance=np.diag(np.append(1e-3 * VALUES[:-1], STD_KG) ** 2),
        ci95={"environment1_mass_kg": interval},
        robot=None,
        surfaces=(surface,),
        quality=FIT,
        latency=WrenchLatency(seconds=0.0, std_s=1e-5, applied_s=0.0),
    )


@pytest.mark.parametrize(
    ("profile", "stated"),
    [
        ((1.3, 1.6), (LOW_KG, HIGH_KG)),
        ((1.3, 3.0), (LOW_KG, 3.0)),
        ((0.2, 1.6), (0.2, HIGH_KG)),
        ((0.2, 3.0), (0.2, 3.0)),
        ((-0.5, 3.0), (0.0, 3.0)),
    ],
)
def test_a_stated_interval_holds_the_profile_and_two_deviations(
    profile: tuple[float, float], stated: tuple[float, float]
) -> None:
    (surface,) = JointEstimates(name="x", fit=fit_with(profile), period_s=1e-3).environments
    # Rounding of one sum; the deviation comes out of a square root.
    assert surface.mass_kg.ci95 == pytest.approx(stated, rel=1e-12)


def test_an_interval_without_an_upper_end_is_not_stated() -> None:
    (surface,) = JointEstimates(name="x", fit=fit_with((0.0, np.inf)), period_s=1e-3).environments
    assert surface.mass_kg.value == MASS_KG
    assert surface.mass_kg.ci95 is None


@pytest.mark.parametrize(
    ("left_n", "touching", "friction_n", "coupling", "surface"),
    [
        (0.29, 2.9, None, None, None),
        (2.08, 1.0, None, 20.8, 20.8),
        (0.1, 4.0, None, None, 4.0),
        (0.1, 4.0, (0.5, 0.1), None, None),
        (2.08, 4.0, (0.5, 0.1), 20.8, 20.8),
    ],
)
def test_what_nothing_explains_leaves_nothing_mechanical_more_than_weak(
    left_n: float,
    touching: float,
    friction_n: tuple[float, float] | None,
    coupling: float | None,
    surface: float | None,
) -> None:
    """The noise is 0.1 N; what contacts leave may be friction's, where that is reported."""
    fit = fit_with((1.3, 1.6))
    quality = replace(fit.quality, noise_ratio_free=20.8, noise_ratio_contact=touching)
    fit = with_unexplained(replace(fit, quality=quality, friction_n=friction_n), left_n, 0.1, 0.1)
    found = JointEstimates(name="x", fit=fit, period_s=1e-3)
    (touched,) = found.environments
    notes = [None if left is None else UNEXPLAINED.format(left=left) for left in (coupling, surface)]
    for each in (found.coupling.stiffness_n_per_m, found.coupling.damping_n_s_per_m, found.drag_n_s_per_m):
        assert (each.status, each.note) == ((Status.WEAK, notes[0]) if notes[0] else (Status.IDENTIFIED, ""))
    for each in (touched.stiffness_n_per_m, touched.damping_n_s_per_m):
        assert each.status is Status.WEAK
        assert each.note == (notes[1] or found.without_command)
    (finding,) = misfit_findings("x", fit)
    assert finding.severity == ("warning" if surface else "info")
    weak = "K_s, B_s, B_p, K_e and B_e" if coupling else "K_e and B_e"
    assert (f"Nothing explains it, so {weak} are weak at best." in finding.message) is (surface is not None)


def test_deviations_of_one_pole_are_those_of_its_frequency() -> None:
    """1/(s/ω + 1): ω of r(s) and ω/2π of the bandwidth have the share of ω."""
    omega, std, delay_std = 25.0, 0.05, 1e-5
    covariance = np.diag([std**2, delay_std**2])
    found = describe_robot(np.array([omega, 2.4e-3]), covariance, 8e-4, "by hand")
    assert found.numerator.std == pytest.approx((std,), rel=1e-5)
    assert found.denominator.std == pytest.approx((0.0, std), rel=1e-5)
    assert found.bandwidth_hz.std == pytest.approx(std / (2.0 * np.pi), rel=1e-5)
    assert found.delay_s.std == pytest.approx(delay_std, rel=1e-9)
    assert robot_bandwidth(np.array([omega, 2.4e-3]), covariance) == pytest.approx(
        (omega / (2.0 * np.pi), std / (2.0 * np.pi)), rel=1e-5
    )


def test_deviations_of_two_poles_follow_from_both_and_what_they_have_in_common() -> None:
    """ω²/(s² + 2ζω s + ω²): d(ω²) = 2ω dω, d(2ζω) = 2ζ dω + 2ω dζ."""
    omega, damping, stds, common = 30.0, 0.7, np.array([0.1, 4e-3]), -1e-4
    covariance = np.diag([*stds**2, 1e-10])
    covariance[0, 1] = covariance[1, 0] = common
    found = describe_robot(np.array([omega, damping, 2.0e-3]), covariance, 1e-3, "by hand")
    middle = (2.0 * damping * stds[0]) ** 2 + (2.0 * omega * stds[1]) ** 2 + 8.0 * damping * omega * common
    assert found.numerator.std == pytest.approx((2.0 * omega * stds[0],), rel=1e-5)
    assert found.denominator.std == pytest.approx((0.0, middle**0.5, 2.0 * omega * stds[0]), rel=1e-5)
