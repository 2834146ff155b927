"""Axes that do not go together on their payload are searched again, each beside the laws of the others."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from autotune.errors import InfeasibleError, UsageError
from autotune.explore.saving import Target, save_controller
from autotune.explore.source import read_exploration
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ProblemSpec, read_problem
from autotune.tuning.coupled import TogetherAsked
from autotune.tuning.optimize import Optimized, optimize
from autotune.validation.axis_proof import ProofOptions
from autotune.validation.coupled import build_dense_loop, check_coupled
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_sweep import CoupledPlants, coupled_plants
from identification.result import AxisEstimate, Identified
from problems.errors import ParameterError
from tests.autotune.tuning.cases import FAST_REQUIREMENTS, known, known_vector
from tests.autotune.tuning.turning import FAST_TURNING_SPEC, two_axes

# Each axis alone is asked so little that both together, which hardly anything damps, are unstable.
ASKED = 0.15
REQUIREMENTS = replace(
    FAST_REQUIREMENTS, modulus_margin=ASKED, gain_margin_db=None, phase_margin_deg=None, delay_margin_s=None
)
SPEC = replace(
    FAST_TURNING_SPEC,
    bounds={"mass": (5.0, 7.0), "damping": (1200.0, 1600.0), "lead_s": (0.01, 0.03), "feedback_damping_s": (0.0, 1e-3)},
    requirements=REQUIREMENTS,
)
QUICK = ProofOptions(further_s=0.1)


def undamped(axis: AxisEstimate) -> AxisEstimate:
    """Return an axis with a tenth of its dampings."""
    damping, drag = axis.coupling.damping_n_s_per_m.value, axis.drag_n_s_per_m.value
    assert damping is not None
    assert drag is not None
    coupling = replace(axis.coupling, damping_n_s_per_m=known(0.1 * damping, 1e-3 * damping))
    return replace(axis, coupling=coupling, drag_n_s_per_m=known(0.1 * drag, 1e-3 * drag))


def plant(com_m: float = 0.18) -> Identified:
    both = two_axes()
    payload = replace(both.payload, com_m=known_vector(0.0, 0.0, com_m))
    return replace(both, axes={name: undamped(each) for name, each in both.axes.items()}, payload=payload)


def tuned(spec: ProblemSpec, axes: Literal["apart", "checked"] = "checked") -> Optimized:
    file = IdentifiedFile(result=plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    proof = replace(QUICK, axes=axes)
    return optimize(file, spec, seed=1, replays=False, proof=proof)


@cache
def apart() -> Optimized:
    return tuned(SPEC, "apart")


@cache
def searched_again() -> Optimized:
    return tuned(SPEC)


def largest_pole(controller: Controller) -> float:
    """Return the largest |z| over the plants of the sweep, from scipy's matrices."""
    body = searched_again().controller.certificate.coupled
    assert body is not None
    cell = CoupledCell.of(controller, body.body)
    loops = (build_dense_loop(each, cell.law(group), cell.sample_time_s) for group, each in coupled_plants(cell))
    return max(loop.radius() for loop in loops)


def test_designs_that_are_unstable_together_are_searched_again() -> None:
    assert largest_pole(apart().controller) > 1.0
    found = searched_again()
    assert largest_pole(found.controller) < 1.0
    stated = found.controller.certificate.coupled
    assert stated is not None
    # Not at the edge of stability: 0.8 of what one axis is asked, by the eigenvalues of a Hamiltonian matrix too.
    assert stated.min_modulus == pytest.approx(0.8 * ASKED)
    assert stated.modulus >= 0.8 * ASKED
    (check,) = check_coupled(found.controller)
    assert check.passed, check.message
    # What each axis is asked by itself still holds, and being stable together costs something.
    for name, search in found.searches.items():
        assert search.evaluation.is_feasible
        assert search.evaluation.cost >= (1.0 - 1e-3) * apart().searches[name].evaluation.cost
    (note,) = (each for each in found.controller.provenance["notes"] if "searched again" in each)
    assert "unstable together" in note
    assert re.search(r"x: peak contact force \d", note)


def test_a_claim_of_more_modulus_than_there_is_does_not_pass() -> None:
    controller = searched_again().controller
    stated = controller.certificate.coupled
    assert stated is not None
    more = replace(controller.certificate, coupled=replace(stated, min_modulus=stated.modulus + 0.01))
    (check,) = check_coupled(replace(controller, certificate=more))
    assert not check.passed
    assert "is asked" in check.message


def test_a_modulus_of_both_that_no_design_has_is_refused_with_the_reason() -> None:
    with pytest.raises(InfeasibleError, match=r"Searched again, each beside the others: Axis x: .*axes_together"):
        tuned(replace(SPEC, least_modulus_together=0.9))


def test_the_test_of_the_search_agrees_with_dense_matrices_on_drawn_laws() -> None:
    stated = searched_again().controller.certificate.coupled
    assert stated is not None
    cell = CoupledCell.of(searched_again().controller, stated.body)
    plants, rng = CoupledPlants(cell), np.random.default_rng(3)
    seen = set()
    for _ in range(30):
        laws = {
            name: each
            and replace(each, mass_kg=each.mass_kg * rng.uniform(0.3, 2.0), lead_s=float(rng.uniform(0.0, 0.03)))
            for name, each in cell.laws.items()
        }
        moved = replace(cell, laws=laws)
        dense = max(
            build_dense_loop(each, moved.law(group), cell.sample_time_s).radius()
            for group, each in coupled_plants(moved)
        )
        fails = plants.failure(laws) is not None
        assert fails == (dense >= 1.0)
        seen.add(fails)
    assert seen == {True, False}


def test_the_modulus_of_both_is_read_and_has_bounds(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("axes_together: {min_modulus: 0.4}\n", encoding="utf-8")
    assert read_problem(path).least_modulus_together == 0.4
    path.write_text("axes_together: {min_modulus: 1.4}\n", encoding="utf-8")
    with pytest.raises(UsageError, match="min_modulus"):
        read_problem(path)
    with pytest.raises(ParameterError, match="least_modulus_together"):
        ProblemSpec(least_modulus_together=1.0)


def test_explore_saves_no_gains_that_are_unstable_together(tmp_path: Path) -> None:
    """Gains set by hand are checked on the payload as searched ones are, and the file says so."""
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    write_controller(good, searched_again().controller)
    exploration = read_exploration(good)
    assert exploration.together is not None
    designs = {name: start.design for name, start in exploration.axes.items()}
    save_controller(exploration, designs, Target(tmp_path / "saved.yaml"))
    saved = read_controller(tmp_path / "saved.yaml").controller.certificate.coupled
    stated = searched_again().controller.certificate.coupled
    assert saved is not None
    assert stated is not None
    assert saved.modulus == pytest.approx(stated.modulus, rel=1e-6)
    assert saved.min_modulus == stated.min_modulus
    write_controller(bad, apart().controller)
    known_plant = replace(read_exploration(bad), together=TogetherAsked(identified=plant()))
    designs = {name: start.design for name, start in known_plant.axes.items()}
    with pytest.raises(InfeasibleError, match="unstable together"):
        save_controller(known_plant, designs, Target(tmp_path / "refused.yaml"))
    assert not (tmp_path / "refused.yaml").exists()
