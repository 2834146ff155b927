"""The run of one contact: the loop matrices while it touches, its peaks, its end."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.contact.event_free_steps import SETTLED
from problems.contact.kernel import _settled, contact_forces, run_contact, steady_start
from problems.contact.kernel_types import FOUND, Forces, Start, Traces
from problems.contact.transient import Approach, SampledContact
from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.plant import Plant
from problems.model.sampled import build_loop
from tests.problems.axes import (
    LAW,
    PERIOD_S,
    PRESS,
    admittance,
    any_controllers,
    any_plants,
    environments,
    one_pole,
    pair_of,
    paper_plant,
)


def begin(
    pair: SampledContact, controller: AdmittanceController, approach: Approach
) -> tuple[FloatArray, Start, Forces]:
    """Return blocks, start and the forces after the impact."""
    blocks = controller_blocks(controller, PERIOD_S)
    resistance = controller.damping_n_s_per_m - pair.ramp[0, -1] * PERIOD_S
    speed, push, forces = contact_forces(approach.numbers(), resistance)
    effort, chain = controller.damping_n_s_per_m * speed, pair.free.chain_length
    start = steady_start(pair.ramp, pair.free.c_position, blocks, chain, PERIOD_S, speed, push, effort)
    return blocks, start, forces


def run(
    plant: Plant,
    controller: AdmittanceController,
    samples: int,
    approach: Approach = PRESS,
    *,
    until_settled: bool = False,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return F, F_e and the peaks of the kernel, from the steady approach on."""
    pair = pair_of(plant)
    blocks, start, forces = begin(pair, controller, approach)
    traces, found = np.full((2, samples), np.nan), np.zeros(FOUND)
    count = run_contact(pair.arguments, blocks, start, forces, Traces(traces[0], traces[1]), found, until_settled)
    return traces[0][:count], traces[1][:count], found


# A hand and a desired force that change at the impact.
APPROACHES = st.sampled_from(
    [
        PRESS,
        Approach(speed_m_s=0.05, after_impact_n=20.0),
        Approach(force_n=30.0, driven_by="hand"),
        Approach(speed_m_s=0.05, driven_by="hand", after_impact_n=80.0),
    ]
)


@LAW
@given(any_plants(touched=environments()), any_controllers(), APPROACHES)
def test_while_it_touches_the_kernel_is_the_loop_matrix(
    plant: Plant, controller: AdmittanceController, approach: Approach
) -> None:
    sensed, pressed, _ = run(plant, controller, 200, approach)
    pair = pair_of(plant)
    blocks, (state, past, control), (desired, push) = begin(pair, controller, approach)
    loop, n = build_loop(pair.contact, controller), len(state)
    state = state.copy()
    state[n - 1] *= plant.payload.mass_kg / (plant.payload.mass_kg + plant.environment.mass_kg)
    whole = np.concatenate([state, past[: pair.free.chain_length], control[needed_states(blocks)]])
    left = np.flatnonzero(pressed[1:] <= 0.0)
    # What happens between two ticks that both press is the subject of other tests.
    stays = int(left[0]) + 1 if left.size else len(pressed)
    rows, expected, contact_force = pair.contact, [], []
    for _ in range(stays):
        command = loop.c_command @ whole + loop.d_command * desired
        held = whole[n + pair.contact.chain_length - 1] if pair.contact.chain_length else command
        expected.append(loop.c_force @ whole + loop.d_force * desired)
        contact_force.append(rows.c_contact @ whole[:n] + rows.d_contact * held + rows.push_contact * push)
        whole = loop.a @ whole + loop.b * desired + loop.b_push * push
        if contact_force[-1] < 0.0:  # torn off a mass at the tick itself
            break
    count = len(expected)
    # The same sums in another order; F is a difference of terms up to a thousand times as large.
    scale = np.max(np.abs([expected, contact_force]))
    np.testing.assert_allclose(sensed[:count], expected, atol=1e-9 * scale)
    np.testing.assert_allclose(pressed[1:count], np.maximum(0.0, contact_force[1:]), atol=1e-9 * scale)


@pytest.mark.parametrize("damping", [0.0, 400.0])
@pytest.mark.parametrize("mass", [0.0, 8.0])
def test_at_the_impact_the_wall_pushes_with_its_damping_and_its_inertia(damping: float, mass: float) -> None:
    """F_e = M_e a + B_e v' with v' = M_p v/(M_p + M_e); the drag that was B_p v is B_p v' then."""
    plant = paper_plant(stiffness=1e5, environment_damping=damping, environment_mass=mass, robot=one_pole(2.2e-3))
    _, pressed, found = run(plant, admittance(damping=2000.0), 3)
    speed = 30.0 / 2630.0
    after = 16.0 / (16.0 + mass) * speed
    # On the payload: its weight of force −F = B_p v of the approach against drag, damper and both masses.
    acceleration = (630.0 * (speed - after) - damping * after) / (16.0 + mass)
    # The sampled approach is 2e-4 from F^d/(B_a + B_p); a massless wall has no force before it is entered.
    assert pressed[0] == pytest.approx(mass * acceleration + damping * after, rel=2e-3, abs=1e-9)
    assert found[4] * PERIOD_S == pytest.approx(16.0 * mass / (16.0 + mass) * speed, rel=1e-3)


@LAW
@given(any_plants(touched=environments()), any_controllers(), APPROACHES)
def test_the_peaks_are_not_below_the_ticks(plant: Plant, controller: AdmittanceController, approach: Approach) -> None:
    sensed, pressed, found = run(plant, controller, 150, approach)
    assert np.min(pressed) >= 0.0
    # At rest the sensor shows F^d; anything above it is a tick's.
    desired = begin(pair_of(plant), controller, approach)[2].desired
    largest = max(0.0, float(np.max(-sensed)))
    assert found[0] in {largest, desired}
    assert found[0] >= largest
    assert found[2] >= np.max(pressed)
    # Ticks are half a radian of the fastest oscillation apart at the most where nobody looks in between; a contact that
    # comes and goes within a sample has no tick at all.
    assert 0.0 <= found[3] <= 150.0


@pytest.mark.parametrize("name", ["damper", "mass", "mass and damper"])
def test_without_stiffness_no_force_at_rest_is_added(name: str) -> None:
    """Nothing there brings the payload to rest, so F^d is not what the force creeps up to."""
    plant = paper_plant(
        stiffness=0.0,
        environment_damping=200.0 if "damper" in name else 0.0,
        environment_mass=5.0 if "mass" in name else 0.0,
    )
    sensed, pressed, found = run(plant, admittance(damping=3000.0, lead=0.02), 12500, until_settled=True)
    assert len(pressed) < 2000
    assert found[0] == np.max(-sensed) < 30.0
    assert found[2] < 3.0
    # Between ticks 0.2 rad apart.
    assert found[2] == pytest.approx(np.max(pressed), rel=1e-2)
    # What is left is the drag of the payload and, where it still pushes it, of the damper.
    drag = 630.0 + (200.0 if "damper" in name else 0.0)
    expected = drag * 30.0 / (3000.0 + drag)
    assert -sensed[-1] == pytest.approx(expected, rel=2e-3)
    assert pressed[-1] == pytest.approx(expected - 630.0 * 30.0 / (3000.0 + drag), abs=0.02)


@pytest.mark.parametrize("stiffness", [2e4, 5e5])
@pytest.mark.parametrize("damping", [3000.0, 9000.0])
def test_a_run_ends_when_nothing_changes_any_more(stiffness: float, damping: float) -> None:
    plant, controller = paper_plant(stiffness=stiffness), admittance(damping=damping, lead=0.02)
    sensed, pressed, found = run(plant, controller, 12500, until_settled=True)
    longer, longer_pressed, later = run(plant, controller, 3 * len(sensed))
    assert len(sensed) < 12500
    # The last quarter is within a thousandth of the largest force, and so is what follows.
    np.testing.assert_allclose(longer[len(sensed) :], sensed[-1], atol=2.0 * SETTLED * found[0])
    np.testing.assert_array_equal(longer[: len(sensed)], sensed)
    np.testing.assert_array_equal(longer_pressed[: len(sensed)], pressed)
    np.testing.assert_array_equal(later[[0, 2]], found[[0, 2]])
    # One look earlier it was not settled: the run is no longer than a third more than it must be.
    early = -sensed[: len(sensed) * 3 // 4 - 40]
    quarter = early[-max(len(early) // 4, 32) :]
    assert np.ptp(quarter) > 0.5 * SETTLED * found[0] or abs(30.0 - early[-1]) > 0.5 * SETTLED * found[0]


def test_a_hand_that_never_makes_the_sensor_press_comes_to_rest_too() -> None:
    """F rests at 0 and never reads pressing: the scale of what is small is the hand's force."""
    plant, controller = paper_plant(stiffness=2e4), admittance(mass=5.0, damping=8000.0)
    hand = Approach(force_n=30.0, driven_by="hand")
    sensed, pressed, found = run(plant, controller, 12500, hand, until_settled=True)
    assert len(sensed) < 8000
    assert np.min(sensed) > -1e-3
    assert abs(sensed[-1]) < 30.0 * SETTLED
    assert pressed[-1] == pytest.approx(30.0, rel=2.0 * SETTLED)
    assert found[2] == 30.0


@pytest.mark.parametrize(
    ("end", "forces", "touching", "anchored", "settled"),
    [
        pytest.param(-30.0, Forces(30.0, 0.0), True, True, True, id="at rest: e = 0"),
        pytest.param(-29.0, Forces(30.0, 0.0), True, True, False, id="flat, but still driven"),
        pytest.param(0.0, Forces(0.0, 25.0), True, True, True, id="at rest under a hand"),
        pytest.param(-6.0, Forces(30.0, 0.0), True, False, True, id="pushing a damper for ever"),
        pytest.param(-0.5, Forces(8.0, 0.0), False, True, False, id="drifting back to the wall"),
        pytest.param(0.4, Forces(0.0, 8.0), False, True, False, id="carried back to the wall"),
        pytest.param(0.5, Forces(-8.0, 0.0), False, True, True, id="pulled away"),
        pytest.param(0.0, Forces(0.0, 0.0), False, True, True, id="thrown off and left alone"),
        pytest.param(-0.5, Forces(8.0, 0.0), False, False, True, id="behind a mass that flies ahead"),
    ],
)
def test_rest_is_where_nothing_is_flat_by_chance(
    end: float, forces: Forces, touching: bool, anchored: bool, settled: bool
) -> None:
    """A flat quarter is not enough where e = F^d + F is not 0 on a spring, or where the payload will come back."""
    force = np.concatenate([np.linspace(-20.0, end, 60), np.full(40, end)])
    assert _settled(force, 100, forces, touching, anchored, 20.0) is settled
    # Shortly before, the last quarter was not flat.
    assert not _settled(force, 80, forces, touching, anchored, 20.0)


def test_a_payload_in_flight_towards_the_wall_has_not_come_to_rest() -> None:
    """Far out, drifting back slowly under a steady force, it is as flat as at rest; it still has its impact ahead."""
    # Thrown back by a hard spring and driven by next to nothing afterwards.
    plant = paper_plant(stiffness=1e6, mass=30.0, drag=60.0, coupling=4e4)
    controller = admittance(mass=30.0, damping=4000.0, lead=0.01)
    approach = Approach(speed_m_s=0.3, after_impact_n=8.0)
    sensed, pressed, found = run(plant, controller, 12500, approach, until_settled=True)
    assert np.sum(np.diff((pressed[1:] == 0.0).astype(int)) == 1) >= 2
    assert pressed[-1] == pytest.approx(8.0, abs=2.0 * SETTLED * found[0])
    assert -sensed[-1] == pytest.approx(8.0, abs=2.0 * SETTLED * found[0])


@pytest.mark.parametrize("by_hand", [True, False])
def test_a_payload_that_is_pulled_away_ends_in_flight(by_hand: bool) -> None:
    approach = Approach(speed_m_s=0.1, after_impact_n=-15.0, driven_by="hand" if by_hand else "desired_force")
    plant, controller = paper_plant(), admittance(damping=3000.0, lead=0.02)
    sensed, pressed, found = run(plant, controller, 12500, approach, until_settled=True)
    assert len(sensed) < 2000
    assert np.all(pressed[-20:] == 0.0)
    assert found[2] > 100.0
    # Back at −15 N per (B_a + B_p): the sensor pulls the drag along, or the hand against the admittance.
    speed = -15.0 / 3630.0
    expected = -3000.0 * speed if by_hand else 630.0 * speed
    assert -sensed[-1] == pytest.approx(expected, abs=2.0 * SETTLED * found[0])
