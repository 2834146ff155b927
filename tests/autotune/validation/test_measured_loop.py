"""|1 + L| on measured responses against the loop in state space, and its circle against drawn errors."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.validation.measured_loop import measured_checks, measured_moduli, wrench_filter_of
from identification.measured_response import FrequencyResponse, measured_response
from identification.result import Identified, WrenchFilterEstimate
from problems.arrays import ComplexArray, FloatArray
from problems.model.plant import FREE_SPACE, WrenchFilter
from problems.model.response import plant_response
from problems.model.sampled import build_cut_loop, build_sampled_plant
from tests.autotune.tuning.cases import absent, identified_axis, identified_plant, known, small_controller, with_axis

FREQUENCY_HZ = np.geomspace(0.5, 60.0, 50)


def _damped() -> Controller:
    """The small controller with damping fed back, so that the loop has two break points that differ."""
    controller = small_controller()
    axes = {"x": replace(controller.axes["x"], feedback_damping_s=0.01)}
    return replace(controller, axes=axes)


def _true(controller: Controller) -> tuple[ComplexArray, ComplexArray]:
    """Return x/x^d and F/x^d of the nominal plant in free space, the hold taken out."""
    h, s = controller.sample_time_s, 2j * np.pi * FREQUENCY_HZ
    plant = controller.certificate.domain["x"].plants.at(16.0, 1e5).in_contact_with(FREE_SPACE)
    found = plant_response(build_sampled_plant(plant, h), 2.0 * np.pi * FREQUENCY_HZ)
    hold = -np.expm1(-s * h) / (s * h)
    return found.position / hold, found.force / hold


def _identified(pose: ComplexArray, force: ComplexArray, share: float | tuple[float, float]) -> Identified:
    of_pose, of_force = share if isinstance(share, tuple) else (share, share)
    radii = of_pose * np.abs(pose), of_force * np.abs(force)
    response = FrequencyResponse(
        command_to_pose=measured_response(FREQUENCY_HZ, pose, radii[0], radii[0], 1),
        command_to_force=measured_response(FREQUENCY_HZ, force, radii[1], radii[1], 1),
    )
    return with_axis(replace(identified_axis(), frequency_response=response))


def _state_space(controller: Controller) -> FloatArray:
    """Return |1 + L| and |1 + L_x| (2, k) by the return difference of the cut loop."""
    h = controller.sample_time_s
    plant = controller.certificate.domain["x"].plants.at(16.0, 1e5).in_contact_with(FREE_SPACE)
    cut = build_cut_loop(build_sampled_plant(plant, h), admittance_controller(controller, "x"))
    out = []
    for signal, other in ((cut.force, cut.command), (cut.command, cut.force)):
        m, n = cut.closed_at(other), cut.state_count
        z = np.exp(2j * np.pi * FREQUENCY_HZ * h)
        states = np.linalg.solve(z[:, None, None] * np.eye(n) - m[:n, :n], m[:n, signal][:, None])[..., 0]
        out.append(np.abs(1.0 - states @ m[signal, :n] - m[signal, signal]))
    return np.array(out)


@pytest.mark.parametrize("controller", [small_controller(), _damped()], ids=["plain", "damped"])
def test_of_an_exact_response_it_is_that_of_the_loop_in_state_space(controller: Controller) -> None:
    (found,) = measured_moduli(controller, _identified(*_true(controller), 1e-3))
    expected = _state_space(controller)
    assert found.modulus == pytest.approx(float(np.min(expected)), rel=1e-4)  # six digits are written
    place, point = np.unravel_index(int(np.argmin(expected)), expected.shape)
    assert found.frequency_hz == pytest.approx(FREQUENCY_HZ[point], rel=1e-5)
    assert found.at == ("force", "command")[place]
    assert found.certified == controller.certificate.margins["x"].modulus


@pytest.mark.parametrize("share", [(1e-3, 0.0), (0.0, 1e-3), (1e-3, 1e-3)])
def test_the_interval_holds_what_any_error_inside_the_circles_makes_of_it(share: tuple[float, float]) -> None:
    controller, rng = _damped(), np.random.default_rng(4)
    pose, force = _true(controller)
    (found,) = measured_moduli(controller, _identified(pose, force, share))
    half = found.interval_95[1] - found.modulus
    reached = 0.0
    for _ in range(300):
        turn = np.exp(2j * np.pi * rng.uniform(size=(2, 1)))
        wrong = pose * (1.0 + share[0] * turn[0]), force * (1.0 + share[1] * turn[1])
        (moved,) = measured_moduli(controller, _identified(*wrong, share))
        reached = max(reached, abs(moved.modulus - found.modulus))
    # To first order the interval is what the worst pair of errors reaches; 300 pairs come near it.
    assert 0.6 * half < reached < 1.02 * half


def test_a_response_that_comes_nearer_to_instability_than_certified_refutes_it() -> None:
    controller = small_controller()
    pose, force = _true(controller)
    (found,) = measured_moduli(controller, _identified(pose, force, 1e-3))
    assert not found.is_refuted
    late = np.exp(-2j * np.pi * FREQUENCY_HZ * 0.03)
    (check,), tree = measured_checks(controller, _identified(pose * late, force * late, 1e-3))
    assert not check.passed
    assert "this cell is none of the certified plants" in check.message
    assert tree["x"]["interval_95"][1] < tree["x"]["certified"]
    (check,), _ = measured_checks(controller, _identified(pose, force, 0.6))
    assert check.passed
    assert check.warns
    assert "leaves open" in check.message


def test_a_file_without_measured_responses_has_no_such_check() -> None:
    assert measured_checks(small_controller(), identified_plant()) == ((), {})
    pose, force = _true(small_controller())
    radius = 0.1 * np.abs(force / pose)
    alone = FrequencyResponse(pose_to_force=measured_response(FREQUENCY_HZ, force / pose, radius, radius, 1))
    without_command = with_axis(replace(identified_axis(), frequency_response=alone))
    assert measured_checks(small_controller(), without_command) == ((), {})


def test_the_filter_of_the_wrench_is_the_one_that_was_identified() -> None:
    assert wrench_filter_of(None) == WrenchFilter()
    assert wrench_filter_of(WrenchFilterEstimate(corner_hz=known(80.0, 1.0))) == WrenchFilter.from_corner(80.0)
    assert wrench_filter_of(WrenchFilterEstimate(delay_s=known(2e-3, 1e-4))) == WrenchFilter(delay_s=2e-3)
    assert wrench_filter_of(WrenchFilterEstimate(delay_s=absent())) == WrenchFilter()
