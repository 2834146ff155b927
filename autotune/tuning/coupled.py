"""Check a controller's axes on their common payload, as far as a log shows it; refuse what is unstable together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from autotune.errors import InfeasibleError
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, RuntimePayload, admittance_controller
from autotune.formats.coupled_record import PRODUCTS, CoupledBody, HeldAxis, Vector
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import AXES, ROTATIONAL_AXES
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_failure import CoupledFailure
from autotune.validation.coupled_proof import prove_together
from autotune.validation.coupled_sweep import CoupledPlants, CoupledSweep, damped_by, sweep_coupled
from identification.errors import EstimateError
from identification.result import AxisEstimate, Estimate, Identified
from problems.design.uncertainty import ENVIRONMENT_MASS
from problems.errors import ParameterError
from problems.model.coupled import Law

# What is tried, from little to much: so many times M_a and B_a of every axis.
_HEAVIER = (1.25, 1.5, 2.0, 3.0, 5.0)


@dataclass(frozen=True, kw_only=True)
class Together:
    """The controller with what is certified of its axes together, and in words what could not be checked."""

    controller: Controller
    unchecked: str = ""


@dataclass(frozen=True, kw_only=True)
class OnPayload:
    """The laws of all tuned axes on their payload, and what a sweep of them found.

    `unchecked` says in words why there is no cell.
    """

    cell: CoupledCell | None
    sweep: CoupledSweep | None = None
    unchecked: str = ""


@dataclass(frozen=True, kw_only=True)
class TogetherAsked:
    """What is known and asked of all axes together: where the payload may touch, and the least modulus, if any.

    The payload is what was `identified`, or the `body` of an earlier certificate.
    """

    identified: Identified | None = None
    body: CoupledBody | None = None
    contact_points_m: tuple[Vector, ...] = ()
    least_modulus: float | None = None

    @classmethod
    def of(cls, identified: Identified, spec: ProblemSpec) -> "TogetherAsked":
        """Return what a problem asks of what was identified."""
        points, least = spec.contact_points_m, spec.least_modulus_together
        return cls(identified=identified, contact_points_m=points, least_modulus=least)

    def place(
        self, domains: Mapping[str, AxisDomain], laws: Mapping[str, Law], payload: RuntimePayload, sample_time_s: float
    ) -> tuple[OnPayload, CoupledBody | None]:
        """Return the laws on the payload, and the body that it is; the sweep is still to be made."""
        body = self.body
        if body is None and self.identified is not None:
            body = coupled_body(domains, payload, self.identified, self.contact_points_m)
        if body is None:
            return OnPayload(cell=None, unchecked="payload.com_m is not known"), None
        if any(domain.plants.range_of(ENVIRONMENT_MASS)[1] > 0.0 for domain in domains.values()):
            return OnPayload(cell=None, unchecked="the surface moves with a mass (environment_mass_kg)"), None
        if len(domains) + len(body.held) < 2:
            return OnPayload(cell=None, unchecked=f"not known: {', '.join(body.missing)}"), None
        try:
            cell = CoupledCell.build(domains, laws, body, sample_time_s)
            cell.plant(cell.names, cell.masses_kg[0])
        except ParameterError as refusal:
            reason = f"no body has the payload that was identified: {refusal}"
            return OnPayload(cell=None, unchecked=reason), None
        return OnPayload(cell=cell), body


class TogetherCheck:
    """Adds what is certified of all axes to a controller; `unchecked` then says in words what could not be checked."""

    def __init__(self, asked: TogetherAsked, proof: ProofOptions) -> None:
        self.asked, self._proof, self.unchecked = asked, proof, ""
        self._known: tuple[CoupledCell, float | None, CoupledSweep] | None = None

    @property
    def is_asked(self) -> bool:
        """Whether anything is to be checked."""
        return self._proof.axes != "apart"

    def sweep(
        self, domains: Mapping[str, AxisDomain], laws: Mapping[str, Law], payload: RuntimePayload, sample_time_s: float
    ) -> OnPayload:
        """Sweep the laws of all axes; what was swept last is not swept again."""
        found, body = self.asked.place(domains, laws, payload, sample_time_s)
        self.unchecked = found.unchecked
        if found.cell is None or body is None:
            return found
        least = self.asked.least_modulus
        if self._known is None or self._known[1] != least or not _same(self._known[0], found.cell):
            try:
                self._known = found.cell, least, sweep_coupled(found.cell, body, least)
            except ParameterError as refusal:
                self.unchecked = f"no body has the payload that was identified: {refusal}"
                return OnPayload(cell=None, unchecked=self.unchecked)
        return replace(found, sweep=self._known[2])

    def __call__(self, controller: Controller, prover: Prover) -> Controller:
        """Return the controller with its certificate of all axes.

        Raises InfeasibleError where the axes together are unstable, bounce for ever or miss the modulus asked of them,
        EstimateError where a proof of them was asked for by name and too little is known.
        """
        if not self.is_asked:
            return controller
        domains = {name: controller.certificate.domain[name] for name in controller.axes}
        laws = {name: admittance_controller(controller, name) for name in domains}
        found = self.sweep(domains, laws, controller.payload, controller.sample_time_s)
        if found.cell is None or found.sweep is None:
            if self.unchecked and self._proof.axes == "together":
                raise EstimateError(
                    f"The axes cannot be proved together ({self.unchecked}). Record what is missing, or leave --axes "
                    "together out: they are then checked one by one."
                )
            return controller
        if found.sweep.failure is not None:
            raise InfeasibleError(refusal_text(found.cell, found.sweep.failure))
        certificate = replace(controller.certificate, coupled=found.sweep.certificate)
        checked = replace(controller, certificate=certificate)
        return prove_together(checked, prover, self._proof) if self._proof.axes == "together" else checked


def _same(one: CoupledCell, other: CoupledCell) -> bool:
    """Return whether two cells are the same for a sweep."""
    payloads = [
        (each.payload.mass_kg, each.payload.mass_matrix.tolist(), each.contact_points_m) for each in (one, other)
    ]
    known = [(each.domains, each.laws, each.held, each.sample_time_s) for each in (one, other)]
    return payloads[0] == payloads[1] and known[0] == known[1]


def check_together(controller: Controller, identified: Identified, contact_points_m: Sequence[Vector] = ()) -> Together:
    """Return the controller with its certificate of all axes together; as it is where one axis alone is known.

    Raises InfeasibleError where the axes together are unstable or bounce for ever.
    """
    asked = TogetherAsked(identified=identified, contact_points_m=tuple(contact_points_m))
    check = TogetherCheck(asked, ProofOptions())
    checked = check(controller, Prover())
    return Together(controller=checked, unchecked=check.unchecked)


def coupled_body(
    domains: Mapping[str, AxisDomain],
    payload: RuntimePayload,
    identified: Identified,
    contact_points_m: Sequence[Vector],
) -> CoupledBody | None:
    """Return the payload as a rigid body and the axes that are known beside the tuned ones; None without its centre.

    Points of contact that are not given are those that were declared of the cell.

    Of a tuned axis the moment of inertia is that of its own loop. A product of inertia that no motion shows is that of
    a body without any about its centre of mass, and named as missing.
    """
    if payload.set_in_cell:
        return None
    others = {name: _held(axis) for name, axis in identified.axes.items() if name not in domains}
    held = {name: each for name, each in others.items() if each is not None}
    inertia, missing = {}, []
    for name in (*domains, *held):
        if name in ROTATIONAL_AXES:
            moment = _moment(domains, identified, name)
            if moment is None:
                del held[name]
            else:
                inertia["xyz"[AXES.index(name) - 3] * 2] = moment
    known = [name for name in AXES if name in domains or name in held]
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


def _moment(domains: Mapping[str, AxisDomain], identified: Identified, name: str) -> float | None:
    """Return the moment of inertia about one axis: that of its own loop, else of the tensor, else of its motion."""
    if name in domains:
        low, high = domains[name].payload_mass_kg
        return 0.5 * (low + high)
    tensor = identified.payload.inertia_kg_m2
    component = None if tensor is None else getattr(tensor, "xyz"[AXES.index(name) - 3] * 2)
    estimates = (component, identified.axes[name].mass_kg)
    return next((each.value for each in estimates if each is not None and each.value is not None), None)


def heavier_factor(cell: CoupledCell, group: tuple[str, ...], plants: CoupledPlants | None = None) -> float | None:
    """Return how many times M_a and B_a of every axis are enough for a group, None where nothing that is tried is."""
    of = CoupledPlants(cell) if plants is None else plants
    return next((each for each in _HEAVIER if of.failure(damped_by(cell, each).laws, group) is None), None)


def refusal_text(cell: CoupledCell, failure: CoupledFailure, searched: str = "") -> str:
    """Return why the axes are refused together, what came of another search, and what eases it."""
    names = " and ".join(name for name in failure.group if name in cell.laws)
    ways = "bring the centre of mass nearer to the sensor, or stiffen the coupling about the turning axis"
    if failure.modulus is not None or searched:
        ways = f"ask for less of them together in problem.yaml (axes_together: {{min_modulus: …}}); {ways}"
    if failure.modulus is None and not failure.bounces:
        factor = heavier_factor(cell, failure.group)
        if factor is not None:
            raised = (
                "which what is asked of each axis leaves no room for"
                if searched
                else "so raise the lower bounds of mass and damping in problem.yaml (rotational.bounds for what turns)"
            )
            ways = f"{factor:g} times M_a and B_a of {names} would make it stable, {raised}; or {ways}"
    message = failure.message()
    text = f"{message[0].upper()}{message[1:]}. "
    if searched:
        text += f"Searched again, each beside the others: {searched.rstrip('.')}. "
    return f"{text}What eases it: {ways}. --axes apart leaves this check out."
