"""Time to prove stability, modulus and peaks of the paper's cell over continuous ranges; false claims of peaks."""

import time

import numpy as np

from autotune.certificate.certify import certify, prove
from autotune.certificate.family import WORK_PER_SECOND, Claim, Family, build_families
from autotune.certificate.peaks import prove_peak
from autotune.validation.margins import sweep_margins
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact, transient_from
from problems.design.requirements import HeldByHand
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant

PERIOD_S = 8e-4
STIFFNESSES = (2e4, 5e5)
WORK = 20_000_000
PRESS = Approach(force_n=30.0)
LAW = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1600.0, lead_s=0.02, feedback_damping_s=0.01)
PLANT = Plant(
    robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
    coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=0.0),
    payload=PayloadDynamics(mass_kg=16.0, drag_n_s_per_m=630.0),
    environment=Environment(stiffness_n_per_m=STIFFNESSES[0]),
)


def drawn_cell(rng: np.random.Generator) -> tuple[PlantSet, AdmittanceController]:
    """Return a drawn cell with a law that is stable at the ends of its ranges."""
    while True:
        soft, light = float(rng.uniform(2e4, 2e5)), float(rng.uniform(8.0, 20.0))
        plants = PlantSet.of(
            RobotModel.from_bandwidth(
                bandwidth_rad_per_s=float(rng.uniform(15.0, 30.0)), delay_s=float(rng.uniform(1.0, 4.0)) * PERIOD_S
            ),
            environment_stiffness_n_per_m=(soft, soft * float(rng.uniform(1.1, 1.8))),
            payload_mass_kg=(light, light * float(rng.uniform(1.0, 1.2))),
            coupling_stiffness_n_per_m=3e5,
            coupling_damping_n_s_per_m=float(rng.choice([0.0, 150.0])),
            drag_n_s_per_m=float(rng.uniform(200.0, 800.0)),
            environment_damping_n_s_per_m=float(rng.choice([0.0, 30.0])),
        )
        law = AdmittanceController(
            mass_kg=float(rng.uniform(8.0, 25.0)),
            damping_n_s_per_m=float(rng.uniform(1200.0, 3500.0)),
            lead_s=0.015,
            feedback_damping_s=0.01,
        )
        if sweep_margins(plants, law, PERIOD_S, stiffness=3, mass=2).largest_radius < 0.999:
            return plants, law


def attack(count: int) -> None:
    """Print how many claims of a peak 0.5 % below the worst of a cell are refuted, left open, and proved: 0."""
    rng, refuted, proved, spent = np.random.default_rng(3), 0, 0, 0.0
    for _ in range(count):
        plants, law = drawn_cell(rng)
        (family,) = build_families(plants.nominal, plants.ranges, PERIOD_S)
        grid = [
            plants.at(m, k)
            for m in np.linspace(*plants.payload_mass_kg, 3)
            for k in np.geomspace(*plants.environment_stiffness_n_per_m, 9)
        ]
        pairs = [build_sampled_contact(build_sampled_plant(each, PERIOD_S)) for each in grid]
        worst = max(transient_from(pair, law, PRESS).peak_contact_force_n for pair in pairs)
        start = time.process_time()
        found = prove_peak(family, law, PRESS, 0.995 * worst, work=60_000)
        spent += time.process_time() - start
        refuted, proved = refuted + (found.refuted_by is not None), proved + found.holds
    print(
        f"of {count} claims 0.5 % below the worst peak {refuted} are refuted, {count - refuted - proved} left open, "
        f"{proved} proved; {spent / count:.2f} s each"
    )


def main() -> None:
    for mass, slacks in (((16.0, 16.0), (0.1, 0.05, 0.03, 0.01)), ((14.0, 24.0), (0.1, 0.05, 0.03))):
        plants = PlantSet(nominal=PLANT, ranges={STIFFNESS: STIFFNESSES, MASS: mass})
        swept = sweep_margins(plants, LAW, PERIOD_S, stiffness=25, mass=3)
        domain = f"K_e {STIFFNESSES[0]:g} to {STIFFNESSES[1]:g} N/m, M_p {mass[0]:g} to {mass[1]:g} kg"
        print(f"{domain}: swept modulus {swept.values['modulus']:.4f}")
        family = Family(nominal=PLANT, ranges=plants.ranges, sample_time_s=PERIOD_S)
        claims: list[tuple[str, float | None]] = [
            (f"{100 * slack:4.1f} % slack", (1.0 - slack) * swept.values["modulus"]) for slack in slacks
        ]
        for name, modulus in [*claims, ("stability alone", None)]:
            start = time.process_time()
            parts = [certify(each, LAW, modulus, work=WORK) for each in (family, family.in_free_space())]
            spent = time.process_time() - start
            cells, arcs = sum(p.cells for p in parts), sum(p.arcs for p in parts)
            counted = sum(p.work for p in parts) / WORK_PER_SECOND
            verdict = "proved" if all(p.holds for p in parts) else "NOT proved"
            took = f"{spent:6.2f} s ({counted:.2f} s as the file counts it)"
            print(f"  {name}: {verdict}, {took}, {cells} cells, {arcs} arcs")
        held = HeldByHand(min_modulus=0.1)
        corners = [each.holding(plants.at(m, k)) for each in held.corners() for m in mass for k in (0.0, *STIFFNESSES)]
        least = sweep_margins(plants, LAW, PERIOD_S, stiffness=2, mass=2, others=corners).values["modulus"]
        claim = Claim(plants=plants, law=LAW, sample_time_s=PERIOD_S, modulus=0.95 * least, work=WORK, hand=held.hand)
        start = time.process_time()
        found = prove(claim)
        spent = time.process_time() - start
        took = f"{spent:6.2f} s ({found.run_time_s:.2f} s as the file counts it), {found.cells} cells"
        verdict = "proved" if found.holds else "NOT proved"
        print(f"   5.0 % slack, with {held.hand.describe()} (swept {least:.4f}): {verdict}, {took}")
        ends = [plants.at(m, k) for m in np.linspace(*mass, 3) for k in np.geomspace(*STIFFNESSES, 12)]
        pairs = [build_sampled_contact(build_sampled_plant(each, PERIOD_S)) for each in ends]
        largest = max(simulate_contact(pair, LAW, PRESS).peak_contact_force_n for pair in pairs)
        for slack in (0.05, 0.02):
            start = time.process_time()
            peak = prove_peak(family, LAW, PRESS, (1.0 + slack) * largest, work=WORK)
            spent = time.process_time() - start
            took = f"{spent:6.2f} s ({peak.work / WORK_PER_SECOND:.2f} s as the file counts it), {peak.cells} cells"
            verdict = "proved" if peak.holds else "NOT proved"
            print(
                f"  {100 * slack:4.1f} % slack, no first contact above {(1 + slack) * largest:.2f} N: {verdict}, {took}"
            )
        false = certify(family, LAW, 1.05 * swept.values["modulus"], work=WORK)
        print(f"  a claim 5 % too high: {false.verdict.name.lower()} after {false.work} units of work")
    attack(200)


if __name__ == "__main__":
    main()
