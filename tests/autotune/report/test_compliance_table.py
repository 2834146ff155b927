"""The table of a compliance in the report says what the file says."""

from types import SimpleNamespace
from typing import Any

import pytest

from autotune.report.controller_tables import compliance_tables


def controller(tried: list[tuple[float, float | None, bool]], **more: Any) -> Any:
    rows = [
        {"environment_stiffness_n_per_m": stiffness, "peak_force_n": peak, "meets_all": meets, **more}
        for stiffness, peak, meets in tried
    ]
    reported = {
        "tolerance": 0.15,
        "chosen_n_per_m": 2e4,
        "active_bound": "lower",
        "stiffest_within_one_percent_n_per_m": 2.1e4,
        "stiffest_that_meets_all_n_per_m": 5e4,
        "tried": rows,
    }
    return SimpleNamespace(provenance={"compliance": {"x": reported}})


@pytest.mark.parametrize("wished", [False, True])
def test_every_stiffness_has_its_row(wished: bool) -> None:
    tried = [(2e4, 34.0, True), (2.1e4, 34.2, True), (5e4, 44.9, True), (8e4, 50.2, False), (2e5, None, False)]
    found = controller(tried, **({"objective_n": 60.0} if wished else {}))
    (table,) = compliance_tables(found)
    assert table.caption == "Axis x: the compliance to build, to ± 15 %"
    rows = [[cell.text for cell in row] for row in table.rows]
    assert [row[:2] for row in rows] == [
        ["20", "34.00"],
        ["21", "34.20"],
        ["50", "44.90"],
        ["80", "50.20"],
        ["200", "-"],
    ]
    assert [row[2:-1] for row in rows] == [["60.00"] if wished else []] * 5
    assert [row[-1] for row in rows] == [
        "chosen, at the lower bound",
        "the stiffest within 1 % of that",
        "the stiffest that meets everything",
        "above max_peak_force_n",
        "no controller meets the requirements",
    ]


def test_a_controller_for_a_given_surface_has_none() -> None:
    given: Any = SimpleNamespace(provenance={"tool": "by hand"})
    assert list(compliance_tables(given)) == []
