import numpy as np
import pytest

from problems.contact.bouncing import Ending
from problems.contact.coupled_contact import build_coupled_pair, simulate_coupled_contact, steady_motion
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.model.coupled import PointSurface
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError
from tests.problems.axes import PERIOD_S
from tests.problems.coupled_cases import LAWS, cell, single, wall

ALONG_X = np.array([30.0, 0.0])


@pytest.mark.parametrize("surface", [wall(2e4), wall(), wall(5e5, damping=0.0)])
@pytest.mark.parametrize("speed", [None, 0.03])
def test_without_an_offset_the_contact_is_that_of_the_axis_alone(surface: PointSurface, speed: float | None) -> None:
    found = simulate_coupled_contact(build_coupled_pair(cell(0.0, surface), LAWS, PERIOD_S), ALONG_X, speed)
    approach = Approach(force_n=30.0) if speed is None else Approach(speed_m_s=speed)
    pair = build_sampled_contact(build_sampled_plant(single(0, surface), PERIOD_S))
    alone = simulate_contact(pair, LAWS[0], approach)
    # The force is looked at four times in a sample: of a swing of 30 Hz 0.02 rad before its top at most.
    assert found.peak_contact_force_n == pytest.approx(alone.peak_contact_force_n, rel=3e-4)
    assert found.time_of_peak_s == pytest.approx(alone.time_of_peak_s, abs=PERIOD_S / 8.0)
    assert found.peak_sensor_force_n == pytest.approx(alone.peak_sensor_force_n, rel=1e-6)
    assert found.approach_speed_m_s == pytest.approx(alone.contact_speed_m_s, rel=1e-6)
    assert found.rest_n == pytest.approx(alone.driving_force_n, rel=1e-6)


def test_what_rests_at_a_lever_turns_away_and_presses_less() -> None:
    """The force at rest is F^d/(1 + l² R_x/R_r) with the resistances R = B_a + B_p: x presses what ry lets go."""
    lever = 0.3
    pair = build_coupled_pair(cell(surface=wall(1e5, np.array([1.0, lever]))), LAWS, PERIOD_S)
    found = simulate_coupled_contact(pair, ALONG_X)
    resistance = [
        law.damping_n_s_per_m + plant.payload.drag_n_s_per_m
        for law, plant in zip(LAWS, pair.free.plant.plants, strict=True)
    ]
    # The ripple of F between the ticks, which the laws do not see, is a ten-thousandth.
    assert found.rest_n == pytest.approx(30.0 / (1.0 + lever**2 * resistance[0] / resistance[1]), rel=1e-3)
    assert found.ending is Ending.SETTLED


def test_a_stiff_contact_at_a_lever_is_left_many_times() -> None:
    far = build_coupled_pair(cell(surface=wall(5e5, np.array([1.0, 0.45]), damping=0.0)), LAWS, PERIOD_S)
    near = build_coupled_pair(cell(surface=wall(5e5, damping=0.0)), LAWS, PERIOD_S)
    assert simulate_coupled_contact(far, ALONG_X).leaves > simulate_coupled_contact(near, ALONG_X).leaves


def test_the_steady_motion_repeats_itself() -> None:
    loop = build_coupled_pair(cell(surface=wall()), LAWS, PERIOD_S).free_loop
    state, way = steady_motion(loop, ALONG_X)
    np.testing.assert_allclose(loop.a @ state + loop.b @ ALONG_X, state + way, atol=1e-11)


def test_what_cannot_be_simulated_is_refused() -> None:
    with pytest.raises(ParameterError, match="towards"):
        simulate_coupled_contact(build_coupled_pair(cell(surface=wall()), LAWS, PERIOD_S), -ALONG_X)
    with pytest.raises(ParameterError, match="surface"):
        build_coupled_pair(cell(), LAWS, PERIOD_S)
    softer = tuple(type(law)(mass_kg=0.3 * law.mass_kg, damping_n_s_per_m=0.3 * law.damping_n_s_per_m) for law in LAWS)
    with pytest.raises(UnstableLoopError):
        simulate_coupled_contact(build_coupled_pair(cell(surface=wall()), softer, PERIOD_S), ALONG_X)
