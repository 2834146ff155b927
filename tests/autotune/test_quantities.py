"""Numbers with units and with deviations, as people type them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.errors import UsageError
from autotune.quantities import parse_given, parse_quantities, parse_quantity, parse_range
from identification.given import Given


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("1.2e5", "stiffness", 1.2e5),
        ("1.2e5N/m", "stiffness", 1.2e5),
        ("120 N/mm", "stiffness", 1.2e5),
        ("120kN/m", "stiffness", 1.2e5),
        ("0.12 N/µm", "stiffness", 1.2e5),
        ("16.2kg", "mass", 16.2),
        ("16200 g", "mass", 16.2),
        (".0162t", "mass", 16.2),
        ("40N·m/rad", "rotational stiffness", 40.0),
        ("40Nm/rad", "rotational stiffness", 40.0),
        ("40 N*m/rad", "rotational stiffness", 40.0),
        ("1Nm/deg", "rotational stiffness", 180.0 / math.pi),
        ("0.4 kg·m²", "inertia", 0.4),
        ("630N·s/m", "damping", 630.0),
        ("2.4ms", "time", 2.4e-3),
    ],
)
def test_a_number_with_a_unit_is_in_si(text: str, kind: str, value: float) -> None:
    found = parse_quantity(text, kind)
    # A factor and a product: two roundings.
    assert found.value == pytest.approx(value, rel=1e-15)
    assert found.has_unit == (text != "1.2e5")


@pytest.mark.parametrize(
    ("parts", "values"),
    [
        (["20", "500N/mm"], [2e4, 5e5]),
        (["20N/mm", "5e5N/m"], [2e4, 5e5]),
        (["2e4", "5e5"], [2e4, 5e5]),
        (["20N/mm", "500"], [2e4, 500.0]),
    ],
)
def test_a_unit_behind_the_last_number_is_that_of_all_without_one(parts: list[str], values: list[float]) -> None:
    assert [each.value for each in parse_quantities(parts, "stiffness")] == pytest.approx(values, rel=1e-15)


@pytest.mark.parametrize("text", ["heavy", "", "16.2kN", "1e5N/km", "kg", "1,5kg"])
def test_what_is_no_number_or_no_such_unit_is_refused_by_name(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a number|is no unit of mass; known are kg, g, t"):
        parse_quantity(text, "mass")


@given(st.floats(1e-300, 1e300))
def test_every_plain_number_is_itself(value: float) -> None:
    assert parse_quantity(repr(value), "mass").value == value


@pytest.mark.parametrize(
    "text", ["mass_kg=16.2±0.1", "mass_kg=16.2+-0.1", "mass_kg=16.2+/-0.1", " mass_kg=1.62e1 ± 1e-1"]
)
def test_the_usual_ways_to_write_a_deviation(text: str) -> None:
    assert parse_given([text]) == {"mass_kg": Given(value=16.2, std=0.1)}


def test_without_deviation_it_is_exact_and_exponents_are_no_deviations() -> None:
    assert parse_given(["x.delay_s=2.4e-3", "sample_time_s=8e+0"]) == {
        "x.delay_s": Given(value=2.4e-3, std=0.0),
        "sample_time_s": Given(value=8.0, std=0.0),
    }


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["mass_kg"], "must be NAME=VALUE±STD"),
        (["mass_kg="], "must be NAME=VALUE±STD"),
        (["mass_kg=16,2±0.1"], "must hold numbers, found '16,2'"),
        (["mass_kg=nan"], "finite"),
        (["mass_kg=16±-0.1"], "must not be negative"),
        (["mass_kg=16±inf"], "finite"),
        (["mass_kg=16", "mass_kg=17"], "twice"),
    ],
)
def test_what_is_no_prior_is_refused(texts: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_given(texts)


@pytest.mark.parametrize("text", ["mass_kg=-3", "mass_kg=0±1", "x.coupling_stiffness_n_per_m=-1e5", "x.delay_s=-1e-3"])
def test_what_no_payload_has_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be"):
        parse_given([text])


def test_a_damping_or_delay_may_be_none() -> None:
    assert parse_given(["x.drag_n_s_per_m=0±10", "x.delay_s=0"])["x.delay_s"].value == 0.0


def test_a_range_has_its_ends_in_order_above_0() -> None:
    low, high = parse_range(["20", "500N/mm"], "stiffness")
    assert (low.value, high.value) == (2e4, 5e5)
    (same, again) = parse_range(["16.2"], "mass")
    assert same == again
    for parts, found in ((["1", "inf"], "found 1 and inf"), (["0", "2"], "the gripper")):
        with pytest.raises(ValueError, match=rf"a payload mass must be finite and above 0; .*{found}"):
            parse_range(parts, "mass")
    with pytest.raises(ValueError, match=r"^a range of payload mass must have the lower one first; found 3 and 2\.$"):
        parse_range(["3", "2"], "mass")
