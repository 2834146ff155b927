"""Contacts of many plants of a certified set: the compiled batch beside the same contacts one by one in Python.

Usage: python benchmarks/bench_samples.py [CONTROLLER] [--samples 1000000] [--seed 1]

By default the controller is that of the demo's log, which takes some ten seconds before. The contacts one by one are
those of the first plants, and their time is scaled to all of them.
"""

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import autotune as at
from autotune.formats.controller import read_controller
from autotune.formats.controller_record import Controller
from autotune.processes import count_processors
from autotune.validation.monte_carlo import build_contacts, run_monte_carlo
from autotune.validation.monte_carlo_checks import monte_carlo_checks
from autotune.validation.sampled_contacts import CHUNK
from problems.contact.many_contacts import FULL_CONTACT, LINEAR_CONTACT

ONE_BY_ONE = 128


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("controller", nargs="?", type=Path)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    controller = _of_demo() if options.controller is None else read_controller(options.controller).controller
    # Whatever has to be compiled is compiled before.
    run_monte_carlo(controller, count=CHUNK, seed=options.seed)
    of = options.controller or "the demo's controller"
    print(f"{options.samples} plants of {of}, {count_processors()} processors")
    begin, spent = time.perf_counter(), time.process_time()
    found = run_monte_carlo(controller, count=options.samples, seed=options.seed)
    batch, batch_cpu = time.perf_counter() - begin, time.process_time() - spent
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"  compiled batch      {batch:10.1f} s, {batch_cpu:10.1f} s of processor, at most {memory:.0f} MB resident")
    peer, difference = _one_by_one(controller, options.seed)
    scaled = peer * options.samples / ONE_BY_ONE
    print(
        f"  one by one          {scaled:10.1f} s of processor, scaled from {ONE_BY_ONE}: {scaled / batch_cpu:.0f} times"
    )
    print(f"  largest difference of their peaks {difference:.1e}")
    for check in monte_carlo_checks(found):
        print(f"  axis {check.axis}, {check.name}: {check.message}")
    return 0


def _of_demo() -> Controller:
    """Return the controller that `optimize` finds from the demo's log."""
    with tempfile.TemporaryDirectory() as made:
        log, result = Path(made) / "demo.mcap", Path(made) / "controller.yaml"
        at.optimize(at.identify(at.simulate_log(log))).save(result)
        return read_controller(result).controller


def _one_by_one(controller: Controller, seed: int) -> tuple[float, float]:
    """Return the time of processor of the scalar simulation of every axis, and how far its peaks are from the batch."""
    spent, worst = 0.0, 0.0
    for name in controller.axes:
        contacts = build_contacts(controller, name, seed)
        batch, draws = contacts.simulate_chunk(0, ONE_BY_ONE), contacts.draw(0, ONE_BY_ONE)
        contacts.run(draws, 0)
        begin = time.process_time()
        peaks = [
            [contacts.run(draws, place, disturbed=disturbed).peak_contact_force_n for disturbed in (False, True)]
            for place in range(ONE_BY_ONE)
        ]
        spent += time.process_time() - begin
        both = np.array(peaks) / batch.peaks_n[:, [LINEAR_CONTACT, FULL_CONTACT]]
        worst = max(worst, float(np.max(np.abs(both - 1.0))))
    return spent, worst


if __name__ == "__main__":
    sys.exit(main())
