"""What people read of the requirements and bounds that a result rests on."""

from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli._optimized import active_lines
from autotune.cli._terminal import wrap_lines
from autotune.formats.problem import read_problem
from autotune.tuning.bounds import wider_bounds
from autotune.tuning.optimality_report import ActiveConstraint
from autotune.tuning.optimize import Optimized
from tests.autotune.tuning.cases import fast_optimized


def with_active(*active: ActiveConstraint) -> Optimized:
    found = fast_optimized()
    return replace(found, optimality_reports={"x": replace(found.optimality_reports["x"], active=active)})


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (
            ActiveConstraint(name="delay_margin_s", price=0.8),
            "delay_margin_s holds the peak up: easing it by 1 % saves 0.80 N, asking 1 % more costs as much",
        ),
        (
            ActiveConstraint(name="upper bound of lead_s", price=0.25),
            ("the upper bound of K_l, 30 ms, is active: 1 % wider saves 0.25 N; accept it, or widen it"),
        ),
        (
            ActiveConstraint(name="lower bound of damping", price=0.0),
            "the lower bound of B_a, 900 N·s/m, is active, and widening it saves nothing",
        ),
        (
            ActiveConstraint(name="gain_margin_db", price=0.0),
            "gain_margin_db is active, easing it alone saves nothing",
        ),
        (
            ActiveConstraint(name="phase_margin_deg", price=0.0049),
            "phase_margin_deg is active, easing it alone saves nothing",
        ),
        (
            ActiveConstraint(name="modulus_margin", price=0.5, soft=True),
            "modulus_margin is a soft requirement: asking 1 % less saves 0.50 N of peak and price",
        ),
    ],
)
def test_every_kind_of_limit_has_its_sentence(entry: ActiveConstraint, said: str) -> None:
    assert active_lines(with_active(entry), "x")[0] == said


def test_all_bounds_to_widen_are_one_part_of_a_problem_file_that_says_where_it_belongs(tmp_path: Path) -> None:
    named = ("upper bound of lead_s", "modulus_margin", "lower bound of mass", "lower bound of damping")
    prices = (0.25, 0.3, 0.12, 0.0)
    found = with_active(*(ActiveConstraint(name=name, price=price) for name, price in zip(named, prices, strict=True)))
    (said,) = (each for each in active_lines(found, "x") if each.startswith("to widen"))
    where, *pasted = said.split("\n")
    assert where == "to widen, in problem.yaml (where it has bounds already, into that):"
    assert pasted == ["    bounds: {lead_s: [0.01, 0.06], mass: [3.0, 6.0]}"]
    # As a terminal shows it, below a line that is there.
    path = tmp_path / "problem.yaml"
    shown = wrap_lines(said, indent="  ", columns=40)
    path.write_text("\n".join(("objective: contact_force", *shown[-len(pasted) :])) + "\n", encoding="utf-8")
    assert dict(read_problem(path).bounds) == {"lead_s": (0.01, 0.06), "mass": (3.0, 6.0)}
    tree = wider_bounds(found.searches["x"].problem, named[:1], turning=True)
    assert tree == {"rotational": {"bounds": {"lead_s": [0.01, 0.06]}}}
    # A biquad's follow from the tick and the band; problem.yaml has no place for them.
    assert wider_bounds(found.searches["x"].problem, ["lower bound of biquad_pole_s"], turning=False) == {}
    # No further than a controller file may hold.
    longest = replace(problem := found.searches["x"].problem, bounds={**problem.bounds, "lead_s": (0.0, 0.6)})
    assert wider_bounds(longest, named[:1], turning=False) == {"bounds": {"lead_s": [0.0, 1.0]}}


def test_with_soft_limits_the_gap_is_one_of_peak_and_price() -> None:
    found = with_active()
    assert " N is the least that was found" in active_lines(found, "x")[-1]
    search = found.searches["x"]
    wished = replace(search.problem, requirements=replace(search.problem.requirements, soft_n={"modulus_margin": 20.0}))
    lines = active_lines(replace(found, searches={"x": replace(search, problem=wished)}), "x")
    assert " N of peak and price is the least that was found" in lines[-1]


def test_nothing_active_and_nothing_found_elsewhere() -> None:
    found = with_active()
    standing = found.optimality_reports["x"]
    alone = replace(standing.reference, elsewhere=float("inf"), arrived=0)
    lines = active_lines(replace(found, optimality_reports={"x": replace(standing, reference=alone)}), "x")
    assert lines[0] == "no requirement is active: the peak is the approach force itself"
    assert lines[-1].startswith("no other design to compare with; ")
    assert lines[-1].endswith("other designs, none of which met the requirements")
