"""Force and travel of the axes of a log without a payload's mass, and what is a blow in them."""

from dataclasses import replace

import numpy as np

from identification.touches.signals import axis_signals
from identification.touches.surfaces import identify_touches
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


def test_a_slow_press_that_is_held_has_no_blow() -> None:
    """12 mm/s into 15 N/mm and back 1 s later: its largest force is that of its depth, whatever its speed."""
    time = np.arange(0.0, 8.0, 4e-3)
    travel = np.interp(time, [0.0, 1.0, 4.0, 5.5, 8.0], [0.0, 0.0, 0.036, 0.036, 0.0])
    press = 15e3 * np.maximum(travel - 0.0335, 0.0)
    swing = np.where(
        time > 3.79, 12.0 * np.exp(-(time - 3.79) / 0.05) * np.sin(2.0 * np.pi * 12.0 * (time - 3.79)), 0.0
    )
    for force, has_blow in ((press, False), (np.maximum(press + 3.0 * swing, 0.0), True)):
        [surface] = identify_touches(logged(travel, -force, 4e-3, 0.0)).surfaces["z"]
        assert (surface.impact_n_s_per_m is not None) == has_blow
    [surface] = identify_touches(logged(travel, -press, 4e-3, 0.0)).surfaces["z"]
    secant = surface.secant_stiffness_n_per_m
    assert secant.value is not None
    assert abs(secant.value - 15e3) < 0.05 * 15e3
