"""The numbers of one axis in a program of mass, damping and spring: within what it declares, and no spring unasked."""

import math
import re
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.export import cartesian_vic, crisp
from autotune.export.mdk_axis import MdkAxis, MdkForm
from problems.errors import ParameterError
from problems.model.mass_damper_controllers import Discretization
from tests.autotune.export.peer_cases import PLAIN

EULER = MdkForm(discretization=Discretization.EULER)
BY_RATIO = MdkForm(discretization=Discretization.MEASURED_MOTION, most_damping_ratio=5.0, most_stiffness=1000.0)


def axis(form: MdkForm) -> MdkAxis:
    return MdkAxis(task=cast(Any, None), gains=PLAIN, form=form)


@given(st.floats(1e-3, 1e3), st.floats(1e-2, 1e5))
def test_mass_and_damping_are_written_with_six_digits_and_without_a_spring(mass: float, damping: float) -> None:
    written = axis(EULER).written((mass / damping, damping))
    assert written == {
        "mass": pytest.approx(mass, rel=1e-5),
        "damping": pytest.approx(damping, rel=1e-5),
        "stiffness": 0.0,
    }
    rule = axis(EULER).rule((mass / damping, damping))
    assert (rule.mass, rule.damping, rule.stiffness) == tuple(written.values())
    assert all(each == float(f"{each:.6g}") for each in written.values())


@given(st.floats(1.0, 50.0), st.floats(10.0, 300.0))
def test_a_limited_ratio_gets_its_damping_from_the_spring_that_it_needs(mass: float, damping: float) -> None:
    written = axis(BY_RATIO).written((mass / damping, damping))
    ratio, stiffness = written["damping_ratio"], written["stiffness"]
    assert ratio <= 5.0
    assert 2.0 * ratio * math.sqrt(written["mass"] * stiffness) == pytest.approx(damping, rel=1e-4)
    # With less of a spring the ratio would be larger.
    assert stiffness >= (damping / 10.0) ** 2 / mass * (1.0 - 1e-4)


def test_a_spring_beyond_what_is_declared_is_refused() -> None:
    # ζ = 5 with 1000 N/m and 4 kg is 632 N·s/m.
    axis(BY_RATIO).rule((4.0 / 630.0, 630.0))
    with pytest.raises(ParameterError, match="stiffness must be at most 1000"):
        axis(BY_RATIO).rule((4.0 / 635.0, 635.0))


DECLARED = {
    # `mass` 0.001 to 100 and `damping` 0 to 5000 in the parameter file of crisp_controllers.
    "crisp": (crisp._form(), (0.001, 100.0), (0.0, 5000.0)),
    # `inertia` 1e-4 to 1e6 in that of cartesian_controllers' VIC, which declares no damping.
    "cartesian_vic": (cartesian_vic._form(), (1e-4, 1e6), (0.0, math.inf)),
}


@pytest.mark.parametrize("program", DECLARED)
def test_what_a_program_declares_it_gets(program: str) -> None:
    form, mass, damping = DECLARED[program]
    assert (form.mass, form.damping) == (mass, damping)
    of = axis(MdkForm(discretization=Discretization.EULER, mass=mass, damping=damping))
    for name, (low, high) in (("mass", mass), ("damping", damping)):
        for value, beyond in ((low, low * (1.0 - 1e-4)), (high, high * (1.0 + 1e-4))):
            if not 0.0 < value < math.inf:
                continue
            at, past = ((each, 1.0) if name == "mass" else (1.0 / each, each) for each in (value, beyond))
            rule = of.rule(at)
            assert getattr(rule, name) == pytest.approx(value, rel=1e-9)
            with pytest.raises(ParameterError, match=re.escape(f"{name} must be from {low:g} to {high:g}, found")):
                of.rule(past)
