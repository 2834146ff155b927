"""Many plants at once as arrays: one plant, with some of its parameters at many values."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..errors import ParameterError
from .plant import PLANT_PARAMETERS, Plant
from .plant_parameters import PARAMETERS
from .robot import bandwidth_hz, bandwidth_share, has_damping_ratio


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantArrays:
    """Plants (p,) of one robot order, row by row.

    `numerators` (p, n) and `denominators` (p, n + 1) are those of `RobotModel.ascending`, `parameters` (p, 7), or
    (p, 8) of a filtered wrench, those of `Plant.parameters`; `delay_s` (p,) are T_d and the wrench's delay together,
    and `wrench_delay_s` (p,) the latter.
    """

    numerators: FloatArray
    denominators: FloatArray
    parameters: FloatArray
    delay_s: FloatArray
    wrench_delay_s: FloatArray

    @property
    def count(self) -> int:
        """How many plants there are."""
        return len(self.parameters)


def build_plant_arrays(nominal: Plant, values: Mapping[str, FloatArray]) -> PlantArrays:
    """Return the plants that `with_values` makes of one, for columns (p,) of values by the parameters' names.

    The values are the caller's to check. Raises ParameterError for a damping ratio of a robot that has none.
    """
    count = len(next(iter(values.values())))
    filtered = "wrench_time_constant_s" in values or nominal.wrench_filter.time_constant_s > 0.0
    parameters = np.zeros((count, PLANT_PARAMETERS + int(filtered)))
    own = nominal.parameters()
    parameters[:, : len(own)] = own
    for name, column in values.items():
        place = PLANT_PARAMETERS if name == "wrench_time_constant_s" else PARAMETERS[name].place
        if place is not None:
            parameters[:, place] = column
    numerators, denominators = _robots(nominal, values, count)
    wrench = values.get("wrench_delay_s", np.full(count, nominal.wrench_filter.delay_s))
    return PlantArrays(
        numerators=numerators,
        denominators=denominators,
        parameters=parameters,
        delay_s=values.get("delay_s", np.full(count, nominal.robot.delay_s)) + wrench,
        wrench_delay_s=wrench,
    )


def _robots(nominal: Plant, values: Mapping[str, FloatArray], count: int) -> tuple[FloatArray, FloatArray]:
    """Return what `vary_robot` makes of the robot, in ascending powers of s."""
    robot = nominal.robot
    numerator, denominator = robot.ascending()
    ratio, wanted = values.get("robot_damping_ratio"), values.get("robot_bandwidth_hz")
    if ratio is not None:
        if not has_damping_ratio(robot):
            raise ParameterError("robot_damping_ratio", ratio, "asked of a robot with two poles and no zero")
        bandwidth = np.full(count, bandwidth_hz(robot)) if wanted is None else wanted
        omega = 2.0 * np.pi * bandwidth / np.array([bandwidth_share(float(each)) for each in ratio])
        nothing, one = np.zeros(count), np.ones(count)
        return np.stack([omega**2, nothing], axis=1), np.stack([omega**2, 2.0 * ratio * omega, one], axis=1)
    slower = np.ones(count) if wanted is None else bandwidth_hz(robot) / wanted
    # Another bandwidth b makes r(s) into r(s b₀/b); the leading coefficient stays 1.
    powers = slower[:, None] ** (np.arange(robot.order + 1) - robot.order)
    return numerator * powers[:, :-1], denominator * powers
