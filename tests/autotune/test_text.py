"""Numbers as far as their deviation goes, and what is uncertain with symbols and units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.formats.units import axis_units
from autotune.text import off_nominal, rounded_to, scenario_text, touch_columns, touch_rows, with_deviation
from identification.result import Blow, Timeline, Touch, TouchCause
from problems.design.uncertainty import UNCERTAIN, Scenario


@pytest.mark.parametrize(
    ("value", "std", "reported"),
    [
        (16.20512, 0.0241, ("16.205", "0.024")),
        (310.018, 0.0996, ("310.02", "0.10")),  # two digits, not the three of 0.100
        (12345.6, 250.0, ("12346", "250")),
        (-0.00001, 0.0016, ("0.0000", "0.0016")),  # no negative zero
        (1.234e-9, 1e-10, ("1.23e-09", "0.10e-09")),
        (3e-12, 1.4e-10, ("0.0e-10", "1.4e-10")),
        (0.8, 0.0, ("0.8000", "0")),
        (0.8, None, ("0.8000", "-")),
        (None, None, ("-", "-")),
        (2.0, math.inf, ("2.0000", "0")),
    ],
)
def test_value_and_deviation_have_the_same_decimals(
    value: float | None, std: float | None, reported: tuple[str, str]
) -> None:
    assert with_deviation(value, std) == reported


def test_both_are_reported_in_the_unit_of_the_reader() -> None:
    assert with_deviation(0.0023996, 2.4e-6, 1e3) == ("2.3996", "0.0024")


@given(value=st.floats(-1e6, 1e6), std=st.floats(1e-12, 1e4))
def test_what_is_written_is_the_value_to_a_part_of_its_deviation(value: float, std: float) -> None:
    written, spread = with_deviation(value, std)
    # Two digits: half of the second one is at most a twentieth of the deviation.
    assert float(written) == pytest.approx(value, abs=0.0501 * std, rel=1e-15)
    assert float(spread) == pytest.approx(std, rel=0.0501)
    decimals = [len(text.partition("e")[0].partition(".")[2]) for text in (written, spread)]
    assert decimals[0] == decimals[1]
    assert written.partition("e")[2] == spread.partition("e")[2]


def test_a_truth_is_written_as_far_as_the_estimate_beside_it() -> None:
    assert rounded_to(0.024, 16.2) == "16.200"
    assert rounded_to(0.0, 16.2) == "16.2000"


_NUMBERS = (1.2e5, 16.0, 3.102e5, 150.2, 329.8, 2.0, 1.5, 2.403e-3, 3.182, 0.7, 3.2e-3, 8e-4)
VALUES = dict(zip(UNCERTAIN, _NUMBERS, strict=True))


def test_every_value_has_its_symbol_and_the_unit_of_its_axis() -> None:
    message = scenario_text(Scenario(**VALUES), axis_units("x"))
    assert message == (
        "K_e 120 N/mm, M_p 16 kg, K_s 310.2 N/mm, B_s 150.2 N·s/m, B_p 329.8 N·s/m, B_e 2 N·s/m, M_e 1.5 kg, "
        "T_d 2.403 ms, f_b 3.182 Hz, ζ_b 0.7, τ_w 3.2 ms, T_w 0.8 ms"
    )
    turned = scenario_text(Scenario(**{**VALUES, "payload_mass_kg": 0.52}), axis_units("ry"))
    assert turned.startswith("K_e 1.2e+05 N·m/rad, M_p 0.52 kg·m², K_s 3.102e+05 N·m/rad, B_s 150.2 N·m·s/rad")
    nominal = Scenario(environment_stiffness_n_per_m=2e4, payload_mass_kg=16.0)
    assert (off_nominal(nominal, axis_units("x")), scenario_text(nominal, axis_units("x"))) == (
        "",
        "K_e 20 N/mm, M_p 16 kg",
    )


@pytest.mark.parametrize(("cause", "count"), [(TouchCause.WALL, 2), (TouchCause.UNDETERMINED, 0)])
def test_as_many_later_blows_are_counted_as_listed(cause: TouchCause, count: int) -> None:
    """It left three times, and came back with two blows; of what may be a hand none is listed."""
    blow = Blow(onset_s=1.2, peak_s=1.22, peak_force=10.0, approach_speed=0.02, peak_interval=(9.0, 11.0))
    touch = Touch(
        axis="z",
        sign=1,
        cause=cause,
        peak_s=1.0,
        peak_force=30.0,
        bounces_s=(1.1, 1.3, 1.5),
        later_blows=(blow,) * count,
    )
    timeline = Timeline(phases=(), touches=(touch,))
    first, *others = touch_rows(timeline)
    assert first[touch_columns(timeline).index("later blows")] == (str(count) if count else "-")
    assert [row[1] for row in others] == [f"later blow {i + 1}" for i in range(count)]
