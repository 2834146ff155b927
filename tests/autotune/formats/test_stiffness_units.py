"""Stiffnesses that can only be meant in another unit, and those that may be: at their limits."""

import pytest

from autotune.formats.stiffness_units import check_bumper_unit, check_surface_unit, doubtful_surface, interval_text
from problems.errors import ParameterError


def test_a_surface_into_which_30_n_press_a_metre_is_refused() -> None:
    check_surface_unit((30.0, 100.0), [30, 100])
    deep = r"in N/m: into this one 30 N press 1\.5 m deep \(did you mean 20000 to 90000\?\), found \[20, 90\]"
    with pytest.raises(ParameterError, match=deep):
        check_surface_unit((20.0, 90.0), [20, 90])
    with pytest.raises(ParameterError, match=r"press 1 m deep \(did you mean 29900\?\)"):
        check_surface_unit((29.9, 29.9), 29.9)


def test_a_bumper_that_gives_way_by_more_than_a_hand_s_breadth_is_refused() -> None:
    check_bumper_unit(300.0)
    with pytest.raises(ParameterError, match=r"30 N press this one 0.12 m deep \(did you mean 250000\?\)"):
        check_bumper_unit(250.0)


def test_a_surface_below_2_newtons_a_millimetre_is_doubted() -> None:
    assert list(doubtful_surface((1000.0, 2000.0))) == []
    (soft,) = doubtful_surface((1000.0, 1500.0))
    assert soft == (
        "An environment_stiffness of 1000 to 1500 N/m is very soft: 30 N press 20 to 30 mm into it. If it was meant in "
        "N/mm or kN/m, write 1e+06 to 1.5e+06."
    )
    (alone,) = doubtful_surface((1200.0, 1200.0))
    assert "30 N press 25 mm into it" in alone
    assert interval_text((2.0, 2.0), 3.0) == "6"
    assert interval_text((2.0, 4.0)) == "2 to 4"
