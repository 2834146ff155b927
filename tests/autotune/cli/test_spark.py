"""A force over time in one line."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autotune.cli._optimized import contact_spark, spark
from autotune.formats.units import axis_units
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import fast_optimized

BLOCKS = "▁▂▃▄▅▆▇█"


def test_a_rise_uses_every_block_once() -> None:
    assert spark([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) == BLOCKS


def test_a_short_peak_is_not_lost_between_the_cells() -> None:
    values = np.ones(1000)
    values[437] = 100.0
    message = spark(list(values), 40)
    assert len(message) == 40
    assert message[17] == "█"
    assert set(message) == {"▁", "█"}


def test_no_force_is_flat_and_no_value_is_refused() -> None:
    assert spark([0.0, 0.0]) == "▁▁"
    with pytest.raises(ValueError, match="at least one"):
        spark([])


def test_the_contact_is_drawn_from_the_impact_past_its_peak() -> None:
    search = fast_optimized().searches["x"]
    problem, controller = search.problem, search.problem.controller(search.design)
    hardest = max(problem.scenarios(2, 2), key=lambda each: each.environment_stiffness_n_per_m)
    worst: Any = SimpleNamespace(scenario=lambda: hardest)
    message = contact_spark(problem, controller, worst, axis_units("x"))
    pair = build_sampled_contact(build_sampled_plant(problem.plant(hardest), problem.sample_time_s))
    found = simulate_contact(pair, controller, problem.approach)
    drawn, _, rest = message.partition("  ")
    duration_s = 1e-3 * float(rest.split(", ")[1].removesuffix(" ms"))
    assert rest.endswith(f"peak {found.peak_contact_force_n:.3g} N")
    assert 2.5 * found.time_of_peak_s < duration_s <= found.time_s[-1] + 1e-3
    # The highest block stands where the peak is.
    share = (drawn.index("█") + drawn.rindex("█") + 1) / 2.0 / len(drawn)
    assert share == pytest.approx(found.time_of_peak_s / duration_s, abs=0.1)
