"""A slider's position and the number that it stands for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.explore.sliders import SliderRange, build_gain_sliders, build_plant_sliders, nominal_values, scenario_at
from problems.design.uncertainty import UNCERTAIN
from tests.autotune.tuning.cases import design_problem


@given(value=st.floats(100.0, 10000.0), logarithmic=st.booleans())
def test_a_position_gives_its_value_with_six_digits(value: float, logarithmic: bool) -> None:
    span = SliderRange(
        name="damping", symbol="B_a", label="", unit="", low=100.0, high=10000.0, logarithmic=logarithmic
    )
    assert span.value(span.position(value)) == pytest.approx(value, rel=5.1e-6)
    assert span.value(span.position(float(f"{value:.6g}"))) == float(f"{value:.6g}")
    assert (span.value(span.ends[0] - 1.0), span.value(span.ends[1] + 1.0)) == (100.0, 10000.0)


@pytest.mark.parametrize(("axis", "unit"), [("x", "N·s/m"), ("rx", "N·m·s/rad")])
def test_there_is_a_slider_for_each_gain_and_for_the_plant(axis: str, unit: str) -> None:
    problem = design_problem()
    gains, plant = build_gain_sliders(problem, axis), build_plant_sliders(problem, axis)
    assert [span.name for span in gains] == list(problem.variables)
    assert [(span.low, span.high) for span in gains] == [problem.bounds[span.name] for span in gains]
    assert {span.name for span in plant} <= set(UNCERTAIN)
    assert gains[1].unit == next(span.unit for span in plant if span.name == "drag_n_s_per_m") == unit
    for span in plant:
        assert span.low < nominal_values(problem)[span.name] < span.high


def test_what_is_nominal_stays_unsaid() -> None:
    problem = design_problem()
    values = nominal_values(problem)
    # Six digits are what a slider gives back.
    rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
    assert not scenario_at(problem, rounded).further()
    assert scenario_at(problem, {**values, "delay_s": 3e-3}).further() == {"delay_s": 3e-3}
