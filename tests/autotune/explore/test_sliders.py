"""A slider's position and the number that it stands for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.explore.sliders import (
    SliderRange,
    build_gain_sliders,
    build_plant_sliders,
    build_requirement_sliders,
    nominal_values,
    requirements_at,
    scenario_at,
    shown_thresholds,
)
from problems.design.problem import Requirements
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


@pytest.mark.parametrize(("axis", "unit"), [("x", "m/s/N"), ("rx", "rad/s/(N·m)")])
def test_a_requirement_is_set_in_the_unit_in_which_it_is_shown(axis: str, unit: str) -> None:
    asked = Requirements(delay_margin_s=1.5e-3, max_peak_force_n=60.0)
    spans = {span.name: span for span in build_requirement_sliders(asked, axis)}
    shown = shown_thresholds(asked)
    assert set(spans) == set(shown)
    assert (spans["asked-delay_margin_s"].unit, shown["asked-delay_margin_s"]) == ("ms", 1.5)
    assert spans["asked-free_space_admittance"].unit == unit
    assert "at most" in spans["asked-max_peak_force_n"].title
    # |1 + L| tends to 1, so no more can be asked.
    assert spans["asked-modulus_margin"].high < 1.0
    assert requirements_at(asked, shown) == asked
    changed = requirements_at(asked, {**shown, "asked-delay_margin_s": 2.0, "asked-free_space_admittance": 5e-4})
    assert changed.delay_margin_s == 2e-3
    assert changed.free_space_admittance is not None
    assert changed.free_space_admittance.min_m_s_per_n == 5e-4
    assert changed.gain_margin_db == asked.gain_margin_db
