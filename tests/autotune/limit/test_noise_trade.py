"""The trade of peak against noise, for programs and for people."""

import pytest

from autotune.limit.noise_trade import NoisePoint, trade_text
from problems.model.controller import AdmittanceController

GAINS = {"mass": 6.0, "damping": 1200.0, "lead_s": 0.02, "feedback_damping_s": 0.005}
LAW = AdmittanceController(mass_kg=6.0, damping_n_s_per_m=1200.0, lead_s=0.02, feedback_damping_s=0.005)
FOUND = NoisePoint(factor=2.0, noise_m_s_per_n=1e-4, peak_force_n=47.789, law=LAW)
NOTHING = NoisePoint(factor=0.5, noise_m_s_per_n=2.5e-5, peak_force_n=None, law=None)


@pytest.mark.parametrize(("point", "gains"), [(FOUND, GAINS), (NOTHING, dict.fromkeys(GAINS))])
def test_a_point_shows_its_gains_where_there_are_any(point: NoisePoint, gains: dict[str, float | None]) -> None:
    of_noise = {
        "factor": point.factor,
        "noise_m_s_per_n": point.noise_m_s_per_n,
        "peak_force_n": point.peak_force_n,
    }
    assert point.to_dict() == of_noise | gains


def test_the_sentence_names_the_factors_that_nothing_meets() -> None:
    assert trade_text((NOTHING, FOUND), "N") == (
        "peak against noise, M_a and K_l hardly bounded: no design with 0.5, 47.79 N with 2 times the noise of the "
        "command"
    )
