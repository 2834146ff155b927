import math

import numpy as np
import pytest

from problems.modes import analyse_modes
from problems.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import PERIOD_S, admittance, paper_plant


def test_without_lead_the_onset_of_instability_is_the_papers_payload_mode() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    # MODEL.md, erratum 7: at B_p = 630 instability begins near K_l = 0.047, at 33 Hz.
    before = analyse_modes(build_loop(sampled, admittance(mass=10.0, damping=1000.0, lead=0.0455)))
    after = analyse_modes(build_loop(sampled, admittance(mass=10.0, damping=1000.0, lead=0.0475)))
    assert before.is_stable
    assert not after.is_stable
    assert after.dominant.oscillation_hz == pytest.approx(33.0, abs=0.5)  # the erratum gives whole hertz
    assert after.dominant.damping_ratio < 0.0 < before.dominant.damping_ratio


def test_the_distance_is_that_of_the_spectral_radius() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=1e5), PERIOD_S)
    loop = build_loop(sampled, admittance(mass=13.0, damping=1500.0, lead=0.01))
    found = analyse_modes(loop)
    assert found.distance == pytest.approx(1.0 - spectral_radius(loop), abs=1e-12)  # rounding of one eigenvalue run
    slowest = -math.log(spectral_radius(loop)) / PERIOD_S
    assert found.dominant.decay_rate_per_s == pytest.approx(slowest, rel=1e-9)


def test_every_mode_is_its_eigenvalue_again() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=1e5), PERIOD_S)
    for mode in analyse_modes(build_loop(sampled, admittance(mass=13.0, damping=1500.0, lead=0.01))).modes:
        if not math.isfinite(mode.frequency_hz):
            continue
        s = -mode.decay_rate_per_s + 2j * np.pi * mode.oscillation_hz
        # Near z = 0 the logarithm is large and loses digits of small numbers; 1e-9 is far above that.
        assert np.exp(s * PERIOD_S) == pytest.approx(mode.z, abs=1e-9)
        assert 2.0 * np.pi * mode.frequency_hz * mode.damping_ratio == pytest.approx(mode.decay_rate_per_s, rel=1e-9)
