"""Check a controller's axes on their common payload, as far as a log shows it; refuse what is unstable together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from autotune.errors import InfeasibleError
from autotune.formats.controller_record import Controller
from autotune.formats.coupled_record import PRODUCTS, CoupledBody, HeldAxis, Vector
from autotune.formats.units import AXES, ROTATIONAL_AXES
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_proof import prove_together
from autotune.validation.coupled_sweep import CoupledFailure, damped_by, first_failure, sweep_coupled
from identification.result import AxisEstimate, Estimate, Identified
from problems.errors import ParameterError

# What is tried, from little to much: so many times M_a and B_a of every axis.
_HEAVIER = (1.25, 1.5, 2.0, 3.0, 5.0)


@dataclass(frozen=True, kw_only=True)
class Together:
    """The controller with what is certified of its axes together, and in words what could not be checked."""

    controller: Controller
    unchecked: str = ""


class TogetherCheck:
    """Adds what is certified of all axes to a controller; `unchecked` then says in words what could not be checked."""

    def __init__(self, identified: Identified, asked: ProofOptions, contact_points_m: Sequence[Vector] = ()) -> None:
        self._identified, self._asked, self._points, self.unchecked = identified, asked, contact_points_m, ""

    def __call__(self, controller: Controller, prover: Prover) -> Controller:
        """Return the controller with its certificate of all axes; raises what `check_together` raises."""
        if self._asked.axes == "apart":
            return controller
        found = check_together(controller, self._identified, self._points)
        self.unchecked = found.unchecked
        return (
            prove_together(found.controller, prover, self._asked)
            if self._asked.axes == "together"
            else found.controller
        )


def check_together(controller: Controller, identified: Identified, contact_points_m: Sequence[Vector] = ()) -> Together:
    """Return the controller with its certificate of all axes together; as it is where one axis alone is known.

    Raises InfeasibleError where the axes together are unstable or bounce for ever.
    """
    body = coupled_body(controller, identified, contact_points_m)
    if body is None:
        return Together(controller=controller, unchecked="payload.com_m is not known")
    if len(controller.axes) + len(body.held) < 2:
        return Together(controller=controller, unchecked=f"not known: {', '.join(body.missing)}")
    try:
        cell = CoupledCell.of(controller, body)
        found = sweep_coupled(cell, body)
    except ParameterError as refusal:
        return Together(controller=controller, unchecked=f"no body has the payload that was identified: {refusal}")
    if found.failure is not None:
        raise InfeasibleError(_refusal(cell, found.failure))
    certificate = replace(controller.certificate, coupled=found.certificate)
    return Together(controller=replace(controller, certificate=certificate))


def coupled_body(
    controller: Controller, identified: Identified, contact_points_m: Sequence[Vector] = ()
) -> CoupledBody | None:
    """Return the payload as a rigid body and the axes that are known beside the tuned ones; None without its centre.

    Points of contact that are not given are those that were declared of the cell.

    Of a tuned axis the moment of inertia is that of its own loop. A product of inertia that no motion shows is that of
    a body without any about its centre of mass, and named as missing.
    """
    payload = controller.payload
    if payload.set_in_cell:
        return None
    others = {name: _held(axis) for name, axis in identified.axes.items() if name not in controller.axes}
    held = {name: each for name, each in others.items() if each is not None}
    inertia, missing = {}, []
    for name in (*controller.axes, *held):
        if name in ROTATIONAL_AXES:
            moment = _moment(controller, identified, name)
            if moment is None:
                del held[name]
            else:
                inertia["xyz"[AXES.index(name) - 3] * 2] = moment
    known = [name for name in AXES if name in controller.axes or name in held]
    missing += [name for name in AXES if name not in known]
    tensor = identified.payload.inertia_kg_m2
    for product, (i, j) in PRODUCTS.items():
        if i == j or not {AXES[3 + i], AXES[3 + j]} <= set(known):
            continue
        found: Estimate | None = None if tensor is None else getattr(tensor, product)
        if found is not None and found.value is not None:
            inertia[product] = found.value
        else:
            inertia[product] = -payload.mass_kg * payload.com_m[i] * payload.com_m[j]
            missing.append(f"inertia {product}")
    return CoupledBody(
        mass_kg=payload.mass_kg,
        com_m=payload.com_m,
        inertia_kg_m2=inertia,
        held=held,
        contact_points_m=tuple(contact_points_m) or identified.payload.contact_points_m,
        missing=tuple(missing),
    )


def _held(axis: AxisEstimate) -> HeldAxis | None:
    """Return what the payload swings on where an axis is not tuned, None where that is not known."""
    coupling = axis.coupling
    values = [each.value for each in (coupling.stiffness_n_per_m, coupling.damping_n_s_per_m, axis.drag_n_s_per_m)]
    stiffness, damping, drag = values
    if stiffness is None or damping is None or drag is None:
        return None
    return HeldAxis(
        coupling_stiffness_n_per_m=stiffness,
        coupling_damping_n_s_per_m=max(damping, 0.0),
        drag_n_s_per_m=max(drag, 0.0),
    )


def _moment(controller: Controller, identified: Identified, name: str) -> float | None:
    """Return the moment of inertia about one axis: that of its own loop, else of the tensor, else of its motion."""
    if name in controller.axes:
        low, high = controller.certificate.domain[name].payload_mass_kg
        return 0.5 * (low + high)
    tensor = identified.payload.inertia_kg_m2
    component = None if tensor is None else getattr(tensor, "xyz"[AXES.index(name) - 3] * 2)
    estimates = (component, identified.axes[name].mass_kg)
    return next((each.value for each in estimates if each is not None and each.value is not None), None)


def _refusal(cell: CoupledCell, failure: CoupledFailure) -> str:
    """Return why the axes are refused together, and what eases it."""
    tuned = [name for name in failure.group if name in cell.laws]
    ways = "bring the centre of mass nearer to the sensor, or stiffen the coupling about the turning axis"
    if not failure.bounces:
        factor = next((each for each in _HEAVIER if first_failure(damped_by(cell, each)) is None), None)
        if factor is not None:
            names = " and ".join(tuned)
            ways = (
                f"{factor:g} times M_a and B_a of {names} would make it stable, so raise the lower bounds of mass and "
                f"damping in problem.yaml (rotational.bounds for what turns); or {ways}"
            )
    message = failure.message()
    return f"{message[0].upper()}{message[1:]}. What eases it: {ways}. --axes apart leaves this check out."
