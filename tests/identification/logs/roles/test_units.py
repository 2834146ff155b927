"""Units of logs, each against scipy's constants: a torque is that of its force at its length."""

import pytest
from scipy import constants

from identification.logs.roles.cell import ANGLE_RAD, FORCE_N, LENGTH_M, TORQUE_N_M, check_unit
from problems.errors import ParameterError

FORCES = {"N": 1.0, "kN": constants.kilo, "lbf": constants.lbf, "kgf": constants.kgf}
LENGTHS = {"m": 1.0, "cm": constants.centi, "mm": constants.milli, "in": constants.inch, "ft": constants.foot}


def test_forces_lengths_and_angles_are_those_of_the_tables() -> None:
    assert pytest.approx(FORCES, rel=1e-12) == FORCE_N
    assert pytest.approx({name: LENGTHS[name] for name in ("m", "cm", "mm", "in")}, rel=1e-12) == LENGTH_M
    assert pytest.approx({"rad": 1.0, "deg": constants.degree}, rel=1e-12) == ANGLE_RAD


@pytest.mark.parametrize("unit", TORQUE_N_M)
def test_a_torque_is_its_force_at_its_length(unit: str) -> None:
    force = next(each for each in sorted(FORCES, key=len, reverse=True) if unit.startswith(each))
    assert TORQUE_N_M[unit] == pytest.approx(FORCES[force] * LENGTHS[unit.removeprefix(force).lstrip("·")], rel=1e-12)


def test_a_unit_that_is_not_known_is_refused_with_those_that_are() -> None:
    check_unit("units.force", "kN", FORCE_N)
    with pytest.raises(ParameterError, match=r"units\.force must be one of N, kN, lbf, kgf, found 'dyn'"):
        check_unit("units.force", "dyn", FORCE_N)
