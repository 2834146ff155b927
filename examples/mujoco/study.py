"""Every parameter and every peak of many MuJoCo cells beside the truth: makes docs/independent_physics.md.

Usage: python examples/mujoco/study.py [--cells 24] [--folder mujoco-study] [--jobs 2] [--anew] [--page PAGE.md]

A folder per cell keeps log, estimates and contacts, so that a study that was interrupted goes on; `--anew` keeps the
logs and makes everything else again.
"""

import argparse
import json
import math
import multiprocessing
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import autotune as at
from examples.mujoco.cell import Hand, MujocoCell, Wall
from examples.mujoco.chain import FIRST_LOG, FORCE_N, estimates, press, record

FRICTION_N, JOINT_FRICTION_N, DRAG_N_S_PER_M, FILTER_HZ = 3.0, 40.0, (5.0, 600.0), (50.0, 200.0)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A cell of the study and the wall of its log."""

    cell: MujocoCell
    wall: Wall

    def words(self) -> str:
        """Return what this cell has beyond a clean one."""
        cell, parts = self.cell, [f"B_p {self.cell.drag_n_s_per_m:.0f}"]
        parts += [f"coupling {cell.coupling_friction_n:.1f} N"] if cell.coupling_friction_n else []
        parts += [f"joints {cell.joint_friction_n:.0f} N"] if cell.joint_friction_n else []
        parts += [f"filter {cell.filter_hz:.0f} Hz"] if cell.filter_hz else []
        parts += [f"second mode {cell.part_hz:.0f} Hz"] if cell.part_share else []
        return ", ".join(parts)


def draw(seed: int) -> Drawn:
    """Draw a cell; each effect is left out of some, so that its part can be seen. Every eighth has none."""
    rng = np.random.default_rng(seed)

    def log_uniform(low: float, high: float) -> float:
        return float(low * (high / low) ** rng.random())

    mass, stiffness = log_uniform(8.0, 30.0), log_uniform(1e5, 5e5)
    critical = 2.0 * math.sqrt(mass * stiffness)
    effects = rng.random(4) < 0.5 if seed % 8 else np.zeros(4, dtype=bool)
    side = rng.uniform(0.25, 0.4, 3)
    cell = MujocoCell(
        mass_kg=mass,
        com_S_m=(float(rng.uniform(-0.015, 0.015)), float(rng.uniform(-0.015, 0.015)), float(rng.uniform(0.1, 0.17))),
        inertia_kg_m2=tuple((mass / 12.0 * (sum(side**2) - side**2)).tolist()),
        stiffness_n_per_m=stiffness,
        damping_n_s_per_m=critical * log_uniform(0.02, 0.08),
        turning_n_m_per_rad=log_uniform(3e4, 8e4),
        drag_n_s_per_m=log_uniform(*DRAG_N_S_PER_M),
        coupling_friction_n=float(rng.uniform(0.0, FRICTION_N)) * bool(effects[0]),
        joint_friction_n=float(rng.uniform(0.0, JOINT_FRICTION_N)) * bool(effects[1]),
        part_share=0.1 * bool(effects[2]),
        part_hz=log_uniform(25.0, 60.0),
        servo_hz=log_uniform(4.0, 9.0),
        servo_damping_ratio=float(rng.uniform(0.8, 1.0)),
        period_s=2e-3,
        delay_s=float(rng.uniform(2e-3, 6e-3)),
        filter_hz=log_uniform(*FILTER_HZ) if effects[3] else None,
        force_noise_n=log_uniform(0.05, 0.3),
        resolution_n=log_uniform(0.01, 0.1),
        bias=tuple((rng.uniform(-1.0, 1.0, 6) * np.repeat([10.0, 0.5], 3)).tolist()),
    )
    wall = Wall(stiffness_n_per_m=log_uniform(1.5e4, 1.5e5), damping_n_s_per_m=float(rng.uniform(20.0, 80.0)))
    return Drawn(cell=cell, wall=wall)


@dataclass(frozen=True, kw_only=True)
class Contact:
    """One contact of the study: what differs from the log, and whether the certificate speaks of it."""

    name: str
    cell: MujocoCell
    wall: Wall
    hand: Hand | None = None
    is_modelled: bool = True


def contacts(drawn: Drawn) -> list[Contact]:
    """Return the contacts: walls and payloads of the model, then edges, inclinations and a hand, which it ignores."""
    cell, wall = drawn.cell, drawn.wall

    def other(name: str, *, is_modelled: bool = False, hand: Hand | None = None, **changes: Any) -> Contact:
        return Contact(name=name, cell=cell, wall=replace(wall, **changes), hand=hand, is_modelled=is_modelled)

    stiffness = wall.stiffness_n_per_m
    return [
        other("wall of the log", is_modelled=True),
        other("half as stiff", is_modelled=True, stiffness_n_per_m=0.5 * stiffness),
        other("twice as stiff", is_modelled=True, stiffness_n_per_m=2.0 * stiffness),
        Contact(name="payload −15 %", cell=cell.with_mass(0.85), wall=wall),
        Contact(name="payload +15 %", cell=cell.with_mass(1.15), wall=wall),
        other("edge 40 mm off", edge_m=(0.04, 0.0)),
        other("edge 80 mm off", edge_m=(0.0, 0.08)),
        other("inclined by 10°", inclination_rad=math.radians(10.0)),
        other("inclined by 20°", inclination_rad=math.radians(20.0)),
        other("a hand on it", hand=Hand()),
    ]


def kept(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what a file holds, and make it where it is not there."""
    if not path.is_file():
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(make(), indent=1), encoding="utf-8")
        partial.replace(path)
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return held


def identified(drawn: Drawn, folder: Path, seed: int) -> dict[str, Any]:
    """Record where there is no log, and return what was identified: value, deviation, verdict by name, and findings."""
    log, file = folder / "cell.mcap", folder / "identified.yaml"
    if not log.is_file():
        record(drawn.cell, drawn.wall, FIRST_LOG, log, seed=seed)
    try:
        found = at.identify(log, cell=log.with_suffix(".cell.yaml"), allow_partial=True)
    except at.AutotuneError as error:
        return {"refused": str(error)}
    found.save(file)
    values = {n: {"value": e.value, "std": e.std, "status": e.status.value} for n, e in estimates(found).items()}
    findings = [{"code": f.code, "severity": f.severity, "message": f.message} for f in found.result.findings]
    return {"estimates": values, "findings": findings}


def designed(drawn: Drawn, folder: Path, seed: int) -> dict[str, Any]:
    """Return the peaks of all contacts, predicted and measured, and the certified worst."""
    source, file = folder / "identified.yaml", folder / "controller.yaml"
    if not source.is_file():
        return {"refused": "The log was refused."}
    try:
        design, refusal = _searched(source, folder / "problem.yaml", drawn)
    except at.AutotuneError as error:
        return {"refused": str(error)}
    design.save(file)
    return {"eased": refusal, "certified": design.peak_force, "contacts": _contacts(drawn, design, file, seed)}


def _searched(source: Path, problem: Path, drawn: Drawn) -> tuple[at.Design, str]:
    """Return a design, with the lines in `problem.yaml` that a refusal names where there are any; and the refusal."""
    wall, mass = drawn.wall.stiffness_n_per_m, drawn.cell.mass_kg

    def search(problem: Path | None) -> at.Design:
        masses, walls = (0.84 * mass, 1.16 * mass), (0.45 * wall, 2.2 * wall)
        return at.optimize(source, payload_mass=masses, environment_stiffness=walls, problem=problem, axes=["z"])

    try:
        return search(None), ""
    except at.InfeasibleError as error:
        if not error.suggestion:
            raise
        lines = {"format": "autotune/problem", "version": 1, **error.suggestion}
        problem.write_text(json.dumps(lines, indent=1), encoding="utf-8")  # which is YAML, too
        return search(problem), str(error)


def _contacts(drawn: Drawn, design: at.Design, file: Path, seed: int) -> list[dict[str, Any]]:
    rows = []
    for contact in contacts(drawn):
        predicted = at.predict(
            design,
            environment_stiffness=contact.wall.stiffness_n_per_m,
            payload_mass=contact.cell.mass_kg,
            approach_force=FORCE_N,
        )
        measured = press(contact.cell, contact.wall, file, hand=contact.hand, seed=seed)
        rows.append(
            {
                "name": contact.name,
                "modelled": contact.is_modelled,
                "predicted": predicted.peak_force,
                **asdict(measured),
            }
        )
    return rows


def run_cell(job: tuple[int, Path, bool]) -> int:
    """Do what is not done yet of one cell."""
    seed, folder, with_contacts = job
    warnings.simplefilter("ignore")
    folder.mkdir(parents=True, exist_ok=True)
    drawn = draw(seed)
    kept(folder / "identified.json", lambda: identified(drawn, folder, seed))
    if with_contacts:
        kept(folder / "contacts.json", lambda: designed(drawn, folder, seed))
    return seed


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=24)
    parser.add_argument("--folder", type=Path, default=Path("mujoco-study"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--anew", action="store_true", help="keep the logs, make everything else again")
    parser.add_argument("--logs-only", action="store_true", help="identify, but design and press nothing")
    parser.add_argument("--page", type=Path)
    options = parser.parse_args(arguments)
    folders = {seed: options.folder / f"cell-{seed:02d}" for seed in range(options.cells)}
    if options.anew:
        for path in (folder / name for folder in folders.values() for name in ("identified.json", "contacts.json")):
            path.unlink(missing_ok=True)
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        # All logs first: what they show is the larger half of the page.
        for with_contacts in (False,) if options.logs_only else (False, True):
            jobs = [(seed, folder, with_contacts) for seed, folder in folders.items()]
            for seed in pool.imap_unordered(run_cell, jobs):
                print(f"cell {seed}: {'contacts' if with_contacts else 'log'} done", file=sys.stderr)
    if options.page is not None:
        from examples.mujoco.page import page, tables

        guided = options.page.with_name(f"{options.page.stem}_guided.csv")
        options.page.write_text(page(folders, guided), encoding="utf-8")
        for name, text in tables(folders).items():
            options.page.with_name(f"{options.page.stem}_{name}.csv").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
