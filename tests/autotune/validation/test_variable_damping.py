"""Small gain around one B_a: its identity in the exact sampled loop, its bound, and claims that are too wide."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.certificate.family import Claim
from autotune.formats.limits import VariableDampingSettings
from autotune.validation.axis_proof import Prover
from autotune.validation.variable_damping import METHOD, _feedback_response, needed_modulus, prove_varied
from problems.arrays import ComplexArray, FloatArray
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.response import loop_response
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

FREQUENCY = 2.0 * np.pi * np.geomspace(0.01, 620.0, 60)
Z = np.exp(1j * FREQUENCY * PERIOD_S)
TUSTIN = 2.0 / PERIOD_S * (Z - 1.0) / (Z + 1.0)


def position_response(plant_delay_s: float) -> ComplexArray:
    """X/X^d of the held robot 20/(s + 20) with its delay, in closed form."""
    whole = int(plant_delay_s / PERIOD_S + 1e-9)
    part, pole = plant_delay_s / PERIOD_S - whole, np.exp(-20.0 * PERIOD_S)
    newer = 1.0 - np.exp(-20.0 * PERIOD_S * (1.0 - part))
    older = 1.0 - pole - newer
    return np.asarray(Z ** (-whole) * (newer + older / Z) / (Z - pole))


def feedback(law: AdmittanceController, delay_s: float) -> ComplexArray:
    corner = law.velocity_filter_rad_per_s
    return np.asarray(1.0 + law.feedback_damping_s * corner * TUSTIN / (TUSTIN + corner) * position_response(delay_s))


@settings(max_examples=20, deadline=None)
@given(
    other=st.floats(300.0, 4000.0),
    feedback_s=st.sampled_from([0.0, 5e-3, 3e-2]),
    samples=st.sampled_from([3.0, 2.4]),
    stiffness=st.sampled_from([0.0, 1e5]),
)
def test_what_another_damping_changes_is_its_difference_times_the_feedback(
    other: float, feedback_s: float, samples: float, stiffness: float
) -> None:
    """(M_a s + B)(1 + L_B) = (M_a s + B_0)(1 + L_{B_0}) + (B − B_0)(1 + C_fb X/X^d), in the exact sampled loop."""
    delay = samples * PERIOD_S
    plant = paper_plant(stiffness=stiffness, robot=one_pole(delay))
    law = replace(admittance(12.0, 1100.0, 0.015), feedback_damping_s=feedback_s)
    varied, sampled = replace(law, damping_n_s_per_m=other), build_sampled_plant(plant, PERIOD_S)
    left, right = (
        (12.0 * TUSTIN + each.damping_n_s_per_m) * (1.0 + loop_response(sampled, each, FREQUENCY).at_command)
        for each in (varied, law)
    )
    added = (other - 1100.0) * feedback(law, delay)
    # Two frequency responses, each to some 1e-10 of the loop.
    np.testing.assert_allclose(left, right + added, rtol=0.0, atol=1e-7 * float(np.max(np.abs(right))))


@pytest.mark.parametrize("feedback_s", [0.0, 5e-3, 3e-2])
@pytest.mark.parametrize("samples", [3.0, 2.4])
def test_the_bound_holds_what_a_sweep_finds_and_little_more(feedback_s: float, samples: float) -> None:
    law, robot = replace(admittance(12.0, 1000.0), feedback_damping_s=feedback_s), one_pole(samples * PERIOD_S)
    swept = float(np.max(np.abs(feedback(law, robot.delay_s))))
    # The farther end is 200 of 1000.
    found = needed_modulus(law, robot, PERIOD_S, (900.0, 1200.0)) / 0.2
    assert swept <= found <= 1.02 * swept


def plants() -> PlantSet:
    nominal = paper_plant(stiffness=1e5)
    return PlantSet(
        nominal=nominal,
        ranges={"environment_stiffness_n_per_m": (5e4, 2e5), "payload_mass_kg": (14.0, 16.0)},
    )


def variable(lowest: float, highest: float) -> VariableDampingSettings:
    return VariableDampingSettings(
        highest=highest, lowest=lowest, decay_s_per_m=10.0, update_periods=12, largest_change=20.0
    )


LAW = admittance(13.0, 1200.0, 0.02)


@pytest.mark.parametrize("feedback_s", [1e-4, 0.01, 20.0])
def test_what_the_feedback_makes_of_one_command_is_in_proportion_to_it_and_sums_to_nothing(feedback_s: float) -> None:
    """A speed that is filtered is 0 over all of a motion that ends where it began, however weak the feedback is."""
    law = replace(admittance(), feedback_damping_s=feedback_s)
    found, unit = (
        _feedback_response(each, one_pole(), PERIOD_S) for each in (law, replace(law, feedback_damping_s=1.0))
    )
    np.testing.assert_allclose(found, feedback_s * unit, rtol=1e-12, atol=0.0)
    # What is left out at its end is 1e-13 of the largest, over some thousand samples.
    assert abs(np.sum(found)) < 1e-9 * np.max(np.abs(found))
    # Nothing is seen before the command has come.
    assert found[0] == 0.0


def test_every_damping_of_a_range_that_is_proved_is_stable_when_it_is_kept() -> None:
    found = prove_varied(Prover(), plants(), LAW, PERIOD_S, variable(900.0, 1500.0), None)
    assert found.holds
    assert found.centre == 1200.0
    assert found.needed_modulus == pytest.approx(0.25, rel=1e-5)
    statement = found.statement(plants(), variable(900.0, 1500.0), "x")
    assert "B_a varies in [900, 1500] N·s/m, however fast" in statement.claim
    assert statement.method == METHOD
    for damping in np.linspace(900.0, 1500.0, 4):
        law = replace(LAW, damping_n_s_per_m=float(damping))
        for stiffness in (0.0, 5e4, 2e5):
            loop = build_loop(build_sampled_plant(plants().at(14.0, stiffness), PERIOD_S), law)
            assert spectral_radius(loop) < 1.0


@pytest.mark.parametrize(("above", "centre"), [(1.001, 1300.0), (0.999, 1200.0)])
@pytest.mark.parametrize("budget_s", [0.1, 5.0])
def test_a_modulus_that_is_proved_of_the_law_is_enough_where_it_covers_what_is_needed(
    above: float, centre: float, budget_s: float
) -> None:
    law = replace(LAW, damping_n_s_per_m=1300.0)
    needed = needed_modulus(law, plants().nominal.robot, PERIOD_S, (900.0, 1500.0))
    asked = list[Claim]()

    def prove(claim: Claim) -> SimpleNamespace:
        asked.append(claim)
        return SimpleNamespace(holds=True)

    prover = cast(Prover, SimpleNamespace(origin=lambda _: "", prove=prove))
    known = (above * needed, budget_s)
    found = prove_varied(prover, plants(), law, PERIOD_S, variable(900.0, 1500.0), known)
    assert found.centre == centre
    assert asked[0].modulus == pytest.approx(known[0] if above > 1.0 else found.needed_modulus)
    # |B − B_0| is 400 of 1300 and 300 of 1200 at most.
    assert found.needed_modulus == pytest.approx(400.0 / 1300.0 if above > 1.0 else 0.25, rel=1e-5)


def test_a_range_that_holds_an_unstable_damping_is_not_proved() -> None:
    wide = variable(150.0, 1200.0)
    loop = build_loop(
        build_sampled_plant(plants().at(14.0, 2e5), PERIOD_S), replace(LAW, damping_n_s_per_m=wide.lowest)
    )
    assert spectral_radius(loop) > 1.0
    assert not prove_varied(Prover(), plants(), LAW, PERIOD_S, wide, None).holds


def test_any_sequence_of_dampings_decays_where_it_is_proved() -> None:
    """The theorem's own system: M_a (y⁺ − 2y + y⁻) + ½ B_k h (y⁺ − y⁻) = ¼ h² (F⁺ + 2F + F⁻), with lead."""
    rng, plant = np.random.default_rng(3), plants().at(15.0, 1e5)
    sampled = build_sampled_plant(plant, PERIOD_S)
    for pattern in ("random", "alternating"):
        dampings = (
            rng.choice([900.0, 1500.0], 6000) if pattern == "random" else np.tile([900.0, 900.0, 1500.0, 1500.0], 1500)
        )
        outputs = _followed(sampled.phi, sampled.gamma, sampled.c_force, dampings)
        assert np.max(np.abs(outputs[-500:])) < 1e-9 * np.max(np.abs(outputs[:500]))


def _followed(phi: FloatArray, gamma: FloatArray, c_force: FloatArray, dampings: FloatArray) -> FloatArray:
    """Return y of the loop in contact, three samples late and without damping in the coupling, from a bent spring."""
    h, mass, lead = PERIOD_S, LAW.mass_kg, 2.0 * LAW.lead_s / PERIOD_S
    state, sent, y, force = np.zeros(len(phi)), [0.0] * 4, [0.0, 0.0], [0.0, 0.0]
    state[-2], out = 1e-3, []
    for damping in dampings:
        newest, half = float(c_force @ state), 0.5 * damping * h
        pushed = 0.25 * h * h * ((1.0 + lead) * newest + 2.0 * force[1] + (1.0 - lead) * force[0])
        following = (2.0 * mass * y[1] - (mass - half) * y[0] + pushed) / (mass + half)
        y, force = [y[1], following], [force[1], newest]
        sent = [following, *sent[:3]]
        state = phi @ state + gamma * sent[3]
        out.append(following)
    return np.array(out)
