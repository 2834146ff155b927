"""The part of a force that turns a payload: sums over point masses that are accelerated and turned."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from identification.axis_command import CellSignals
from identification.payload.inertia import PAIRS
from identification.payload.turning import turning_force, turning_of_payload
from identification.result import Estimate, Status
from problems.arrays import FloatArray
from tests.identification.payload.test_inertia import MASSES_KG, POINTS_S_M, true_inertia

MASS = float(np.sum(MASSES_KG))
COM = MASSES_KG @ POINTS_S_M / MASS


def moved(count: int = 50) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return force and torque (n, 3) of small motions, and what of the force turns the payload, summed over points."""
    rng = np.random.default_rng(4)
    a, alpha = rng.standard_normal((2, count, 1, 3))
    at_points = a + np.cross(alpha, POINTS_S_M[None])
    forces = -MASSES_KG[:, None] * at_points
    turned = -MASS * np.cross(alpha[:, 0], COM)
    return np.sum(forces, axis=1), np.sum(np.cross(POINTS_S_M[None], forces), axis=1), turned


def tensor(std: float = 0.001) -> tuple[Estimate, ...]:
    values = [true_inertia()[pair] for pair in PAIRS]
    return tuple(Estimate(value=float(v), std=std, status=Status.IDENTIFIED, method="made") for v in values)


def found(components: tuple[Estimate, ...]) -> FloatArray | None:
    force, torque, _ = moved()
    gravity: Any = SimpleNamespace(
        mass_kg=MASS, com_S_m=COM, has_torque=True, compensated_torque_S_n_m=lambda _: torque
    )
    return turning_of_payload(cast(Any, None), force, gravity, cast(Any, SimpleNamespace(components=components)))


def test_force_and_torque_of_point_masses_give_what_turns_them() -> None:
    force, torque, turned = moved()
    assert turning_force(force, torque, MASS, COM, true_inertia()) == pytest.approx(turned, abs=1e-9)
    assert found(tensor()) == pytest.approx(turned, abs=1e-9)


def test_an_axis_about_whose_neighbours_the_inertia_is_unknown_has_none() -> None:
    unknown = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE, method="made")
    vague = replace(tensor()[2], status=Status.WEAK)
    for third in (unknown, vague):
        along = found((*tensor()[:2], third, *tensor()[3:]))
        assert along is not None
        assert np.all(np.isnan(along[:, :2]))
        # What turns about z hardly moves the payload along z: only the products of inertia bring it in.
        assert along[:, 2] == pytest.approx(moved()[2][:, 2], abs=0.15 * float(np.std(moved()[2][:, 2])))
    assert found((unknown,) * 6) is None
    assert found((unknown, *tensor()[1:2], unknown, *tensor()[3:])) is None


@pytest.mark.parametrize("lacking", [(), (1,)])
def test_an_axis_has_its_column_of_what_turns_where_all_of_it_is_known(lacking: tuple[int, ...]) -> None:
    turning = np.arange(12.0).reshape(4, 3)
    turning[2, list(lacking)] = np.nan
    found = {
        name: CellSignals.turning_of(cast(Any, SimpleNamespace(turning_S_n=turning)), name)
        for name in ("x", "y", "z", "ry")
    }
    assert found.pop("ry") is None
    for i, column in enumerate(found.values()):
        if i in lacking:
            assert column is None
        else:
            np.testing.assert_array_equal(column, turning[:, i])
    assert CellSignals.turning_of(cast(Any, SimpleNamespace(turning_S_n=None)), "x") is None
