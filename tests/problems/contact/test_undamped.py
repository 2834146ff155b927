"""Plants without any damping (B_s = B_p = 0): a pole on the unit circle is a frequency at which nothing is finite."""

import numpy as np
import pytest

from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.response import plant_response
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import find_margins, frequency_grid, prepare_margins

PERIOD_S = 4e-3
# The shared case `undamped`: in its grid of plants one has its resonance exactly on a frequency that was looked at.
STIFFNESSES = np.geomspace(1727352.4161978557, 2072822.8994374268, 33)
MASSES = np.linspace(54.40846547449256, 55.49663478398241, 3)


def plant(stiffness: float, mass: float, damping: float = 0.0) -> Plant:
    return Plant(
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=103.97276323280894, delay_s=0.0),
        coupling=Coupling(stiffness_n_per_m=904178.9383898769, damping_n_s_per_m=damping),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=0.0),
        environment=Environment(stiffness_n_per_m=stiffness),
    )


def test_every_plant_of_the_case_has_a_finite_response_where_it_is_looked_at() -> None:
    for mass in MASSES:
        for stiffness in (0.0, *STIFFNESSES):
            sampled = build_sampled_plant(plant(float(stiffness), float(mass)), PERIOD_S)
            seen = plant_response(sampled, frequency_grid(sampled))
            assert np.all(np.isfinite(seen.force))
            omega, *_ = prepare_margins(sampled).grid
            assert np.all(np.isfinite(omega))


def test_margins_without_damping_are_the_limit_of_those_with_little() -> None:
    law = AdmittanceController(mass_kg=100.0, damping_n_s_per_m=20000.0, lead_s=0.01)
    bare, damped = (build_sampled_plant(plant(2e5, 54.4, each), PERIOD_S) for each in (0.0, 1e-3))
    assert max(spectral_radius(build_loop(each, law)) for each in (bare, damped)) < 1.0
    # 1e-3 of 2 sqrt(K M) = 1.4e4 N·s/m moves a pole by 1e-7 of itself; a margin is found to 1e-6.
    assert find_margins(bare, law).modulus == pytest.approx(find_margins(damped, law).modulus, rel=1e-5)
