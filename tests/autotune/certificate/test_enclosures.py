"""Balls hold what they must: their arithmetic, the plants of a cell, the factors on an arc."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.certificate import certify as certify_module
from autotune.certificate.balls import (
    Balls,
    DualBall,
    Jet,
    as_series,
    exact,
    exponential,
    jet_exponential,
    number,
    units,
)
from autotune.certificate.base_plant import fails_at
from autotune.certificate.bounds import judge
from autotune.certificate.family import Family
from autotune.certificate.plant_cells import half_widths
from autotune.certificate.plant_polynomials import plant_polynomials
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Bumper
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from tests.autotune.certificate.loops import family, smallest_return_difference
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3)
ROBOTS = {
    "whole delay": one_pole(),
    "no delay": one_pole(0.0),
    "fraction": one_pole(2.7 * PERIOD_S),
    "fraction below one sample": one_pole(0.4 * PERIOD_S),
    "two poles": TWO_POLES,
}
PLAIN = admittance(20.0, 3500.0, 0.013, 0.01)
LAWS = {
    "plain": admittance(20.0, 3500.0, 0.0),
    "feedback": PLAIN,
    "compensated": replace(PLAIN, compensation_mass_kg=8.0),
    "ideal": replace(PLAIN, compensation_mass_kg=4.0, compensation="ideal"),
    "forward": replace(PLAIN, discretization="forward_euler"),
    "backward": replace(PLAIN, discretization="backward_euler"),
}
EVERY_KIND = pytest.mark.parametrize(
    ("robot", "law"),
    [(robot, LAWS["feedback"]) for robot in ROBOTS.values()] + [(TWO_POLES, law) for law in LAWS.values()],
    ids=[*ROBOTS, *(f"two poles, {name}" for name in LAWS)],
)


def of_kind(robot: RobotModel) -> Family:
    plant = paper_plant(
        stiffness=1e5, mass=15.0, drag=400.0, coupling_damping=120.0, environment_damping=30.0, robot=robot
    )
    return family((1e5, 1.3e5), (15.0, 17.0), nominal=plant, coupling_damping_n_s_per_m=(100.0, 140.0))


def test_operations_on_balls_hold_all_results() -> None:
    rng = np.random.default_rng(2)
    left, right = (rng.normal(size=(4, 5)) + 1j * rng.normal(size=(4, 5)) for _ in range(2))
    radii = 0.1 * rng.random((2, 4, 5))
    a, b = Balls(mid=left, rad=radii[0]), Balls(mid=right, rad=radii[1])
    for _ in range(200):
        turns = np.exp(2j * np.pi * rng.random((2, 4, 5)))
        x, y = left + radii[0] * turns[0], right + radii[1] * turns[1]
        for found, value in ((a + b, x + y), (a * b, x * y), (a @ Balls(mid=right.T, rad=radii[1].T), x @ y.T)):
            assert np.all(np.abs(value - found.mid) <= found.rad * (1.0 + 1e-12) + 1e-14)
    third = exact(np.array([1.0 / 3.0])) * exact(np.array([3.0]))
    assert third.rad[0] >= 1e-16


@EVERY_KIND
def test_the_balls_return_difference_is_that_of_the_loop(robot: RobotModel, law: AdmittanceController) -> None:
    """A claim a millionth above or below |1 + L| by determinants is certainly false, or not."""
    for of in (of_kind(robot), of_kind(robot).in_free_space()):
        point = np.mean(of.box(), axis=1)
        for angle in (0.003, 0.02, 0.15, 1.0, 3.0):
            there = float(smallest_return_difference(of.plant(point), law, np.array([angle]))[0])
            assert fails_at(of, law, point, angle, there * (1.0 + 1e-6))
            assert not fails_at(of, law, point, angle, there * (1.0 - 1e-6))


@EVERY_KIND
def test_cells_and_arcs_hold_their_plants_and_frequencies(robot: RobotModel, law: AdmittanceController) -> None:
    """|χ| > m |R| is claimed on no arc on which a plant of the cell has |1 + L| ≤ m."""
    rng = np.random.default_rng(6)
    for of in (of_kind(robot), of_kind(robot).in_free_space()):
        search = certify_module._Search(of, law, 0.5)
        box, arcs = of.box(), np.arange(search.circle.count_of_first)
        for _ in range(3):
            arcs = search.circle.halves(arcs)
        angles = search.circle.angles(arcs)
        cell = search._plant_cell(box)
        for modulus in (0.3, 0.6, 0.9):
            holds = judge(search.circle.at(arcs), cell, modulus).holds
            for share in rng.random((4, len(box))):
                plant = of.plant(box[:, 0] + share * (box[:, 1] - box[:, 0]))
                inside: FloatArray = angles[:, 0] + rng.random(len(angles)) * (angles[:, 1] - angles[:, 0])
                there = smallest_return_difference(plant, law, np.minimum(inside, np.pi))
                # At the lowest frequencies determinants of free space lose their digits.
                assert np.all(there[holds & (inside > 1e-3)] > modulus * (1.0 - 1e-6))
        assert np.any(judge(search.circle.at(arcs), cell, 0.1).holds)


@EVERY_KIND
def test_the_coefficients_of_a_cell_hold_those_of_its_plants(robot: RobotModel, law: AdmittanceController) -> None:
    of = of_kind(robot)
    search = certify_module._Search(of, law, 0.5)
    box = of.box()
    cell = search._plant_cell(box)
    rng = np.random.default_rng(8)
    middle, half = np.mean(box, axis=1), 0.5 * (box[:, 1] - box[:, 0])
    for delta in [*rng.uniform(-1.0, 1.0, (12, len(box))), np.ones(len(box)), -np.ones(len(box))]:
        point = np.clip(middle + half * delta, box[:, 0], box[:, 1])
        there = search._plant_cell(np.stack([point, point], axis=1))
        moved = np.concatenate([[1.0], delta])
        for group, found in zip(cell.groups, there.groups, strict=True):
            # Half a side is rounded up by 1e-12, so that δ is not exactly that of the point.
            rounding = 1e-11 * np.sum(np.abs(group.mid), axis=1)
            off = np.abs(group.mid @ moved - found.mid[:, 0])
            assert np.all(off <= group.rad[:, 0] + found.rad[:, 0] + rounding)
            # The rest is of second order: far below what the slopes tell.
            assert np.max(group.rad[:, 0]) < 0.3 * np.max(np.sum(np.abs(group.mid[:, 1:]), axis=1))


@pytest.mark.parametrize("robot", [one_pole(), TWO_POLES])
def test_the_coefficients_of_a_cell_hold_those_of_plants_with_a_bumper(robot: RobotModel) -> None:
    """The middle's polynomial has the poles of the sampled plant, and the cell holds every plant, free or touching."""
    whole = of_kind(robot)
    bumper = Bumper(mass_kg=0.7, stiffness_n_per_m=8e4, damping_n_s_per_m=30.0)
    soft = replace(whole, nominal=replace(whole.nominal, bumper=bumper))
    rng = np.random.default_rng(9)
    for of in (soft, soft.in_free_space()):
        box = of.box()
        found, *_ = plant_polynomials(of, np.repeat(np.mean(box, axis=1)[:, None], 2, axis=1))
        values = [float(as_series(each).value.mid()) for each in found]
        exact_poles = np.linalg.eigvals(build_sampled_plant(of.plant(np.mean(box, axis=1)), PERIOD_S).phi)
        off = [abs(np.polyval(values[::-1], pole - 1.0)) for pole in exact_poles]
        assert max(off) < 1e-9
        search = certify_module._Search(of, PLAIN, 0.5)
        cell = search._plant_cell(box)
        for delta in rng.uniform(-1.0, 1.0, (12, len(box))):
            point = np.mean(box, axis=1) + 0.5 * (box[:, 1] - box[:, 0]) * delta
            there = search._plant_cell(np.stack([point, point], axis=1))
            for group, one in zip(cell.groups, there.groups, strict=True):
                off_by = np.abs(group.mid @ np.concatenate([[1.0], delta]) - one.mid[:, 0])
                rounding = 1e-11 * np.sum(np.abs(group.mid), axis=1)
                assert np.all(off_by <= group.rad[:, 0] + one.rad[:, 0] + rounding)


def test_jets_hold_value_slope_and_half_the_second_derivative() -> None:
    """Of e^(x + 2t + 3t²): e^x, 2 e^x and (3 + 2²/2) e^x; of a product the sums of all products."""
    found = jet_exponential(np.array([[Jet(0.5, 2.0, 3.0)]], dtype=object))[0, 0]
    for each, expected in zip(found.c, (1.0, 2.0, 5.0), strict=True):
        assert float(each.mid()) == pytest.approx(expected * math.exp(0.5), rel=1e-15)
    product = (2.0 - Jet(1.0, 1.0, 0.0)) * (Jet(3.0, 0.0, 1.0) - 1.0)
    assert [float(each.mid()) for each in product.c] == [2.0, -2.0, 1.0]
    turn = np.array([[0, Jet(0.0, 1.0)], [Jet(0.0, -1.0), 0]], dtype=object)
    # cos t and sin t to second order.
    rotated = jet_exponential(turn)
    assert [[[float(e.mid()) for e in each.c] for each in row] for row in rotated] == [
        [[1.0, 0.0, -0.5], [0.0, 1.0, 0.0]],
        [[0.0, -1.0, 0.0], [1.0, 0.0, -0.5]],
    ]


def test_several_derivatives_at_once_are_those_along_one_after_the_other() -> None:
    """Through every operation and the exponential, to the last bit; of e^(x y) they are y e^(x y) and x e^(x y)."""

    def work(x: DualBall, y: DualBall) -> DualBall:
        turned = exponential(np.array([[x, y / 3], [-y, 2 - x]], dtype=object))
        found: DualBall = (turned[0, 0] / (1 + y * y) - turned[1, 1] ** 3) * x + 2.5 / turned[0, 1]
        return found

    both = work(*(DualBall(number(at), unit) for at, unit in zip((0.3, 0.7), units(2), strict=True)))
    for along in range(2):
        alone = work(*(DualBall(number(at), number(1) if i == along else None) for i, at in enumerate((0.3, 0.7))))
        assert both.value.mid() == alone.value.mid()
        assert both.derivative[0, along].mid() == alone.derivative.mid()
        assert both.derivative[0, along].rad() == alone.derivative.rad()
    x, y = (DualBall(number(at), unit) for at, unit in zip((0.3, 0.7), units(2), strict=True))
    (power,) = exponential(np.array([[x * y]], dtype=object))[0]
    slopes = [float(power.derivative[0, along].mid()) for along in range(2)]
    assert slopes == pytest.approx([0.7 * math.exp(0.21), 0.3 * math.exp(0.21)], rel=1e-15)


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6))
def test_the_middle_and_half_the_width_hold_a_cell_and_hardly_more(low: float, width: float) -> None:
    cell = np.array([[low, low + width], [0.0, 0.0]])
    half, middle = half_widths(cell), np.mean(cell, axis=1)
    for i, (first, last) in enumerate(cell):
        reach = (Fraction(middle[i]) - Fraction(half[i]), Fraction(middle[i]) + Fraction(half[i]))
        assert reach[0] <= Fraction(first) <= Fraction(last) <= reach[1]
        assert half[i] <= 0.5 * (last - first) * (1.0 + 1e-9) + 4.0 * np.spacing(abs(first) + abs(last))
