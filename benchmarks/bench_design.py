"""One design in one scenario: stability, modulus margin at the force and peak contact force, beside python-control.

python-control gets the loop in state space and computes the same quantities: poles, the frequency response on the same
grid, and `forced_response` of the loop in contact (no leaving, so the scenario is one that stays in contact).

Usage: python benchmarks/bench_design.py
"""

import os
import sys
import time
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np

from problems.contact import Approach, build_sampled_contact, settling_samples, steady_approach, transient_from
from problems.controller import AdmittanceController
from problems.plant import Coupling, Environment, Payload, Plant
from problems.response import loop_response
from problems.robot import RobotModel
from problems.sampled import build_loop, build_sampled_plant, spectral_radius

H = 8e-4
GRID = np.geomspace(2.0 * np.pi * 0.2, np.pi / H, 500)
APPROACH = Approach(force_n=30.0)


def main() -> int:
    plant = Plant(
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=0.0),
        payload=Payload(mass_kg=16.0, drag_n_s_per_m=630.0),
        environment=Environment(stiffness_n_per_m=1e5),
    )
    pair = build_sampled_contact(build_sampled_plant(plant, H))
    controller = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1200.0, lead_s=0.02)

    def ours() -> tuple[float, float, float]:
        loop, free = build_loop(pair.contact, controller), build_loop(pair.free, controller)
        radius = spectral_radius(loop)
        margin = float(np.min(np.abs(1.0 + loop_response(pair.contact, controller, GRID).at_force)))
        run = transient_from(pair, free, controller, APPROACH, settling_samples(radius, H))
        return radius, margin, run.peak_contact_force_n

    def peer() -> tuple[float, float, float]:
        loop, free = build_loop(pair.contact, controller), build_loop(pair.free, controller)
        start = steady_approach(pair.free, free, APPROACH)
        wall = np.zeros(len(loop.a))
        wall[pair.contact.state_count - 2] = plant.environment.stiffness_n_per_m
        system = control.ss(loop.a, loop.b[:, None], np.array([loop.c_force, wall]), np.zeros((2, 1)), H)
        radius = float(np.max(np.abs(system.poles())))
        closed = control.frequency_response(system[0, 0], GRID).complex
        # F/F^d = −L/(1 + L), so S = 1 + F/F^d and the modulus margin is 1/max |S|.
        margin = float(1.0 / np.max(np.abs(1.0 + closed)))
        samples = settling_samples(radius, H)
        time_s = np.arange(samples) * H
        run = control.forced_response(system, time_s, np.full(samples, start.force_n), start.state)
        return radius, margin, float(np.max(run.outputs[1]))

    ours()  # compiled code is loaded outside the measurement
    mine, theirs = ours(), peer()
    fast, slow = _best(ours, 50), _best(peer, 10)
    print("                 spectral radius  modulus margin  peak force [N]   time [ms]")
    print(f"autotune         {mine[0]:15.9f}  {mine[1]:14.9f}  {mine[2]:14.9f}  {fast * 1e3:10.3f}")
    print(f"python-control   {theirs[0]:15.9f}  {theirs[1]:14.9f}  {theirs[2]:14.9f}  {slow * 1e3:10.3f}")
    print(f"ratio {slow / fast:.0f}")
    return 0


def _best(run: Callable[[], object], times: int) -> float:
    found = []
    for _ in range(times):
        begin = time.perf_counter()
        run()
        found.append(time.perf_counter() - begin)
    return min(found)


if __name__ == "__main__":
    sys.exit(main())
