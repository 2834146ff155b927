"""Measured responses as values: joined over logs, corrected for what a log adds, refused where they contradict."""

import numpy as np
import pytest

from identification.measured_response import FrequencyResponse, MeasuredResponse, join_responses, measured_response
from problems.errors import ParameterError


def _response(values: complex, radius: float, *, frequency_hz: float = 2.0, noise: float = 0.0) -> FrequencyResponse:
    point = (frequency_hz, values.real, values.imag, radius, noise or radius)
    return FrequencyResponse(command_to_pose=MeasuredResponse(points=(point,)))


def test_two_logs_are_the_mean_by_their_circles() -> None:
    both = join_responses([_response(1.0 + 0.2j, 0.1), None, _response(1.03 + 0.2j, 0.2)])
    assert both is not None
    assert both.command_to_pose is not None
    assert both.command_to_pose.values[0] == pytest.approx((4.0 * 1.0 + 1.03) / 5.0 + 0.2j, rel=1e-5)
    assert both.command_to_pose.radius_95[0] == pytest.approx(0.1 * 0.2 / np.hypot(0.1, 0.2), rel=1e-5)
    assert both.command_to_pose.records == 2
    assert both.pose_to_force is None


def test_logs_that_differ_have_a_wider_circle() -> None:
    both = join_responses([_response(1.0 + 0.0j, 0.01), _response(1.2 + 0.0j, 0.01)])
    assert both is not None
    assert both.command_to_pose is not None
    # Two values 0.2 apart: each is 0.1 off the mean, whose deviation is then 0.1, and its circle sqrt(ln 20) of that.
    assert both.command_to_pose.radius_95[0] == pytest.approx(0.1 * np.sqrt(np.log(20.0)), rel=1e-5)
    assert both.command_to_pose.noise_radius_95[0] == pytest.approx(0.01 / np.sqrt(2.0), rel=1e-5)


def test_frequencies_of_one_log_alone_are_kept() -> None:
    both = join_responses([_response(1.0 + 0.0j, 0.01), _response(0.5 - 0.5j, 0.02, frequency_hz=5.0)])
    assert both is not None
    assert both.command_to_pose is not None
    assert both.command_to_pose.points == ((2.0, 1.0, 0.0, 0.01, 0.01), (5.0, 0.5, -0.5, 0.02, 0.02))


def test_nothing_and_nothing_is_nothing() -> None:
    assert join_responses([None, None]) is None


def test_what_the_log_adds_is_taken_out() -> None:
    f = np.array([1.0, 10.0])
    s = 2j * np.pi * f
    late = np.exp(-3e-4 * s) * np.exp(-1e-3 * s) / (1.0 + 2e-3 * s)
    logged = measured_response(f, late, np.full(2, 0.01), np.full(2, 0.01), 1)
    found = FrequencyResponse(command_to_force=logged, pose_to_force=logged).on_time(
        command_s=3e-4, force_s=1e-3, time_constant_s=2e-3, force_scale=0.04
    )
    assert found.command_to_force is not None
    assert found.pose_to_force is not None
    assert found.command_to_force.values == pytest.approx(np.full(2, 0.04), rel=2e-6)
    assert found.pose_to_force.values == pytest.approx(0.04 * np.exp(-3e-4 * s), rel=2e-6)
    assert found.command_to_force.radius_95 == pytest.approx(4e-4 * np.abs(1.0 + 2e-3 * s), rel=1e-5)


@pytest.mark.parametrize(
    "points",
    [
        (),
        ((0.0, 1.0, 0.0, 0.1, 0.1),),
        ((2.0, 1.0, 0.0, 0.1, 0.1), (2.0, 1.0, 0.0, 0.1, 0.1)),
        ((2.0, 1.0, 0.0, 0.1, 0.2),),
    ],
)
def test_what_contradicts_itself_is_refused(points: tuple[tuple[float, float, float, float, float], ...]) -> None:
    with pytest.raises(ParameterError, match="points"):
        MeasuredResponse(points=points)
