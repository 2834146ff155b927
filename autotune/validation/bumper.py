"""A payload that is soft inside: what a file says of its bumper, and whether what it certifies of one mass holds there.

The bumper is a part of the payload's mass behind a spring and a damper, so it swings in free space too, and on a hard
surface its own blow comes before the payload's. Its loops and contacts are the exact ones (`problems.model.plant`).
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter

import numpy as np

from autotune.certificate.certify import METHOD
from autotune.certificate.family import Claim
from autotune.errors import UsageError
from autotune.formats.bumper_record import BumperContacts, describe_bumper
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.stiffness_units import check_bumper_unit
from autotune.formats.units import ROTATIONAL_AXES
from autotune.quantities import parse_quantity
from autotune.text import scenario_text
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.requirements import ContactAtSpeed, led_contacts, led_peaks
from problems.design.uncertainty import ALWAYS_UNCERTAIN, PlantSet, Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import STRAIGHT
from problems.model.controller import AdmittanceController
from problems.model.plant import Bumper, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import Margins, UnstableLoopError, find_margins

from .axis_proof import ProofOptions, Prover, modulus_claim
from .certified_requirements import asked_of, limit_n
from .law import of_own_law
from .report import Check

_STIFFNESSES, _MASSES, _SAMPLES, _SEED = 9, 2, 32, 7919
# By so much what is found may be worse than what is stated: the slack of a proof that was not asked for another.
_SLACK = 0.05
# Of what is stated with a bumper: its samples are others here, without the search between them.
_NEAR, _SAME_SHARE = 0.01, 0.01
_MOST_MODULUS = 1.0 - 1e-9
SAMPLED = "margins and contacts of the exact loops of both masses on a grid, corners and samples; no proof"
_MARGINS: Mapping[str, Callable[[Margins], float]] = {
    "modulus_margin": attrgetter("modulus"),
    "gain_margin_db": attrgetter("gain_db"),
    "phase_margin_deg": attrgetter("phase_deg"),
    "delay_margin_s": attrgetter("delay_s"),
}


@dataclass(kw_only=True)
class _Worst:
    """The worst over the plants so far, and what does not hold."""

    last: Scenario
    margins: dict[str, float] = field(default_factory=dict)
    contact_n: float = 0.0
    sensor_n: float = 0.0
    led_n: float = 0.0
    at: Scenario | None = None
    broken: str = ""
    count: int = 0

    @property
    def modulus(self) -> float:
        return self.margins["modulus_margin"]


def parse_bumper(text: str) -> Bumper:
    """Return the bumper that a person typed as mass, stiffness and perhaps damping; raises ValueError."""
    parts = text.split(",")
    if len(parts) not in {2, 3}:
        raise ValueError(f"{text!r} must be a mass, a stiffness and perhaps a damping, with commas between.")
    kinds = ("mass", "stiffness", "damping")
    mass, stiffness, *damping = (parse_quantity(part, kind).value for part, kind in zip(parts, kinds, strict=False))
    try:
        found = Bumper(mass_kg=mass, stiffness_n_per_m=stiffness, damping_n_s_per_m=sum(damping))
        check_bumper_unit(found.stiffness_n_per_m)
    except ParameterError as refusal:
        raise ValueError(str(refusal)) from refusal
    return found


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


def check_stated_bumper(controller: Controller, name: str, prover: Prover) -> Iterator[Check]:
    """Hold what a file states of one axis with its bumper against other plants, and prove again what is proved."""
    record = controller.certificate.bumper
    if record is None or name not in record.axes:
        return
    stated, check = record.axes[name], partial(Check, axis=name, name="bumper")
    plants, law, h = (
        controller.certificate.domain[name].plants,
        admittance_controller(controller, name),
        controller.sample_time_s,
    )
    if record.method != SAMPLED or record.proof_method != METHOD:
        yield check(
            passed=False, message=f"{record.describe()}: stated by methods that are not {SAMPLED!r}, {METHOD!r}"
        )
        return
    if record.bumper.mass_kg >= plants.payload_mass_kg[0]:
        yield check(passed=False, message=f"{record.describe()}: it must be lighter than the lightest payload")
        return
    found = _search(controller, name, record.bumper)
    wrong = [found.broken] if found.broken else [*_missed(controller, name, found, stated)]
    where = f"{record.describe()}, {found.count} plants sampled"
    if not wrong:
        where += f": modulus {found.modulus:.3g} or more, at most {found.contact_n:.4g} N at the contact and"
    yield check(
        passed=not wrong,
        message=f"{where}: {'; '.join(wrong)}" if wrong else f"{where} {found.sensor_n:.4g} N at the sensor",
    )
    if stated.share > 0.0 and not wrong:
        claim = _claim(plants, law, h, record.bumper, stated.proved_modulus, stated.budget_s)
        origin, proved = prover.origin(claim), prover.prove(claim)
        share = 0.0 if proved.false else proved.share
        passed = stated.share <= share + _SAME_SHARE
        said = f"with the bumper stable with |1 + L| > {stated.proved_modulus:.4g}, over K_e, M_p"
        message = f"{said}: proved for {100.0 * share:.3g} % of the set ({proved.cells} cells{origin})"
        message = message if passed else f"{said}: claimed for the share {stated.share:.4g}, proved for {share:.4g}"
        yield check(passed=passed, message=message)


def prove_with_bumper(
    prover: Prover,
    plants: PlantSet,
    law: AdmittanceController,
    sample_time_s: float,
    bumper: Bumper,
    sampled: BumperContacts,
    options: ProofOptions,
) -> BumperContacts:
    """Return what was sampled of one axis with what of its modulus is proved; nothing where the claim is false."""
    modulus = (1.0 - options.slack) * min(sampled.modulus, _MOST_MODULUS)
    found = prover.prove(_claim(plants, law, sample_time_s, bumper, modulus, options.budget_s))
    share = 0.0 if found.false else found.share
    return replace(
        sampled,
        proved_modulus=modulus if share > 0.0 else 0.0,
        share=share,
        cells=float(found.cells),
        arcs=float(found.arcs),
        budget_s=options.budget_s,
        run_time_s=found.run_time_s,
    )


def _claim(
    plants: PlantSet,
    law: AdmittanceController,
    sample_time_s: float,
    bumper: Bumper,
    modulus: float,
    budget_s: float,
) -> Claim:
    soft = replace(plants, nominal=replace(plants.nominal, bumper=bumper))
    return modulus_claim(soft, law, sample_time_s, ALWAYS_UNCERTAIN, modulus, budget_s)


def _missed(controller: Controller, name: str, found: "_Worst", stated: BumperContacts) -> Iterator[str]:
    """Yield what is worse than stated, or less than was asked."""
    for what, value, said, unit, is_worse in (
        ("modulus", found.modulus, stated.modulus, "", found.modulus < (1.0 - _NEAR) * stated.modulus),
        ("peak at the contact", found.contact_n, stated.peak_contact_force_n, " N", None),
        ("peak at the sensor", found.sensor_n, stated.peak_sensor_force_n, " N", None),
    ):
        if value > (1.0 + _NEAR) * said if is_worse is None else is_worse:
            yield f"{what} {value:.4g}{unit}, stated {said:.4g}"
    asked, most = asked_of(controller, name), limit_n(controller, name)
    for key, least in found.margins.items():
        level = asked.get(key)
        if isinstance(level, int | float) and least < (1.0 - _NEAR) * level:
            yield f"{key} {least:.4g}, asked {level:.4g}"
    if most is not None and max(found.contact_n, stated.peak_contact_force_n) > (1.0 + _NEAR) * most:
        yield f"peak at the contact {found.contact_n:.4g} N, asked at most {most:.4g}"
    limit = asked.get("contact_at_speed")
    if isinstance(limit, ContactAtSpeed) and found.led_n > (1.0 + _NEAR) * limit.max_force_n:
        yield f"led at {limit.speed_m_s:g} m/s {found.led_n:.4g} N, asked at most {limit.max_force_n:g}"


def _check_axis(controller: Controller, name: str, bumper: Bumper) -> Check:
    found = _search(controller, name, bumper)
    if found.broken:
        where = f"{describe_bumper(bumper)}, {scenario_text(found.last, STRAIGHT)}"
        return Check(axis=name, name="bumper", passed=False, message=f"{where}: {found.broken}")
    return _verdict(controller, name, bumper, found)


def _search(controller: Controller, name: str, bumper: Bumper) -> "_Worst":
    """Return the worst over the plants, up to the first that is broken."""
    scenarios = _scenarios(controller.certificate.domain[name].plants)
    found = _Worst(last=scenarios[0])
    for scenario in scenarios:
        found.count, found.last = found.count + 1, scenario
        _look(controller, name, scenario, bumper, found)
        if found.broken:
            break
    return found


def _look(controller: Controller, name: str, scenario: Scenario, bumper: Bumper, found: "_Worst") -> None:
    """Hold one plant against what was found before."""
    domain, h, law = (
        controller.certificate.domain[name],
        controller.sample_time_s,
        admittance_controller(controller, name),
    )
    try:
        plant: Plant = replace(scenario.plant(domain.plants.nominal), bumper=bumper)
        pair = build_sampled_contact(build_sampled_plant(plant, h))
        margins = [find_margins(each, law) for each in (pair.free, pair.contact)]
        contact = simulate_contact(pair, law, domain.approach)
    except (ParameterError, UnstableLoopError) as refusal:
        found.broken = str(refusal)
        return
    if not contact.is_settled:
        found.broken = "the contact does not come to rest"
    for key, of_margins in _MARGINS.items():
        found.margins[key] = min(found.margins.get(key, math.inf), *(of_margins(each) for each in margins))
    found.sensor_n = max(found.sensor_n, contact.peak_sensor_force_n)
    limit = asked_of(controller, name).get("contact_at_speed")
    if isinstance(limit, ContactAtSpeed):
        led = led_contacts(pair, limit.hand, limit.hand_mass_kg)
        found.led_n = max([found.led_n, *(led_peaks(each, law, [limit.approach])[0] for each in led)])
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
