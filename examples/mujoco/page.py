"""Write docs/independent_physics.md and its tables from what a study kept: parameters and peaks beside the truth."""

import csv
import io
import json
import statistics
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from examples.mujoco.chain import truths
from examples.mujoco.study import DRAG_N_S_PER_M, FILTER_HZ, FRICTION_N, JOINT_FRICTION_N, Drawn, contacts, draw

INTERVAL, TOGETHER = 1.96, 2.58  # 95 %, and each of five parameters that are to hold together
OFFSET_CODES = {"clock-offset", "wrench-lag"}
JOINTLY = ("K_s", "B_s", "B_p", "T_d", "bandwidth")
HEAD = """# Physics that is not our own

Made by `python examples/mujoco/study.py --page docs/independent_physics.md`; a folder keeps what is done, and
`--anew` identifies and designs again from the same logs.

The cells live in MuJoCo (`examples/mujoco/cell.py`) and share no equation with `problems`: three slides and three
hinges with servos of second order, dry friction and a delay that is no whole number of samples; a rigid payload, its
centre of mass off the axes, on six springs and dampers; walls as planes with a contact of given K_e and B_e, which a
quasi-static push confirms; a sensor with noise, steps and, in some, a filter of first order. `autotune.recording`
records the log of docs/recording.md, without anybody's help and the same for every cell: six poses, a sweep of 10 s,
three contacts, the clocks in agreement; identify takes it with the cell.yaml that the recorder wrote.
`autotune.runtime` drives the contacts below. One cell through the whole chain, predicted beside measured:
`python examples/mujoco/chain.py`.

Drawn for each cell: mass 8 to 30 kg, K_s 1e5 to 5e5 N/m, B_s 2 to 8 % of the critical damping, K_e 1.5e4 to 1.5e5 N/m,
servo 4 to 9 Hz, delay 2 to 6 ms at 500 Hz, drag {drag[0]:.0f} to {drag[1]:.0f} N·s/m, and each in half of the cells
dry friction of 0 to {coupling:.0f} N in the coupling and of 0 to {joints:.0f} N in the robot's joints, a part of a
tenth of the mass that swings at 25 to 60 Hz (second mode), and a filter of {filter[0]:.0f} to {filter[1]:.0f} Hz.
Every eighth cell has none of these four. Cell by cell: [errors in stated
deviations](independent_physics_deviations.csv) (in brackets what is `weak`), [predicted → measured peaks in
N](independent_physics_peaks.csv).

A simulator's step is part of its physics: semi-implicit Euler with steps dt makes K_s and B_s of a payload M_p
larger by a share B_s dt/(2 M_p) and the delay shorter by dt/2. One log of another simulator, with steps of 50 µs, shows
a T_d that is 3.8 deviations off the number that was typed into it, and 2.4 off that which its steps make
(`tests/autotune/test_seen_contacts.py` computes it). Fitted to its command and pose, a robot of such steps has a T_d of
2.402 ± 0.006 ms, where 2.4 was typed, one without steps 2.377 ± 0.006 ms, and both leave the same. The cells here are
integrated to fourth order.
"""


def page(folders: Mapping[int, Path], guided: Path | None = None) -> str:
    """Return the page of the cells that are done, with what the table of `guided.py` says."""
    found = {seed: _read(folder / "identified.json") for seed, folder in folders.items()}
    pressed = {seed: _read(folder / "contacts.json") for seed, folder in folders.items()}
    head = HEAD.format(drag=DRAG_N_S_PER_M, coupling=FRICTION_N, joints=JOINT_FRICTION_N, filter=FILTER_HZ)
    cells = {seed: (draw(seed), held) for seed, held in found.items() if held is not None}
    if len(cells) < len(folders):
        head += f"\n**{len(cells)} of {len(folders)} cells are done.** The command goes on with the others.\n"
    return "\n".join([head, *_parameters(cells), *_guided(guided), *_peaks(pressed)]) + "\n"


def tables(folders: Mapping[int, Path]) -> dict[str, str]:
    """Return, as CSV by name, the error of every parameter in stated deviations and every peak, cell by cell."""
    found = {seed: _read(folder / "identified.json") for seed, folder in folders.items()}
    cells = {seed: (draw(seed), held) for seed, held in found.items() if held is not None}
    pressed = {seed: _read(folder / "contacts.json") for seed, folder in folders.items()}
    return {"deviations": _text(_by_cell(cells)), "peaks": _text(_peaks_by_cell(pressed))}


def _text(rows: Iterator[list[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def _read(path: Path) -> dict[str, Any] | None:
    held: dict[str, Any] | None = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    return held


def _errors(drawn: Drawn, held: dict[str, Any]) -> dict[str, tuple[str, float, float]]:
    """Return verdict, error as a share of the truth, and error in stated deviations of what has a value."""
    out = {}
    for name, truth in truths(drawn.cell, drawn.wall).items():
        estimate = held.get("estimates", {}).get(name)
        if estimate is not None and estimate["value"] is not None and estimate["std"]:
            error = estimate["value"] - truth
            out[name] = (estimate["status"], error / truth, error / estimate["std"])
    return out


def _parameters(cells: Mapping[int, tuple[Drawn, dict[str, Any]]]) -> Iterator[str]:
    refused = {seed: held["refused"] for seed, (_, held) in cells.items() if "refused" in held}
    errors = {seed: _errors(drawn, held) for seed, (drawn, held) in cells.items() if "refused" not in held}
    yield f"## Parameters: {len(cells)} cells, {len(refused)} logs refused\n"
    yield (
        "*Covered*: how often value ± 1.96 stated deviations holds the truth, of what is `identified`. *Worst*: the "
        "largest error of these\nin stated deviations, and its cell. Bold where fewer than 90 % are covered.\n"
    )
    yield "| parameter | identified | weak | no value | median error [%] | largest [%] | covered | worst |"
    yield "|---|---|---|---|---|---|---|---|"
    names = list(truths(draw(0).cell, draw(0).wall))
    for name in names:
        rows = {seed: each[name] for seed, each in errors.items() if name in each}
        good = {seed: row for seed, row in rows.items() if row[0] == "identified"}
        share = [abs(row[1]) for row in good.values()]
        inside = sum(abs(row[2]) <= INTERVAL for row in good.values())
        worst = max(good, key=lambda seed: abs(good[seed][2]), default=None)
        covered = f"{inside} of {len(good)}"
        yield (
            f"| {name} | {len(good)} | {len(rows) - len(good)} | {len(cells) - len(rows)} | "
            + (f"{100 * statistics.median(share):.2g} | {100 * max(share):.2g}" if share else "– | –")
            + f" | {covered if inside >= 0.9 * len(good) else f'**{covered}**'} | "
            + (f"{good[worst][2]:+.1f} (cell {worst})" if worst is not None else "–")
            + " |"
        )
    whole = [each for each in errors.values() if all(name in each for name in JOINTLY)]
    both = sum(all(abs(each[name][2]) <= TOGETHER for name in JOINTLY) for each in whole)
    percent, verdict = 100.0 * both / max(len(whole), 1), "reached" if both >= 0.93 * len(whole) else "not reached"
    yield (
        f"\nK_s, B_s, B_p, T_d and bandwidth have a value in {len(whole)} cells; in {both} of them all five lie within "
        f"{TOGETHER} deviations,\nwhich hold five parameters with 95 % together: {percent:.1f} % (target: 93 % of the "
        f"cells, {verdict})."
    )
    late = [seed for seed, (_, held) in cells.items() if _codes(held) & OFFSET_CODES]
    passed = sum(drawn.cell.filter_hz is not None for drawn, _ in cells.values())
    yield (
        f"Of {len(cells)} cells, {passed} of which have a filter that delays the wrench, {len(late)} have a finding\n"
        f"that the clocks of wrench and pose disagree (target: none): {_listed(late) or 'none'}. Drag to the ground\n"
        "makes the inertia's force lag by B_p/K_s when the tool turns, 0.05 to 4 ms here, which is estimated, too."
    )
    for seed, (_, held) in cells.items():
        for finding in held.get("findings", ()):
            if finding["severity"] == "error":
                yield f"\nCell {seed} ({cells[seed][0].words()}), exit code 4: {finding['message']}"
    for seed, reason in refused.items():
        yield f"\nCell {seed} ({cells[seed][0].words()}) refused: {reason}"


def _guided(table: Path | None) -> Iterator[str]:
    """Yield what is off in logs in which a hand goes over into the sweep, and the sweep into contacts."""
    if table is None or not table.is_file():
        return
    with table.open(encoding="utf-8", newline="") as stream:
        names, targets, *logs = csv.reader(stream)
    good = sum(row[-1] == "yes" for row in logs)
    yield "\n## A hand, the sweep and contacts without rests between\n"
    yield (
        f"`python examples/mujoco/guided.py --table docs/{table.name}`: {good} of {len(logs)} logs of "
        f"{len({row[0] for row in logs})} cells have every value\nwithin its target ([log by log]({table.name})); "
        "pauses before and after the sweep: "
        f"{', '.join(dict.fromkeys(row[1] for row in logs))} s.\nLargest error beside its target, T_d in samples:\n"
    )
    yield "| |" + "".join(f" {name} |" for name in names[2:-1])
    yield "|---" * (len(names) - 2) + "|"
    columns = range(2, len(names) - 1)
    sizes = [max((row[i].lstrip("-") for row in logs if "nan" not in row[i]), key=_size, default="–") for i in columns]
    for title, cells in (("largest", sizes), ("target", targets[2:-1])):
        yield f"| {title} | " + " | ".join(cells) + " |"
    for row in logs:
        missing = [names[i] for i in columns if "nan" in row[i]]
        if missing:
            yield f"\nCell {row[0]}, {row[1]} s: no value of {', '.join(missing)}."


def _size(shown: str) -> float:
    return float(shown.split(maxsplit=1)[0].rstrip("%"))


def _codes(held: dict[str, Any]) -> set[str]:
    return {finding["code"] for finding in held.get("findings", ())}


def _by_cell(cells: Mapping[int, tuple[Drawn, dict[str, Any]]]) -> Iterator[list[str]]:
    names = ("mass", "com z", "K_s", "B_s", "B_p", "K_e", "B_e", "T_d", "bandwidth")
    yield ["cell", "what it has", *names]
    for seed, (drawn, held) in cells.items():
        errors = _errors(drawn, held)
        yield [str(seed), drawn.words(), *(_deviations(errors.get(name)) for name in names)]


def _deviations(error: tuple[str, float, float] | None) -> str:
    if error is None:
        return ""
    status, _, deviations = error
    return f"{deviations:+.1f}" if status == "identified" else f"({deviations:+.1f})"


def _peaks(pressed: Mapping[int, dict[str, Any] | None]) -> Iterator[str]:
    done = {seed: held for seed, held in pressed.items() if held is not None}
    held_back = {seed: held["refused"] for seed, held in done.items() if "refused" in held}
    eased = {seed: held["eased"] for seed, held in done.items() if held.get("eased")}
    yield f"\n## Peaks: {len(done)} of {len(pressed)} cells, {len(held_back)} of these without a controller\n"
    yield (
        "F^d = 30 N at the wall, force-driven; ranges of 0.45 to 2.2 of K_e and 0.84 to 1.16 of the mass were "
        "certified, other entries of\nproblem.yaml left as they are"
        + (f", but for {len(eased)} cells ({_listed(eased)}) with the lines that the refusal names" * bool(eased))
        + ".\nThe largest force on the wall, as MuJoCo has it, beside `at.predict` on the controller, which knows "
        "nothing of edges, inclinations\nand hands, and beside the certified worst of the whole domain.\n"
    )
    yield "| contact | pressed | median error [%] | from | to | above the certified worst | faults |"
    yield "|---|---|---|---|---|---|---|"
    for contact in contacts(draw(0)):
        rows = [
            {**row, "certified": held["certified"]}
            for held in done.values()
            for row in held.get("contacts", ())
            if row["name"] == contact.name
        ]
        good = [row for row in rows if not row["fault"]]
        share = [100.0 * (row["contact_n"] / row["predicted"] - 1.0) for row in good]
        above = sum(row["contact_n"] > row["certified"] for row in good)
        numbers = f"{statistics.median(share):+.1f} | {min(share):+.1f} | {max(share):+.1f}" if share else "– | – | –"
        yield f"| {contact.name} | {len(rows)} | {numbers} | {above} | {len(rows) - len(good)} |"
    yield (
        "\nWithout friction a wall inclined by φ pushes back along F^d with cos φ of its force, so that it ends at "
        "F^d/cos φ: 30.5 N at 10°,\n31.9 N at 20°, beside a certified worst of straight walls, which may be little "
        "above F^d."
    )
    for title, reasons in (("no controller", held_back), ("usual requirements refused", eased)):
        for seed, reason in reasons.items():
            yield f"\nCell {seed} ({draw(seed).words()}), {title}: {reason}"


def _listed(seeds: Iterable[int]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def _peaks_by_cell(pressed: Mapping[int, dict[str, Any] | None]) -> Iterator[list[str]]:
    names = [contact.name for contact in contacts(draw(0))]
    yield ["cell", "certified worst", *names]
    for seed, held in pressed.items():
        if held is None or "refused" in held:
            continue
        rows = {row["name"]: row for row in held["contacts"]}
        yield [str(seed), f"{held['certified']:.1f}", *(_arrow(rows[name]) for name in names)]


def _arrow(row: dict[str, Any]) -> str:
    measured = row["fault"] or f"{row['contact_n']:.1f}"
    return f"{row['predicted']:.1f} → {measured}"
