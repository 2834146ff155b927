"""Random plants and controllers of the whole model: environments with mass, compensation, every sampled form."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from problems.model.controller import AdmittanceController, Compensation
from problems.model.plant import FREE_SPACE, Environment, Plant
from tests.problems.axes import ANY_DELAYS, between, controllers, or_zero, plants


@st.composite
def environments(draw: st.DrawFn) -> Environment:
    """Draw a surface that holds its place."""
    return Environment(
        stiffness_n_per_m=draw(between(1e3, 1e6)),
        damping_n_s_per_m=draw(or_zero(between(1.0, 500.0))),
        mass_kg=draw(or_zero(between(0.1, 10.0))),
    )


@st.composite
def whole_plants(
    draw: st.DrawFn, delays: st.SearchStrategy[float] = ANY_DELAYS, *, contact: bool | None = None
) -> Plant:
    """Draw a plant; `contact` None leaves open whether it touches anything."""
    touching = draw(st.booleans()) if contact is None else contact
    return draw(plants(delays, contact=False)).in_contact_with(draw(environments()) if touching else FREE_SPACE)


@st.composite
def whole_controllers(
    draw: st.DrawFn, *, forms: tuple[str, ...] = ("tustin", "forward_euler", "backward_euler")
) -> AdmittanceController:
    """Draw any controller of the model; an ideal compensation has no forward Euler form."""
    compensation: Compensation | None = draw(st.sampled_from([None, "filtered", "ideal"]))
    known = [form for form in forms if compensation != "ideal" or form != "forward_euler"]
    controller = replace(
        draw(controllers()),
        velocity_filter_rad_per_s=draw(between(60.0, 400.0)),
        discretization=draw(st.sampled_from(known)),
    )
    if compensation is None:
        return controller
    return replace(
        controller,
        compensation=compensation,
        compensation_mass_kg=draw(between(0.5, 30.0)),
        acceleration_filter_rad_per_s=draw(between(100.0, 600.0)),
    )


def plant_of(like: Plant, parameters: np.ndarray) -> Plant:
    """Return a plant with the numbers of `Plant.parameters` and the robot of another."""
    k_s, b_s, m_p, b_p, k_e, b_e, m_e = (float(value) for value in parameters)
    return replace(
        like,
        coupling=replace(like.coupling, stiffness_n_per_m=k_s, damping_n_s_per_m=b_s),
        payload=replace(like.payload, mass_kg=m_p, drag_n_s_per_m=b_p),
        environment=Environment(stiffness_n_per_m=k_e, damping_n_s_per_m=b_e, mass_kg=m_e),
    )


def controller_of(like: AdmittanceController, parameters: np.ndarray) -> AdmittanceController:
    """Return a controller with the numbers of `AdmittanceController.parameters` and the forms of another."""
    m_a, b_a, k_l, b_fb, w_v, w_a, p = (float(value) for value in parameters)
    return replace(
        like,
        mass_kg=m_a,
        damping_n_s_per_m=b_a,
        lead_s=k_l,
        feedback_damping_s=b_fb,
        velocity_filter_rad_per_s=w_v,
        acceleration_filter_rad_per_s=w_a,
        compensation_mass_kg=p,
    )
