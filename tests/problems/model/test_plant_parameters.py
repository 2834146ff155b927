"""The table of the plant's parameters: every row is read and written where it says, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.design.uncertainty import UNCERTAIN, Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import rotational_name
from problems.model.plant import FREE_SPACE, Plant, WrenchFilter
from problems.model.plant_parameters import PARAMETERS, build_plant, with_values
from problems.model.robot import RobotModel
from tests.problems.axes import LAW, between, one_pole, paper_plant

TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.4e-3)
CELL = replace(
    paper_plant(coupling_damping=150.0, environment_damping=40.0, environment_mass=0.5, robot=TWO_POLES),
    wrench_filter=WrenchFilter(time_constant_s=3e-3, delay_s=1e-3),
)


def values(plant: Plant) -> dict[str, float]:
    return {name: each.value(plant) for name, each in PARAMETERS.items()}


@LAW
@given(st.sampled_from(list(PARAMETERS)), between(0.5, 2.0))
def test_setting_one_parameter_changes_that_one_alone(name: str, factor: float) -> None:
    before, asked = values(CELL), factor * PARAMETERS[name].value(CELL)
    after = values(with_values(CELL, {name: asked}))
    # The bandwidth and the ratio are worked out from the coefficients again.
    assert after == pytest.approx({**before, name: asked}, rel=1e-9)


def test_the_equations_take_each_value_at_its_place() -> None:
    found = CELL.parameters()
    added = np.zeros(len(found))
    for each in PARAMETERS.values():
        if each.place is not None:
            added[each.place] += each.value(CELL)
    assert [*added[:-1], CELL.wrench_filter.time_constant_s] == found.tolist()


def test_a_plant_is_built_of_its_values_as_it_was() -> None:
    parts = ("environment", "payload", "coupling", "wrench_filter")
    said = {name: value for name, value in values(CELL).items() if PARAMETERS[name].part in parts}
    assert build_plant(TWO_POLES, said) == CELL
    free = {name: value for name, value in said.items() if PARAMETERS[name].part != "environment"}
    assert build_plant(TWO_POLES, free).environment == FREE_SPACE


def test_a_value_that_cannot_be_is_refused_by_the_name_that_was_said() -> None:
    with pytest.raises(ParameterError, match="environment_damping_n_s_per_m must be finite and not below 0"):
        with_values(CELL, {"environment_damping_n_s_per_m": -1.0})
    with pytest.raises(ParameterError, match="two poles"):
        with_values(replace(CELL, robot=one_pole()), {"robot_damping_ratio": 0.7})


def test_a_scenario_may_say_everything_that_may_vary() -> None:
    said = {name: 0.9 * PARAMETERS[name].value(CELL) for name in UNCERTAIN}
    found = values(Scenario(**said).plant(CELL))
    assert found == pytest.approx({**values(CELL), **said}, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "turning"),
    [
        ("environment_stiffness_n_per_m", "environment_stiffness_n_m_per_rad"),
        ("drag_n_s_per_m", "drag_n_m_s_per_rad"),
        ("payload_mass_kg", "payload_inertia_kg_m2"),
        ("approach_speed_m_s", "approach_speed_rad_s"),
        ("max_speed_rms_m_s", "max_speed_rms_rad_s"),
        ("min_m_s_per_n", "min_rad_s_per_n_m"),
        ("hand_force_n_per_m_s", "hand_torque_n_m_per_rad_s"),
        ("peak_sensor_force_n", "peak_sensor_torque_n_m"),
        ("soft_n", "soft_n_m"),
        ("delay_s", "delay_s"),
        ("robot_bandwidth_hz", "robot_bandwidth_hz"),
    ],
)
def test_an_entry_is_named_by_the_unit_that_it_has_about_an_axis(name: str, turning: str) -> None:
    assert rotational_name(name) == turning
