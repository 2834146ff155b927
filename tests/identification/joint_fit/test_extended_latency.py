"""A late wrench settled beside friction: what is known before of its delay, and of the low-pass that it may be."""

from dataclasses import replace

import numpy as np
import pytest

from identification.joint_fit import extended_latency
from identification.joint_fit.extended_fit import beginning, with_own_noise
from identification.joint_fit.extended_latency import SettledLatency, settle_latency
from identification.joint_fit.extended_problem import ExtendedProblem, PayloadFit
from identification.joint_fit.free_motion import fit_free_motion, fit_robot, with_fitted_noise
from identification.joint_fit.latency import WrenchLatency
from tests.identification.joint_fit.fine_cell import PERIOD_S, Cell
from tests.identification.joint_fit.test_extension import logged

FILTER_HZ = 60.0


def test_a_low_pass_is_looked_for_within_half_of_the_delay_that_it_looks_like(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay itself is known to a sample, and both fits begin where nothing but the latency differs."""
    data = logged(Cell(filter_hz=FILTER_HZ), noise_n=0.04)
    base, start = fit_robot(data)
    problem, point = fit_free_motion(data, base, start[:-3])
    of = ExtendedProblem(
        problem=with_fitted_noise(problem, point), point=point, latency_std_samples=1.0, quiet_rms_n=0.04, is_held=True
    )
    latency = WrenchLatency(seconds=2.5e-3, std_s=1e-5, applied_s=0.0)
    open_s, delays_s = list[list[float]](), list[float]()

    def fitted(other: ExtendedProblem, at: PayloadFit) -> PayloadFit:
        known, _ = other.prior(len(at.theta))
        lags = slice(other.shared, other.shared + other.lags)
        open_s.append((np.diag(known)[lags] ** -0.5 * PERIOD_S).tolist())
        found = with_own_noise(other, at)
        delays_s.append(float(found.theta[other.shared]) * PERIOD_S)
        return found

    monkeypatch.setattr(extended_latency, "with_own_noise", fitted)
    settled = settle_latency(SettledLatency(of=of, fit=beginning(of), latency=latency), data.force_n, 0.0)
    of_delay, of_filter = open_s
    assert of_delay == pytest.approx([PERIOD_S])
    assert of_filter[0] == pytest.approx(0.5 * delays_s[0])
    # What the log shows is the filter that it passed.
    assert settled.latency.is_filter
    assert settled.latency.seconds == pytest.approx(1.0 / (2.0 * np.pi * FILTER_HZ), rel=0.02)
    # A time constant below its own deviation is no low-pass.
    again = replace(settled, latency=replace(settled.latency, std_s=1.0))
    assert not settle_latency(again, data.force_n, 0.0).latency.is_filter
