"""A hand that guides goes over into a sweep, and the sweep into an approach: identified minus true beside the targets.

Usage: python examples/mujoco/guided.py [--cells 9] [--pauses 0,0.1 1.4,1.0] [--folder mujoco-guided] [--table CSV]

Pauses are before and after the sweep, in seconds. A log is kept; the cells are those of `study` without dry friction,
filter and second mode, 0, 8, 16, …, but for those that a plain admittance does not hold (drag below 50 N·s/m).
"""

import argparse
import csv
import math
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np

import autotune as at
from autotune.recording import FirstLog, FirstLogCommand, PlainAdmittance, Recorder
from examples.mujoco.cell import MujocoCell, Reading, Running, Wall
from examples.mujoco.chain import estimates, truths
from examples.mujoco.study import draw

PAUSES = ((0.0, 0.1), (1.4, 1.0))
LEAST_DRAG_N_S_PER_M = 50.0
GUIDED_S, SWEEP_S, CONTACTS, PRESSED_S, BACK_S, FORCE_N = 8.0, 10.0, 3, 1.5, 1.5, 30.0
# Gains of the admittance that hand and F^d push.
MASS_KG, DAMPING_N_S_PER_M = 30.0, 3000.0
# docs/accuracy.md: shares, metres for the centre of mass, and samples for the delay.
TARGETS = {"mass": 0.005, "com x": 0.002, "com y": 0.002, "com z": 0.002, "K_s": 0.04, "B_s": 0.15, "B_p": 0.15}
TARGETS |= {"K_e": 0.05, "T_d": 0.14, "bandwidth": 0.05}


class Guided:
    """The cell in motion and the log of it: `tick` sends a way along z, and a pose where one is given."""

    def __init__(self, cell: MujocoCell, wall: Wall, log: Recorder, seed: int) -> None:
        self.cell, self.log, self.way = cell, log, 0.0
        self.running = Running(cell, wall, seed=seed)
        self.contact_n = self.force_n = self.weight_n = 0.0

    def tick(
        self, displacement_m: tuple[float, ...] | None = None, turn: tuple[float, ...] = (0.0, 0.0, 0.0)
    ) -> Reading:
        seen, running = self.running.read(), self.running
        place = (0.0, 0.0, self.way) if displacement_m is None else displacement_m
        self.log.write(
            running.ticks * self.cell.period_s,
            wrench=seen.wrench_S,
            pose=(*seen.position_m, *seen.quaternion_xyzw),
            command=running.command_pose(place, turn),
        )
        running.send(place, turn)
        self.contact_n, self.force_n = seen.contact_n, seen.wrench_S[2] - self.weight_n
        return seen

    def seconds(self, duration_s: float) -> Iterator[float]:
        """Yield the time in the phase, once for every period."""
        yield from (np.arange(round(duration_s / self.cell.period_s)) * self.cell.period_s).tolist()


def record_guided(cell: MujocoCell, wall: Wall, path: Path, pauses_s: tuple[float, float], *, seed: int) -> None:
    """Record poses, a hand that guides, a sweep, and three approaches that touch."""
    with Recorder(path, start_ns=1_700_000_000_000_000_000, period_s=cell.period_s) as log:
        of = Guided(cell, wall, log, seed)
        commands = FirstLog(axis="z", pose_count=6, contact_count=0, sweep_s=0.0).commands(period_s=cell.period_s)
        command: FirstLogCommand | None = next(commands)
        while command is not None:
            seen = of.tick(command.displacement_m, command.rotation_rad)
            command = _following(commands, seen.wrench_S)
        forces = []
        for _ in of.seconds(1.0):
            of.tick()
            forces.append(of.force_n)
        of.weight_n, of.force_n = float(np.mean(forces[len(forces) // 2 :])), 0.0
        rng = np.random.default_rng(seed)
        (first_n, second_n), (first_hz, second_hz) = rng.uniform(8.0, 16.0, 2), rng.uniform(0.4, 0.8, 2)
        law = PlainAdmittance(mass_kg=MASS_KG, damping_n_s_per_m=DAMPING_N_S_PER_M, period_s=cell.period_s)
        for t in of.seconds(GUIDED_S):
            fade = min(t / 0.3, (GUIDED_S - t) / 0.15, 1.0)
            pushed = first_n * math.sin(math.tau * first_hz * t) + second_n * math.sin(math.tau * second_hz * t + 1.0)
            of.running.push((0.0, 0.0, fade * pushed))
            of.tick()
            of.way = law.step(of.force_n)
        of.running.push((0.0, 0.0, 0.0))
        for _ in of.seconds(pauses_s[0]):
            of.tick()
        for t in of.seconds(SWEEP_S):
            of.way += cell.period_s * sweep_speed_m_s(t)
            of.tick()
        for _ in of.seconds(pauses_s[1]):
            of.tick()
        for _ in range(CONTACTS):
            _approach(of)


def _following(
    commands: Generator[FirstLogCommand, tuple[float, ...], None], wrench_S: tuple[float, ...]
) -> FirstLogCommand | None:
    try:
        return commands.send(wrench_S)
    except StopIteration:
        return None


def sweep_speed_m_s(t: float) -> float:
    """Return the speed of a sweep from 0.5 to 45 Hz, faster at higher frequencies."""
    rate = math.log(90.0) / SWEEP_S
    frequency = 0.5 * math.exp(rate * t)
    edge = min(t / 0.5, (SWEEP_S - t) / 0.5, 1.0)
    return edge * min(0.05, 0.02 + 6e-4 * frequency) * math.sin(math.tau * (frequency - 0.5) / rate)


def _approach(of: Guided) -> None:
    """Touch the wall under F^d, press, and go back."""
    law = PlainAdmittance(mass_kg=MASS_KG, damping_n_s_per_m=DAMPING_N_S_PER_M, period_s=of.cell.period_s)
    begun, pressed = of.way, 0
    for _ in of.seconds(40.0):
        of.tick()
        of.way = begun + law.step(FORCE_N + of.force_n)
        pressed += of.contact_n > 0.0 or pressed > 0
        if pressed * of.cell.period_s > PRESSED_S:
            break
    top = of.way
    for t in of.seconds(BACK_S):
        of.tick()
        of.way = top - 0.005 * (1.0 - math.cos(math.pi * t / BACK_S))
    for _ in of.seconds(0.6):
        of.tick()


def errors(cell: MujocoCell, wall: Wall, found: at.Identification) -> dict[str, float]:
    """Return identified − true as shares, metres for the centre of mass, and samples for the delay; NaN without one."""
    out = {}
    for name, truth in truths(cell, wall).items():
        value = estimates(found)[name].value if name in TARGETS and name in estimates(found) else None
        unit = 1.0 if name.startswith("com") else cell.period_s if name == "T_d" else truth
        out[name] = math.nan if value is None else (value - truth) / unit
    return {name: out[name] for name in TARGETS}


def shown(name: str, error: float) -> str:
    """Return an error, or a target, in mm, samples or percent."""
    return f"{1e3 * error:.2f} mm" if name.startswith("com") else f"{error:.3f}" if name == "T_d" else f"{error:.2%}"


def tables(folder: Path, seeds: list[int], pauses: list[tuple[float, float]]) -> Iterator[list[str]]:
    """Yield the table, log by log: errors, and whether all of them are within the targets."""
    yield ["cell", "pauses [s]", *TARGETS, "within"]
    yield ["target", "", *(shown(name, target) for name, target in TARGETS.items()), ""]
    for seed in seeds:
        drawn = draw(seed)
        for pair in pauses:
            log = folder / f"cell-{seed:02d}-{pair[0]:g}-{pair[1]:g}.mcap"
            if not log.with_suffix(".cell.yaml").is_file():
                log.unlink(missing_ok=True)
                record_guided(drawn.cell, drawn.wall, log, pair, seed=seed)
            found = at.identify(log, cell=log.with_suffix(".cell.yaml"), allow_partial=True)
            off = errors(drawn.cell, drawn.wall, found)
            within = all(abs(off[name]) <= target for name, target in TARGETS.items())
            cells = [shown(name, error) for name, error in off.items()]
            yield [str(seed), f"{pair[0]:g} and {pair[1]:g}", *cells, "yes" if within else "no"]


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=9)
    parser.add_argument("--pauses", nargs="+", default=[f"{a:g},{b:g}" for a, b in PAUSES])
    parser.add_argument("--folder", type=Path, default=Path("mujoco-guided"))
    parser.add_argument("--table", type=Path, help="a CSV beside docs/independent_physics.md")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    drawn = (seed for seed in range(0, 1000, 8) if draw(seed).cell.drag_n_s_per_m >= LEAST_DRAG_N_S_PER_M)
    seeds = [next(drawn) for _ in range(options.cells)]
    pauses = [(float(pair.split(",")[0]), float(pair.split(",")[1])) for pair in options.pauses]
    rows = []
    for row in tables(options.folder, seeds, pauses):
        print(" | ".join(row), flush=True)
        rows.append(row)
    print(f"{sum(row[-1] == 'yes' for row in rows)} of {len(rows) - 2} logs have every value within its target.")
    if options.table is not None:
        with options.table.open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
