"""The free-space admittance from simulated sines against the frequency response."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.validation.requirements import sampled_admittance
from problems.design.requirements import smallest_admittance
from problems.model.controller import AdmittanceController
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

# Both smallest values lie at an end of these bands, where both look; the sines have settled to better than this.
SAME = 1e-4
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3)


@pytest.mark.parametrize(
    ("robot", "law"),
    [
        (one_pole(), admittance(13.0, 1000.0, 0.013)),
        (one_pole(), admittance(13.0, 1000.0, 0.0, 0.02)),
        (one_pole(0.0), admittance(20.0, 800.0)),
        (one_pole(2.7 * PERIOD_S), admittance(10.0, 1500.0, 0.02, 0.008)),
        (TWO_POLES, admittance(16.0, 2000.0, 0.01)),
    ],
    ids=["lead", "feedback", "no delay", "fraction", "two poles"],
)
@pytest.mark.parametrize("band_hz", [(1.0, 4.0), (0.5, 0.5)])
def test_the_sines_find_the_smallest_admittance(
    robot: RobotModel, law: AdmittanceController, band_hz: tuple[float, float]
) -> None:
    free = build_sampled_plant(paper_plant(stiffness=0.0, robot=robot), PERIOD_S)
    expected = smallest_admittance(free, law, band_hz)
    assert sampled_admittance((robot, NO_FILTER), law, PERIOD_S, band_hz) == pytest.approx(expected, rel=SAME)


def test_a_filtered_wrench_pushes_less() -> None:
    """At 20 Hz a filter of 50 Hz leaves 1/sqrt(1 + 0.4²) of a sine."""
    wrench, law = WrenchFilter.from_corner(50.0), admittance(13.0, 1000.0, 0.013, 0.004)
    plant = replace(paper_plant(stiffness=0.0), wrench_filter=wrench)
    found = sampled_admittance(plant.port, law, PERIOD_S, (20.0, 20.0))
    assert found == pytest.approx(
        smallest_admittance(build_sampled_plant(plant, PERIOD_S), law, (20.0, 20.0)), rel=SAME
    )
    without = sampled_admittance((plant.robot, NO_FILTER), law, PERIOD_S, (20.0, 20.0))
    assert found == pytest.approx(without / math.sqrt(1.16), rel=1e-9)


def test_slow_pushes_meet_the_damping_alone() -> None:
    """G(0) = 1/B_a: at 0.1 Hz the mass and the robot have nothing to say yet, to within (ω M_a/B_a)²."""
    law = admittance(13.0, 2000.0)
    omega = 2.0 * math.pi * 0.1
    lag = 0.5 * ((omega * law.mass_kg / law.damping_n_s_per_m) ** 2 + (omega / 20.0) ** 2)
    found = sampled_admittance((one_pole(), NO_FILTER), law, PERIOD_S, (0.1, 0.1))
    assert found == pytest.approx(1.0 / 2000.0, rel=2.0 * lag)
