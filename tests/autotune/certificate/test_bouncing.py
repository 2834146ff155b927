"""That contacts come to rest: the lifted loop by matrix exponentials and eigenvalues, a closed form, and an attack."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from autotune.certificate import bouncing
from autotune.certificate.bouncing import multiplier_over_s, prove_rest
from autotune.certificate.certify import CELL_WORK
from autotune.certificate.family import Family, build_families
from autotune.certificate.multiplier_search import find_multiplier, spring_response
from autotune.certificate.plant_cells import coefficients, with_derivatives
from problems.arrays import FloatArray
from problems.contact.bouncing import Ending, follow_contact, settling_window
from problems.contact.multiplier import Multiplier
from problems.contact.transient import Approach, build_sampled_contact
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Environment, Plant, WrenchFilter
from problems.model.response import controller_response, plant_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError
from tests.autotune.certificate.loops import family
from tests.autotune.certificate.test_enclosures import LAWS, ROBOTS, TWO_POLES
from tests.problems.axes import PERIOD_S, admittance, linear_controller, paper_plant
from tests.problems.contact.test_bouncing import BOUNCY, CALMED, K_E, bouncing_plant

WORK = 40_000
SOME = Multiplier(
    rate_s=0.003,
    shifts_s=(0.004, 0.03, 0.4),
    shift_weights=(0.3, 0.2, 0.02),
    fading_per_s=(1.0, 30.0),
    fading_weights=(0.02, 0.3),
    damper_s=0.02,
)


def damped(robot: object = TWO_POLES, **others: object) -> Plant:
    return replace(paper_plant(stiffness=1.3e5, mass=16.0, drag=400.0, coupling_damping=120.0, robot=robot), **others)  # type: ignore[arg-type]


def lifted(plant: Plant, law: AdmittanceController, omega: float, reach: int) -> tuple[Any, ...]:
    """Return ω_k, P, A and W of one plant at the frequencies that the sampler mixes, and D, in plain floats."""
    return tuple(each[0] for each in all_lifted(plant, law, np.array([omega]), reach))


def all_lifted(plant: Plant, law: AdmittanceController, omega: FloatArray, reach: int) -> tuple[Any, ...]:
    """Return the same of frequencies (n,): a row for each, and D (n,)."""
    h, k = PERIOD_S, np.arange(-reach, reach + 1)
    held = plant_response(build_sampled_plant(plant.in_contact_with(FREE_SPACE), h), omega)
    forward, feedback = controller_response(law, held.z, h)
    closed = forward / (1.0 + feedback * held.position - forward * held.force)
    s = 1j * (omega[:, None] + 2.0 * np.pi * k / h)
    stiff = plant.coupling.stiffness_n_per_m + plant.coupling.damping_n_s_per_m * s
    given = 1.0 / (plant.payload.mass_kg * s**2 + plant.payload.drag_n_s_per_m * s + stiff)
    robot = np.polyval(plant.robot.numerator, s) / np.polyval(plant.robot.denominator, s)
    moved = given * stiff * robot * np.exp(-s * plant.loop_delay_s) * (1.0 - np.exp(-s * h)) / s
    return s, given, moved, given * stiff / (1.0 + s * plant.wrench_filter.time_constant_s), closed


@pytest.mark.parametrize("robot", [ROBOTS["whole delay"], ROBOTS["fraction"], TWO_POLES], ids=["whole", "part", "two"])
def test_the_frequencies_that_the_sampler_mixes_add_up_to_the_plant_in_contact(robot: object) -> None:
    """The force per command in contact less that in free space, by matrix exponentials, is −Σ K W A/((1 + K P) h)."""
    plant, law = damped(robot), LAWS["feedback"]
    for omega in (3.0, 60.0, 900.0, 3500.0):
        at = np.array([omega])
        free, touching = (
            plant_response(build_sampled_plant(plant.in_contact_with(each), PERIOD_S), at).force[0]
            for each in (FREE_SPACE, Environment(stiffness_n_per_m=1.3e5))
        )
        _, given, moved, sensed, _ = lifted(plant, law, omega, 400)
        mixed = -np.sum(1.3e5 * sensed * moved / (1.0 + 1.3e5 * given)) / PERIOD_S
        # 800 frequencies leave out terms that fall with the fourth power.
        assert mixed == pytest.approx(touching - free, rel=1e-6)


def test_the_spring_sees_an_integrator_at_rest() -> None:
    """The steady speed under a force is that over B_a + B_p."""
    plant, law = damped(), LAWS["feedback"]
    found = spring_response(plant, law, PERIOD_S, np.array([0.01]))[0]
    assert found * 0.01j == pytest.approx(1.0 / (law.damping_n_s_per_m + 400.0), rel=1e-3)


@pytest.mark.parametrize("shift_s", [0.01, 0.1, 1.0, 30.0])
@pytest.mark.parametrize("half", [1e-5, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("ratio", [1.2, 5.0, 50.0])
def test_a_multiplier_on_an_arc_is_within_its_straight_line_and_rest(shift_s: float, half: float, ratio: float) -> None:
    """∫ e^{−st} dt over [0, τ] in closed form: where the shifted part turns little, and where only its size is used."""
    middle, along = half * ratio, np.linspace(-1.0, 1.0, 201)
    one = Multiplier(
        rate_s=0.0,
        shifts_s=(shift_s,),
        shift_weights=(2.0,),
        fading_per_s=(5.0,),
        fading_weights=(1e-12,),
        damper_s=0.0,
    )
    found = multiplier_over_s(one, np.array([middle]), np.array([half]), PERIOD_S)
    s = 1j * (middle + half * along) / PERIOD_S
    exact = -2.0 * np.expm1(-s * shift_s) / s + 1e-12 / (s + 5.0)
    off = np.abs(exact - found.terms[0, 0] - found.terms[0, 1] * along)
    assert np.max(off) <= found.rest[0, 0]


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_the_enclosures_hold_the_response_of_every_plant_of_a_cell(law: AdmittanceController) -> None:
    plant = damped(wrench_filter=WrenchFilter(time_constant_s=8e-4))
    of = family(
        (1e5, 1.3e5),
        (15.0, 15.4),
        nominal=plant,
        coupling_damping_n_s_per_m=(118.0, 122.0),
        delay_s=(2.0e-3, 2.01e-3),
        environment_damping_n_s_per_m=(0.0, 50.0),
    )
    proof = bouncing._Proof(of, law, SOME, WORK)
    cell, rng = proof.box, np.random.default_rng(5)
    plants = with_derivatives(cell, *map(proof._groups, coefficients(proof.family, cell)))
    arcs = proof.circle.halves(proof.circle.halves(proof.circle.halves(np.arange(proof.circle.count_of_first))))
    port = proof.response(arcs, cell, plants)
    for i in range(0, len(arcs), 7):
        for _ in range(3):
            low, high = proof.circle.angles(arcs)[i]
            omega = np.array([rng.uniform(low, high) / PERIOD_S])
            there = proof.family.plant(cell[:, 0] + rng.random(len(cell)) * np.ptp(cell, axis=1))
            answer, response = spring_response(there, law, PERIOD_S, omega), SOME.response(omega)
            spring, velocity = response * (answer + 1.0 / 1.3e5), 1j * omega * answer
            across = 0.5 * (response * answer + SOME.damper_s * np.conj(velocity))
            for exact, found in ((spring, port.spring), (velocity, port.velocity), (across, port.across)):
                # Beside what is bounded there is the rounding of the plain floats.
                spread = found.magnitude()[i] - abs(found.terms[i, 0]) + 1e-9 * abs(exact[0])
                assert abs(exact[0] - found.terms[i, 0]) <= spread
                assert found.least_real()[i] <= exact[0].real + 1e-9 * abs(exact[0])


@cache
def paper_set() -> tuple[Family, AdmittanceController]:
    return family((2e4, 5e5), (14.0, 24.0)), admittance(10.0, 1600.0, 0.02, 0.01)


def least_eigenvalues(plant: Plant, law: AdmittanceController, by: Multiplier, omega: FloatArray) -> FloatArray:
    """Return the least eigenvalue of the Hermitian part of what spring and damper take, on 31 frequencies that mix.

    Forces are in units that make what each takes alone 1, but for M.
    """
    stiffness, damping, found = plant.environment.stiffness_n_per_m, plant.environment.damping_n_s_per_m, []
    for each in omega:
        s, given, moved, sensed, closed = lifted(plant, law, float(each), 15)
        answer, one = np.diag(given) + np.outer(moved, sensed) * closed / PERIOD_S, np.eye(len(s))
        response = by.response(s.imag)[:, None]
        matrix = response * (stiffness * answer + one)
        if damping > 0.0:
            lossy = damping * s[:, None] * answer
            size = (damping * stiffness / by.damper_s) ** 0.5
            beside = size * by.damper_s * s[:, None] * answer
            matrix = np.block([[matrix, size * response * answer], [beside, lossy + one]])
        found.append(np.linalg.eigvalsh(0.5 * (matrix + matrix.conj().T))[0])
    return np.array(found)


@pytest.mark.parametrize("damping", [0.0, 300.0])
def test_what_is_proved_is_positive_on_the_frequencies_that_mix(damping: float) -> None:
    of, law = paper_set()
    of = replace(of, ranges={**of.ranges, "environment_damping_n_s_per_m": (0.0, damping)})
    multiplier = find_multiplier([of], law)
    assert multiplier is not None
    assert prove_rest(of, law, multiplier, work=WORK).holds
    omega = np.concatenate([np.geomspace(0.01, 3000.0, 9), [3926.0]])
    for mass in (14.0, 24.0):
        plant = of.nominal.in_contact_with(Environment(stiffness_n_per_m=5e5, damping_n_s_per_m=damping))
        plant = replace(plant, payload=replace(plant.payload, mass_kg=mass))
        assert np.all(least_eigenvalues(plant, law, multiplier, omega) > 0.0)


@pytest.mark.parametrize(("share", "holds"), [(0.9, True), (1.1, False)])
def test_a_damped_oscillator_is_proved_up_to_its_circle(share: float, holds: bool) -> None:
    """Behind a flange that hardly moves G is P, with min Re P = −1/(4 ζ (1 + ζ) K_s): the circle criterion's K_e.

    A multiplier that fades in a third of a second is 1 but for a thousandth at the 16 Hz of the payload; the flange's
    motion is 2 % of P there.
    """
    mass, coupling, damping = 20.0, 2e5, 500.0
    ratio = damping / (2.0 * (coupling * mass) ** 0.5)
    largest = share * 4.0 * ratio * (1.0 + ratio) * coupling
    plant = paper_plant(stiffness=largest, mass=mass, drag=damping, coupling=coupling)
    circle = Multiplier(
        rate_s=0.0, shifts_s=(), shift_weights=(), fading_per_s=(3.0,), fading_weights=(1.0,), damper_s=0.0
    )
    (of,) = build_families(plant, {}, PERIOD_S)
    assert prove_rest(of, admittance(10.0, 2e5, 0.0), circle, work=WORK).holds is holds
    # With Popov's term, the energy of the spring, any stiffness will do.
    popov = replace(circle, rate_s=0.05)
    assert prove_rest(of, admittance(10.0, 2e5, 0.0), popov, work=WORK).holds


def test_nothing_that_bounces_is_proved_by_any_multiplier() -> None:
    """Of designs on both sides of where bouncing begins, those whose simulation bounces are never proved."""
    rng, bounced, proved = np.random.default_rng(3), 0, 0
    for _ in range(12):
        law = replace(
            BOUNCY,
            lead_s=float(rng.uniform(0.028, 0.045)),
            damping_n_s_per_m=float(rng.uniform(3000.0, 4200.0)),
            feedback_damping_s=float(rng.uniform(0.018, 0.03)),
        )
        surface = Environment(stiffness_n_per_m=K_E, damping_n_s_per_m=float(rng.choice([0.0, 1.0, 10.0])))
        plant = bouncing_plant().in_contact_with(surface)
        (of,) = build_families(plant, {}, PERIOD_S)
        found = find_multiplier([of], law)
        multipliers = [each for each in (found, SOME) if each is not None]
        is_proved = any(prove_rest(of, law, each, work=WORK).holds for each in multipliers)
        proved += is_proved
        bounces = simulation_bounces(plant, law)
        bounced += bounces
        assert not (bounces and is_proved), law
    assert bounced >= 3
    assert proved >= 3


def simulation_bounces(plant: Plant, law: AdmittanceController) -> bool:
    """Return whether one of some impacts bounces for ever; a loop that is not stable is not followed."""
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    try:
        window = min(settling_window(pair, law), 500)
    except UnstableLoopError:
        return False
    approaches = (Approach(speed_m_s=0.01, after_impact_n=force) for force in (1.0, 10.0))
    return any(follow_contact(pair, law, each, window=window).ending is Ending.BOUNCING for each in approaches)


def test_the_shared_case_has_no_multiplier_and_the_calmed_one_is_proved() -> None:
    (of,) = build_families(bouncing_plant(), {}, PERIOD_S)
    assert find_multiplier([of], BOUNCY) is None
    multiplier = find_multiplier([of], CALMED)
    assert multiplier is not None
    assert prove_rest(of, CALMED, multiplier, work=WORK).holds
    assert not prove_rest(of, BOUNCY, multiplier, work=WORK).holds


def test_what_it_does_not_cover_is_refused() -> None:
    of, law = paper_set()
    damped_surface = replace(of, ranges={**of.ranges, "environment_damping_n_s_per_m": (0.0, 50.0)})
    assert prove_rest(damped_surface, law, replace(SOME, damper_s=0.0), work=WORK).share == 0.0
    follows = linear_controller(law, PERIOD_S)
    with pytest.raises(ParameterError, match="law"):
        prove_rest(of, replace(follows, follows_position=True), SOME, work=WORK)
    # A payload that swings faster than half the sampling frequency is not bounded.
    light = family((2e4, 5e5), (0.01, 0.01))
    assert prove_rest(light, law, SOME, work=WORK).share == 0.0


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"rate_s": -1e-3}, "rate_s"),
        ({"shifts_s": (0.0, 0.03, 0.4)}, "shifts_s"),
        ({"shift_weights": (0.3,)}, "shift_weights"),
        ({"fading_weights": (-0.1, 0.3)}, "fading_weights"),
        ({"fading_weights": (0.0, 0.0)}, "fading_weights"),
    ],
)
def test_a_multiplier_has_no_negative_coefficient(changes: dict[str, object], reported: str) -> None:
    with pytest.raises(ParameterError, match=reported):
        replace(SOME, **changes)  # type: ignore[arg-type]


def least_passive(plant: Plant, law: AdmittanceController) -> float:
    """Return the least eigenvalue of the Hermitian part of s G on 31 mixed frequencies, each scaled to Re jωP = 1."""
    omega = np.concatenate([np.geomspace(0.05, 3900.0, 400), np.linspace(20.0, 3900.0, 400)])
    s, given, moved, sensed, closed = all_lifted(plant, law, omega, 15)
    mixed = moved[:, :, None] * sensed[:, None, :] * closed[:, None, None] / PERIOD_S
    answer = s[:, :, None] * (given[:, :, None] * np.eye(31) + mixed)
    size = 1.0 / np.sqrt(np.real(s * given))
    matrix = size[:, :, None] * answer * size[:, None, :]
    return float(np.min(np.linalg.eigvalsh(0.5 * (matrix + matrix.conj().swapaxes(1, 2)))))


@pytest.mark.parametrize("filtered", [False, True])
def test_passivity_is_proved_where_the_mixed_frequencies_have_it_and_never_where_not(filtered: bool) -> None:
    """40 drawn laws and payloads: M = s, by the eigenvalues of the lifted loop in plain floats."""
    rng, proved, passive = np.random.default_rng(11), 0, 0
    begun: set[int] = set()
    for _ in range(40):
        mass, drag = float(rng.uniform(6.0, 25.0)), float(rng.uniform(50.0, 800.0))
        plant = paper_plant(stiffness=1.3e5, mass=mass, drag=drag, coupling_damping=100.0 if filtered else 0.0)
        plant = replace(plant, wrench_filter=WrenchFilter(time_constant_s=1e-3)) if filtered else plant
        law = admittance(
            float(rng.uniform(5.0, 40.0)), float(rng.uniform(600.0, 3000.0)), float(rng.uniform(0.0, 0.06))
        )
        (of,) = build_families(plant, {"payload_mass_kg": (mass, mass)}, PERIOD_S)
        found, least = prove_rest(of, law, None, work=WORK), least_passive(plant, law)
        holds = found.holds
        assert not (holds and least <= 0.0), (mass, drag, law)
        if holds:
            # Of one plant there is one cell, and an arc is judged, or cut in two: so many began.
            assert found.cells == 1
            begun.add(2 * found.arcs - (found.work - CELL_WORK))
        proved, passive = proved + holds, passive + (least > 0.02)
    assert len(begun) == 1
    assert min(begun) > 0
    assert 3 < passive < 37
    assert proved >= 0.8 * passive


def test_contacts_with_moving_surfaces_come_to_rest_where_passivity_is_proved() -> None:
    """Every mass, spring and damper: of drawn ones each contact ends; a coupling with damping is not proved."""
    plant, law = paper_plant(stiffness=1.3e5), admittance(20.0, 1500.0, 0.03)
    (of,) = build_families(plant, {"payload_mass_kg": (15.0, 17.0)}, PERIOD_S)
    assert prove_rest(of, law, None, work=WORK).holds
    rng = np.random.default_rng(3)
    for _ in range(12):
        surface = Environment(
            stiffness_n_per_m=float(np.exp(rng.uniform(np.log(2e4), np.log(5e5)))),
            damping_n_s_per_m=float(rng.uniform(0.0, 100.0)),
            mass_kg=float(rng.uniform(0.5, 6.0)),
        )
        pair = build_sampled_contact(build_sampled_plant(plant.in_contact_with(surface), PERIOD_S))
        for speed in (0.02, 0.2):
            seen = follow_contact(
                pair, law, Approach(speed_m_s=speed, after_impact_n=10.0), window=settling_window(pair, law)
            )
            assert seen.ending is not Ending.BOUNCING, surface
    (rough,) = build_families(paper_plant(stiffness=1.3e5, coupling_damping=50.0), {}, PERIOD_S)
    assert not prove_rest(rough, law, None, work=WORK).holds
