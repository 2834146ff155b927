"""Run after `pip install ./examples/plugin`: what autotune asks of every objective and requirement."""

from autotune.studies.contract import check_objective, check_requirement
from autotune.studies.plugins import load_objective, load_requirement


def test_the_objective_keeps_the_contract() -> None:
    check_objective(type(load_objective("time_to_peak")))


def test_the_requirement_keeps_the_contract() -> None:
    check_requirement(type(load_requirement("time_to_react")))
