"""Force and travel of the axes of a log without a payload's mass."""

from dataclasses import replace

import numpy as np

from identification.touches.signals import axis_signals
from tests.identification.touches.test_find import logged


def test_a_position_along_one_axis_shows_the_way_along_it() -> None:
    time = np.arange(0.0, 4.0, 4e-3)
    travel = np.minimum(0.03 * time, 0.061)
    whole = logged(travel, -2e4 * np.maximum(travel - 0.06, 0.0), 4e-3, 15.0)
    axis = int(np.argmax(np.ptp(whole.pose.position_m, axis=0)))
    alone = np.array(whole.pose.position_m)
    alone[:, [i for i in range(3) if i != axis]] = np.nan
    lacking = replace(whole, pose=replace(whole.pose, position_m=alone, measured_axes=("xyz"[axis],)))
    (found,), (of_all,) = ([each for each in axis_signals(log) if each.axis == "xyz"[axis]] for log in (lacking, whole))
    np.testing.assert_allclose(found.travel_m, of_all.travel_m, atol=1e-12)
    np.testing.assert_allclose(found.travel_m, travel - travel[0], atol=1e-12)
