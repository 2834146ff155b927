"""A payload that touches with a bumper: limits in closed form, and an integrator that shares nothing with the tool."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from problems.contact.transient import simulate_contact
from problems.errors import ParameterError
from problems.model.coupled import CoupledPlant
from problems.model.plant import FREE_SPACE, Bumper, Environment, Plant, WrenchFilter, build_plant_matrices
from problems.model.python_control import to_control
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.problems.axes import DELAY_S, PERIOD_S, PRESS, admittance, pair_of, paper_plant

LAW = admittance(10.0, 1600.0, 0.02, 0.01)


def bumped(mass: float, stiffness: float, damping: float, wall: float = 5e5, coupling_damping: float = 0.0) -> Plant:
    bumper = Bumper(mass_kg=mass, stiffness_n_per_m=stiffness, damping_n_s_per_m=damping)
    return replace(paper_plant(stiffness=wall, coupling_damping=coupling_damping), bumper=bumper)


def stepped(plant: Plant, substeps: int) -> tuple[float, float]:
    """Return the peaks at the wall and at the sensor, pole 20/s, from a start at rest in steps of h/`substeps`.

    States x, x_b, v_b, x_t, v_t and the held command; the law is Tustin's form written out.
    """
    bumper, k_s, b_s = plant.bumper, plant.coupling.stiffness_n_per_m, plant.coupling.damping_n_s_per_m
    assert bumper is not None
    m_b, drag, wall = plant.payload.mass_kg - bumper.mass_kg, plant.payload.drag_n_s_per_m, plant.environment
    flange = np.array([-20.0, 0.0, 0.0, 0.0, 0.0, 20.0])
    force = np.array([-k_s, k_s, b_s, 0.0, 0.0, 0.0]) - b_s * flange
    k_t, b_t = bumper.stiffness_n_per_m, bumper.damping_n_s_per_m
    push = np.array([0.0, k_t, b_t, -k_t, -b_t, 0.0])
    press = np.array([0.0, 0.0, 0.0, wall.stiffness_n_per_m, 0.0, 0.0])
    steps = []
    for on_it in (0.0, 1.0):
        rate = np.zeros((6, 6))
        rate[0], rate[1, 2], rate[3, 4] = flange, 1.0, 1.0
        rate[2], rate[4] = (-force - push) / m_b, (push - on_it * press) / bumper.mass_kg
        rate[2, 2] -= drag / m_b
        steps.append(expm(rate * PERIOD_S / substeps))
    c = 2.0 / PERIOD_S
    m_a, b_a, lead, feedback, corner = 10.0, 1600.0, 0.02, 0.01, 120.0
    first = m_a * c * c + b_a * c
    b_0, b_1, b_2 = (1.0 + lead * c) / first, 2.0 / first, (1.0 - lead * c) / first
    a_1, a_2 = -2.0 * m_a * c * c / first, (m_a * c * c - b_a * c) / first
    begin = -0.02
    state = np.array([begin, begin, 0.0, begin, 0.0, begin])
    late, ticks = round(DELAY_S / PERIOD_S), 2500
    sent = np.full(ticks + late + 1, begin)
    u_1 = u_2 = damped = at_wall = at_sensor = 0.0
    y_1 = y_2 = x_1 = begin
    for k in range(ticks):
        read = float(force @ state)
        at_sensor = max(at_sensor, -read) if at_wall > 0.0 else 0.0
        damped = ((c - corner) * damped + feedback * corner * c * (state[0] - x_1)) / (c + corner)
        u, x_1 = 30.0 + read, state[0]
        y = b_0 * u + b_1 * u_1 + b_2 * u_2 - a_1 * y_1 - a_2 * y_2
        u_1, u_2, y_1, y_2 = u, u_1, y, y_1
        sent[k + late] = y - damped
        state[5] = sent[k]
        for _ in range(substeps):
            state = steps[int(state[3] > 0.0)] @ state
            at_wall = max(at_wall, float(press @ state))
    return at_wall, at_sensor


@pytest.mark.parametrize(
    ("mass", "stiffness", "share", "wall", "coupling_damping"),
    [(0.5, 1e5, 0.05, 5e5, 0.0), (2.0, 2e4, 0.3, 5e5, 150.0), (2.0, 5e5, 0.3, 5e6, 0.0), (0.5, 2e4, 0.05, 5e6, 0.0)],
)
def test_contacts_are_those_of_two_masses_in_fine_steps(
    mass: float, stiffness: float, share: float, wall: float, coupling_damping: float
) -> None:
    """Peaks to 0.5 %: the touch falls anywhere between two ticks there. The last case strikes 33 times."""
    plant = bumped(mass, stiffness, 2.0 * share * math.sqrt(stiffness * mass), wall, coupling_damping)
    exact = simulate_contact(pair_of(plant), LAW, PRESS)
    at_wall, at_sensor = stepped(plant, 40 if wall < 1e6 else 160)
    assert exact.is_settled
    assert exact.peak_contact_force_n == pytest.approx(at_wall, rel=5e-3)
    assert exact.peak_sensor_force_n == pytest.approx(at_sensor, rel=5e-3)


def test_a_bumper_without_mass_is_a_spring_before_the_wall_and_a_rigid_one_none() -> None:
    series = 1.0 / (1.0 / 1e5 + 1.0 / 5e5)
    for plant, alone in (
        (bumped(5e-3, 1e5, 5.0), paper_plant(stiffness=series)),
        (bumped(4.0, 2e8, 4e3), paper_plant()),
    ):
        one, other = pair_of(plant), pair_of(alone)
        for mine, simple in ((one.free, other.free), (one.contact, other.contact)):
            assert find_margins(mine, LAW).modulus == pytest.approx(find_margins(simple, LAW).modulus, rel=3e-3)
        mine_n, simple_n = (simulate_contact(each, LAW, PRESS).peak_contact_force_n for each in (one, other))
        assert mine_n == pytest.approx(simple_n, rel=5e-3)


def test_it_swings_on_the_payload_with_the_reduced_mass() -> None:
    """ω = √(K_t (1/M_t + 1/(M_p − M_t))) where the coupling hardly holds, from −ω² = tr for an undamped pair."""
    plant = replace(bumped(2.0, 1e5, 0.0), environment=FREE_SPACE)
    plant = replace(
        plant,
        coupling=replace(plant.coupling, stiffness_n_per_m=1e-3),
        payload=replace(plant.payload, drag_n_s_per_m=0.0),
    )
    poles = np.linalg.eigvals(build_plant_matrices(plant, PERIOD_S).a) / PERIOD_S
    assert np.max(poles.imag) == pytest.approx(math.sqrt(1e5 * (1.0 / 2.0 + 1.0 / 14.0)), rel=1e-6)


def test_a_filter_of_the_wrench_stays_before_the_payload() -> None:
    """With no mass to speak of on the bumper, the filtered loop is that of a payload in one piece."""
    late = WrenchFilter(time_constant_s=1e-3)
    plant, alone = replace(bumped(1e-3, 1e6, 1.0), wrench_filter=late), replace(paper_plant(), wrench_filter=late)
    found = find_margins(build_sampled_plant(plant.in_contact_with(FREE_SPACE), PERIOD_S), LAW).modulus
    free = find_margins(build_sampled_plant(alone.in_contact_with(FREE_SPACE), PERIOD_S), LAW).modulus
    assert found == pytest.approx(free, rel=1e-3)


def test_what_does_not_know_it_refuses_it() -> None:
    plant = bumped(0.5, 1e5, 20.0)
    free = plant.in_contact_with(FREE_SPACE)
    with pytest.raises(ParameterError, match="bumper"):
        plant.parameters()
    with pytest.raises(ParameterError, match="bumper"):
        CoupledPlant(plants=(free,), mass_matrix=np.array([[16.0]]))
    with pytest.raises(ParameterError, match="bumper"):
        to_control(build_sampled_plant(plant, PERIOD_S), LAW)
    with pytest.raises(ParameterError, match=r"below the payload's 16 kg"):
        bumped(16.0, 1e5, 0.0)
    with pytest.raises(ParameterError, match=r"environment\.mass_kg"):
        plant.in_contact_with(Environment(stiffness_n_per_m=1e5, mass_kg=1.0))
