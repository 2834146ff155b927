"""Time to check axes on one payload, x and ry, and all six, and to prove x and ry, beside what is found."""

import time

import numpy as np

from autotune.certificate.coupled import prove_coupled
from autotune.certificate.coupled_system import BREAK_POINTS, CoupledFamily
from autotune.certificate.family import WORK_PER_SECOND
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.coupled_record import CoupledBody
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_sweep import sweep_coupled
from problems.model.controller import AdmittanceController
from problems.model.coupled import PointSurface

PERIOD_S, LEVER_M, INERTIA_KG_M2 = 8e-4, 0.2, 0.8


def domain(scale: float, mass: tuple[float, float]) -> AxisDomain:
    """Return the certified set of a straight axis, or with the squared lever as `scale` of a turning one."""
    return AxisDomain(
        environment_stiffness_n_per_m=(2e4 * scale, 5e5 * scale),
        payload_mass_kg=mass,
        environment_damping_n_s_per_m=0.0,
        environment_mass_kg=0.0,
        coupling_stiffness_n_per_m=3e5 * scale,
        coupling_damping_n_s_per_m=150.0 * scale,
        drag_n_s_per_m=330.0 * scale,
        robot_numerator=(20.0,),
        robot_denominator=(1.0, 20.0),
        delay_s=2.4e-3,
        approach_force_n=30.0 * np.sqrt(scale),
    )


def cell(names: tuple[str, ...]) -> tuple[CoupledCell, CoupledBody]:
    """Return axes under one design, straight ones and turning ones through the lever."""
    domains, laws = {}, {}
    for name in names:
        scale = LEVER_M**2 if name.startswith("r") else 1.0
        mass = (INERTIA_KG_M2, INERTIA_KG_M2) if name.startswith("r") else (15.7, 16.3)
        domains[name] = domain(scale, mass)
        laws[name] = AdmittanceController(
            mass_kg=10.0 * scale, damping_n_s_per_m=1600.0 * scale, lead_s=0.02, feedback_damping_s=0.01
        )
    body = CoupledBody(
        mass_kg=16.0,
        com_m=(0.012, -0.008, 0.15),
        inertia_kg_m2={"xx": INERTIA_KG_M2, "yy": INERTIA_KG_M2, "zz": INERTIA_KG_M2},
        held={},
    )
    made = CoupledCell(
        domains=domains,
        laws=laws,
        held={},
        payload=body.rigid(),
        contact_points_m=(),
        sample_time_s=PERIOD_S,
    )
    return made, body


def prove(factors: tuple[float, float], slack: float, budget_s: float) -> None:
    """Print what of x and ry is proved over K_e and so many times the mass, cut at the forces and at the commands."""
    of, body = cell(("x", "ry"))
    certificate = sweep_coupled(of, body).certificate
    if certificate is None:
        return
    (group,) = certificate.groups
    touched: dict[str, tuple[PointSurface | None, tuple[float, float]]] = {"free space": (None, (0.0, 0.0))}
    for name in group:
        stiffness = of.domains[name].environment_stiffness_n_per_m
        touched[f"touching along {name}"] = of.surface(group, name, max(stiffness)), stiffness
    for at in BREAK_POINTS:
        for where, (surface, stiffness) in touched.items():
            family = CoupledFamily(
                plant=of.plant(group, of.payload.mass_kg, surface),
                laws=of.law(group),
                scale=of.scale(group),
                sample_time_s=PERIOD_S,
                stiffness_n_per_m=stiffness,
                mass_factors=factors,
                at=at,
            )
            start, modulus = time.process_time(), (1.0 - slack) * certificate.modulus
            found = prove_coupled(family, modulus, work=int(budget_s * WORK_PER_SECOND))
            spent = time.process_time() - start
            print(
                f"  {where}, cut at the {at}s, σ_min(I + L) > {modulus:.3f}: {100.0 * found.share:.0f} % in "
                f"{spent:.1f} s ({found.work / WORK_PER_SECOND:.1f} s as the file counts it), {found.cells} cells"
            )


def main() -> None:
    sweep_coupled(*cell(("x", "ry")))  # compiles
    for names in (("x", "ry"), ("x", "y", "z", "rx", "ry", "rz")):
        of, body = cell(names)
        start = time.process_time()
        found = sweep_coupled(of, body)
        spent = time.process_time() - start
        print(f"{', '.join(names)}: {spent:.2f} s of the processor")
        if found.failure is not None:
            print(f"  {found.failure.message()}")
        for line in () if found.certificate is None else found.certificate.sentences():
            print(f"  {line}")
    print("x, ry: proved over K_e 20 to 500 N/mm and 11.2 to 20.8 kg, 60 s each")
    prove((0.7, 1.3), 0.05, 60.0)


if __name__ == "__main__":
    main()
