import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.contact.transient import Approach
from problems.design.problem import (
    DEFAULT_BOUNDS,
    VARIABLES,
    AdmittanceTarget,
    DesignProblem,
    NoiseLimit,
    PassivityTarget,
    Requirements,
)
from problems.design.uncertainty import Ellipsoid, Scenario
from problems.errors import ParameterError
from tests.problems.axes import LAW, between, paper_problem


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("environment_stiffness_n_per_m", (5e5, 2e4)),
        ("environment_stiffness_n_per_m", (0.0, 5e5)),
        ("environment_stiffness_n_per_m", (-1.0, 5e5)),
        ("environment_stiffness_n_per_m", (2e4, math.inf)),
        ("environment_stiffness_n_per_m", ()),
        ("payload_mass_kg", (16.0, 8.0)),
        ("payload_mass_kg", (0.0, 8.0)),
        ("payload_mass_kg", (math.nan, 8.0)),
        ("payload_mass_kg", (8.0,)),
        ("sample_time_s", 0.0),
        ("sample_time_s", math.nan),
        ("drag_n_s_per_m", -1.0),
        ("environment_damping_n_s_per_m", -1.0),
    ],
)
def test_ranges_that_cannot_be_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ParameterError) as refusal:
        paper_problem(**{name: value})
    assert refusal.value.name == name


@pytest.mark.parametrize(
    ("bounds", "must"),
    [
        ({"mas": (5.0, 10.0)}, "mass, damping, lead_s, feedback_damping_s"),
        ({"mass": (10.0, 5.0)}, "from low to high"),
        ({"mass": (0.0, 5.0)}, "above 0"),
        ({"damping": (0.0, 5.0)}, "above 0"),
        ({"lead_s": (-0.1, 0.1)}, "not below 0"),
        ({"feedback_damping_s": (0.0, math.nan)}, "finite"),
        ({"feedback_damping_s": (0.0, 2e-5)}, "0 or at least 0.0001 s"),
        ({"feedback_damping_s": (2e-5, 0.05)}, "0 or at least 0.0001 s"),
    ],
)
def test_bounds_that_cannot_be_are_refused(bounds: dict[str, tuple[float, float]], must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        paper_problem(bounds=bounds)


def test_a_bound_that_is_not_given_is_the_usual_one() -> None:
    found = paper_problem(bounds={"mass": (9.0, 9.0)}).bounds
    assert tuple(found) == VARIABLES
    assert dict(found) == dict(DEFAULT_BOUNDS) | {"mass": (9.0, 9.0)}


def test_a_problem_cannot_be_changed_afterwards() -> None:
    bounds = {"mass": (9.0, 20.0)}
    found = paper_problem(bounds=bounds)
    bounds["mass"] = (1.0, 2.0)
    assert found.bounds["mass"] == (9.0, 20.0)
    with pytest.raises(TypeError):
        found.bounds["mass"] = (1.0, 2.0)  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.sample_time_s = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    "name",
    ["modulus_margin", "gain_margin_db", "phase_margin_deg", "delay_margin_s", "decay_rate_per_s", "max_peak_force_n"],
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_requirement_is_positive_or_absent(name: str, value: float) -> None:
    with pytest.raises(ParameterError) as refusal:
        dataclasses.replace(Requirements(), **{name: value})  # type: ignore[arg-type]
    assert refusal.value.name == name
    assert getattr(dataclasses.replace(Requirements(), **{name: None}), name) is None  # type: ignore[arg-type]


def test_a_modulus_margin_of_one_is_out_of_reach() -> None:
    with pytest.raises(ParameterError, match="below 1"):
        Requirements(modulus_margin=1.0)
    assert Requirements(modulus_margin=0.99).modulus_margin == 0.99


@pytest.mark.parametrize(
    ("value", "band"), [(0.0, (0.1, 2.0)), (5e-4, (2.0, 0.1)), (5e-4, (0.0, 2.0)), (math.nan, (0.1, 2.0))]
)
def test_an_admittance_target_that_cannot_be_is_refused(value: float, band: tuple[float, float]) -> None:
    with pytest.raises(ParameterError):
        AdmittanceTarget(min_m_s_per_n=value, band_hz=band)


def test_the_admittance_band_lies_below_half_the_sampling_rate() -> None:
    inside, outside = (
        Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=1e-4, band_hz=(0.1, top)))
        for top in (624.0, 625.0)
    )
    assert paper_problem(requirements=inside).requirements is inside
    with pytest.raises(ParameterError, match="half the sampling rate"):
        paper_problem(requirements=outside)


@LAW
@given(
    between(1e2, 1e6),
    st.one_of(st.just(1.0), between(1.001, 1e3)),
    between(0.5, 50.0),
    st.one_of(st.just(0.0), st.floats(0.01, 40.0)),
    st.integers(2, 9),
    st.integers(2, 9),
)
def test_a_grid_of_scenarios_has_the_ends_to_the_last_bit(
    low: float, ratio: float, mass: float, more: float, stiffnesses: int, masses: int
) -> None:
    high, heavy = low * ratio, mass + more
    found = paper_problem(environment_stiffness_n_per_m=(low, high), payload_mass_kg=(mass, heavy)).scenarios(
        stiffnesses, masses
    )
    corners = {(s.environment_stiffness_n_per_m, s.payload_mass_kg) for s in found}
    assert {(k, m) for k in (low, high) for m in (mass, heavy)} <= corners
    assert all(low <= k <= high and mass <= m <= heavy for k, m in corners)
    assert len(found) == len(corners) == (stiffnesses if high > low else 1) * (masses if heavy > mass else 1)


def test_a_grid_has_equal_ratios_of_stiffness_and_equal_steps_of_mass() -> None:
    found = paper_problem(environment_stiffness_n_per_m=(1e3, 1e5), payload_mass_kg=(8.0, 16.0)).scenarios(3, 3)
    # Rounding of two logarithms.
    assert [s.environment_stiffness_n_per_m for s in found[:3]] == pytest.approx([1e3, 1e4, 1e5], rel=1e-14)
    assert [s.payload_mass_kg for s in found[::3]] == [8.0, 12.0, 16.0]


def test_a_range_that_is_a_point_gives_one_scenario() -> None:
    found = paper_problem(environment_stiffness_n_per_m=(2e4, 2e4), payload_mass_kg=(16.0, 16.0)).scenarios(5, 5)
    assert found == (Scenario(environment_stiffness_n_per_m=2e4, payload_mass_kg=16.0),)


def test_the_plant_of_a_scenario_is_the_problems_with_that_wall_and_mass() -> None:
    asked = paper_problem(environment_damping_n_s_per_m=40.0)
    plant = asked.plant(Scenario(environment_stiffness_n_per_m=7e4, payload_mass_kg=9.0))
    assert (plant.environment.stiffness_n_per_m, plant.environment.damping_n_s_per_m) == (7e4, 40.0)
    assert (plant.payload.mass_kg, plant.payload.drag_n_s_per_m) == (9.0, 630.0)
    assert (plant.robot, plant.coupling) == (asked.plants.nominal.robot, asked.plants.nominal.coupling)


def test_a_design_vector_is_a_controller_in_the_order_of_the_variables() -> None:
    found = paper_problem(velocity_filter_rad_per_s=90.0).controller([13.0, 1000.0, 0.02, 7.5e-3])
    assert found.parameters().tolist() == [13.0, 1000.0, 0.02, 7.5e-3, 90.0, 200.0, 0.0]
    design = np.array([[13.0, 1000.0, 0.02, 5e-5]])
    for keeps, feedback in ((False, 0.0), (True, 5e-5)):
        (alone,) = paper_problem(velocity_filter_rad_per_s=90.0).parameters(design, keeps_small=keeps)
        assert alone.tolist() == [13.0, 1000.0, 0.02, feedback, 90.0, 200.0, 0.0]


@pytest.mark.parametrize(("asked", "found"), [(0.0, 0.0), (9.9e-5, 0.0), (1e-4, 1e-4)])
def test_feedback_damping_too_small_to_be_seconds_is_none(asked: float, found: float) -> None:
    """docs/method.md, erratum 2."""
    assert paper_problem().controller([13.0, 1000.0, 0.02, asked]).feedback_damping_s == found


def test_the_approach_of_the_paper_is_driven_by_a_force() -> None:
    assert paper_problem().approach == Approach(force_n=30.0)


K_S, T_D = "coupling_stiffness_n_per_m", "delay_s"
CUT = Ellipsoid(names=(K_S, T_D), centre=(3e5, 2.4e-3), covariance=((9e6, 0.048), (0.048, 4e-10)))
UNCERTAIN = {K_S: (2.9e5, 3.1e5), T_D: (2.3e-3, 2.5e-3), "drag_n_s_per_m": (600.0, 700.0)}


def uncertain_problem() -> DesignProblem:
    return paper_problem(further=UNCERTAIN, ellipsoid=CUT, requirements=Requirements(max_peak_force_n=80.0))


def test_ranges_beyond_stiffness_and_mass_belong_to_the_uncertainty() -> None:
    found = uncertain_problem()
    assert found.plants.varying == ("environment_stiffness_n_per_m", "payload_mass_kg", K_S, "drag_n_s_per_m", T_D)
    assert paper_problem().plants.varying == ("environment_stiffness_n_per_m", "payload_mass_kg")
    # The grid stays at the nominal plant.
    assert all(found.plant(s).coupling == found.plants.nominal.coupling for s in found.scenarios(3, 3))


@pytest.mark.parametrize(
    ("uncertain", "must"),
    [
        ({K_S: (1e5, 2e5)}, "around the nominal value"),
        ({"payload_mass_kg": (8.0, 9.0)}, "the problem's own range"),
        ({"robot_damping_ratio": (0.5, 0.9)}, "two poles and no zero"),
        ({"mass": (1.0, 2.0)}, "one of"),
    ],
)
def test_an_uncertainty_that_cannot_be_is_refused(uncertain: dict[str, tuple[float, float]], must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        paper_problem(further=uncertain)


def wished_problem() -> DesignProblem:
    return paper_problem(
        bounds={"velocity_filter_rad_per_s": (60.0, 300.0), "compensation_mass_kg": (0.0, 16.0)},
        requirements=Requirements(
            command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.2),
            passivity=PassivityTarget(passive_below_hz=10.0),
            soft_n={"modulus_margin": 20.0, "passivity": 3.0},
        ),
    )


def test_variables_that_are_made_free_follow_the_four_in_a_fixed_order() -> None:
    found = wished_problem()
    assert found.variables == (*VARIABLES, "velocity_filter_rad_per_s", "compensation_mass_kg")
    law = found.controller([13.0, 1000.0, 0.02, 7.5e-3, 80.0, 5.0])
    assert law.parameters().tolist() == [13.0, 1000.0, 0.02, 7.5e-3, 80.0, 200.0, 5.0]
    assert paper_problem().variables == VARIABLES


@pytest.mark.parametrize(
    ("bounds", "must"),
    [
        ({"acceleration_filter_rad_per_s": (60.0, 400.0)}, "unless compensation_mass_kg is free too"),
        ({"velocity_filter_rad_per_s": (0.0, 300.0)}, "above 0"),
        ({"compensation_mass_kg": (5.0, 1.0)}, "an interval"),
        ({"collision_threshold_n": (5.0, 10.0)}, "given for mass"),
    ],
)
def test_variables_that_cannot_be_free_are_refused(bounds: dict[str, tuple[float, float]], must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        paper_problem(bounds=bounds)


def test_soft_limits_and_requirements_are_distinguished_in_print() -> None:
    text = str(wished_problem())
    for reported in (
        "free: compensation_mass_kg          0 to 16",
        "soft: modulus margin                0.5, or 20 N per share missed",
        "soft: passivity                     up to 10 Hz, or 3 N per share missed",
        "required: command noise             speed RMS at most 0.001 m/s under noise of 0.2 N",
        "required: free-space admittance     0.0007 m/s/N, 0.1 to 2 Hz",
    ):
        assert reported in text


def test_a_problem_can_be_read_by_people() -> None:
    text = str(uncertain_problem())
    for reported in (
        "minimise                            the peak contact force, worst over the whole uncertainty",
        "free: mass                          5 to 100",
        "uncertain: K_s                      290000 to 310000  (coupling_stiffness_n_per_m)",
        "cut by                              the 95 % confidence set of K_s, T_d",
        "required: peak force                at most 80 N",
    ):
        assert reported in text
