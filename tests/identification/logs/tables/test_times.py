"""Times of rows: the nearest nanosecond of what is written, computed exactly here with fractions."""

from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation, localcontext
from fractions import Fraction

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.logs.tables.layout import EXPONENT
from identification.logs.tables.times import from_decimals, from_floats, from_integers, from_rate, from_texts

UNITS = st.sampled_from(sorted(EXPONENT))


@settings(max_examples=300, deadline=None)
@given(unit=UNITS, ns=st.integers(-(2**62), 2**62), thousandths=st.integers(-499, 499))
def test_decimals_and_texts_are_rounded_to_the_nearest_nanosecond(unit: str, ns: int, thousandths: int) -> None:
    number = (Decimal(ns) + Decimal(thousandths) / 1000).scaleb(-EXPONENT[unit])
    assert from_decimals(pa.array([number], type=pa.decimal128(38, 12)), unit).tolist() == [ns]
    for text in (f"{number:f}", f"{number:e}", f"  {number:.30E}\t"):
        assert from_texts(pa.array([text]), unit).tolist() == [ns]
        assert from_texts(pa.array([text.replace(".", ",")]), unit, ",").tolist() == [ns]


@settings(max_examples=500, deadline=None)
@given(unit=UNITS, text=st.from_regex(r"[-+]?[0-9]{0,25}(\.[0-9]{0,25})?([eE][-+]?[0-9]{1,3})?", fullmatch=True))
def test_texts_are_rounded_as_decimals_are_ties_to_even(unit: str, text: str) -> None:
    try:
        exact = Decimal(text)
    except InvalidOperation:
        with pytest.raises(ValueError, match="no number"):
            from_texts(pa.array([text or "-"]), unit)
        return
    with localcontext(prec=1100):
        expected = int(exact.scaleb(EXPONENT[unit]).to_integral_value(ROUND_HALF_EVEN))
    if abs(expected) < 2**63:
        assert from_texts(pa.array(["7", text]), unit).tolist() == [7 * 10 ** EXPONENT[unit], expected]
    else:
        with pytest.raises(OverflowError):
            from_texts(pa.array(["7", text]), unit)


@pytest.mark.parametrize(
    "text", ["", " ", "-", ".", "e5", "1e", "1e+", "1.2.3", "1,5", "nan", "inf", "0x1", "1 2", "1_0", "--1"]
)
def test_texts_that_are_no_numbers_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no number"):
        from_texts(pa.array(["5", text, "6"]), "s")


@settings(max_examples=500, deadline=None)
@given(unit=UNITS, value=st.floats(-1e9, 1e9) | st.floats(1.6e9, 1.8e9))
def test_doubles_are_rounded_to_the_nearest_nanosecond_of_their_exact_value(unit: str, value: float) -> None:
    exact = Fraction(value) * 10 ** EXPONENT[unit]
    # The broken part times 1e9 is rounded to a double before it is rounded to a whole number.
    assert abs(from_floats(np.array([value]), unit)[0].item() - exact) <= Fraction(1, 2) + Fraction(1, 10**6)


def test_a_slice_of_texts_is_converted_where_it_lies() -> None:
    values = pa.array([str(index) for index in range(10)])
    assert from_texts(values.slice(3, 4), "ns").tolist() == [3, 4, 5, 6]
    assert from_texts(values.slice(3, 0), "ns").tolist() == []
    assert from_texts(pa.array([], type=pa.string()), "ns").tolist() == []


@pytest.mark.parametrize("unit", sorted(EXPONENT))
def test_times_beyond_what_nanoseconds_hold_are_refused(unit: str) -> None:
    beyond = Decimal(2**63).scaleb(-EXPONENT[unit])
    largest = Decimal(2**63 - 1).scaleb(-EXPONENT[unit])
    for convert, kind in ((from_decimals, pa.decimal128(38, 9)), (from_texts, pa.string())):
        make = str if convert is from_texts else Decimal
        assert convert(pa.array([make(largest)], type=kind), unit).tolist() == [2**63 - 1]
        with pytest.raises(OverflowError):
            convert(pa.array([make(beyond)], type=kind), unit)
    with pytest.raises(OverflowError):
        from_floats(np.array([0.0, float(beyond)]), unit)
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(OverflowError):
            from_floats(np.array([value]), unit)
    scale = 10 ** EXPONENT[unit]
    assert from_integers(np.array([-((2**63 - 1) // scale)]), unit).tolist() == [-((2**63 - 1) // scale) * scale]
    if scale > 1:
        with pytest.raises(OverflowError):
            from_integers(np.array([2**63 // scale + 1]), unit)


def test_rows_with_a_rate_are_nowhere_more_than_half_a_nanosecond_off() -> None:
    found = from_rate(750_000, 1234.5)
    exact = [Fraction(index) * 10**9 * 10 / 12345 for index in (1, 7, 749_999)]
    # Half a nanosecond, and the rounding of a double at 6e11.
    assert all(
        abs(int(found[i]) - at) < Fraction(1, 2) + Fraction(1, 10**3)
        for i, at in zip((1, 7, 749_999), exact, strict=True)
    )
    assert found[0] == 0
