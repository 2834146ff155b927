"""A slider's position and the number that it stands for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.explore.sliders import Knob, build_gain_knobs, build_plant_knobs, nominal_values, scenario_at
from problems.design.uncertainty import UNCERTAIN
from tests.autotune.tuning.cases import design_problem


@given(value=st.floats(100.0, 10000.0), logarithmic=st.booleans())
def test_a_position_gives_its_value_with_six_digits(value: float, logarithmic: bool) -> None:
    knob = Knob(name="damping", symbol="B_a", label="", unit="", low=100.0, high=10000.0, logarithmic=logarithmic)
    assert knob.value(knob.position(value)) == pytest.approx(value, rel=5.1e-6)
    assert knob.value(knob.position(float(f"{value:.6g}"))) == float(f"{value:.6g}")
    assert (knob.value(knob.ends[0] - 1.0), knob.value(knob.ends[1] + 1.0)) == (100.0, 10000.0)


@pytest.mark.parametrize(("axis", "unit"), [("x", "N·s/m"), ("rx", "N·m·s/rad")])
def test_there_is_a_knob_for_each_gain_and_for_the_plant(axis: str, unit: str) -> None:
    problem = design_problem()
    gains, plant = build_gain_knobs(problem, axis), build_plant_knobs(problem, axis)
    assert [knob.name for knob in gains] == list(problem.variables)
    assert [(knob.low, knob.high) for knob in gains] == [problem.bounds[knob.name] for knob in gains]
    assert {knob.name for knob in plant} <= set(UNCERTAIN)
    assert gains[1].unit == next(knob.unit for knob in plant if knob.name == "drag_n_s_per_m") == unit
    for knob in plant:
        assert knob.low < nominal_values(problem)[knob.name] < knob.high


def test_what_is_nominal_stays_unsaid() -> None:
    problem = design_problem()
    values = nominal_values(problem)
    # Six digits are what a slider gives back.
    rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
    assert not scenario_at(problem, rounded).further()
    assert scenario_at(problem, {**values, "delay_s": 3e-3}).further() == {"delay_s": 3e-3}
