"""Time of what a certificate says of contacts beyond one axis alone: led by hand, driven on, on a surface with mass.

Processor time on the demo's kind of cell, each beside what it says.
"""

import time
from collections.abc import Callable

from autotune.certificate.certify import prove
from autotune.certificate.family import WORK_PER_SECOND, Claim
from problems.contact.transient import build_sampled_contact
from problems.design.driving_hand import largest_driven_peak
from problems.design.hand import HandImpedance
from problems.design.requirements import HANDS, hand_approach, led_contacts, led_peaks
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant

PERIOD_S, SPEED_M_S = 8e-4, 0.1
LAW = AdmittanceController(mass_kg=5.0, damping_n_s_per_m=1190.0, lead_s=0.0213, feedback_damping_s=0.007)
STIFFNESS, MASS = (8e4, 1.6e5), (14.0, 18.0)


def plants(moved_kg: float) -> PlantSet:
    """Return K_e × M_p, on a surface of which up to so much moves."""
    return PlantSet.of(
        RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling_stiffness_n_per_m=3e5,
        coupling_damping_n_s_per_m=150.0,
        drag_n_s_per_m=330.0,
        environment_stiffness_n_per_m=STIFFNESS,
        payload_mass_kg=MASS,
        further={"environment_mass_kg": (0.0, moved_kg)} if moved_kg else {},
    )


def corners() -> list[Plant]:
    """Return the plants at the ends of K_e and M_p."""
    return [plants(0.0).at(mass, stiffness) for mass in MASS for stiffness in STIFFNESS]


def led() -> str:
    """Return the peaks per speed of a hand that pushes on, lets go or holds, over the corners."""
    worst = dict.fromkeys(HANDS, 0.0)
    for plant in corners():
        pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
        alone, held = led_contacts(pair, "holds", HandImpedance().mass_kg)
        approaches = [hand_approach(SPEED_M_S, hand) for hand in HANDS]
        found = dict(zip(HANDS, led_peaks(alone, LAW, approaches), strict=True))
        found["holds"] = max(found["holds"], *led_peaks(held, LAW, [hand_approach(SPEED_M_S, "holds")]))
        worst = {hand: max(worst[hand], peak / SPEED_M_S) for hand, peak in found.items()}
    return ", ".join(f"{hand.replace('_', ' ')} {peak:.0f} N per m/s" for hand, peak in worst.items())


def driven() -> str:
    """Return the largest peak per speed of an arm that drives on, over the corners."""
    return f"{largest_driven_peak(corners(), LAW, HandImpedance(), PERIOD_S):.0f} N per m/s"


def proved(moved_kg: float) -> str:
    """Return what is proved over K_e × M_p, or K_e × M_p × M_e."""
    claim = Claim(
        plants=plants(moved_kg), law=LAW, sample_time_s=PERIOD_S, modulus=0.45, work=int(60.0 * WORK_PER_SECOND)
    )
    found = prove(claim)
    return f"|1 + L| > 0.45 for {100.0 * found.share:.3g} %, {found.cells} cells"


def main() -> None:
    parts: dict[str, Callable[[], str]] = {
        "led by hand, four plants": led,
        "driven on by an arm, four plants, four arms": driven,
        "proof over K_e and M_p": lambda: proved(0.0),
        "proof over K_e, M_p and M_e up to 4 kg": lambda: proved(4.0),
    }
    for name, part in parts.items():
        part()  # compiles
        start = time.process_time()
        said = part()
        print(f"{name}: {time.process_time() - start:.2f} s of the processor; {said}")


if __name__ == "__main__":
    main()
