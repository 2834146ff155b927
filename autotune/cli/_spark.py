"""A force over time as one line of block characters."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotune.formats.controller_record import ScenarioPrediction
    from autotune.formats.units import AxisUnits
    from problems.design.problem import DesignProblem
    from problems.model.controller import AdmittanceController

_BLOCKS = "▁▂▃▄▅▆▇█"
_CELLS = 40
# What is shown ends where the force stays this near to its last value.
_SETTLED_SHARE = 0.02
_BEHIND_THE_PEAK = 3.0


def spark(values: Sequence[float], cells: int = _CELLS) -> str:
    """Return non-negative `values` as at most `cells` blocks: the largest of each cell, in eighths of the largest.

    Nothing but zeros is the lowest block throughout; raises ValueError where there is no value.
    """
    if not len(values):
        raise ValueError("A line of blocks needs at least one value.")
    count = min(cells, len(values))
    ends = [round(i * len(values) / count) for i in range(count + 1)]
    tops = [max(values[a:b]) for a, b in itertools.pairwise(ends)]
    whole = max(tops)
    eighths = [0 if whole <= 0.0 else round(max(top, 0.0) / whole * (len(_BLOCKS) - 1)) for top in tops]
    return "".join(_BLOCKS[each] for each in eighths)


def contact_spark(
    problem: "DesignProblem", controller: "AdmittanceController", worst: "ScenarioPrediction", units: "AxisUnits"
) -> str:
    """Return the predicted force at the contact of one scenario, from the impact until it has settled."""
    from problems.contact.transient import build_sampled_contact, simulate_contact
    from problems.model.sampled import build_sampled_plant

    plant = problem.plant(worst.scenario())
    pair = build_sampled_contact(build_sampled_plant(plant, problem.sample_time_s))
    found = simulate_contact(pair, controller, problem.approach)
    force = [float(value) for value in found.contact_force_n]
    stop = max(_settled(force), round(_BEHIND_THE_PEAK * found.time_of_peak_s / problem.sample_time_s), 2)
    shown = force[:stop]
    return (
        f"{spark(shown)}  the hardest contact, {1e3 * len(shown) * problem.sample_time_s:.0f} ms, "
        f"peak {found.peak_contact_force_n:.3g} {units.force}"
    )


def _settled(force: Sequence[float]) -> int:
    """Return from which sample on the force stays near its last value."""
    near = _SETTLED_SHARE * max(abs(value) for value in force)
    off = [i for i, value in enumerate(force) if abs(value - force[-1]) > near]
    return off[-1] + 2 if off else 1
