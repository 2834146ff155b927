"""Sets of plants for the tests of proofs, and the eigenvalues that judge one."""

import numpy as np
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.design.uncertainty import PlantSet
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import Controller, build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import ANY_DELAYS, PERIOD_S, between, one_pole, or_zero, robots


def uncertain(
    *,
    robot: RobotModel | None = None,
    coupling: float = 3e5,
    coupling_damping: float = 0.0,
    drag: float = 630.0,
    environment_damping: float = 0.0,
    mass: tuple[float, float] = (15.0, 17.0),
    stiffness: tuple[float, float] = (5e4, 3e5),
    wrench_filter: WrenchFilter = NO_FILTER,
) -> PlantSet:
    """Return the paper's cell with ranges of mass and stiffness."""
    return PlantSet.of(
        robot if robot is not None else one_pole(),
        coupling_stiffness_n_per_m=coupling,
        coupling_damping_n_s_per_m=coupling_damping,
        drag_n_s_per_m=drag,
        environment_damping_n_s_per_m=environment_damping,
        payload_mass_kg=mass,
        environment_stiffness_n_per_m=stiffness,
        wrench_filter=wrench_filter,
    )


@st.composite
def uncertain_plants(draw: st.DrawFn) -> PlantSet:
    """Draw robots of one and two poles, whole, fractional and no delays, damped and undamped walls and couplings."""
    lightest, softest = draw(between(5.0, 40.0)), draw(between(1e4, 3e5))
    return uncertain(
        robot=draw(robots(ANY_DELAYS)),
        coupling=draw(between(1e5, 6e5)),
        coupling_damping=draw(or_zero(between(30.0, 500.0))),
        drag=draw(between(150.0, 1000.0)),
        environment_damping=draw(or_zero(between(5.0, 300.0))),
        mass=(lightest, lightest * draw(st.sampled_from((1.0, 1.02, 1.1)))),
        stiffness=(softest, softest * draw(st.sampled_from((1.0, 1.2, 1.6)))),
    )


def radius_at(plants: PlantSet, law: Controller, mass: float, stiffness: float) -> float:
    """Return the largest |z| of one loop of the set, straight from its eigenvalues."""
    return spectral_radius(build_loop(build_sampled_plant(plants.at(mass, stiffness), PERIOD_S), law))


def radii(plants: PlantSet, law: Controller, points: list[tuple[float, float]]) -> FloatArray:
    """Return the largest |z| at points (M_p, K_e)."""
    return np.array([radius_at(plants, law, mass, stiffness) for mass, stiffness in points])


def random_points(plants: PlantSet, count: int, *, seed: int = 0) -> list[tuple[float, float]]:
    """Return the corners and `count` random points of the set."""
    rng = np.random.default_rng(seed)
    masses = rng.uniform(*plants.payload_mass_kg, count)
    stiffness = rng.uniform(*plants.environment_stiffness_n_per_m, count)
    corners = [(m, k) for m in plants.payload_mass_kg for k in plants.environment_stiffness_n_per_m]
    return [*corners, *((float(m), float(k)) for m, k in zip(masses, stiffness, strict=True))]
