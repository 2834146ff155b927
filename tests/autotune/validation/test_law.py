"""The certificate of any law: true of what runs, false where it must be, by more than one road."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.validation import law as law_module
from autotune.validation.law import AxisTask, certify_law, prove_law, spring_share
from problems.design.requirements import NoiseLimit, PassivityTarget
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.model.third_party_controllers import ForwardDynamics, SpringAdmittance
from problems.stability.margins import find_margins
from tests.autotune.export.peer_cases import CELL, LEAD, PERIOD_S, peer_controller, requirements, task_of
from tests.problems.axes import linear_controller, paper_plant


def sprung(damping: float, stiffness: float, mass: float = 8.0) -> LinearController:
    return SpringAdmittance(
        mass=mass,
        damping_ratio=damping / (2.0 * np.sqrt(mass * stiffness)),
        stiffness=stiffness,
        joint_damping_per_s=0.0,
        filter_coefficient=1.0,
    ).law(PERIOD_S)


@pytest.fixture(scope="module")
def task() -> AxisTask:
    return task_of(peer_controller({"x": LEAD}, requirements(6.4e-4)))


def test_the_file_s_own_law_is_certified_as_the_controller_s_margins_say(task: AxisTask) -> None:
    controller = AdmittanceController(
        mass_kg=LEAD.mass,
        damping_n_s_per_m=LEAD.damping,
        lead_s=LEAD.lead_s,
        feedback_damping_s=LEAD.feedback_damping_s,
    )
    found = certify_law(task, linear_controller(controller, PERIOD_S))
    assert found.missed == ()
    assert found.spring_share is None
    assert found.margins is not None
    plants = task.domain.plants
    at_the_worst = find_margins(
        build_sampled_plant(plants.at(16.0, 0.0), PERIOD_S),
        controller,
    )
    assert found.margins.values["modulus"] == pytest.approx(at_the_worst.modulus, rel=1e-3)
    assert found.worst is not None
    assert found.worst.peak_contact_force_n == pytest.approx(task.promised_n(), rel=1e-5)
    assert found.admittance is not None
    assert found.admittance.hand_force_n_per_m_s == pytest.approx(LEAD.damping + CELL.drag_n_s_per_m, rel=2e-3)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"modulus_margin": 0.7}, "modulus_margin must be at least 0.7"),
        ({"max_peak_force_n": 31.0}, "the peak force must be at most 31 N"),
        ({"decay_rate_per_s": 500.0}, "decay_rate_per_s must be at least 500 1/s"),
        (
            {"command_noise": NoiseLimit(max_speed_rms_m_s=1e-6, force_noise_rms_n=0.3)},
            "command_noise must be at most 1e-06",
        ),
        ({"passivity": PassivityTarget(passive_below_hz=300.0)}, "passivity must be at least 300 Hz"),
        ({"something_new": 1.0}, "something_new cannot be verified"),
    ],
)
def test_what_is_missed_is_reported_with_its_numbers(task: AxisTask, asked: dict[str, float], message: str) -> None:
    found = certify_law(replace(task, asked=asked), sprung(2500.0, 1.0))
    assert not found.holds
    assert message in found.missed[0]


def test_an_unstable_law_has_no_margins_and_no_peak(task: AxisTask) -> None:
    found = certify_law(task, ForwardDynamics(proportional=0.05, derivative=0.0).law(PERIOD_S))
    assert (found.margins, found.worst, found.admittance) == (None, None, None)
    assert "does not hold or cannot be proved" in found.missed[0]


def test_a_weak_spring_is_certified_over_a_range_of_masses(task: AxisTask) -> None:
    wide = replace(task.domain, payload_mass_kg=(15.5, 16.5))
    found, share = prove_law(wide.plants, sprung(2500.0, 1.0))
    assert found.holds
    assert (len(found.free_space), len(found.contact)) == (1, 1)
    assert share is not None
    assert 0.0 < share < 1e-3


def test_where_the_spring_has_room_the_loop_is_stable_and_where_it_is_not_it_has_none() -> None:
    """The theorem of `spring_share` against eigenvalues, from weak springs to such as shake the payload."""
    plant, verdicts = paper_plant(stiffness=0.0, coupling_damping=150.0), []
    for stiffness in np.geomspace(1.0, 3e6, 14):
        law = sprung(1500.0, float(stiffness))
        stable = spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), law)) < 1.0
        share = spring_share(plant, law)
        assert stable or share >= 1.0
        verdicts.append((stable, share < 1.0))
    assert (True, True) in verdicts
    assert (False, False) in verdicts


def test_a_spring_that_is_not_weak_is_refused(task: AxisTask) -> None:
    found = certify_law(task, sprung(2500.0, 3e4))
    assert any("return spring" in line for line in found.missed)
    assert not found.is_unproved


def test_a_proof_that_ran_out_is_reported_from_a_plant_that_is_unstable(
    task: AxisTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    unstable = certify_law(task, ForwardDynamics(proportional=0.05, derivative=0.0).law(PERIOD_S))
    assert (unstable.holds, unstable.is_unproved) == (False, False)
    monkeypatch.setattr(law_module, "STABILITY_WORK", 1)
    found = certify_law(task, sprung(2500.0, 1.0))
    assert (found.holds, found.is_unproved) == (False, True)
