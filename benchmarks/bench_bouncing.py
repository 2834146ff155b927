"""Time to search a controller for contacts that bounce for ever, and to find one: runs, seconds, verdict."""

import time

from autotune.formats.certificate_record import AxisDomain
from autotune.validation.bouncing import search_bouncing
from problems.model.controller import AdmittanceController

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


def main() -> None:
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
