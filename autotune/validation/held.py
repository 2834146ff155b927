"""A payload that a hand holds: what of the modulus is left, proved over every such hand, and checked from the file."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from autotune.certificate.certify import METHOD
from autotune.certificate.family import WORK_PER_SECOND, Claim
from autotune.formats.controller_record import Controller
from autotune.formats.proof_records import HeldProof
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.design.hand import HandImpedance
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant

from .axis_proof import ProofOptions, Prover, describe_false
from .margins import sweep_margins
from .report import Check

_SAME_NUMBER = 1e-6
# A claim that is refuted is made again with this share of its modulus, so often.
_LOWERED, _TRIES = 0.9, 4
# Shares of the largest impedance that are swept; springs that are soft beside the admittance have margins of their own.
_SHARES, _SPRINGS = (0.0, 1.0), (0.0, 0.003, 0.1, 1.0)
_OTHER_SHARES, _OTHER_SPRINGS = (0.0, 0.4), (0.001, 0.03, 0.5)


def prove_held(
    prover: Prover,
    plants: PlantSet,
    law: AdmittanceController,
    sample_time_s: float,
    hand: HandImpedance,
    options: ProofOptions,
) -> HeldProof:
    """Prove the modulus that a sweep over surfaces and hands finds, less the slack, and lower it where it is false."""
    held = _held(plants, hand, _SHARES, _SPRINGS)
    swept = sweep_margins(plants.only(), law, sample_time_s, stiffness=2, mass=2, others=held)
    nothing = HeldProof(
        hand=hand,
        modulus=0.0,
        method=METHOD,
        share=0.0,
        cells=0.0,
        arcs=0.0,
        budget_s=options.budget_s,
        run_time_s=0.0,
    )
    if not swept.largest_radius < 1.0:
        return nothing
    modulus = (1.0 - options.slack) * min(swept.values["modulus"], 1.0)
    for _ in range(_TRIES):
        found = prover.prove(_claim(plants, law, sample_time_s, replace(nothing, modulus=modulus)))
        if found.false is None:
            return replace(
                nothing,
                modulus=modulus,
                share=found.share,
                cells=float(found.cells),
                arcs=float(found.arcs),
                run_time_s=found.run_time_s,
            )
        modulus *= _LOWERED
    return nothing


def check_held(controller: Controller, name: str, law: AdmittanceController, prover: Prover) -> Iterator[Check]:
    """Prove again what the file states of a payload that is held, and look at other hands by another method."""
    stated = (controller.certificate.held or {}).get(name)
    if stated is None:
        return
    plants, h = controller.certificate.domain[name].plants, controller.sample_time_s
    words = stated.hand.describe(turning=name in ROTATIONAL_AXES)
    check = partial(Check, axis=name, name="held by a hand")
    if stated.modulus == 0.0:
        yield check(passed=True, message=f"nothing is claimed: {words} may make the loop unstable", warns=True)
        return
    claim = _claim(plants, law, h, stated)
    origin, found = prover.origin(claim), prover.prove(claim)
    bound = f"|1 + L| > {stated.modulus:.4g} and stable with {words}"
    if found.false is not None:
        yield check(passed=False, message=f"{bound}: {describe_false(found.false, axis_units(name))}")
        return
    if stated.share > found.share + _SAME_NUMBER:
        message = f"{bound}: claimed for the share {stated.share:.4g}, proved for {found.share:.4g}"
        yield check(passed=False, message=message)
        return
    others = _held(plants, stated.hand, _OTHER_SHARES, _OTHER_SPRINGS)
    swept = sweep_margins(plants.only(), law, h, stiffness=2, mass=2, others=others)
    if not (swept.largest_radius < 1.0 and swept.values["modulus"] > stated.modulus):
        seen = f"a sweep finds {swept.values['modulus']:.4g}, largest |z| {swept.largest_radius:.6f}"
        yield check(passed=False, message=f"{bound}: {seen}")
        return
    part = "" if stated.share == 1.0 else f" for {100.0 * stated.share:.4g} % of the set"
    counts = f"{found.cells} cells{origin}; {swept.plants} plants swept"
    message = f"{bound}, on every surface and off it: proved{part} ({counts})"
    yield check(passed=True, message=message, warns=stated.share < 1.0)


def _claim(plants: PlantSet, law: AdmittanceController, sample_time_s: float, held: HeldProof) -> Claim:
    return Claim(
        plants=plants.only(),
        law=law,
        sample_time_s=sample_time_s,
        modulus=held.modulus,
        work=int(held.budget_s * WORK_PER_SECOND),
        hand=held.hand,
    )


def _held(
    plants: PlantSet, hand: HandImpedance, shares: tuple[float, ...], springs: tuple[float, ...]
) -> tuple[Plant, ...]:
    """Return the corners of K_e × M_p and free space, each held by hands with these shares of the largest impedance."""
    touched = itertools.product(plants.payload_mass_kg, (0.0, *plants.environment_stiffness_n_per_m))
    hands = [
        HandImpedance(
            mass_kg=heavy * hand.mass_kg,
            damping_n_s_per_m=damped * hand.damping_n_s_per_m,
            stiffness_n_per_m=stiff * hand.stiffness_n_per_m,
        )
        for heavy, damped, stiff in itertools.product(shares, shares, springs)
    ]
    found = [plants.at(mass, stiffness) for mass, stiffness in touched]
    return tuple(dict.fromkeys(each.holding(plant) for plant in found for each in hands))
