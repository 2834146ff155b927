"""Design a controller for a plant in a few numbers, compare what uncertainty costs, and save it.

python examples/design_from_python.py [controller.yaml]
"""

import sys

import autotune as at

EXACT = at.Plant(
    mass=16.0,
    coupling_stiffness=3e5,
    drag=630.0,
    robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    environment_stiffness=(4e4, 8e4),
    sample_time=8e-4,
)
UNCERTAIN = at.Plant(
    mass=(15.0, 17.0),
    coupling_stiffness=3e5,
    drag=630.0,
    robot=at.Robot(bandwidth=3.2, delay=at.Uncertain(2.4e-3, 1e-4)),
    environment_stiffness=(4e4, 8e4),
    sample_time=8e-4,
)


def main(out: str | None = None) -> None:
    for name, plant in (("exact", EXACT), ("uncertain", UNCERTAIN)):
        design = at.optimize(plant)
        contact = at.predict(design, environment_stiffness=6e4, payload_mass=16.0)
        print(f"{name}: largest peak {design.peak_force:.1f} N, at 60 N/mm {contact.peak_force:.1f} N")
    if out is not None:
        design.save(out)


if __name__ == "__main__":
    main(*sys.argv[1:2])
