"""Simulate a cell of your own, write its log, and see how well it can be identified.

Usage: python examples/simulate_own_cell.py [LOG.mcap]
"""

import sys
from pathlib import Path

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from identification.identify import identify_cell
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment
from problems.model.robot import RobotModel


def main(arguments: list[str]) -> int:
    cell = SimulatedCell(
        payload_mass_kg=24.0,
        com_S_m=(0.0, 0.02, 0.18),
        coupling=Coupling(stiffness_n_per_m=1.8e5, damping_n_s_per_m=250.0),
        drag_n_s_per_m=150.0,
        environment=Environment(stiffness_n_per_m=6e4, damping_n_s_per_m=20.0),
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=28.0, delay_s=3.1e-3),
        controller=AdmittanceController(mass_kg=20.0, damping_n_s_per_m=2200.0, lead_s=0.006),
        approach_axis="z",
    )
    run = simulate_cell(cell, Program(pose_count=7, jogging_s=0.0, sweep_s=8.0, contact_count=3), seed=4)
    found = identify_cell(run.recording)
    axis = found.axes["z"]
    for name, truth, estimate in (
        ("M_p [kg]", cell.payload_mass_kg, found.payload.mass_kg),
        ("K_s [N/m]", cell.coupling.stiffness_n_per_m, axis.coupling.stiffness_n_per_m),
        ("K_e [N/m]", cell.environment.stiffness_n_per_m, axis.environments[0].stiffness_n_per_m),
        ("T_d [s]", cell.robot.delay_s, axis.robot.delay_s),
    ):
        shown = "-" if estimate.value is None else f"{estimate.value:10.6g} ± {estimate.std:.2g}"
        print(f"{name:10} true {truth:10.6g}  identified {shown} ({estimate.status})")
    if arguments:
        write_mcap(run.recording, Path(arguments[0]))
        print(f"written: {arguments[0]}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
