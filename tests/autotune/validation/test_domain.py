"""Whether an identified plant lies in the domain that a certificate speaks of."""

from dataclasses import replace

import pytest

from autotune.validation.domain import check_domain
from identification.result import AxisEstimate, Identified
from tests.autotune.tuning.cases import absent, identified_axis, identified_plant, known, small_controller, with_axis


def messages(identified: Identified) -> list[str]:
    (check,) = check_domain(small_controller(), identified)
    assert check.axis == "x"
    assert check.passed == (check.message == "lies inside the certified domain")
    return [] if check.passed else check.message.split("; ")


def test_the_plant_that_was_tuned_for_is_inside() -> None:
    assert messages(identified_plant()) == []


def _surface(axis: AxisEstimate, stiffness: float) -> AxisEstimate:
    return replace(axis, environments=(replace(axis.environments[0], stiffness_n_per_m=known(stiffness, 10.0)),))


@pytest.mark.parametrize(
    ("axis", "told"),
    [
        (_surface(identified_axis(), 2e5), "K_e of x1 [N/m] is 200000, certified for [100000, 120000]"),
        (_surface(identified_axis(), 9e4), "K_e of x1 [N/m] is 90000, certified for [100000, 120000]"),
        (replace(identified_axis(), drag_n_s_per_m=known(350.0, 1.0)), "B_p [N·s/m] is 350, certified for 330"),
        (replace(identified_axis(), drag_n_s_per_m=absent()), "B_p [N·s/m] is not identified"),
    ],
)
def test_a_plant_outside_is_told_with_both_numbers(axis: AxisEstimate, told: str) -> None:
    assert messages(with_axis(axis)) == [told]


def test_an_estimate_within_its_own_uncertainty_is_the_same_number() -> None:
    near = replace(identified_axis(), drag_n_s_per_m=known(350.0, 8.0))
    assert messages(with_axis(near)) == []


def test_another_payload_and_another_axis_are_told() -> None:
    plant = identified_plant()
    heavy = replace(plant, payload=replace(plant.payload, mass_kg=known(20.0, 0.1)))
    assert messages(heavy) == ["payload mass [kg] is 20, certified for [16, 16]"]
    assert messages(replace(plant, axes={"y": identified_axis()})) == ["the identified file does not hold this axis"]


def test_another_robot_and_another_coupling_are_told() -> None:
    axis = identified_axis()
    slow = replace(axis, robot=replace(axis.robot, delay_s=known(4e-3, 1e-5)))
    assert messages(with_axis(slow)) == ["T_d [s] is 0.004, certified for 0.0024"]
    soft = replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=known(2e5, 500.0)))
    assert messages(with_axis(soft)) == ["K_s [N/m] is 200000, certified for 300000"]
