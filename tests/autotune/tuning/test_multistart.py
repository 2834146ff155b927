"""The reference: found without the help of the search, it is no higher than the design, and shows a poor one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.multistart import Reference, find_reference
from autotune.tuning.search import SearchResult
from tests.autotune.tuning.cases import solved


def moved(share: float) -> SearchResult:
    """Return the solution with more damping: gentler nowhere, and still feasible over what the search looked at."""
    found = solved()
    design = found.design * np.array([1.0, 1.0, 1.0 - share, 1.0])
    evaluation = found.active.evaluate(design, peaks_if_missed=True)
    return replace(found, design=design, evaluation=evaluation)


def test_descents_from_elsewhere_end_at_the_search_s_own_optimum() -> None:
    found, reference = solved(), find_reference(solved())
    assert reference.arrived >= 1
    # Less is asked: nothing in reserve, fewer scenarios. That is worth less than the search's own tolerance of 1e-3.
    assert reference.least_n <= found.evaluation.objective_n
    assert reference.gap(found.evaluation.objective_n) < 1e-3
    assert reference.elsewhere_n == pytest.approx(reference.from_here_n, rel=1e-4)
    assert reference == find_reference(solved())


def test_a_design_that_is_not_the_best_has_the_gap_that_it_was_given() -> None:
    worse = moved(0.05)
    given = worse.evaluation.objective_n / solved().evaluation.objective_n - 1.0
    assert given > 5e-3
    reference = find_reference(worse)
    assert reference.gap(worse.evaluation.objective_n) == pytest.approx(given, abs=1e-3)
    # Where the design stands does not matter to what is found elsewhere.
    assert reference.elsewhere_n == find_reference(solved()).elsewhere_n


def test_without_anything_from_elsewhere_the_descent_from_here_is_the_reference() -> None:
    alone = Reference(elsewhere_n=math.inf, from_here_n=50.0, designs=128, descents=4, arrived=0, scenarios=3)
    assert alone.gap(50.5) == pytest.approx(0.01)
    assert alone.gap(49.0) == 0.0
