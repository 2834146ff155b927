"""Predicted contacts of a controller file: its own plants, and whether its certificate holds the contact."""

import math
from collections.abc import Iterator
from dataclasses import replace

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller
from autotune.formats.plant import NO_DELAY_GIVEN
from autotune.formats.stiffness_units import check_surface_unit, doubtful_surface, interval_text
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.contact.transient import Approach
from problems.design.uncertainty import MASS, STIFFNESS, SYMBOLS
from problems.errors import ParameterError
from problems.model.plant import Bumper
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import has_damping_ratio

from .as_run_by import as_run_by, running_law
from .contact import NO_DEADBAND, TargetLaw, check_approach, with_bumper
from .law import law_notes
from .plants import PlantEnsemble, Surface, range_plants
from .result import PredictedContact, predict_contact

# The same contact computed twice agrees to rounding.
_ROUNDING = 1e-9


def certified_plants(
    domain: AxisDomain,
    axis: str,
    sample_time_s: float,
    *,
    stiffness: float | None = None,
    payload_mass: float | None = None,
    nominal_mass: float | None = None,
) -> PlantEnsemble:
    """Return the certified plants of an axis against a surface with a payload; both may lie outside of the domain.

    None keeps the whole range, and the nominal plant is then in the middle of it (of the stiffness by ratios), or
    has `nominal_mass`.
    """
    (soft, stiff), (light, heavy) = domain.environment_stiffness_n_per_m, domain.payload_mass_kg
    middle = 0.5 * (light + heavy) if nominal_mass is None else nominal_mass
    mass = middle if payload_mass is None else payload_mass
    plants, said = domain.plants, {STIFFNESS: stiffness, MASS: payload_mass}
    ranges = {**plants.ranges, **{name: (value, value) for name, value in said.items() if value is not None}}
    cut = plants.ellipsoid
    if cut is not None and any(ranges[name] != plants.ranges[name] for name in cut.names):
        cut = None
    return PlantEnsemble(
        axis=axis,
        surface="certified" if stiffness is None else Surface(stiffness=stiffness).label(axis),
        sample_time_s=sample_time_s,
        nominal=plants.at(mass, math.sqrt(soft * stiff) if stiffness is None else stiffness),
        others=range_plants(replace(plants, ranges=ranges, ellipsoid=cut)),
        is_range=True,
    )


def predict_certified(
    controller: Controller,
    axis: str,
    stiffness: float,
    *,
    payload_mass: float | None = None,
    approach_speed: float | None = None,
    approach_force: float | None = None,
    bumper: Bumper | None = None,
) -> PredictedContact:
    """Predict a contact of a controller file on its own nominal plant; the interval is that over its certified plants.

    With a `bumper` the payload touches with that part of it, which no certificate of peaks in one piece is about.
    Without a payload's mass it is that with the largest peak of both ends of the domain and of the payload that is the
    hardest in the file, and the interval is over the whole range of payloads. Raises ParameterError for numbers out of
    range and a stiffness that must be of another unit, UnstableLoopError where the loop is unstable.
    """
    domain, predicted = controller.certificate.domain[axis], controller.predicted[axis]
    notes = [NO_DELAY_GIVEN] if any(NO_DELAY_GIVEN in each for each in controller.provenance.get("notes", ())) else []
    is_said = approach_speed is not None or approach_force is not None
    approach = Approach(force_n=approach_force, speed_m_s=approach_speed) if is_said else domain.approach
    check_approach(approach)
    if payload_mass is not None and not 0.0 < payload_mass <= 1e3:
        raise ParameterError("payload_mass", payload_mass, "greater than 0 and at most 1000")
    if not (0.0 < stiffness < math.inf):
        raise ParameterError("environment_stiffness", stiffness, "a number greater than 0")
    if axis not in ROTATIONAL_AXES:
        check_surface_unit((stiffness, stiffness), stiffness)
        notes += doubtful_surface((stiffness, stiffness))
    law = running_law(controller, axis)
    if not isinstance(law, TargetLaw):
        # The certified peaks are those of the linear law.
        law = replace(law, deadband=NO_DEADBAND)
    hardest = max(predicted.scenarios, key=lambda each: each.peak_contact_force_n)
    masses = {*domain.payload_mass_kg, hardest.payload_mass_kg} if payload_mass is None else {payload_mass}
    found = max(
        (
            predict_contact(
                with_bumper(
                    certified_plants(
                        domain,
                        axis,
                        controller.sample_time_s,
                        stiffness=stiffness,
                        payload_mass=payload_mass,
                        nominal_mass=mass,
                    ),
                    bumper,
                ),
                law,
                approach,
            )
            for mass in sorted(masses)
        ),
        key=lambda each: each.contact.peak_contact_force_n,
    )
    said = () if isinstance(law, TargetLaw) else tuple(law_notes(law, axis, controller))
    outside = (*outside_domain(domain, found), *_other_contact(domain, approach, axis, bumper))
    found = replace(found, outside=outside, law_notes=said, neglected=(*notes, *found.neglected))
    if found.outside:
        return found
    target = as_run_by(controller, axis)
    worst = max(each.peak_contact_force_n for each in predicted.scenarios) if target is None else target.peak
    return replace(found, certified=found.peak_force <= worst * (1.0 + _ROUNDING), certified_peak=worst)


def _other_contact(domain: AxisDomain, approach: Approach, axis: str, bumper: Bumper | None) -> Iterator[str]:
    """Yield what else than a value of its plant makes a contact another one than the certified."""
    if approach != domain.approach:
        units = axis_units(axis)
        yield f"approach {domain.approach.text(units)}, here {approach.text(units)}"
    if bumper is not None:
        yield "payload in one piece, here with a bumper"


def outside_domain(domain: AxisDomain, found: PredictedContact) -> tuple[str, ...]:
    """Return what of the plant of a prediction lies outside of the ranges of a certificate; without payload nothing."""
    if found.plant is None or not found.has_payload:
        return ()
    units, outside = axis_units(found.axis), []
    for name, (low, high) in domain.plants.ranges.items():
        if name == "robot_damping_ratio" and not has_damping_ratio(found.plant.robot):
            continue
        value = PARAMETERS[name].value(found.plant)
        if not low * (1.0 - _ROUNDING) <= value <= high * (1.0 + _ROUNDING):
            scale, unit = units.shown(PARAMETERS[name].kind)
            certified = f"{interval_text((scale * low, scale * high))} {unit}".rstrip()
            outside.append(f"{SYMBOLS[name]} {certified}, here {scale * value:.4g} {unit}".rstrip())
    return tuple(outside)
