"""Cells beside each other and beside their past: what is planted is found, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.campaign.fleet import _distances, _robust_covariance, changes, unusual
from autotune.campaign.text import outcome_text, unusual_text
from autotune.campaign.work import RunOutcome
from autotune.drift import BIAS, CLOCK, Change, change_text, parameter_text

NAMES = ("payload.mass_kg", "x.coupling_stiffness_n_per_m", "x.delay_s")
TRUE, STD = (16.0, 3e5, 2.4e-3), (0.02, 3e3, 2e-5)


def outcome(cell: str, run: str, values: tuple[float, ...], *, at: float = 0.0) -> RunOutcome:
    named = {name: (value, std) for name, value, std in zip(NAMES, values, STD, strict=True)}
    return RunOutcome(cell=cell, run=run, key="", recorded_s=at, values=named)


def fleet(count: int = 20) -> list[RunOutcome]:
    """Return cells whose stiffness goes with their delay, each parameter spread by a twentieth."""
    drawn = np.random.default_rng(5).normal(size=(count, 2))
    return [
        outcome(f"c{i}", "mon", (16.0 * (1 + 0.05 * b), 3e5 * (1 + 0.05 * a), 2.4e-3 * (1 + 0.05 * a + 0.002 * b)))
        for i, (a, b) in enumerate(drawn)
    ]


def test_a_change_beyond_three_deviations_is_named_in_the_order_of_recording() -> None:
    later = outcome("a", "alpha", (16.0, 3.3e5, 2.41e-3), at=9.0)
    earlier = outcome("a", "zulu", TRUE, at=1.0)
    (found,) = changes([later, earlier, outcome("b", "mon", TRUE)])
    assert replace(found, stds=0.0) == Change(
        cell="a", before="zulu", after="alpha", name=NAMES[1], old=3e5, new=3.3e5, stds=0.0
    )
    assert found.stds == pytest.approx(3e4 / np.hypot(STD[1], STD[1]))
    assert change_text(found) == "a: from zulu to alpha, x: K_s went from 300 to 330 N/mm, 7.1 standard deviations."


def test_what_creeps_is_named_against_the_run_since_which_it_holds() -> None:
    """Each week 1 % more, 0.7 deviations of the difference: after five weeks it is 3.5 of them."""
    weeks = [outcome("a", f"w{k}", (16.0, 3e5 * (1 + 0.01 * k), 2.4e-3), at=float(k)) for k in range(11)]
    assert [(each.before, each.after, each.name) for each in changes(weeks)] == [
        ("w0", "w5", NAMES[1]),
        ("w5", "w10", NAMES[1]),
    ]
    # A step is no drift as well, and what stays where it went is said once.
    step = [outcome("a", f"w{k}", (16.0, 3e5 if k < 2 else 3.3e5, 2.4e-3), at=float(k)) for k in range(6)]
    assert [(each.before, each.after) for each in changes(step)] == [("w1", "w2")]


def test_clocks_differ_where_their_offset_went_by_more_than_a_tenth_of_a_millisecond() -> None:
    runs = [
        replace(outcome("a", f"w{k}", TRUE, at=float(k)), values={CLOCK: (offset, 1e-6)})
        for k, offset in enumerate((0.0, 9e-5, 2.1e-3))
    ]
    (found,) = changes(runs)
    assert change_text(found).startswith("a: from w1 to w2, lateness of the wrench's clock went from 0.09 to 2.1 ms")


def test_a_tare_is_a_change_of_its_cell_and_no_bias_is_unusual_in_a_fleet() -> None:
    name = f"{BIAS}.x"
    runs = [
        replace(outcome("a", f"w{k}", TRUE, at=float(k)), values={name: (bias, 0.002)})
        for k, bias in enumerate((4.2, 4.5, 10.2))
    ]
    (found,) = changes(runs)
    assert change_text(found).startswith("a: from w1 to w2, force bias x went from 4.5 to 10.2 N")
    biased = [replace(each, values={**each.values, name: (40.0 * k, 0.002)}) for k, each in enumerate(fleet())]
    assert unusual(biased) == ()


def test_a_change_that_is_known_too_well_to_matter_is_none() -> None:
    assert changes([outcome("a", "1", TRUE), outcome("a", "2", (16.0, 3.005e5, 2.4e-3), at=1.0)]) == ()


def test_of_equal_cells_none_is_unusual() -> None:
    assert unusual(fleet()) == ()


def test_a_cell_far_away_in_one_parameter_is_named_with_its_median() -> None:
    cells = fleet()
    cells[7] = outcome("c7", "mon", (27.0, TRUE[1], TRUE[2]))
    one = next(each for each in unusual(cells) if each.name)
    assert (one.cell, one.name, one.value) == ("c7", NAMES[0], 27.0)
    assert one.median == pytest.approx(16.0, rel=0.05)
    assert unusual_text(one).startswith("c7: payload mass is 27 kg, the cells' median 1")


def test_a_cell_that_is_usual_in_each_parameter_and_not_in_both_is_found() -> None:
    """Stiffness and delay go together: one up and one down by two deviations is what no other cell does."""
    cells = fleet(40)
    cells[3] = outcome("c3", "mon", (16.0, 3e5 * 1.1, 2.4e-3 * 0.9))
    assert {(each.cell, each.name) for each in unusual(cells)} == {("c3", "")}


def test_four_cells_are_no_fleet() -> None:
    assert unusual([*fleet(3), outcome("far", "mon", (99.0, 9e5, 9e-3))]) == ()


def test_values_are_shown_in_the_units_of_people() -> None:
    assert parameter_text("x.delay_s", 2.4e-3) == ("x: T_d", "ms", "2.4")
    assert parameter_text("x.x1.stiffness_n_per_m", 2e5, 1e3) == ("x: x1: K_e", "N/mm", "200", "1")
    assert parameter_text("rz.coupling_stiffness_n_per_m", 4e3)[1:] == ("N·m/rad", "4000")
    refused = RunOutcome(cell="a", run="2", key="", refused="log", reason="cut")
    assert outcome_text([outcome("a", "1", TRUE), refused]).startswith("2 runs of 1 cell, 1 refused; 0 changes")


def test_the_robust_covariance_of_normal_cells_is_that_they_were_drawn_from() -> None:
    """The planted covariance has no zero and both signs; a tenth of the cells lie 20 deviations away."""
    true = np.array([[1.0, 0.7, -0.3], [0.7, 1.0, 0.2], [-0.3, 0.2, 1.0]])
    rows = np.random.default_rng(2).multivariate_normal(np.zeros(3), true, size=20_000)
    np.testing.assert_allclose(_robust_covariance(rows), true, rtol=0.0, atol=0.05)
    rows[::10] += 20.0
    np.testing.assert_allclose(_robust_covariance(rows), true, rtol=0.0, atol=0.4)
    errors = np.tile([0.0, 0.5, 1.0], (len(rows), 1))
    found = _distances(rows[:5], errors[:5])
    shared = _robust_covariance(rows[:5]) + np.diag([0.0, 0.25, 1.0])
    np.testing.assert_allclose(found, np.sum(rows[:5] @ np.linalg.inv(shared) * rows[:5], axis=1))


def test_a_column_that_differs_less_keeps_its_share_of_the_pairs() -> None:
    """The eigenvectors are those of 2 Σ_ij / (Σ_ii + Σ_jj), the variances along them those of Σ."""
    true = np.array([[1.0, 0.6, 0.2], [0.6, 1.0, 0.1], [0.2, 0.1, 0.25]])
    rows = np.random.default_rng(3).multivariate_normal(np.zeros(3), true, size=40_000)
    sizes = np.diag(true)
    _, turned = np.linalg.eigh(2.0 * true / (sizes[:, None] + sizes))
    expected = (turned * np.diag(turned.T @ true @ turned)) @ turned.T
    np.testing.assert_allclose(_robust_covariance(rows), expected, rtol=0.0, atol=0.02)


def test_a_score_is_the_distance_from_the_median_in_robust_deviations_and_the_cells_own() -> None:
    cells = [outcome(f"c{i}", "mon", (value, *TRUE[1:])) for i, value in enumerate((15.0, 15.5, 16.0, 16.5, 40.0))]
    (far,) = (each for each in unusual(cells) if each.name)
    assert (far.cell, far.median) == ("c4", 16.0)
    assert far.score == pytest.approx(24.0 / np.hypot(1.4826 * 0.5, STD[0]))
