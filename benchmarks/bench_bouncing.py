"""Contacts that bounce for ever: drawn designs that are proved not to, an attack on that, the cost of the search."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from autotune.certificate.bouncing import prove_rest
from autotune.certificate.family import build_families
from autotune.certificate.multiplier_search import find_multiplier
from autotune.errors import AutotuneError
from autotune.formats.certificate_record import AxisDomain
from autotune.tuning.search import solve_design
from autotune.validation.bouncing import search_bouncing
from benchmarks.tuning_problems import draw_problem
from problems.contact.bouncing import Ending, follow_contact, settling_window
from problems.contact.transient import Approach, build_sampled_contact
from problems.design.problem import DesignProblem
from problems.design.uncertainty import ALWAYS_UNCERTAIN, Scenario
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError

PERIOD_S = 8e-4


def domain(pole: float, stiffness: tuple[float, float], mass: tuple[float, float], coupling: float) -> AxisDomain:
    """Return a certified set with a robot of one pole."""
    return AxisDomain(
        environment_stiffness_n_per_m=stiffness,
        payload_mass_kg=mass,
        environment_damping_n_s_per_m=0.0,
        environment_mass_kg=0.0,
        coupling_stiffness_n_per_m=coupling,
        coupling_damping_n_s_per_m=2.0,
        drag_n_s_per_m=80.0 if mass[1] < 10.0 else 630.0,
        robot_numerator=(pole,),
        robot_denominator=(1.0, pole),
        delay_s=1.72616e-3 if mass[1] < 10.0 else 2.4e-3,
        approach_force_n=10.0,
        approach_speed_m_s=None,
    )


CASES = {
    "the paper's cell": (
        domain(20.0, (2e4, 5e5), (14.0, 24.0), 3e5),
        AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1600.0, lead_s=0.02, feedback_damping_s=0.01),
    ),
    "a light payload on a stiff wall": (
        domain(41.42, (3.0e6, 3.2e6), (3.96, 4.04), 3.6549e5),
        AdmittanceController(mass_kg=6.6788, damping_n_s_per_m=3582.1, lead_s=0.042425, feedback_damping_s=0.024376),
    ),
    "the same with less lead": (
        domain(41.42, (3.0e6, 3.2e6), (3.96, 4.04), 3.6549e5),
        AdmittanceController(mass_kg=6.6788, damping_n_s_per_m=3582.1, lead_s=0.03, feedback_damping_s=0.024376),
    ),
}


def drawn_designs(count: int) -> Iterator[tuple[DesignProblem, AdmittanceController]]:
    """Yield the first designs that the search makes for drawn cells; a cell without one is passed over."""
    for seed in itertools.count():
        if count == 0:
            return
        try:
            found = solve_design(draw_problem(seed), seed=0)
        except AutotuneError:
            continue
        count -= 1
        yield found.problem, found.problem.controller(found.design)


def proofs(designs: Sequence[tuple[DesignProblem, AdmittanceController]], damping: float) -> None:
    """Print how many designs are proved to come to rest on surfaces of B_e up to `damping`, and what that costs."""
    proved, spent = 0, []
    for problem, law in designs:
        start, plants = time.process_time(), problem.plants
        if damping > 0.0:
            plants = plants.with_ranges({"environment_damping_n_s_per_m": (0.0, damping)})
        box = plants.only((*ALWAYS_UNCERTAIN, *plants.further))
        families = build_families(box.nominal, box.ranges, problem.sample_time_s)
        multiplier = find_multiplier(families, law)
        if multiplier is not None:
            proved += all(prove_rest(each, law, multiplier, work=400_000).holds for each in families)
        spent.append(time.process_time() - start)
    print(
        f"{proved} of {len(designs)} drawn designs are proved to come to rest with B_e up to {damping:g} N·s/m, in "
        f"{np.median(spent):.2f} s (median), {max(spent):.2f} s (most)"
    )


def attack(count: int) -> None:
    """Print of designs on both sides of where bouncing begins how many bounce, are proved, and both: 0."""
    rng, (of, law) = np.random.default_rng(1), CASES["a light payload on a stiff wall"]
    plants, (mass, stiffness) = of.plants, (4.0, 3.12e6)
    plant = Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass).plant(plants.nominal)
    (one,) = build_families(plant, {}, PERIOD_S)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    bounced, proved, both, followed = 0, 0, 0, 0
    while followed < count:
        drawn = replace(
            law,
            lead_s=float(rng.uniform(0.02, 0.045)),
            damping_n_s_per_m=float(rng.uniform(2500.0, 5000.0)),
            feedback_damping_s=float(rng.uniform(0.015, 0.03)),
        )
        try:
            window = min(settling_window(pair, drawn), 1000)
        except UnstableLoopError:
            continue
        followed += 1
        multiplier = find_multiplier([one], drawn)
        is_proved = multiplier is not None and prove_rest(one, drawn, multiplier, work=40_000).holds
        impacts = (Approach(speed_m_s=0.01, after_impact_n=force) for force in (1.0, 3.0, 10.0, 30.0))
        bounces = any(follow_contact(pair, drawn, each, window=window).ending is Ending.BOUNCING for each in impacts)
        bounced, proved, both = bounced + bounces, proved + is_proved, both + (bounces and is_proved)
    print(f"of {followed} designs near bouncing {bounced} bounce, {proved} are proved to come to rest, {both} are both")


def main() -> None:
    designs = list(drawn_designs(30))
    for damping in (0.0, 100.0, 1000.0, 5000.0):
        proofs(designs, damping)
    attack(200)
    of, law = CASES["the paper's cell"]
    search_bouncing("x", of, law, PERIOD_S)  # compiles
    for name, (of, law) in CASES.items():
        start = time.process_time()
        found = search_bouncing("x", of, law, PERIOD_S)
        spent = time.process_time() - start
        print(f"{name}: {found.runs} impacts on {found.plants} plants in {spent:.2f} s of the processor")
        print(f"  {found.message()}")


if __name__ == "__main__":
    main()
