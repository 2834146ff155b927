"""Contacts without a known coupling still tell the secant."""

import dataclasses

import numpy as np
import pytest

from autotune.cell.phases import Program
from autotune.cell.simulate import simulate_cell
from autotune.cell.truth import Cell
from identification.identify import identify_cell
from identification.result import Status
from problems.plant import Environment

ONLY_CONTACTS = Program(jogging_s=0.0, sweep_s=0.0, contact_count=3)


@pytest.mark.parametrize("stiffness", [2.0e4, 1.2e5])
def test_the_secant_is_told_where_the_coupling_is_not(stiffness: float) -> None:
    cell = dataclasses.replace(Cell(), environment=Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=40.0))
    axis = identify_cell(simulate_cell(cell, ONLY_CONTACTS, seed=5).recording).axes["x"]
    assert axis.coupling.stiffness_n_per_m.value is None
    (surface,) = axis.environments
    secant = surface.secant_stiffness_n_per_m
    k_s = cell.coupling.stiffness_n_per_m
    assert secant.status is Status.WEAK
    assert secant.value is not None
    assert secant.std is not None
    assert abs(secant.value - k_s * stiffness / (k_s + stiffness)) < 3.0 * secant.std
    assert surface.contacts == len(surface.peak_force_n) == 3
    assert np.min(surface.peak_force_n) > 25.0
    assert surface.stiffness_n_per_m.value is None
