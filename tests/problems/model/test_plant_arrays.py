"""Many plants as arrays against the same plants one by one."""

from dataclasses import replace

import numpy as np
import pytest

from problems.errors import ParameterError
from problems.model.plant import WrenchFilter
from problems.model.plant_arrays import build_plant_arrays
from problems.model.plant_parameters import with_values
from problems.model.robot import RobotModel
from tests.problems.axes import one_pole, paper_plant

TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=2.4e-3)
ZERO = RobotModel(numerator=np.array([30.0, 900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=2.4e-3)
SPANS = {
    "environment_stiffness_n_per_m": (2e4, 5e5),
    "payload_mass_kg": (8.0, 16.0),
    "coupling_stiffness_n_per_m": (2e5, 3e5),
    "coupling_damping_n_s_per_m": (0.0, 100.0),
    "drag_n_s_per_m": (100.0, 600.0),
    "environment_damping_n_s_per_m": (0.0, 50.0),
    "delay_s": (1e-3, 3e-3),
    "robot_bandwidth_hz": (3.0, 5.0),
    "robot_damping_ratio": (0.6, 1.2),
    "wrench_time_constant_s": (1e-3, 2e-3),
    "wrench_delay_s": (0.0, 1e-3),
}


@pytest.mark.parametrize(
    ("robot", "names"),
    [
        pytest.param(one_pole(), ["payload_mass_kg"], id="one parameter"),
        pytest.param(one_pole(), [name for name in SPANS if name != "robot_damping_ratio"], id="one pole"),
        pytest.param(TWO_POLES, [*SPANS], id="two poles"),
        pytest.param(TWO_POLES, ["robot_damping_ratio"], id="damping ratio alone"),
        pytest.param(ZERO, ["robot_bandwidth_hz", "wrench_delay_s"], id="with a zero"),
    ],
)
@pytest.mark.parametrize("filtered", [False, True])
def test_every_row_is_the_plant_with_these_values(robot: RobotModel, names: list[str], *, filtered: bool) -> None:
    nominal = paper_plant(robot=robot)
    if filtered:
        nominal = replace(nominal, wrench_filter=WrenchFilter(time_constant_s=1.5e-3, delay_s=5e-4))
    rng = np.random.default_rng(3)
    values = {name: rng.uniform(*SPANS[name], 5) for name in names}
    found = build_plant_arrays(nominal, values)
    assert found.count == 5
    for i in range(5):
        plant = with_values(nominal, {name: float(column[i]) for name, column in values.items()})
        numerator, denominator = plant.robot.ascending()
        np.testing.assert_allclose(found.numerators[i], numerator, rtol=1e-12)
        np.testing.assert_allclose(found.denominators[i], denominator, rtol=1e-12)
        np.testing.assert_array_equal(found.parameters[i], plant.parameters())
        assert found.delay_s[i] == pytest.approx(plant.loop_delay_s, rel=1e-15)
        assert found.wrench_delay_s[i] == plant.wrench_filter.delay_s


def test_a_damping_ratio_is_of_a_robot_that_has_one() -> None:
    with pytest.raises(ParameterError, match="robot_damping_ratio"):
        build_plant_arrays(paper_plant(), {"robot_damping_ratio": np.array([0.7])})
