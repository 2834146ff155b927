"""The tables of the optimizer's benchmark, from its records, and whether they meet their targets."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Record = Mapping[str, Any]

WITHIN = 0.005
SECONDS = 2.0
FIGURE = "figures/optimizer_growth.svg"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def tables(records: Sequence[Record]) -> str:
    """Return every table that the records have something for."""
    parts = [_problems(records), _polish(records), _peers(records), _growth(records), _bits(records)]
    return "\n\n".join(part for part in parts if part) + "\n"


def put_between(page: str, text: str) -> str:
    """Return the page with what stands between its markers replaced."""
    before, found, rest = page.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not found or not ended:
        raise ValueError(f"The page has no {BEGIN} … {END} to write between.")
    return f"{before}{BEGIN}\n\n{text}\n{END}{after}"


def misses(records: Sequence[Record]) -> list[str]:
    """Tell which targets are missed, and by what."""
    misses = []
    for each in _part(records, "problem"):
        name = f"problem {each['seed']}"
        if each["refused"]:
            if each["rival_holds"]:
                misses.append(f"{name}: refused, but a design that holds was found ({each['reference_n']:.2f} N)")
            continue
        if each["gap"] is not None and each["gap"] > WITHIN:
            misses.append(f"{name}: {100.0 * each['gap']:.2f} % above the long differential evolution")
        if each["unstable"] or each["worst"] > 1.0 + 1e-9:
            misses.append(
                f"{name}: {each['unstable']} unstable, {each['worst_name']} {each['worst']:.6f} of what is allowed"
            )
        if each["cpu_s"] > SECONDS:
            misses.append(f"{name}: {each['cpu_s']:.1f} s of processor time")
    misses += ["two runs with one seed differ" for each in _part(records, "bits") if len(set(each["sha256"])) > 1]
    for each in _part(records, "peer"):
        if each["name"] == "autotune" and each["cpu_s"] > SECONDS:
            misses.append(f"the paper's cell: {each['cpu_s']:.1f} s of processor time")
    return misses


def _problems(records: Sequence[Record]) -> str:
    everything = sorted(_part(records, "problem"), key=lambda each: each["seed"])
    solved = [each for each in everything if not each["refused"]]
    if not solved:
        return ""
    refused = [each for each in everything if each["refused"]]
    rivals = sum(each["rival_holds"] for each in refused)
    rows = [
        [
            str(each["seed"]),
            f"{each['cpu_s']:.2f}",
            f"{each['value_n']:.3f}",
            _newtons(each["reference_n"]),
            "–" if each["gap"] is None else f"{100.0 * each['gap']:+.3f}",
            f"{each['worst']:.6f} ({_words(each['worst_name'])})",
            f"{100.0 * (each['dense_n'] / each['value_n'] - 1.0):+.3f}",
        ]
        for each in solved
    ]
    head = [
        "problem",
        "processor [s]",
        "worst peak [N]",
        "evolution, at least [N]",
        "gap [%]",
        "largest required/achieved",
        "peak, denser grid [%]",
    ]
    gaps = [each["gap"] for each in solved if each["gap"] is not None]
    over = (
        f"{len(everything)} problems were drawn for these {len(solved)}; {len(refused)} were refused as infeasible, "
        f"and in {'none' if rivals == 0 else rivals} of them did the evolution find a design that holds. "
        f"The evolution: seeds {min(len(each['by_seed']) for each in solved)}, in the median "
        f"{np.median([each['reference_evaluations'] for each in solved]):.0f} evaluations. "
        f"Largest gap {100.0 * max(gaps, default=np.nan):+.3f} %; processor time in the median "
        f"{np.median([each['cpu_s'] for each in solved]):.2f} s, at most {max(each['cpu_s'] for each in solved):.2f} s."
    )
    return f"### Drawn problems\n\n{over}\n\n{_table(head, rows)}"


def _polish(records: Sequence[Record]) -> str:
    found = _part(records, "polish")
    if not found:
        return ""
    solvers = [each for each in dict.fromkeys(each["solver"] for each in found) if each != "before"]
    rows = []
    for name in dict.fromkeys(each["name"] for each in found):
        of_name = {each["solver"]: each for each in found if each["name"] == name}
        cells = [name, f"{of_name['before']['value_n']:.6f}"]
        for solver in solvers:
            each = of_name[solver]
            cells += [f"{each['value_n']:.6f}", f"{each['residual']:.1e}", f"{each['seconds']:.3f}"]
        rows.append(cells)
    head = ["problem", "before [N]"]
    for solver in solvers:
        head += [f"{solver} [N]", "KKT residual", "processor [s]"]
    apart = max(
        abs(one["value_n"] / other["value_n"] - 1.0)
        for one in found
        for other in found
        if one["name"] == other["name"] and "before" not in (one["solver"], other["solver"])
    )
    over = (
        "The same local problem, start and exact gradients; the residual as a share of the gradient, the processor's "
        f"time of one call. Their values differ by {apart:.0e} at most."
    )
    return f"### The last digits\n\n{over}\n\n{_table(head, rows)}"


def _peers(records: Sequence[Record]) -> str:
    found = _part(records, "peer")
    if not found:
        return ""
    names = list(dict.fromkeys(each["name"] for each in found))
    rows = []
    for name in names:
        runs = [each for each in found if each["name"] == name]
        close = [each["to_one_percent_s"] for each in runs]
        reached = sum(np.isfinite(each) for each in close)
        rows.append(
            [
                name,
                _seconds(float(np.median(close))),
                f"{reached} of {len(runs)}",
                "; ".join(dict.fromkeys(_final(each) for each in runs)),
                _seconds(float(np.median([each["cpu_s"] for each in runs]))),
                "; ".join(dict.fromkeys(each["note"] for each in runs)),
            ]
        )
    head = ["", "to 1 % [s]", "runs that came there", "worst peak at the end", "processor [s]", ""]
    best = min(each["best_n"] for each in found)
    over = (
        f"The paper's cell; the best that any of them found is {best:.3f} N. Medians over the seeds, a budget of "
        f"{found[0]['budget_s']:g} s of processor time each."
    )
    return f"### Beside other optimizers\n\n{over}\n\n{_table(head, rows)}"


def _final(each: Record) -> str:
    if each["value_n"] is None:
        return "nothing"
    if not each["is_stable"]:
        return "**unstable**"
    missed = f", **misses {100.0 * each['violation']:.3g} %**" if each["violation"] > 1e-4 else ""
    return f"{each['value_n']:.2f} N{missed}"


def _growth(records: Sequence[Record]) -> str:
    found = sorted(_part(records, "growth"), key=lambda each: each["scenarios"])
    if not found:
        return ""
    rows = [
        [
            str(each["scenarios"]),
            f"{each['exchange_s']:.2f}",
            str(each["active"]),
            str(each["rounds"]),
            f"{each['exchange_n']:.3f}",
            f"{each['at_once_s']:.2f}{' (projected)' if each['is_projected'] else ''}",
            "" if each["at_once_n"] is None else f"{each['at_once_n']:.3f}",
        ]
        for each in found
    ]
    head = ["scenarios", "exchange [s]", "active", "rounds", "peak [N]", "all at once [s]", "peak [N]"]
    picture = f"![Processor time over the number of scenarios, by exchange and all at once]({FIGURE})"
    return f"### More scenarios\n\n{picture}\n\nProcessor time.\n\n{_table(head, rows)}"


def _bits(records: Sequence[Record]) -> str:
    found = _part(records, "bits")
    if not found:
        return ""
    every = [each for record in found for each in record["sha256"]]
    same = "the same bytes" if len(set(every)) == 1 else "**different bytes**"
    return f"### One seed\n\nThe design of the paper's cell from {len(every)} processes: {same} ({every[0][:16]})."


def _part(records: Iterable[Record], part: str) -> list[Record]:
    return [each for each in records if each["part"] == part]


def _seconds(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "never"


def _newtons(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "–"


def _words(name: str) -> str:
    for unit in ("_db", "_deg", "_per_s", "_s", "_n"):
        name = name.removesuffix(unit)
    return name.replace("_", " ")


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
