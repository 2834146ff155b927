"""The confidence set of the identified file becomes the uncertainty of the design problem, and nothing is guessed."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.errors import AutotuneError
from autotune.formats.problem import ProblemSpec, RotationalSpec, Uncertain
from autotune.tuning.problems import build_problems, through_lever
from autotune.tuning.search import solve_design
from autotune.tuning.uncertain import with_uncertainty
from identification.errors import EstimateError
from identification.result import AxisEstimate, CouplingEstimate, Covariance, Estimate, Status
from problems.contact.transient import Approach
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario
from problems.model.robot import RobotModel, bandwidth_share
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.tuning.cases import (
    FAST_REQUIREMENTS,
    FAST_SPEC,
    absent,
    design_problem,
    identified_axis,
    known,
    with_axis,
)

NAMES = ("K_s", "B_s", "B_p", "M_p", "omega", "T_d", "x1.K_e", "x1.B_e", "x1.M_e")
VALUES = (3e5, 150.0, 330.0, 16.0, 20.0, 2.4e-3, 1.1e5, 20.0, 0.0)
STDS = np.array([900.0, 2.0, 1.0, 0.02, 0.06, 1e-5, 500.0, 10.0, 0.01])
CORRELATIONS = np.eye(9)
CORRELATIONS[0, 1] = CORRELATIONS[1, 0] = 0.6
COVARIANCE = Covariance(
    names=NAMES,
    values=VALUES,
    matrix=tuple(tuple(row) for row in (CORRELATIONS * np.outer(STDS, STDS)).tolist()),
)
AXIS = replace(identified_axis(), covariance=COVARIANCE)
# χ² of five parameters at 95 %, from tables.
REACH = math.sqrt(11.0705)


def built(
    uncertain: Uncertain, axis: AxisEstimate = AXIS, stiffness: tuple[float, float] | None = None
) -> DesignProblem:
    spec = ProblemSpec(uncertain=uncertain, environment_stiffness=stiffness)
    return build_problems(with_axis(axis), spec)["x"]


def test_by_default_the_joint_confidence_set_must_be_safe() -> None:
    found = built({})
    assert found.plants.ellipsoid is not None
    assert found.plants.ellipsoid.names == (
        "coupling_stiffness_n_per_m", "coupling_damping_n_s_per_m", "drag_n_s_per_m", "delay_s", "robot_bandwidth_hz"
    )  # fmt: skip
    expected = {
        "coupling_stiffness_n_per_m": (3e5, 900.0),
        "coupling_damping_n_s_per_m": (150.0, 2.0),
        "drag_n_s_per_m": (330.0, 1.0),
        "delay_s": (2.4e-3, 1e-5),
        "robot_bandwidth_hz": (20.0 / (2.0 * np.pi), 0.06 / (2.0 * np.pi)),
    }
    assert set(found.plants.further) == {*expected, "environment_damping_n_s_per_m"}
    for name, (value, std) in expected.items():
        low, high = found.plants.further[name]
        # Five digits, outwards.
        assert low <= value - REACH * std * (1.0 - 1e-5)
        assert high >= value + REACH * std * (1.0 - 1e-5)
        assert (low, high) == pytest.approx((value - REACH * std, value + REACH * std), rel=1e-4)
    assert found.plants.ellipsoid.covariance[0][1] == pytest.approx(0.6 * 900.0 * 2.0)


def test_without_a_covariance_the_plant_is_the_nominal_one() -> None:
    found = built({}, identified_axis())
    assert found.plants.ellipsoid is None
    assert dict(found.plants.further) == {}


def test_what_is_nominal_or_has_a_range_leaves_the_set() -> None:
    found = built({"delay_s": "nominal", "drag_n_s_per_m": (300.0, 400.0), "robot_bandwidth_hz": "nominal"})
    assert found.plants.ellipsoid is not None
    assert found.plants.ellipsoid.names == ("coupling_stiffness_n_per_m", "coupling_damping_n_s_per_m")
    assert found.plants.further["drag_n_s_per_m"] == (300.0, 400.0)
    assert "delay_s" not in found.plants.further
    assert "robot_bandwidth_hz" not in found.plants.further


def test_a_nominal_value_outside_of_a_range_moves_to_its_end() -> None:
    found = built({"coupling_damping_n_s_per_m": (0.0, 100.0), "environment_damping_n_s_per_m": (5.0, 9.0)})
    assert found.plants.nominal.coupling.damping_n_s_per_m == 100.0
    assert found.plants.nominal.environment.damping_n_s_per_m == 5.0
    slow = built({"robot_bandwidth_hz": (2.0, 3.0), "delay_s": (3e-3, 4e-3)})
    assert slow.plants.nominal_values()["robot_bandwidth_hz"] == pytest.approx(3.0, rel=1e-9)
    assert slow.plants.nominal.robot.delay_s == 3e-3


def test_everything_from_no_damping_of_the_surface_to_its_identified_upper_end_must_be_safe() -> None:
    """The nominal plant keeps none of it: another surface than those of the log may have none."""
    found = built({})
    assert found.plants.nominal.environment.damping_n_s_per_m == 0.0
    low, high = found.plants.further["environment_damping_n_s_per_m"]
    assert low == 0.0
    # 20 ± 10 N·s/m: two deviations, which hold the 1.96 of 95 %; five digits, outwards.
    assert 39.6 <= high <= 40.01
    # Of two surfaces the larger end; one that the log says nothing of adds nothing.
    surface = AXIS.environments[0]
    silent = replace(surface, name="x2", damping_n_s_per_m=absent())
    firm = replace(surface, name="x3", damping_n_s_per_m=replace(known(90.0), status=Status.GIVEN))
    weak = replace(
        surface, name="x4", damping_n_s_per_m=Estimate(value=None, std=None, status=Status.WEAK, ci95=(0.0, 300.0))
    )
    for surfaces, end in (((silent,), None), ((surface, silent), high), ((firm, surface), 90.0), ((weak, firm), 300.0)):
        ranges = built({}, replace(AXIS, environments=surfaces), stiffness=(1e5, 1.2e5)).plants.further
        assert ranges.get("environment_damping_n_s_per_m", (0.0, None))[1] == end


def test_what_the_user_says_of_the_surfaces_damping_wins() -> None:
    assert "environment_damping_n_s_per_m" not in built({"environment_damping_n_s_per_m": "nominal"}).plants.further
    found = built({"environment_damping_n_s_per_m": "identified"})
    # One parameter: 1.96 standard deviations.
    assert found.plants.further["environment_damping_n_s_per_m"] == pytest.approx((0.40036, 39.59964), rel=1e-4)
    assert (
        found.plants.nominal.environment.damping_n_s_per_m == found.plants.further["environment_damping_n_s_per_m"][0]
    )


def test_a_value_that_was_corrected_by_hand_is_not_widened_by_the_log() -> None:
    by_hand = replace(AXIS, drag_n_s_per_m=replace(known(500.0), status=Status.GIVEN))
    found = built({}, by_hand)
    assert found.plants.nominal.payload.drag_n_s_per_m == 500.0
    assert "drag_n_s_per_m" not in found.plants.further


def given(estimate: Estimate, std: float, value: float | None = None) -> Estimate:
    at = estimate.value if value is None else value
    return replace(estimate, value=at, std=std, status=Status.GIVEN)


GIVEN_AXIS = replace(
    identified_axis(),
    coupling=CouplingEstimate(
        stiffness_n_per_m=given(identified_axis().coupling.stiffness_n_per_m, 0.2 * 3e5),
        damping_n_s_per_m=given(identified_axis().coupling.damping_n_s_per_m, 0.1 * 150.0),
    ),
    drag_n_s_per_m=given(identified_axis().drag_n_s_per_m, 0.15 * 330.0),
)


@pytest.mark.parametrize("covariance", [None, COVARIANCE])
def test_what_is_given_with_a_deviation_is_certified_with_it(covariance: Covariance | None) -> None:
    """K_s, B_s and B_p to 10 to 20 %: each of the eight corners at one deviation must be safe."""
    problem = built({}, replace(GIVEN_AXIS, covariance=covariance))
    whole = problem.plants
    middle = Scenario(environment_stiffness_n_per_m=1.1e5, payload_mass_kg=16.0)
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = replace(
            middle,
            coupling_stiffness_n_per_m=3e5 * (1.0 + 0.2 * signs[0]),
            coupling_damping_n_s_per_m=150.0 * (1.0 + 0.1 * signs[1]),
            drag_n_s_per_m=330.0 * (1.0 + 0.15 * signs[2]),
        )
        assert whole.contains(corner)
    assert problem.plants.ellipsoid is not None
    by_name = dict(
        zip(problem.plants.ellipsoid.names, np.diag(np.array(problem.plants.ellipsoid.covariance)), strict=True)
    )
    assert by_name["coupling_stiffness_n_per_m"] == pytest.approx((0.2 * 3e5) ** 2)
    assert by_name["drag_n_s_per_m"] == pytest.approx((0.15 * 330.0) ** 2)
    # The log's correlations do not speak of what was given.
    assert problem.plants.ellipsoid.covariance[0][1] == 0.0


def test_no_corner_at_one_deviation_is_closer_to_instability_than_what_is_claimed() -> None:
    """Taken as exact, a claim of 0.5 stood against 0.38 at the worst corner, here as in the cell that showed it."""
    wanted = replace(FAST_REQUIREMENTS, modulus_margin=0.3, phase_margin_deg=20.0, free_space_admittance=None)
    bounds = {
        "mass": (5.0, 8.0),
        "damping": (500.0, 1600.0),
        "lead_s": (0.0, 0.03),
        "feedback_damping_s": (0.005, 0.005),
    }
    spec = replace(FAST_SPEC, requirements=wanted, bounds=bounds)
    problem = build_problems(with_axis(GIVEN_AXIS), spec)["x"]
    found = solve_design(problem)
    claimed = min(each.margins.modulus for each in found.margins)
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        for stiffness in problem.plants.environment_stiffness_n_per_m:
            corner = Scenario(
                environment_stiffness_n_per_m=stiffness,
                payload_mass_kg=16.0,
                coupling_stiffness_n_per_m=3e5 * (1.0 + 0.2 * signs[0]),
                coupling_damping_n_s_per_m=150.0 * (1.0 + 0.1 * signs[1]),
                drag_n_s_per_m=330.0 * (1.0 + 0.15 * signs[2]),
            )
            loop = build_sampled_plant(problem.plant(corner), problem.sample_time_s)
            # A claim is sampled over the set; the slack of the modulus that is proved is 5 %.
            assert find_margins(loop, problem.controller(found.design)).modulus > 0.95 * claimed


@pytest.mark.parametrize("uncertain", [{}, {"drag_n_s_per_m": "identified"}])
def test_only_a_deviation_of_0_is_exact(uncertain: Uncertain) -> None:
    exact = replace(GIVEN_AXIS, drag_n_s_per_m=given(GIVEN_AXIS.drag_n_s_per_m, 0.0))
    problem = built(uncertain, replace(exact, covariance=COVARIANCE))
    assert "drag_n_s_per_m" not in problem.plants.further
    assert "coupling_stiffness_n_per_m" in problem.plants.further


@pytest.mark.parametrize("uncertain", [{}, {"coupling_stiffness_n_per_m": "identified"}])
def test_a_value_corrected_by_hand_brings_its_own_deviation(uncertain: Uncertain) -> None:
    """Not the old width around the new value: 3e5 ± 900 was identified, 2e5 ± 2e4 is said to be true."""
    coupling = replace(AXIS.coupling, stiffness_n_per_m=given(AXIS.coupling.stiffness_n_per_m, 2e4, 2e5))
    found = built(uncertain, replace(AXIS, coupling=coupling))
    assert found.plants.further["coupling_stiffness_n_per_m"] == pytest.approx(
        (2e5 - REACH * 2e4, 2e5 + REACH * 2e4), rel=1e-4
    )


def test_a_prior_that_took_part_in_the_fit_keeps_the_correlations_of_the_fit() -> None:
    coupling = replace(AXIS.coupling, stiffness_n_per_m=given(AXIS.coupling.stiffness_n_per_m, 900.0))
    found = built({}, replace(AXIS, coupling=coupling))
    assert found.plants.ellipsoid is not None
    assert found.plants.ellipsoid.covariance[0][1] == pytest.approx(0.6 * 900.0 * 2.0)


@pytest.mark.parametrize(
    ("uncertain", "axis", "message"),
    [
        ({"delay_s": "identified"}, identified_axis(), r"delay_s .* axes\.x\.covariance is not in it"),
        ({"robot_damping_ratio": "identified"}, AXIS, r"says nothing of it; give a range"),
        ({"environment_damping_n_s_per_m": "identified"}, identified_axis(), r"says nothing of x1\.B_e"),
    ],
)
def test_an_uncertainty_that_the_file_does_not_show_is_refused(
    uncertain: Uncertain, axis: AxisEstimate, message: str
) -> None:
    with pytest.raises(EstimateError, match=message):
        built(uncertain, axis)


def test_a_damping_ratio_of_a_robot_that_has_none_is_refused() -> None:
    with pytest.raises(AutotuneError, match="two poles and no zero"):
        built({"robot_damping_ratio": (0.5, 0.9)})


def test_frequency_and_damping_of_two_poles_become_bandwidth_and_damping_by_the_chain_rule() -> None:
    """Against draws of the original parameters, sent through the exact map."""
    mean, spread = np.array([30.0, 0.8]), np.array([[0.04, 2e-4], [2e-4, 4e-5]])
    covariance = Covariance(
        names=("omega", "zeta"),
        values=(30.0, 0.8),
        matrix=((0.04, 2e-4), (2e-4, 4e-5)),
    )
    robot = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=2.4e-3)
    problem = design_problem()
    problem = replace(problem, plants=replace(problem.plants, nominal=replace(problem.plants.nominal, robot=robot)))
    found = with_uncertainty(problem, replace(AXIS, covariance=covariance), "x", {})
    assert found.plants.ellipsoid is not None
    assert found.plants.ellipsoid.names == ("robot_bandwidth_hz", "robot_damping_ratio")
    draws = np.random.default_rng(2).multivariate_normal(mean, spread, 40000)
    sent = np.array([[w * bandwidth_share(z) / (2.0 * np.pi), z] for w, z in draws])
    # A share of 2 % is three standard deviations of a variance from 40,000 draws, and the map is nearly linear.
    np.testing.assert_allclose(np.array(found.plants.ellipsoid.covariance), np.cov(sent.T), rtol=0.03)


def test_ranges_stay_where_they_were_said_and_origins_hold_for_turning_axes_too() -> None:
    spec = ProblemSpec(
        uncertain={"delay_s": "nominal", "drag_n_s_per_m": (1.0, 2.0)},
        rotational=RotationalSpec(uncertain={"drag_n_s_per_m": (0.1, 0.2)}),
    )
    turned = through_lever(spec, Approach(force_n=30.0))
    assert dict(turned.uncertain) == {"delay_s": "nominal", "drag_n_s_per_m": (0.1, 0.2)}


def test_a_damping_of_which_only_an_interval_is_reported_is_that_interval() -> None:
    bounded = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE, ci95=(0.0, 63.0))
    coupling = replace(AXIS.coupling, damping_n_s_per_m=bounded)
    axis = replace(AXIS, coupling=coupling, drag_n_s_per_m=replace(bounded, ci95=(200.0, 300.0)))
    found = built({}, axis)
    assert found.plants.further["coupling_damping_n_s_per_m"] == (0.0, 63.0)
    assert found.plants.further["drag_n_s_per_m"] == (200.0, 300.0)
    assert (
        found.plants.nominal.coupling.damping_n_s_per_m,
        found.plants.nominal.payload.drag_n_s_per_m,
    ) == pytest.approx((31.5, 250.0))
    assert found.plants.ellipsoid is not None
    assert "coupling_damping_n_s_per_m" not in found.plants.ellipsoid.names
    said = built({"coupling_damping_n_s_per_m": (10.0, 20.0)}, axis)
    assert said.plants.further["coupling_damping_n_s_per_m"] == (10.0, 20.0)
    with pytest.raises(EstimateError, match="drag_n_s_per_m is not identified"):
        built({}, replace(axis, drag_n_s_per_m=replace(bounded, ci95=None)))
