"""Plants and controllers that the tests of this floor share: the paper's cell and random ones around it."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from problems.contact.transient import Approach, SampledContact, build_sampled_contact
from problems.design.problem import DesignProblem
from problems.design.uncertainty import PlantSet
from problems.model.controller import (
    AdmittanceController,
    Compensation,
    Discretization,
    controller_blocks,
    needed_states,
)
from problems.model.linear_controllers import LinearController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant, controller_matrix, controller_rest

PERIOD_S = 8e-4
DELAY_S = 2.4e-3
PRESS = Approach(force_n=30.0)

# A law is checked on the same cases everywhere: a failure on one machine is a failure on all of them.
LAW = settings(deadline=None, max_examples=30)


def one_pole(delay_s: float = DELAY_S, bandwidth_rad_per_s: float = 20.0) -> RobotModel:
    return RobotModel.from_bandwidth(bandwidth_rad_per_s=bandwidth_rad_per_s, delay_s=delay_s)


def linear_controller(controller: AdmittanceController, sample_time_s: float) -> LinearController:
    """Return the sampled form of an admittance controller as a law like any other."""
    blocks = controller_blocks(controller, sample_time_s)
    matrix, kept = controller_matrix(controller, sample_time_s), needed_states(blocks)
    return LinearController(matrix=matrix, rest=controller_rest(blocks)[kept], sample_time_s=sample_time_s)


def pair_of(plant: Plant) -> SampledContact:
    """Return a plant in contact and in free space, sampled with the paper's period."""
    return build_sampled_contact(build_sampled_plant(plant, PERIOD_S))


def paper_plant(
    *,
    stiffness: float = 5e5,
    mass: float = 16.0,
    drag: float = 630.0,
    coupling: float = 3e5,
    coupling_damping: float = 0.0,
    environment_damping: float = 0.0,
    environment_mass: float = 0.0,
    robot: RobotModel | None = None,
) -> Plant:
    """Return the printed example; without stiffness, damping and mass of the environment it is free space."""
    return Plant(
        robot=robot if robot is not None else one_pole(),
        coupling=Coupling(stiffness_n_per_m=coupling, damping_n_s_per_m=coupling_damping),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=drag),
        environment=Environment(
            stiffness_n_per_m=stiffness, damping_n_s_per_m=environment_damping, mass_kg=environment_mass
        ),
    )


def paper_problem(**changes: Any) -> DesignProblem:
    """Return a design problem on the printed cell; what is no field of a problem is said of its set of plants."""
    own = {each.name for each in fields(DesignProblem)}
    plants: dict[str, Any] = {
        "robot": one_pole(),
        "coupling_stiffness_n_per_m": 3e5,
        "coupling_damping_n_s_per_m": 0.0,
        "drag_n_s_per_m": 630.0,
        "environment_stiffness_n_per_m": (2e4, 5e5),
        "payload_mass_kg": (8.0, 16.0),
        **{name: value for name, value in changes.items() if name not in own},
    }
    said = {name: value for name, value in changes.items() if name in own}
    return DesignProblem(**{"plants": PlantSet.of(**plants), "sample_time_s": PERIOD_S, **said})


def admittance(
    mass: float = 13.0, damping: float = 1000.0, lead: float = 0.013, feedback: float = 0.0
) -> AdmittanceController:
    return AdmittanceController(mass_kg=mass, damping_n_s_per_m=damping, lead_s=lead, feedback_damping_s=feedback)


def between(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw evenly in the logarithm, ends included up to rounding."""
    return st.floats(float(np.log(low)), float(np.log(high))).map(lambda exponent: float(np.exp(exponent)))


def or_zero(strategy: st.SearchStrategy[float]) -> st.SearchStrategy[float]:
    return st.one_of(st.just(0.0), strategy)


WHOLE_DELAYS = st.integers(0, 5).map(lambda samples: samples * PERIOD_S)
ANY_DELAYS = st.one_of(WHOLE_DELAYS, st.floats(0.0, 5.0).map(lambda samples: samples * PERIOD_S))


@st.composite
def robots(draw: st.DrawFn, delays: st.SearchStrategy[float] = ANY_DELAYS) -> RobotModel:
    """Draw one pole, or two poles with or without a zero."""
    delay, omega = draw(delays), draw(between(10.0, 80.0))
    if draw(st.booleans()):
        return one_pole(delay, omega)
    numerator = [omega**2]
    if draw(st.booleans()):
        numerator = [omega**2 / draw(between(20.0, 300.0)), omega**2]
    return RobotModel(
        numerator=np.array(numerator),
        denominator=np.array([1.0, 2.0 * draw(st.floats(0.4, 1.3)) * omega, omega**2]),
        delay_s=delay,
    )


@st.composite
def plants(draw: st.DrawFn, delays: st.SearchStrategy[float] = ANY_DELAYS, *, contact: bool | None = None) -> Plant:
    """Draw a plant; `contact` None leaves open whether it touches anything."""
    touching = draw(st.booleans()) if contact is None else contact
    return paper_plant(
        stiffness=draw(between(1e3, 1e6)) if touching else 0.0,
        environment_damping=draw(or_zero(between(1.0, 500.0))) if touching else 0.0,
        mass=draw(between(2.0, 60.0)),
        drag=draw(between(50.0, 1500.0)),
        coupling=draw(between(5e4, 1e6)),
        coupling_damping=draw(or_zero(between(10.0, 1000.0))),
        robot=draw(robots(delays)),
    )


@st.composite
def controllers(draw: st.DrawFn) -> AdmittanceController:
    return admittance(
        mass=draw(between(5.0, 60.0)),
        damping=draw(between(300.0, 8000.0)),
        lead=draw(or_zero(between(1e-3, 0.05))),
        feedback=draw(or_zero(between(1e-3, 0.02))),
    )


@st.composite
def environments(draw: st.DrawFn) -> Environment:
    """Draw anything that can be touched: at least one of stiffness, damping and mass."""
    kinds = st.sampled_from([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)])
    stiff, damped, heavy = draw(kinds)
    return Environment(
        stiffness_n_per_m=draw(between(1e3, 1e6)) if stiff else 0.0,
        damping_n_s_per_m=draw(between(1.0, 500.0)) if damped else 0.0,
        mass_kg=draw(between(0.05, 50.0)) if heavy else 0.0,
    )


@st.composite
def any_plants(
    draw: st.DrawFn,
    delays: st.SearchStrategy[float] = ANY_DELAYS,
    touched: st.SearchStrategy[Environment] | None = None,
) -> Plant:
    """Draw a plant in free space, or on an environment of any kind."""
    free = draw(plants(delays, contact=False))
    surfaces = st.one_of(st.just(free.environment), environments()) if touched is None else touched
    return free.in_contact_with(draw(surfaces))


@st.composite
def any_controllers(draw: st.DrawFn) -> AdmittanceController:
    """Draw every structure: with and without compensation, filtered and ideal; Tustin and both Euler forms."""
    compensation: Compensation = draw(st.sampled_from(["filtered", "ideal"]))
    rules: list[Discretization] = ["tustin", "backward_euler"]
    if compensation == "filtered":
        rules.append("forward_euler")
    return replace(
        draw(controllers()),
        velocity_filter_rad_per_s=draw(between(50.0, 400.0)),
        acceleration_filter_rad_per_s=draw(between(100.0, 800.0)),
        compensation_mass_kg=draw(or_zero(between(1.0, 20.0))),
        compensation=compensation,
        discretization=draw(st.sampled_from(rules)),
    )


# One of every structure, by name.
STRUCTURES: dict[str, AdmittanceController] = {
    "plain": admittance(lead=0.0),
    "lead": admittance(lead=0.02),
    "feedback": admittance(lead=0.02, feedback=7.5e-3),
    "filtered": replace(admittance(lead=0.02), compensation_mass_kg=8.0),
    "filtered, feedback": replace(admittance(lead=0.02, feedback=7.5e-3), compensation_mass_kg=8.0),
    "ideal": replace(admittance(lead=0.0), compensation_mass_kg=8.0, compensation="ideal"),
    "ideal, lead": replace(admittance(lead=0.02), compensation_mass_kg=8.0, compensation="ideal"),
    "ideal, lead, feedback": replace(
        admittance(lead=0.02, feedback=7.5e-3), compensation_mass_kg=8.0, compensation="ideal"
    ),
    "forward Euler": replace(admittance(lead=0.02, feedback=7.5e-3), discretization="forward_euler"),
    "filtered, forward Euler": replace(admittance(lead=0.02), compensation_mass_kg=8.0, discretization="forward_euler"),
    "backward Euler": replace(admittance(lead=0.02, feedback=7.5e-3), discretization="backward_euler"),
    "ideal, backward Euler": replace(
        admittance(lead=0.02), compensation_mass_kg=8.0, compensation="ideal", discretization="backward_euler"
    ),
}


# A light payload on a soft coupling against a hard wall leaves it several times.
BOUNCING = paper_plant(stiffness=5e5, mass=4.0, drag=50.0, coupling=3e4)
DAMPED = paper_plant(
    stiffness=5e5,
    mass=4.0,
    drag=20.0,
    coupling=3e4,
    coupling_damping=5.0,
    environment_damping=15.0,
    robot=one_pole(2.0e-3),
)
QUIET = admittance(damping=3000.0, lead=0.02)


def heavy_wall(mass: float, damping: float = 0.0) -> Plant:
    return BOUNCING.in_contact_with(Environment(stiffness_n_per_m=5e5, mass_kg=mass, damping_n_s_per_m=damping))
