"""How far the deviation of a parameter moves the peak of a contact, and that this decides what binds."""

from dataclasses import replace

import pytest

from identification.experiment_design.experiment import allowed_std, plan_experiment
from identification.experiment_design.result import ExperimentLimits, StepKind, peak_effect
from identification.experiment_design.values import PlanValues, usual_values
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.sampled import build_sampled_plant
from tests.identification.experiment_design.test_experiment import CELL, exact_cell, known, with_known

CHANGES = {"stiffness_n_per_m": 3e3, "drag_n_s_per_m": 10.0, "environment_stiffness_n_per_m": 2e3, "mass_kg": 0.2}


def peak_n(values: PlanValues, damping: float, **changed: float) -> float:
    """The peak of the reference contact, simulated apart, with some values changed."""
    reported = {name: entry.value for name, entry in values.known().items()} | changed
    plant = Plant(
        robot=values.robot,
        coupling=Coupling(
            stiffness_n_per_m=reported["stiffness_n_per_m"], damping_n_s_per_m=reported["damping_n_s_per_m"]
        ),
        payload=PayloadDynamics(mass_kg=reported["mass_kg"], drag_n_s_per_m=reported["drag_n_s_per_m"]),
        environment=Environment(
            stiffness_n_per_m=reported["environment_stiffness_n_per_m"],
            damping_n_s_per_m=reported["environment_damping_n_s_per_m"],
        ),
    )
    pair = build_sampled_contact(build_sampled_plant(plant, CELL.sample_time_s))
    law = peak_effect(values)
    assert law is not None
    assert law.controller.damping_n_s_per_m == damping
    run = simulate_contact(pair, law.controller, Approach(force_n=30.0))
    return max(run.peak_sensor_force_n, run.peak_contact_force_n)


@pytest.mark.parametrize("name", CHANGES)
def test_a_deviation_moves_the_peak_by_what_a_simulation_of_that_change_says(name: str) -> None:
    values = exact_cell()
    effect = peak_effect(values)
    assert effect is not None
    damping = effect.controller.damping_n_s_per_m
    assert effect.peak_force_n == pytest.approx(peak_n(values, damping), rel=1e-9)
    step = CHANGES[name]
    up = peak_n(values, damping, **{name: values.known()[name].value + step})
    moved = effect.moves_n(name, step)
    # A difference to one side over a percent or so of the value: the second derivative is left, a few percent of it.
    assert moved == pytest.approx(abs(up - effect.peak_force_n), rel=0.1, abs=2e-3)


def test_what_moves_the_peak_most_binds_and_not_what_is_known_worst_in_percent() -> None:
    """B_s at five times what is allowed moves the peak less than a drag that is known well enough by its share."""
    values = exact_cell()
    allowed = allowed_std(values)
    reported = known(
        values, damping_n_s_per_m=1.5 * allowed["damping_n_s_per_m"], drag_n_s_per_m=0.9 * allowed["drag_n_s_per_m"]
    )
    plan = plan_experiment("x", reported, ExperimentLimits())
    entries = {entry.name: entry for step in plan.steps for entry in step.predictions}
    damping, drag = entries["damping_n_s_per_m"], entries["drag_n_s_per_m"]
    assert damping.urgency > drag.urgency
    assert damping.peak_now_n is not None
    assert drag.peak_now_n is not None
    assert damping.peak_now_n < drag.peak_now_n
    assert plan.binding != "damping_n_s_per_m"
    assert max((e.peak_now_n or 0.0, e.name) for e in entries.values() if e.name != "motion_mass_kg")[1] == plan.binding


def test_what_hardly_moves_the_peak_makes_no_recording_necessary() -> None:
    values = exact_cell()
    reported = known(values, damping_n_s_per_m=1.5 * allowed_std(values)["damping_n_s_per_m"])
    plan = plan_experiment("x", reported, ExperimentLimits())
    (sweep,) = [step for step in plan.steps if step.kind is StepKind.SWEEP]
    (damping,) = [entry for entry in sweep.predictions if entry.name == "damping_n_s_per_m"]
    assert plan.effect is not None
    assert damping.urgency > 1.0
    assert damping.peak_now_n is not None
    assert damping.peak_now_n < 2e-3 * plan.effect.peak_force_n
    assert not sweep.is_needed


def test_where_no_usual_controller_is_stable_the_share_of_what_is_allowed_binds() -> None:
    values = usual_values(mass_kg=0.3, stiffness_n_per_m=1e8)
    hard = with_known(
        values, {"environment_stiffness_n_per_m": replace(values.environment_stiffness_n_per_m, value=5e8)}
    )
    assert peak_effect(hard) is None
    reported = known(hard, bandwidth_hz=3.0 * allowed_std(hard)["bandwidth_hz"])
    plan = plan_experiment("x", reported, ExperimentLimits(pose_count=0))
    assert plan.effect is None
    assert plan.binding == "bandwidth_hz"
    assert all(entry.peak_now_n is None for step in plan.steps for entry in step.predictions)
