"""One axis of a controller with its certified plants, and the contacts and margins it has on them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from autotune.formats.certificate_record import Asked, AxisDomain, AxisMargins, ProvenRegion, SoftRequirement
from autotune.formats.controller_record import AxisPrediction, Controller, ScenarioPrediction, admittance_controller
from autotune.formats.units import axis_units
from autotune.validation.disturbances import file_strategy
from problems.arrays import FloatArray
from problems.contact.nonlinearities import NO_NONLINEARITIES, Nonlinearities
from problems.contact.transient import Approach, ContactTransient, build_sampled_contact, simulate_contact
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import AxisKind
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

_STIFFNESS = "environment_stiffness_n_per_m"


@dataclass(frozen=True, kw_only=True)
class AxisDesign:
    """An axis `name` that runs `law` every `sample_time_s`, and what its certificate says; SI units of the axis.

    `regions` are those over which the modulus is proved, `strategy` holds collision response and variable damping.
    """

    name: str
    law: AdmittanceController
    sample_time_s: float
    domain: AxisDomain
    predicted: AxisPrediction
    margins: AxisMargins
    asked: Asked
    soft: Mapping[str, SoftRequirement]
    regions: tuple[ProvenRegion, ...] = ()
    strategy: Nonlinearities = NO_NONLINEARITIES

    @property
    def units(self) -> AxisKind:
        """The units of the axis."""
        return axis_units(self.name)

    @property
    def approach(self) -> Approach:
        """How a contact begins; raises ParameterError for a domain that does not say it."""
        return self.domain.approach

    @property
    def modulus_asked(self) -> float | None:
        """The least |1 + L| that was asked, if it was."""
        asked = self.asked.get("modulus_margin")
        soft = self.soft.get("modulus_margin")
        value = asked if soft is None else soft.asked
        return float(value) if isinstance(value, int | float) else None

    @property
    def worst_contact(self) -> ScenarioPrediction:
        """The predicted contact with the largest peak at the contact."""
        return max(self.predicted.scenarios, key=lambda each: each.peak_contact_force_n)

    def plant(self, scenario: Scenario) -> Plant:
        """Return the plant of a scenario, in contact."""
        return scenario.plant(self.domain.plants.nominal)

    def corners(self) -> tuple[Plant, ...]:
        """Return the nominal plants at the ends of K_e and M_p, all in contact."""
        ends = product(sorted(set(self.domain.environment_stiffness_n_per_m)), sorted(set(self.domain.payload_mass_kg)))
        return tuple(
            self.plant(Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass))
            for stiffness, mass in ends
            if stiffness > 0.0
        )

    def free_plant(self) -> Plant:
        """Return the nominal plant with the lightest payload in free space."""
        return self.domain.plants.nominal.in_contact_with(FREE_SPACE)

    def worst_plant(self, margin: str = "modulus") -> Plant | None:
        """Return the plant at which the certificate found a margin smallest; None where it does not say."""
        case = dict(self.margins.worst.get(margin, {}))
        stiffness = case.pop(_STIFFNESS, None)
        if stiffness is None or "payload_mass_kg" not in case:
            return None
        touched = stiffness or self.domain.environment_stiffness_n_per_m[1]
        plant = self.plant(Scenario(environment_stiffness_n_per_m=touched, **case))
        return plant if stiffness > 0.0 else plant.in_contact_with(FREE_SPACE)


def axis_designs(controller: Controller) -> tuple[AxisDesign, ...]:
    """Return the axes of a controller that hold a certificate."""
    certificate = controller.certificate
    return tuple(
        AxisDesign(
            name=name,
            law=admittance_controller(controller, name),
            sample_time_s=controller.sample_time_s,
            domain=certificate.domain[name],
            predicted=controller.predicted[name],
            margins=certificate.margins[name],
            asked=certificate.requirements_of(name) or {},
            soft=(certificate.soft or {}).get(name, {}),
            regions=(certificate.continuous or {}).get(name, ()),
            strategy=file_strategy(controller, name),
        )
        for name in controller.axes
        if name in certificate.domain and name in certificate.margins and name in controller.predicted
    )


def contact_of(design: AxisDesign, law: AdmittanceController, scenario: Scenario) -> ContactTransient | None:
    """Return the contact of a scenario under `law`; None where that is unstable or the domain names no approach."""
    try:
        pair = build_sampled_contact(build_sampled_plant(design.plant(scenario), design.sample_time_s))
        return simulate_contact(pair, law, design.approach)
    except (UnstableLoopError, ParameterError):
        return None


def modulus_of(plant: Plant, law: AdmittanceController, sample_time_s: float) -> float:
    """Return min |1 + L| at both break points; NaN of an unstable loop."""
    try:
        return find_margins(build_sampled_plant(plant, sample_time_s), law).modulus
    except UnstableLoopError:
        return math.nan


@dataclass(frozen=True, kw_only=True)
class OverStiffness:
    """Modulus margin and peak contact force (n,) over K_e (n,) at one payload; NaN where the loop is unstable."""

    payload_mass_kg: float
    stiffness: FloatArray
    modulus: FloatArray
    peak_n: FloatArray


def over_stiffness(
    design: AxisDesign, law: AdmittanceController, payload_mass_kg: float, stiffness: FloatArray
) -> OverStiffness:
    """Compute margin and peak at each of the stiffnesses (n,), the rest of the plant nominal."""
    modulus, peak = np.full(len(stiffness), math.nan), np.full(len(stiffness), math.nan)
    for i, value in enumerate(stiffness):
        scenario = Scenario(environment_stiffness_n_per_m=float(value), payload_mass_kg=payload_mass_kg)
        modulus[i] = modulus_of(design.plant(scenario), law, design.sample_time_s)
        run = contact_of(design, law, scenario)
        peak[i] = math.nan if run is None else run.peak_contact_force_n
    return OverStiffness(payload_mass_kg=payload_mass_kg, stiffness=stiffness, modulus=modulus, peak_n=peak)
