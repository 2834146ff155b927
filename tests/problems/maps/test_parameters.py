"""What a map can vary: names, values and what follows from them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.errors import ParameterError
from problems.maps.loops import designs_around
from problems.maps.maps import MapAxis
from problems.maps.parameters import MAP_PARAMETERS, controller_at, find_parameter, plant_at, value_of
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from tests.problems.axes import LAW, between, controllers, plants
from tests.problems.map_cases import DAMPING, LEAD, MASS, request


@LAW
@given(plants(), controllers(), st.sampled_from(list(MAP_PARAMETERS)), between(0.5, 2.0))
def test_a_parameter_that_is_set_has_that_value_and_no_other_changes(
    plant: Plant, controller: AdmittanceController, name: str, factor: float
) -> None:
    before = {each: value_of(each, plant, controller) for each in MAP_PARAMETERS}
    if math.isnan(before[name]):
        with pytest.raises(ParameterError, match="one pole"):
            plant_at(plant, {name: 20.0})
        return
    value = factor * before[name] if before[name] > 0.0 else 0.01 * factor
    changed = plant_at(plant, {name: value}), controller_at(controller, {name: value})
    after = {each: value_of(each, *changed) for each in MAP_PARAMETERS}
    # sqrt and square of a double differ by a few units of its last place.
    assert after[name] == pytest.approx(value, rel=1e-14)
    payload = {"payload_mass", "drag", "payload_frequency_rad_per_s", "payload_damping_ratio"}
    moved = payload if name in payload | {"coupling_stiffness"} else set()
    for each in set(MAP_PARAMETERS) - moved - {name}:
        assert after[each] == before[each] or math.isnan(before[each])


@LAW
@given(plants(), between(20.0, 500.0), between(0.01, 1.0), between(5e4, 1e6))
def test_frequency_and_damping_ratio_hold_whatever_else_is_set(
    plant: Plant, omega: float, zeta: float, stiffness: float
) -> None:
    values = {"payload_frequency_rad_per_s": omega, "payload_damping_ratio": zeta, "coupling_stiffness": stiffness}
    changed = plant_at(plant, values)
    assert changed.coupling.stiffness_n_per_m == stiffness
    assert math.sqrt(stiffness / changed.payload.mass_kg) == pytest.approx(omega, rel=1e-14)
    critical = 2.0 * math.sqrt(changed.payload.mass_kg * stiffness)
    assert changed.payload.drag_n_s_per_m / critical == pytest.approx(zeta, rel=1e-14)


def test_a_fixed_damping_ratio_goes_along_with_the_mass() -> None:
    asked = request(x=MASS, fixed={"payload_damping_ratio": 0.1})
    for mass in (4.0, 60.0):
        plant, _ = asked.point(mass, 0.01)
        assert plant.payload.drag_n_s_per_m == pytest.approx(0.2 * math.sqrt(mass * 3e5))


@LAW
@given(controllers(), st.lists(between(200.0, 5000.0), min_size=1, max_size=3))
def test_rows_of_numbers_are_the_controllers_they_stand_for(
    controller: AdmittanceController, dampings: list[float]
) -> None:
    designs = designs_around(controller, {"damping": np.array(dampings)})
    assert designs.count == len(dampings)
    for i, damping in enumerate(dampings):
        assert designs.controller(i) == replace(controller, damping_n_s_per_m=damping)
    assert designs_around(controller, {}).controller(0) == controller


def test_parameters_are_found_by_name_and_symbol() -> None:
    for name, parameter in MAP_PARAMETERS.items():
        assert find_parameter(name) is parameter
        assert find_parameter(parameter.symbol) is parameter
    assert find_parameter("damping").unit_of(rotational=True) == "N·m·s/rad"
    assert MapAxis(name="K_l", low=0.0, high=1.0, count=2).name == "lead_s"


@pytest.mark.parametrize("axis", [LEAD, DAMPING, MapAxis(name="K_e", low=0.1, high=0.3, count=7, spacing="log")])
def test_the_ends_of_a_range_are_values_of_it(axis: MapAxis) -> None:
    values = axis.values()
    assert (len(values), values[0], values[-1]) == (axis.count, axis.low, axis.high)
    steps = np.diff(np.log(values) if axis.spacing == "log" else values)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
