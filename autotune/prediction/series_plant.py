"""A plant without payload: the robot in series with a spring between the flange and a surface."""

import math
from dataclasses import replace

from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant, WrenchFilter
from problems.model.robot import RobotModel

# The massless plant: its own mode must be far above everything that is asked of it, in rad/s, and is followed between
# the samples at this many radians per sample, the slower the faster; and the share of that mode's critical damping.
_SWING_RAD_S, _LEAST_SWING, _MOST_SWING, _DAMPED = 2000.0, 2.0, 8.0, 0.1


def series_plant(
    robot: RobotModel,
    stiffness_n_per_m: float,
    period_s: float,
    *,
    damping_n_s_per_m: float = 0.0,
    wrench_filter: WrenchFilter | None = None,
) -> Plant:
    """Return a plant whose force is the stiffness times the flange's way: robot and spring, no payload.

    Half of the compliance lies in the coupling; the mass between both halves is so small that its mode is far above
    the sampling, and damped by so little that the force is the spring's.
    """
    half = 2.0 * stiffness_n_per_m
    swing = min(max(_SWING_RAD_S * period_s, _LEAST_SWING), _MOST_SWING)
    mass = 2.0 * half * (period_s / swing) ** 2
    # Each spring with half of the damping: the mass is damped in free motion too, and still moves by half of the way.
    own = _DAMPED * math.sqrt(2.0 * half * mass)
    # The surface moves by half of the flange's way, and half of its damping's force passes the coupling.
    return replace(
        Plant(
            robot=robot,
            coupling=Coupling(stiffness_n_per_m=half, damping_n_s_per_m=own),
            payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=0.0),
            environment=Environment(stiffness_n_per_m=half, damping_n_s_per_m=own + 4.0 * damping_n_s_per_m),
        ),
        wrench_filter=wrench_filter or WrenchFilter(),
    )
