"""The phases of a simulated log, in closed form."""

import math

import numpy as np
import pytest

from autotune.simulation.phases import Program, build_script


@pytest.mark.parametrize("sample_time_s", [2e-4, 8e-4, 1e-3])
def test_a_knock_is_half_a_sine(sample_time_s: float) -> None:
    program = Program(pose_count=1, jogging_s=0.0, sweep_s=0.0, tap_count=1, contact_count=0)
    script = build_script(program, sample_time_s, np.random.default_rng(1))
    struck = np.flatnonzero(script.hand_force_n)
    knock = script.hand_force_n[struck[0] : struck[-1] + 1]
    assert bool(np.all(knock > 0.0))
    np.testing.assert_allclose(knock, knock[::-1], rtol=1e-9)
    # The sum of a sine at the middles of n intervals is 1/sin(π/2n), that of all its values the integral 2n/π.
    lasts_s = len(knock) * sample_time_s
    assert lasts_s == pytest.approx(0.012, abs=sample_time_s)
    impulse = program.tap_force_n / math.sin(math.pi / (2 * len(knock))) * sample_time_s
    assert float(np.sum(knock)) * sample_time_s == pytest.approx(impulse, rel=1e-12)
    assert impulse == pytest.approx(2.0 / math.pi * program.tap_force_n * lasts_s, rel=0.01)
