"""Whether an identified plant lies in the domain that a certificate speaks of."""

import math
from dataclasses import replace
from typing import Any

import pytest

from autotune.formats.controller_record import Controller
from autotune.validation.domain import check_domain
from autotune.validation.report import Check
from identification.result import AxisEstimate, Identified, WrenchFilterEstimate
from problems.model.plant import WrenchFilter
from tests.autotune.tuning.cases import absent, identified_axis, identified_plant, known, small_controller, with_axis

TAU = 1.0 / (2.0 * math.pi * 50.0)


def messages(identified: Identified) -> list[str]:
    (check, _) = check_domain(small_controller(), identified)
    assert check.axis == "x"
    assert check.passed == (check.message == "lies inside the certified domain")
    return [] if check.passed else check.message.split("; ")


def test_the_plant_that_was_tuned_for_is_inside() -> None:
    assert messages(identified_plant()) == []


def _surface(axis: AxisEstimate, stiffness: float) -> AxisEstimate:
    return replace(axis, environments=(replace(axis.environments[0], stiffness_n_per_m=known(stiffness, 10.0)),))


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        (_surface(identified_axis(), 2e5), "K_e of x1 [N/mm] is 200, certified for [100, 120]"),
        (_surface(identified_axis(), 9e4), "K_e of x1 [N/mm] is 90, certified for [100, 120]"),
        (replace(identified_axis(), drag_n_s_per_m=known(350.0, 1.0)), "B_p [N·s/m] is 350, certified for 330"),
        (replace(identified_axis(), drag_n_s_per_m=absent()), "B_p [N·s/m] is not identified"),
    ],
)
def test_a_plant_outside_is_reported_with_both_numbers(axis: AxisEstimate, message: str) -> None:
    assert messages(with_axis(axis)) == [message]


def test_an_estimate_within_its_own_uncertainty_is_the_same_number() -> None:
    near = replace(identified_axis(), drag_n_s_per_m=known(350.0, 8.0))
    assert messages(with_axis(near)) == []


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ((310.0, 335.0), []),
        ((300.0, 340.0), []),
        ((310.0, 345.0), ["B_p [N·s/m] is 310 to 345, certified for [300, 340]"]),
        ((290.0, 335.0), ["B_p [N·s/m] is 290 to 335, certified for [300, 340]"]),
        (None, ["B_p [N·s/m] is not identified"]),
    ],
)
def test_what_is_known_as_an_interval_only_lies_inside_with_both_ends(
    ends: tuple[float, float] | None, expected: list[str]
) -> None:
    """As `optimize` certifies it: a drag too small to have a value is its interval."""
    controller = small_controller()
    domain = replace(controller.certificate.domain["x"], uncertain={"drag_n_s_per_m": (300.0, 340.0)})
    certificate = replace(controller.certificate, domain={"x": domain})
    axis = replace(identified_axis(), drag_n_s_per_m=replace(absent(), ci95=ends))
    check, _ = check_domain(replace(controller, certificate=certificate), with_axis(axis))
    assert ([] if check.passed else check.message.split("; ")) == expected


def test_another_payload_and_another_axis_are_reported() -> None:
    plant = identified_plant()
    heavy = replace(plant, payload=replace(plant.payload, mass_kg=known(20.0, 0.1)))
    assert messages(heavy) == ["payload mass [kg] is 20, certified for [16, 16]"]
    assert messages(replace(plant, axes={"y": identified_axis()})) == ["the plant does not hold this axis"]


def test_another_robot_and_another_coupling_are_reported() -> None:
    axis = identified_axis()
    slow = replace(axis, robot=replace(axis.robot, delay_s=known(4e-3, 1e-5)))
    assert messages(with_axis(slow)) == ["T_d [ms] is 4, certified for 2.4"]
    soft = replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=known(2e5, 500.0)))
    assert messages(with_axis(soft)) == ["K_s [N/mm] is 200, certified for 300"]


@pytest.mark.parametrize(
    ("certified", "ranges", "found", "message"),
    [
        (
            WrenchFilter(),
            {},
            {"corner_hz": 50.0},
            "the wrench is filtered at 50 Hz, certified for a wrench without a filter",
        ),
        (WrenchFilter(time_constant_s=TAU), {}, {"corner_hz": 50.0}, ""),
        (
            WrenchFilter(time_constant_s=TAU),
            {},
            {"corner_hz": 40.0},
            "corner of the wrench's filter [Hz] is 40, certified",
        ),
        (WrenchFilter(time_constant_s=TAU), {"wrench_time_constant_s": (3e-3, 4e-3)}, {"corner_hz": 40.0}, ""),
        (
            WrenchFilter(time_constant_s=TAU),
            {"wrench_time_constant_s": (3e-3, 3.5e-3)},
            {"corner_hz": 40.0},
            "corner of the wrench's filter [Hz] is 40, certified for [45.4728, 53.0516]",
        ),
        (WrenchFilter(), {}, {"delay_s": 2e-3}, "wrench delay [s] is 0.002, certified for 0"),
        (WrenchFilter(delay_s=2e-3), {"wrench_delay_s": (1e-3, 3e-3)}, {"delay_s": 2.5e-3}, ""),
    ],
)
def test_a_wrench_that_is_later_than_the_certified_one_is_reported(
    certified: WrenchFilter, ranges: dict[str, tuple[float, float]], found: dict[str, float], message: str
) -> None:
    controller, identified = small_controller(), identified_plant()
    domain = controller.certificate.domain["x"]
    domain = replace(domain, wrench_filter=certified, uncertain={**(domain.uncertain or {}), **ranges} or None)
    controller = replace(controller, certificate=replace(controller.certificate, domain={"x": domain}))
    estimate = WrenchFilterEstimate(**{name: known(value) for name, value in found.items()})
    identified = replace(identified, sensor=replace(identified.sensor, wrench_filter=estimate))
    check, *_ = check_domain(controller, identified)
    assert check.passed == (message == "")
    assert message in check.message


def compensated(controller: Controller, identified: Identified) -> Check:
    *_, check = check_domain(controller, identified)
    assert check.name == "gravity compensation"
    return check


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass_kg": 16.2}, "payload mass [kg] is 16.2 in the file, identified as 16"),
        ({"com_m": (5.0, 5.0, 5.0)}, "centre of mass [mm] is 5000, 5000, 5000 in the file, identified as 10, -20, 150"),
        (
            {"force_bias_n": (400.0, -0.25, 3.0)},
            "force bias [N] is 400, -0.25, 3 in the file, identified as 1.5, -0.25, 3",
        ),
        (
            {"torque_bias_n_m": (0.1, 9.0, -0.1)},
            "torque bias [N·m] is 0.1, 9, -0.1 in the file, identified as 0.1, 0.2",
        ),
    ],
)
def test_a_compensation_that_was_not_identified_is_reported(change: dict[str, Any], message: str) -> None:
    controller = small_controller()
    assert compensated(controller, identified_plant()).passed
    check = compensated(replace(controller, payload=replace(controller.payload, **change)), identified_plant())
    assert not check.passed
    assert check.message.startswith(message)
    assert ";" not in check.message


@pytest.mark.parametrize(("off", "passed"), [(2.9, True), (3.1, False)])
def test_the_identified_mass_may_lie_outside_as_far_as_it_is_uncertain(off: float, passed: bool) -> None:
    plant = identified_plant()
    near = replace(plant, payload=replace(plant.payload, mass_kg=known(16.0 + 0.02 * off, 0.02)))
    assert (messages(near) == []) is passed
