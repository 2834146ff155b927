"""The stiffness of a compliance against the least worst peak, as the file of a controller keeps it."""

from collections.abc import Iterator, Mapping
from typing import Any

from autotune.formats.controller_record import Controller

from .page import Cell, Table


def compliance_tables(controller: Controller) -> Iterator[Table]:
    """Yield for each axis whose compliance was chosen every stiffness that was tried."""
    found = controller.provenance.get("compliance")
    for name, told in found.items() if isinstance(found, Mapping) else ():
        wished = any("objective_n" in entry for entry in told["tried"])
        keys = ("peak_force_n", *(("objective_n",) if wished else ()))
        heads = ("least worst peak [N]", "and the price of missed wishes [N]")
        yield Table(
            caption=f"Axis {name}: the compliance to build, to ± {100.0 * told['tolerance']:g} %",
            columns=("K_e [N/mm]", *heads[: len(keys)], ""),
            rows=tuple(_row(told, entry, keys) for entry in told["tried"]),
        )


def _row(told: Mapping[str, Any], entry: Mapping[str, Any], keys: tuple[str, ...]) -> tuple[Cell, ...]:
    stiffness, peak = entry["environment_stiffness_n_per_m"], entry["peak_force_n"]
    numbers = (entry.get(key) for key in keys)
    remarks = []
    if stiffness == told["chosen_n_per_m"]:
        remarks.append("chosen" if told["active_bound"] is None else f"chosen, at the {told['active_bound']} bound")
    elif stiffness == told["stiffest_within_one_percent_n_per_m"]:
        remarks.append("the stiffest within 1 % of that")
    if stiffness == told["stiffest_that_meets_all_n_per_m"]:
        remarks.append("the stiffest that meets everything")
    if not entry["meets_all"]:
        remarks.append("no controller meets the requirements" if peak is None else "above max_peak_force_n")
    return (
        Cell(text=f"{stiffness * 1e-3:.6g}", is_number=True),
        *(Cell(text="-" if number is None else f"{number:.2f}", is_number=True) for number in numbers),
        Cell(text=", ".join(remarks), tone="" if entry["meets_all"] else "bad"),
    )
