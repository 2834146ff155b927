"""Cost of a payload that touches with a bumper: `optimize` beside the same without one, and the proof of its modulus.

Processor time on the paper's cell, kernels compiled; a proof's share is that of the set K_e × M_p within 60 s of work.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import autotune as at
from autotune.certificate.certify import prove
from autotune.certificate.family import WORK_PER_SECOND, Claim
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Bumper
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins

PERIOD_S = 8e-4
PLANT = at.Plant(
    mass=16,
    coupling_stiffness=3e5,
    drag=630,
    robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    environment_stiffness=(2e4, 5e5),
    sample_time=PERIOD_S,
)
BUMPER = Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=20.0)
LAW = AdmittanceController(mass_kg=12.0, damping_n_s_per_m=1300.0, lead_s=0.013, feedback_damping_s=0.005)
SETS = ((2e4, 2e5, 0.03), (2e4, 2e5, 0.2), (2e4, 5e5, 0.0), (2e4, 5e5, 0.2))


def timed(part: Callable[[], at.Design]) -> tuple[float, at.Design]:
    """Return processor time and result."""
    start = time.process_time()
    found = part()
    return time.process_time() - start, found


def proved(low: float, high: float, of_mass: float) -> str:
    """Return what is proved over one set, of 0.95 times the least modulus that a grid of it has."""
    plants = PlantSet.of(
        RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling_stiffness_n_per_m=3e5,
        coupling_damping_n_s_per_m=150.0,
        drag_n_s_per_m=630.0,
        environment_stiffness_n_per_m=(low, high),
        payload_mass_kg=(16.0 * (1.0 - of_mass), 16.0 * (1.0 + of_mass)),
    )
    soft = replace(plants, nominal=replace(plants.nominal, bumper=BUMPER))
    grid = [soft.at(mass, each) for mass in plants.payload_mass_kg for each in np.geomspace(low, high, 33).tolist()]
    least = min(find_margins(build_sampled_plant(each, PERIOD_S), LAW).modulus for each in grid)
    work = int(60.0 * WORK_PER_SECOND)
    claim = Claim(plants=soft, law=LAW, sample_time_s=PERIOD_S, modulus=0.95 * least, work=work)
    start = time.process_time()
    found = prove(claim)
    return (
        f"|1 + L| > {claim.modulus:.3f}: {100.0 * found.share:.3g} % proved, {found.cells} cells, "
        f"{time.process_time() - start:.2f} s"
    )


def main() -> None:
    at.optimize(PLANT, bumper=BUMPER)  # compiles
    plain, without = timed(lambda: at.optimize(PLANT))
    soft, found = timed(lambda: at.optimize(PLANT, bumper=BUMPER))
    print(f"optimize: {plain:.2f} s of the processor without, {soft:.2f} s with a bumper ({soft / plain:.2f} times)")
    print(f"largest peak of the payload in one piece: {without.peak_force:.1f} N, {found.peak_force:.1f} N")
    for low, high, of_mass in SETS:
        said = f"K_e {low / 1e3:g} to {high / 1e3:g} N/mm, M_p ± {100.0 * of_mass:g} %"
        print(f"{said}: {proved(low, high, of_mass)}")


if __name__ == "__main__":
    main()
