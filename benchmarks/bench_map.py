"""A stability map of 10,800 points, beside a loop over python-control; and what the first map of a process costs.

Usage: python benchmarks/bench_map.py

Two loops are timed on the same exact sampled system (held plant, whole delay, Tustin controller): one that builds
everything at each point, as one writes it down, and one that discretises each plant and each controller once and
only closes the loop and asks for its poles. Their verdicts are compared with the map's at every point they did.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.timing import best
from problems.maps.loops import Where
from problems.maps.maps import MapAxis, MapRequest, MapResult, compute_map
from problems.maps.search import IntervalCase, IntervalRequest, find_stable_intervals
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant, build_plant_matrices
from problems.model.robot import RobotModel

ROOT = Path(__file__).resolve().parent.parent
H, DELAY_SAMPLES = 8e-4, 3
LEAD = MapAxis(name="lead_s", low=0.0, high=0.06, count=90)
DAMPING = MapAxis(name="damping", low=200.0, high=5000.0, count=120, spacing="log")
STIFFNESS = MapAxis(name="environment_stiffness", low=1e4, high=1e6, count=120, spacing="log")
MASS = MapAxis(name="payload_mass", low=4.0, high=60.0, count=90)
# Every 5th point: enough to see what a point costs when all of them would take minutes.
EVERY = 5
ONE_MAP = (
    "import sys, time; t = time.perf_counter(); sys.path.insert(0, sys.argv[1]);"
    "from benchmarks.bench_map import request, STIFFNESS, LEAD, compute_map; m = time.perf_counter();"
    "compute_map(request(STIFFNESS, LEAD)); e = time.perf_counter(); print(m - t, e - m)"
)


def main() -> int:
    print("stability of 10,800 points, in contact [ms]")
    for name, (x, y) in {
        "lead over stiffness": (STIFFNESS, LEAD),
        "lead over damping": (DAMPING, LEAD),
        "payload mass over stiffness (10,800 plants)": (STIFFNESS, MASS),
    }.items():
        seconds = best(lambda x=x, y=y: compute_map(request(x, y)), 7)  # type: ignore[misc]
        print(f"  {name:45} {seconds * 1e3:8.1f}")
    seconds = best(lambda: compute_map(request(STIFFNESS, LEAD, "both")), 7)
    print(f"  {'lead over stiffness, and in free space':45} {seconds * 1e3:8.1f}")
    seconds = best(lambda: find_stable_intervals(search()), 3)
    print(f"  {'stable leads at 120 stiffnesses, bisected':45} {seconds * 1e3:8.1f}")
    print("\nlead over stiffness beside python-control")
    fast = best(lambda: compute_map(request(STIFFNESS, LEAD)), 7)
    verdicts = compute_map(request(STIFFNESS, LEAD))
    for name, loop in (("everything at each point", written_down), ("parts discretised once", careful)):
        slow, done, same = peer(loop, verdicts)
        print(
            f"  {name:26} {slow:6.2f} s for 10,800 points ({done} timed), verdicts agree at {same} of {done}: "
            f"ratio {slow / fast:.0f}"
        )
    starts()
    return 0


def request(x: MapAxis, y: MapAxis, where: Where = "contact") -> MapRequest:
    """Return a stability map around the paper's example."""
    return MapRequest(plant=plant(1e5), controller=design(0.01), sample_time_s=H, x=x, y=y, where=where)


def search() -> IntervalRequest:
    """Return the search of the stable leads along the stiffness."""
    cases = {"": IntervalCase(controller=design(0.01))}
    searched = MapAxis(name="lead_s", low=0.0, high=0.1, count=401)
    return IntervalRequest(
        plant=plant(1e5), sample_time_s=H, cases=cases, along=STIFFNESS, searched=searched, where="contact"
    )


def plant(stiffness: float) -> Plant:
    """Return the paper's cell in contact with a wall."""
    return Plant(
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=DELAY_SAMPLES * H),
        coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=0.0),
        payload=PayloadDynamics(mass_kg=16.0, drag_n_s_per_m=630.0),
        environment=Environment(stiffness_n_per_m=stiffness),
    )


def design(lead_s: float) -> AdmittanceController:
    """Return a controller of the paper's size."""
    return AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1000.0, lead_s=lead_s)


def peer(
    loop: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]], result: MapResult
) -> tuple[float, int, int]:
    """Return the time of all points by a python-control loop, on how many it was measured, and how many agree."""
    stiffness, lead = STIFFNESS.values(), LEAD.values()[::EVERY]
    begin = time.perf_counter()
    stable = loop(stiffness, lead)
    seconds = time.perf_counter() - begin
    same = int(np.sum(stable == result.is_stable[::EVERY]))
    return seconds * result.is_stable.size / stable.size, stable.size, same


def written_down(stiffness: NDArray[np.float64], lead: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Judge every point with everything built on the spot."""
    return np.array([[is_stable(held(k), sampled(lead_s)) for k in stiffness] for lead_s in lead])


def careful(stiffness: NDArray[np.float64], lead: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Judge every point, each plant and each controller discretised once."""
    plants = [held(k) for k in stiffness]
    return np.array([[is_stable(one, law) for one in plants] for law in map(sampled, lead)])


def held(stiffness: float) -> control.StateSpace:
    """Return the plant under the hold, with its delay."""
    m = build_plant_matrices(plant(float(stiffness)), 1.0)
    continuous = control.ss(m.a, m.b[:, None], m.c_force[None, :], [[m.d_force]])
    d = DELAY_SAMPLES
    shift = control.ss(np.eye(d, k=-1), np.eye(d, 1), np.eye(1, d, k=d - 1), [[0.0]], H)
    return control.c2d(continuous, H, "zoh") * shift


def sampled(lead_s: float) -> control.StateSpace:
    """Return the Tustin form of the admittance with lead."""
    law = design(float(lead_s))
    return control.c2d(
        control.ss(control.tf([law.lead_s, 1.0], [law.mass_kg, law.damping_n_s_per_m, 0.0])), H, "tustin"
    )


def is_stable(plant_system: control.StateSpace, law: control.StateSpace) -> bool:
    """Close the loop and look at its poles; F is what the payload puts on the flange, hence the sign."""
    return bool(np.max(np.abs(control.feedback(-plant_system * law, 1).poles())) < 1.0)


def starts() -> None:
    """Time the first map of a process, with nothing compiled and with everything on disk."""
    print("\nfirst map of a process [s]    imports    map")
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(ROOT)}
        for name in ("nothing compiled", "compiled code on disk"):
            done = subprocess.run(
                [sys.executable, "-c", ONE_MAP, str(ROOT)], capture_output=True, text=True, env=environment, check=True
            )
            imports, spent = map(float, done.stdout.split())
            print(f"  {name:25}    {imports:7.2f}  {spent:5.2f}")


if __name__ == "__main__":
    sys.exit(main())
