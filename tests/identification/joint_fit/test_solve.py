"""The least squares under the joint refinement: derivatives, elimination, widening, and profiles."""

from dataclasses import replace

import numpy as np
import pytest

from identification.joint_fit.covariance import bounded_intervals, count_misfits, widened
from identification.joint_fit.extended_fit import _eased
from identification.joint_fit.model import ParameterLayout
from identification.joint_fit.noise import Smoother, Whitener
from identification.joint_fit.segments import Segment, group_contacts, predict_force
from identification.joint_fit.solve import Point, Problem, Signals, information, linearise, minimise, sizes_of
from problems.arrays import FloatArray
from tests.identification.synthetic import sweep

H_S = 1e-3
LAYOUT = ParameterLayout(robot_order=1, surfaces=1)
TRUTH = np.array([2.4e5, 120.0, 280.0, 14.0, 20.0, 2.35e-3, 5.0e4, 60.0, 2.0])
NOISE_N, NOISE_M = 0.1, 1e-6
OWN = (np.zeros(3), np.array([-3.0, 0.5, 0.1, 8e-3]))


def command() -> FloatArray:
    """A sweep, a rest, and a slow move onto a wall at 8 mm."""
    rest, t = np.zeros(400), np.linspace(0.0, 1.0, 800)
    approach = 9.5e-3 * t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
    return np.concatenate([rest, sweep(3.0, 1.0 / H_S), rest, approach, np.full(600, 9.5e-3)])


def made(seed: int, values: FloatArray = TRUTH) -> tuple[Problem, Point]:
    """A log that the model itself made, with white noise."""
    held, rng = command(), np.random.default_rng(seed)
    count = len(held)
    segments = (Segment(start=200, stop=4100), Segment(start=count - 1200, stop=count, surface=0))
    quiet = Signals(
        period_s=H_S, position_m=np.zeros(count), force_n=np.zeros(count), command_m=held, smoother=Smoother(taps=None)
    )
    robot = -quiet.path(values, LAYOUT).misfit(slice(0, count))
    exact = replace(quiet, position_m=robot)
    force = np.zeros(count)
    for segment, own in zip(segments, OWN, strict=True):
        force[segment.slice] = predict_force(values, own, segment, exact.path(values, LAYOUT), LAYOUT, H_S)
    white = Whitener(coefficients=np.ones(1), rms=NOISE_N)
    signals = replace(
        exact,
        position_m=robot + NOISE_M * rng.standard_normal(count),
        force_n=force + NOISE_N * rng.standard_normal(count),
    )
    problem = Problem(
        signals=signals,
        layout=LAYOUT,
        segments=segments,
        pose_spans=(slice(0, count),),
        free_noise=white,
        contact_noise=white,
        pose_noise=replace(white, rms=NOISE_M),
    )
    return problem, Point(values=values, nuisances=OWN)


def test_the_derivatives_are_those_of_central_differences() -> None:
    problem, point = made(0)
    sizes = sizes_of(point.values, LAYOUT, H_S)
    blocks = linearise(problem, point)
    path = problem.path(point.values)
    for segment, own, block in zip(problem.segments, point.nuisances, blocks, strict=False):
        for column, index in enumerate(block.indices):
            forces = []
            for side in (1.0, -1.0):
                values = point.values.copy()
                values[index] += side * 1e-4 * sizes[index]
                there = problem.signals.path(values, LAYOUT) if index in (4, 5) else path
                forces.append(predict_force(values, own, segment, there, LAYOUT, H_S))
            expected = (forces[0] - forces[1]) / 2e-4 / NOISE_N
            # The own parameters are projected out of the derivative; so are they here.
            basis, _ = np.linalg.qr(own_columns(problem, point, segment, own))
            expected -= basis @ (basis.T @ expected)
            tolerance = 2e-3 * float(np.linalg.norm(expected))
            assert np.linalg.norm(block.jacobian[:, column] - expected) <= tolerance


def own_columns(problem: Problem, point: Point, segment: Segment, own: FloatArray) -> FloatArray:
    """Central differences by the span's own parameters."""
    path, columns = problem.path(point.values), []
    for index in range(len(own)):
        step = np.zeros(len(own))
        step[index] = 1e-7 if index == 3 else 1e-3
        forces = [predict_force(point.values, own + s * step, segment, path, LAYOUT, H_S) for s in (1.0, -1.0)]
        columns.append((forces[0] - forces[1]) / (2.0 * step[index]))
    return np.column_stack(columns)


def test_scores_over_many_logs_are_standard_normal() -> None:
    scores = []
    for seed in range(40):
        problem, point = made(seed)
        found, _ = minimise(problem, replace(point, values=point.values * 1.02), 12)
        blocks = linearise(problem, found)
        matrix, _ = information(blocks, len(LAYOUT))
        std = np.sqrt(np.diag(np.linalg.inv(matrix))) * sizes_of(found.values, LAYOUT, H_S)
        scores.append((found.values - TRUTH) / std)
    spread, offset = np.std(scores, axis=0), np.mean(scores, axis=0)
    # A spread over 40 draws is known to 11 %, a mean to 0.16 deviations: four times that.
    assert np.all(np.abs(spread - 1.0) < 0.45)
    assert np.all(np.abs(offset) < 0.65)


def test_white_noise_widens_nothing_and_a_misfit_does() -> None:
    problem, point = made(1)
    found, _ = minimise(problem, point, 6)
    assert widened(linearise(problem, found), len(LAYOUT), H_S).widening < 1.6
    force = problem.signals.force_n.copy()
    time = np.arange(len(force)) * H_S
    force += 2.0 * np.sin(2.0 * np.pi * 7.0 * time) * (time > 1.0)
    wrong = replace(problem, signals=replace(problem.signals, force_n=force))
    found, _ = minimise(wrong, point, 6)
    assert widened(linearise(wrong, found), len(LAYOUT), H_S).widening > 5.0


def test_misfit_in_contact_counts_for_the_surface_alone() -> None:
    problem, point = made(1)
    spread = widened(linearise(problem, point), len(LAYOUT), H_S)
    assert count_misfits(problem, spread, (1.0, 1.0)).widening == spread.widening
    wider = count_misfits(problem, spread, (1.0, 3.0)).covariance
    # An excess of 8 − 4·√(2/1200) over 1200 samples that count as 10.
    factor = 1.0 + (8.0 - 4.0 * np.sqrt(2.0 / 1200.0)) * 120.0
    np.testing.assert_allclose(np.diag(wider)[:6], np.diag(spread.covariance)[:6])
    np.testing.assert_allclose(np.diag(wider)[6:], factor * np.diag(spread.covariance)[6:])


def test_a_damping_that_is_nothing_stays_at_nothing_with_an_interval() -> None:
    massless = TRUTH.copy()
    massless[[7, 8]] = 0.0
    covered = 0
    for seed in range(12):
        problem, point = made(seed, massless)
        found, _ = minimise(problem, point, 8)
        assert np.all(found.values >= 0.0)
        blocks = linearise(problem, found)
        intervals = bounded_intervals(problem, found, blocks, widened(blocks, len(LAYOUT), H_S))
        low, high = intervals["environment1_mass_kg"]
        covered += low == 0.0
        assert found.values[8] <= high < 0.5
    # A one-sided 2.5 % each: three or more of twelve would come once in three hundred times.
    assert covered >= 10


def test_a_prior_and_a_summary_pull_as_data_do() -> None:
    problem, point = made(2)
    found, _ = minimise(problem, point, 6)
    strong = replace(problem, priors=((3, 15.0, 1e-6),))
    pulled, _ = minimise(strong, found, 20)
    assert pulled.values[3] == pytest.approx(15.0, abs=1e-4)


def test_contacts_that_felt_alike_are_one_surface() -> None:
    starts = [(1, 9.0e4, 100.0), (1, 4.0e4, 50.0), (1, 9.4e4, 100.0), (-1, 4.1e4, 50.0), (1, 4.2e4, 50.0)]
    assert group_contacts(starts, 1.12) == [2, 1, 2, 0, 1]
    # What is known badly is no surface of its own.
    assert group_contacts([(1, 4.0e4, 50.0), (1, 5.0e4, 3.0e3)], 1.12) == [0, 0]


def test_an_eased_step_is_shorter_the_more_it_is_eased_and_the_whole_one_without() -> None:
    rng = np.random.default_rng(6)
    rows, y = rng.normal(size=(8, 4)), rng.normal(size=8)
    whole = np.linalg.lstsq(rows, y, rcond=None)[0]
    assert _eased(rows, 0.0) @ y == pytest.approx(whole, rel=1e-9)
    lengths = [float(np.linalg.norm(rows @ (_eased(rows, easing) @ y))) for easing in (0.0, 0.1, 1.0, 10.0)]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[-1] < 0.2 * lengths[0]
