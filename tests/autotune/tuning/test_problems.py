"""From identified parameters and options to design problems: who wins, what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec
from autotune.tuning.problems import build_problems, is_identified_mass, runtime_mass_kg
from autotune.tuning.record import runtime_payload
from identification.errors import EstimateError
from identification.result import (
    CONTACT_UNEXPLAINED,
    AxisEstimate,
    Estimate,
    Finding,
    Identified,
    Status,
    VectorEstimate,
)
from problems.contact.transient import Approach
from problems.design.objectives import SensorForce
from problems.design.problem import DEFAULT_BOUNDS, AdmittanceTarget, NoiseLimit, Requirements
from tests.autotune.tuning.cases import absent, identified_axis, identified_plant, known, known_vector, with_axis

DEFAULT = ProblemSpec()


def test_the_plant_is_the_identified_one() -> None:
    problems = build_problems(identified_plant(), DEFAULT)
    assert list(problems) == ["x"]
    problem = problems["x"]
    nominal = problem.plants.nominal
    assert (nominal.coupling.stiffness_n_per_m, nominal.coupling.damping_n_s_per_m) == (3e5, 150.0)
    assert (nominal.payload.drag_n_s_per_m, problem.sample_time_s, nominal.robot.delay_s) == (330.0, 8e-4, 2.4e-3)
    np.testing.assert_array_equal(nominal.robot.denominator, [1.0, 20.0])
    assert problem.approach == Approach(force_n=30.0)
    assert problem.bounds == DEFAULT_BOUNDS
    # The default admittance ends where this robot of 3.2 Hz still follows: a third of its bandwidth.
    target = AdmittanceTarget(min_m_s_per_n=7e-4, band_hz=(0.1, 1.0))
    assert problem.requirements == replace(Requirements(), free_space_admittance=target)


def test_the_default_ranges_hold_the_uncertainty_and_at_least_a_daily_change() -> None:
    problem = build_problems(identified_plant(), DEFAULT)["x"]
    # 3 standard deviations are less than 20 % of K_e and 2 % of M_p here; rounded outwards to three digits.
    assert problem.plants.environment_stiffness_n_per_m == (8.8e4, 1.32e5)
    assert problem.plants.payload_mass_kg == (15.6, 16.4)


def test_a_large_uncertainty_widens_the_range() -> None:
    axis = identified_axis()
    surface = replace(axis.environments[0], stiffness_n_per_m=known(1e5, 3e4))
    problem = build_problems(with_axis(replace(axis, environments=(surface,))), DEFAULT)["x"]
    low, high = problem.plants.environment_stiffness_n_per_m
    assert 0.99e4 <= low <= 1e4
    assert high == pytest.approx(1.9e5)
    # However little the log tells, the range stays positive.
    unsure = replace(axis.environments[0], stiffness_n_per_m=known(1e5, 1e5))
    low, _ = build_problems(with_axis(replace(axis, environments=(unsure,))), DEFAULT)[
        "x"
    ].plants.environment_stiffness_n_per_m
    assert 0.0 < low <= 100.0


def test_all_surfaces_are_in_the_range() -> None:
    axis = identified_axis()
    soft = replace(axis.environments[0], name="x2", stiffness_n_per_m=known(2e4, 10.0))
    problem = build_problems(with_axis(replace(axis, environments=(*axis.environments, soft))), DEFAULT)["x"]
    assert problem.plants.environment_stiffness_n_per_m == (1.6e4, 1.32e5)


def test_the_interval_of_a_weak_surface_is_in_the_range() -> None:
    axis = identified_axis()
    weak = Estimate(value=2e5, std=1e4, status=Status.WEAK, ci95=(1.5e5, 2.6e5))
    stiff = replace(axis.environments[0], name="x2", stiffness_n_per_m=weak)
    plant = with_axis(replace(axis, environments=(*axis.environments, stiff)))
    assert build_problems(plant, DEFAULT)["x"].plants.environment_stiffness_n_per_m == (8.8e4, 2.6e5)


def touched(axis: str) -> Identified:
    message = f"Axis {axis}: what was touched at 52.7 s (75.7 N) is none of the surfaces."
    finding = Finding(code=CONTACT_UNEXPLAINED, severity="error", message=message, advice="Press again.", axis=axis)
    return replace(identified_plant(), findings=(finding,))


def test_no_default_range_leaves_out_what_was_touched() -> None:
    with pytest.raises(EstimateError, match=r"52\.7 s \(75\.7 N\).*or say --environment-stiffness LO:HI"):
        build_problems(touched("x"), DEFAULT)
    said = DEFAULT.with_options(environment_stiffness=(2e4, 5e5))
    assert build_problems(touched("x"), said)["x"].plants.environment_stiffness_n_per_m == (2e4, 5e5)
    # What was touched along another axis is that axis's matter.
    assert build_problems(touched("y"), DEFAULT)["x"].plants.environment_stiffness_n_per_m == (8.8e4, 1.32e5)


@pytest.mark.parametrize("value", [0.0123456, 0.8, 16.0, 123456.0, 99.96])
def test_rounding_is_always_outwards(value: float) -> None:
    plant = identified_plant()
    plant = replace(plant, payload=replace(plant.payload, mass_kg=known(value, 0.0)))
    low, high = build_problems(plant, DEFAULT)["x"].plants.payload_mass_kg
    assert low <= 0.98 * value * (1.0 + 1e-12)
    assert high >= 1.02 * value * (1.0 - 1e-12)
    # Three digits: at most one unit of the third, a hundredth, is given away.
    assert low >= 0.98 * value * 0.99
    assert high <= 1.02 * value * 1.01
    assert float(f"{low:.3g}") == pytest.approx(low, rel=1e-15)


def test_the_command_line_wins_over_the_problem_file_and_that_over_the_log() -> None:
    spec = ProblemSpec(payload_mass=(10.0, 20.0), environment_stiffness=(1e4, 2e4))
    by_file = build_problems(identified_plant(), spec)["x"]
    assert (by_file.plants.payload_mass_kg, by_file.plants.environment_stiffness_n_per_m) == ((10.0, 20.0), (1e4, 2e4))
    asked = spec.with_options(payload_mass=(11.0, 12.0), environment_stiffness=(3e4, 4e4))
    by_hand = build_problems(identified_plant(), asked)["x"]
    assert (by_hand.plants.payload_mass_kg, by_hand.plants.environment_stiffness_n_per_m) == ((11.0, 12.0), (3e4, 4e4))


def test_the_problem_file_sets_the_rest() -> None:
    spec = ProblemSpec(
        axes=("x",),
        bounds={"mass": (6.0, 9.0)},
        approach=Approach(speed_m_s=0.02),
        requirements=Requirements(modulus_margin=0.4),
        objective=SensorForce(),
    )
    problem = build_problems(identified_plant(), spec)["x"]
    assert problem.bounds["mass"] == (6.0, 9.0)
    assert problem.bounds["damping"] == DEFAULT_BOUNDS["damping"]
    assert problem.approach.speed_m_s == 0.02
    assert problem.requirements.modulus_margin == 0.4
    assert problem.objective == SensorForce()


def test_a_damping_that_noise_made_negative_is_none() -> None:
    axis = identified_axis()
    axis = replace(axis, coupling=replace(axis.coupling, damping_n_s_per_m=known(-3.0, 5.0)))
    assert build_problems(with_axis(axis), DEFAULT)["x"].plants.nominal.coupling.damping_n_s_per_m == 0.0


def _without_stiffness(axis: AxisEstimate) -> AxisEstimate:
    return replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=absent("no free motion")))


def _without_robot(axis: AxisEstimate) -> AxisEstimate:
    return replace(axis, robot=replace(axis.robot, denominator=replace(known_vector(1.0), value=None)))


def _without_delay(axis: AxisEstimate) -> AxisEstimate:
    return replace(axis, robot=replace(axis.robot, delay_s=absent()))


@pytest.mark.parametrize(
    ("axis", "output"),
    [
        (_without_stiffness(identified_axis()), r"axes\.x\.coupling\.stiffness_n_per_m .*\(no free motion\)"),
        (_without_robot(identified_axis()), r"axes\.x\.robot\.denominator is not identified"),
        (_without_delay(identified_axis()), r"axes\.x\.robot\.delay_s is not identified"),
        (replace(identified_axis(), drag_n_s_per_m=absent()), r"axes\.x\.drag_n_s_per_m is not identified"),
        (replace(identified_axis(), environments=()), r"no identified environment; .* --environment-stiffness LO:HI"),
    ],
)
def test_nothing_is_tuned_on_a_guess(axis: AxisEstimate, output: str) -> None:
    with pytest.raises(EstimateError, match=output):
        build_problems(with_axis(axis), DEFAULT)


def test_a_missing_environment_can_be_given() -> None:
    axis = replace(identified_axis(), environments=())
    asked = DEFAULT.with_options(environment_stiffness=(1e4, 2e4))
    assert build_problems(with_axis(axis), asked)["x"].plants.environment_stiffness_n_per_m == (1e4, 2e4)


def test_a_value_that_is_called_unidentifiable_is_not_used() -> None:
    contradiction = Estimate(value=330.0, std=None, status=Status.UNIDENTIFIABLE)
    with pytest.raises(EstimateError, match="drag_n_s_per_m"):
        build_problems(with_axis(replace(identified_axis(), drag_n_s_per_m=contradiction)), DEFAULT)


def test_an_axis_that_is_not_there_is_a_wrong_request() -> None:
    with pytest.raises(UsageError, match="Axis y is not in the plant; it holds x"):
        build_problems(identified_plant(), ProblemSpec(axes=("y",)))
    with pytest.raises(EstimateError, match="no axis"):
        build_problems(replace(identified_plant(), axes={}), DEFAULT)


def test_two_translational_axes_are_two_problems() -> None:
    both = replace(identified_plant(), axes={"x": identified_axis(), "z": identified_axis()})
    problems = build_problems(both, DEFAULT)
    assert list(problems) == ["x", "z"]
    assert all(math.isfinite(p.sample_time_s) for p in problems.values())


@pytest.mark.parametrize(("certified", "mass"), [((14.0, 20.0), 16.0), ((22.0, 22.0), 22.0)])
def test_the_runtime_compensates_a_mass_that_is_certified(certified: tuple[float, float], mass: float) -> None:
    assert runtime_mass_kg(identified_plant(), certified) == mass


@pytest.mark.parametrize(("std", "rest"), [(0.1, 0.29), (0.0, 0.004)])
def test_a_range_that_ends_within_the_deviation_compensates_its_end(std: float, rest: float) -> None:
    """Also at a deviation of none: 16.004 kg is told as 16."""
    plant = replace(identified_plant(), payload=replace(identified_plant().payload, mass_kg=known(16.0, std)))
    assert runtime_mass_kg(plant, (16.0 + rest, 22.0)) == 16.0 + rest
    assert runtime_mass_kg(plant, (12.0, 16.0 - rest)) == 16.0 - rest
    assert is_identified_mass(plant, 16.0 + rest)
    for certified in ((16.0 + 1.5 * rest, 22.0), (12.0, 16.0 - 1.5 * rest)):
        with pytest.raises(UsageError, match="the weight to compensate is not known"):
            runtime_mass_kg(plant, certified)


def test_a_range_that_leaves_the_identified_payload_out_is_refused() -> None:
    with pytest.raises(UsageError, match=r"18 to 22 kg leaves out the identified payload of 16 kg"):
        runtime_mass_kg(identified_plant(), (18.0, 22.0))


def test_masses_that_disagree_must_both_be_safe() -> None:
    moved = replace(identified_axis(), mass_kg=known(18.0, 0.01))
    low, high = build_problems(with_axis(moved), ProblemSpec())["x"].plants.payload_mass_kg
    assert low <= 16.0 * 0.98
    assert high >= 18.0 * 1.02
    alone = build_problems(with_axis(replace(moved, mass_kg=known(16.1, 0.01))), ProblemSpec())["x"]
    assert alone.plants.payload_mass_kg[1] < 17.0


def test_the_noise_is_the_sensors_unless_it_is_said() -> None:
    def limit(noise: float | None, plant: Identified | None = None) -> NoiseLimit | None:
        asked = Requirements(command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=noise))
        spec = replace(DEFAULT, requirements=asked)
        return build_problems(plant or identified_plant(), spec)["x"].requirements.command_noise

    assert limit(None) == NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.14)
    assert limit(0.5) == NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.5)
    plant = identified_plant()
    deaf = replace(plant, sensor=replace(plant.sensor, force_noise_rms_n=absent()))
    with pytest.raises(EstimateError, match="say force_noise_rms_n in requirements"):
        limit(None, deaf)
    assert limit(0.5, deaf) is not None


def test_a_log_without_weight_makes_a_controller_whose_payload_is_set_in_the_cell() -> None:
    """Its mass is what moves; of centre of mass and bias it shows nothing."""
    of_log = identified_plant()
    unknown = VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE, method="no weight")
    sensor = replace(of_log.sensor, force_bias_n=unknown, torque_bias_n_m=unknown)
    bare = replace(of_log, payload=replace(of_log.payload, com_m=unknown), sensor=sensor)
    with pytest.raises(EstimateError, match="compensates gravity"):
        runtime_payload(bare, 16.0, is_chosen=False)
    weightless = replace(bare, findings=(Finding.warning("gravity-removed", "Gravity is already removed.", ""),))
    assert runtime_payload(weightless, 16.0, is_chosen=False).set_in_cell
