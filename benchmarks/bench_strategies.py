"""Cost of what is said of contact strategies beside what a simulation counts: false triggers, and changes of the law.

The paper's small robot with its collision response; a hand that leads a payload of 16 kg with three laws in turn.
"""

import itertools
import math
import time

import numpy as np

from autotune.certificate.dwelling import DwellLoop, prove_dwell
from autotune.certificate.family import build_families
from autotune.validation.false_triggers import noise_per_hour
from problems.arrays import FloatArray
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant
from problems.stability.dwell import common_loop, dwell_samples, without_translation
from problems.stability.noise import FeltNoise, felt_noise

PERIOD_S, SEED = 8e-4, 1
LAWS = tuple(
    AdmittanceController(mass_kg=mass, damping_n_s_per_m=damping, lead_s=lead, feedback_damping_s=0.007)
    for mass, damping, lead in ((5.0, 1190.0, 0.0213), (10.0, 1600.0, 0.02), (8.0, 1400.0, 0.015))
)
_RUNS, _TICKS, _SETTLED = 4000, 12_000, 1000
_SEQUENCES, _CHANGES = 200, 12


def plants() -> PlantSet:
    """Return K_e × M_p of the demo's kind of cell."""
    return PlantSet.of(
        RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling_stiffness_n_per_m=3e5,
        coupling_damping_n_s_per_m=150.0,
        drag_n_s_per_m=330.0,
        environment_stiffness_n_per_m=(8e4, 1.6e5),
        payload_mass_kg=(14.0, 18.0),
    )


def counted(law: AdmittanceController, correlation: float, levels: tuple[float, ...]) -> tuple[FloatArray, float]:
    """Return how often noise of 1 N RMS passes each level in the closed loop in free space, and in how many hours."""
    loop = build_loop(build_sampled_plant(plants().at(14.0, 0.0), PERIOD_S), law)
    rng = np.random.default_rng(SEED)
    state, noise = np.zeros((len(loop.a), _RUNS)), rng.standard_normal(_RUNS)
    before, found, at = np.zeros(_RUNS), np.zeros(len(levels)), np.array(levels)[:, None]
    for tick in range(_TICKS + _SETTLED):
        read = loop.c_force @ state + (1.0 + loop.d_force) * noise
        if tick >= _SETTLED:
            for sign in (1.0, -1.0):
                found += np.sum((sign * before <= at) & (sign * read > at), axis=1)
        before, state = read, loop.a @ state + np.outer(loop.b, noise)
        noise = correlation * noise + math.sqrt(1.0 - correlation**2) * rng.standard_normal(_RUNS)
    return found, _RUNS * _TICKS * PERIOD_S / 3600.0


def false_triggers() -> None:
    """Print stated against counted crossings of noise."""
    levels = (3.0, 3.5, 4.0, 4.5)
    for correlation in (0.0, 0.6):
        loop = build_sampled_plant(plants().at(14.0, 0.0), PERIOD_S)
        start = time.process_time()
        felt = felt_noise(loop, LAWS[0], correlation)
        begun = time.process_time()
        seen, hours = counted(LAWS[0], correlation, levels)
        spent, long = begun - start, time.process_time() - begun
        print(
            f"noise of correlation {correlation:g} is {felt.gain:.4f} times the sensor's in the loop "
            f"({1e3 * spent:.1f} ms); {hours:.1f} h simulated in {long:.1f} s of the processor"
        )
        alone = FeltNoise(gain=1.0, correlation=correlation)
        for level, count in zip(levels, seen.tolist(), strict=True):
            stated, open_loop = (
                hours * noise_per_hour(level, 0.0, each.gain, each.correlation, PERIOD_S, 1) for each in (felt, alone)
            )
            print(
                f"  above {level:g} N: stated {stated:7.1f} ± {math.sqrt(stated):.1f}, counted {count:.0f} "
                f"(the sensor alone: {open_loop:.1f})"
            )


def modes(law: AdmittanceController, *, is_free: bool) -> list[FloatArray]:
    """Return a law's loops in free space or in contact, at the ends of M_p and K_e."""
    found = []
    for mass, stiffness in itertools.product((14.0, 18.0), (0.0,) if is_free else (8e4, 1.6e5)):
        sampled = build_sampled_plant(plants().at(mass, stiffness), PERIOD_S)
        loop = common_loop(sampled, law)
        found.append(without_translation(loop, sampled) if is_free else loop)
    return found


def growth(every: list[list[FloatArray]], wait: int) -> float:
    """Return the largest ‖z‖ per first ‖z‖ behind drawn sequences of changes, one each `wait` samples."""
    rng, largest = np.random.default_rng(SEED), 0.0
    powers = [[np.linalg.matrix_power(loop, max(wait, 1)) for loop in of] for of in every]
    for _ in range(_SEQUENCES):
        product, law = np.eye(len(powers[0][0])), int(rng.integers(len(every)))
        for _ in range(_CHANGES):
            law = (law + int(rng.integers(1, len(every)))) % len(every)
            product = powers[law][int(rng.integers(len(powers[law])))] @ product
        largest = max(largest, float(np.linalg.norm(product, 2)))
    return largest


def dwell() -> None:
    """Print the dwell time of the laws, what it took, and what drawn sequences of changes do that wait for it."""
    for is_free in (True, False):
        every = [modes(law, is_free=is_free) for law in LAWS]
        start = time.process_time()
        samples = dwell_samples(every)
        spent = time.process_time() - start
        where = "in free space" if is_free else "in contact"
        print(
            f"changes {where}: dwell time {1e3 * samples * PERIOD_S:.1f} ms in {spent:.2f} s of the processor; behind "
            f"{_CHANGES} changes of {_SEQUENCES} drawn sequences at most {growth(every, samples):.1e} of the state is "
            f"left, {growth(every, max(1, samples // 20)):.1e} where they wait a twentieth of it"
        )


def proved_dwell() -> None:
    """Print for which share of K_e × M_p a dwell time is proved, twice and thrice it too, and what that takes."""
    (family,) = build_families(plants().nominal, plants().ranges, PERIOD_S)
    for of, is_free in ((family.in_free_space(), True), (family, False)):
        every = [[DwellLoop(family=of, law=law)] for law in LAWS]
        least = dwell_samples([modes(law, is_free=is_free) for law in LAWS])
        for samples in (least, 2 * least, 3 * least):
            start = time.process_time()
            found = prove_dwell(every, samples, most_cells=1000)
            where = "in free space" if is_free else "in contact"
            print(
                f"changes {where} after {1e3 * samples * PERIOD_S:.1f} ms: proved "
                f"for {100.0 * found.share:.3g} % of the set, {found.cells} cells, "
                f"{time.process_time() - start:.2f} s of the processor"
            )


def main() -> None:
    felt_noise(build_sampled_plant(plants().at(14.0, 0.0), PERIOD_S), LAWS[0], 0.0)  # compiles
    false_triggers()
    dwell()
    proved_dwell()


if __name__ == "__main__":
    main()
