"""A payload that is soft inside: whether what a file certifies of one mass holds where a bumper touches.

The bumper is a part of the payload's mass behind a spring and a damper, so it swings in free space too, and on a hard
surface its own blow comes before the payload's. Its loops and contacts are the exact ones (`problems.model.plant`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.errors import UsageError
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.units import ROTATIONAL_AXES
from autotune.quantities import parse_quantity
from autotune.text import scenario_text
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.uncertainty import PlantSet, Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import STRAIGHT
from problems.model.plant import Bumper, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

from .law import of_own_law
from .report import Check

_STIFFNESSES, _MASSES, _SAMPLES, _SEED = 9, 2, 32, 7919
# By so much what is found may be worse than what is stated: the slack of a proof that was not asked for another.
_SLACK = 0.05


@dataclass(kw_only=True)
class _Worst:
    """The worst over the plants so far, and what does not hold."""

    modulus: float = math.inf
    contact_n: float = 0.0
    sensor_n: float = 0.0
    at: Scenario | None = None
    broken: str = ""
    count: int = 0


def parse_bumper(text: str) -> Bumper:
    """Return the bumper that a person typed as mass, stiffness and perhaps damping; raises ValueError."""
    parts = text.split(",")
    if len(parts) not in {2, 3}:
        raise ValueError(f"{text!r} must be a mass, a stiffness and perhaps a damping, with commas between.")
    kinds = ("mass", "stiffness", "damping")
    mass, stiffness, *damping = (parse_quantity(part, kind).value for part, kind in zip(parts, kinds, strict=False))
    try:
        return Bumper(mass_kg=mass, stiffness_n_per_m=stiffness, damping_n_s_per_m=sum(damping))
    except ParameterError as refusal:
        raise ValueError(str(refusal)) from refusal


def check_bumper(controller: Controller, bumper: Bumper | None) -> tuple[Check, ...]:
    """Return for each straight axis whether modulus and peaks of the file hold with a bumper on the payload."""
    if bumper is None:
        return ()
    straight = [name for name in controller.axes if name not in ROTATIONAL_AXES]
    for name in straight:
        lightest = controller.certificate.domain[name].plants.payload_mass_kg[0]
        if bumper.mass_kg >= lightest:
            raise UsageError(
                f"--bumper has {bumper.mass_kg:g} kg and is a part of the payload, so it must be below the certified "
                f"{lightest:g} kg."
            )
    return of_own_law(controller, [_check_axis(controller, name, bumper) for name in straight])


def _check_axis(controller: Controller, name: str, bumper: Bumper) -> Check:
    plants = controller.certificate.domain[name].plants
    found = _Worst()
    for scenario in _scenarios(plants):
        found.count += 1
        _look(controller, name, scenario, bumper, found)
        if found.broken:
            where = f"{describe_bumper(bumper)}, {scenario_text(scenario, STRAIGHT)}"
            return Check(axis=name, name="bumper", passed=False, message=f"{where}: {found.broken}")
    return _verdict(controller, name, bumper, found)


def _look(controller: Controller, name: str, scenario: Scenario, bumper: Bumper, found: _Worst) -> None:
    """Hold one plant against what was found before."""
    domain, h, law = (
        controller.certificate.domain[name],
        controller.sample_time_s,
        admittance_controller(controller, name),
    )
    try:
        plant: Plant = replace(scenario.plant(domain.plants.nominal), bumper=bumper)
        pair = build_sampled_contact(build_sampled_plant(plant, h))
        moduli = [find_margins(each, law).modulus for each in (pair.free, pair.contact)]
        contact = simulate_contact(pair, law, domain.approach)
    except (ParameterError, UnstableLoopError) as refusal:
        found.broken = str(refusal)
        return
    if not contact.is_settled:
        found.broken = "the contact does not come to rest"
    found.modulus = min(found.modulus, *moduli)
    found.sensor_n = max(found.sensor_n, contact.peak_sensor_force_n)
    if contact.peak_contact_force_n > found.contact_n:
        found.contact_n, found.at = contact.peak_contact_force_n, scenario


def _verdict(controller: Controller, name: str, bumper: Bumper, found: _Worst) -> Check:
    scenarios = controller.predicted[name].scenarios
    stated = controller.certificate.margins[name].modulus
    contact = max((each.peak_contact_force_n for each in scenarios), default=0.0)
    sensor = max((each.peak_sensor_force_n for each in scenarios), default=0.0)
    rows = (
        ("modulus", found.modulus, stated, "", found.modulus < (1.0 - _SLACK) * stated),
        ("peak at the contact", found.contact_n, contact, " N", found.contact_n > (1.0 + _SLACK) * contact),
        ("peak at the sensor", found.sensor_n, sensor, " N", found.sensor_n > (1.0 + _SLACK) * sensor),
    )
    wrong = [f"{what} {value:.3g}{unit}, stated {said:.3g}" for what, value, said, unit, is_wrong in rows if is_wrong]
    where = "" if found.at is None else f" (the hardest at {scenario_text(found.at, STRAIGHT)})"
    message = "; ".join(wrong) or (
        f"modulus {found.modulus:.3g} or more, at most {found.contact_n:.3g} N at the contact and "
        f"{found.sensor_n:.3g} N at the sensor"
    )
    counted = f"{describe_bumper(bumper)}, {found.count} plants sampled"
    return Check(axis=name, name="bumper", passed=not wrong, message=f"{counted}: {message}{where}")


def _scenarios(plants: PlantSet) -> tuple[Scenario, ...]:
    """Return a grid over K_e × M_p, the corners of the whole set, and samples of it."""
    low, high = plants.environment_stiffness_n_per_m
    grid = [
        Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass)
        for mass in np.unique(np.linspace(*plants.payload_mass_kg, _MASSES)).tolist()
        for stiffness in np.unique(np.clip(np.geomspace(low, high, _STIFFNESSES), low, high)).tolist()
    ]
    return tuple(dict.fromkeys((*grid, *plants.corners(), *plants.samples(_SAMPLES, seed=_SEED))))


def describe_bumper(bumper: Bumper) -> str:
    """Return a bumper in words."""
    return (
        f"a bumper of {bumper.mass_kg:g} kg on {1e-3 * bumper.stiffness_n_per_m:g} N/mm and "
        f"{bumper.damping_n_s_per_m:g} N·s/m"
    )
