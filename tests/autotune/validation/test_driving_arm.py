"""A payload that an arm drives to a surface and on: two methods, a closed form, drawn arms, and what a file claims."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.cli._proved import led_lines
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.validation.driving_arm import driven_plants, led_claim, replay_driven
from autotune.validation.validate import validate_controller
from problems.contact.transient import build_sampled_contact
from problems.design.driving_hand import REACTION_S, driven_peak, driving_hands, largest_driven_peak
from problems.design.hand import HandImpedance
from problems.design.requirements import hand_approach, led_contacts, led_peaks
from problems.errors import ParameterError
from problems.model.plant import Environment, Plant
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import fast_optimized
from tests.autotune.validation.test_moving_surface import LAW, H, plants

HAND = HandImpedance()


def touching(stiffness: float, mass: float = 16.0) -> Plant:
    return plants((0.0, 0.0)).at(mass, stiffness)


@pytest.mark.parametrize("arm", driving_hands(HAND), ids=str)
@pytest.mark.parametrize("stiffness", [2e4, 1.6e5, 5e5])
def test_two_methods_find_the_same_peak(stiffness: float, arm: HandImpedance) -> None:
    """Runge–Kutta steps of order 4, and exact substeps under the paper's difference equation."""
    one, other = driven_peak(touching(stiffness), LAW, arm, H), replay_driven(touching(stiffness), LAW, arm, H, 0.2)
    assert one == pytest.approx(other, rel=5e-3)


def test_long_driving_ends_at_both_springs_in_series() -> None:
    """Per speed, K_e K_h/(K_e + K_h) times the way of the aim: its lead (B_a + B_p)/K_h and the time it goes on."""
    arm, stiffness, time = HandImpedance(mass_kg=0.0, damping_n_s_per_m=0.0), 8e3, 1.5
    lead = (LAW.damping_n_s_per_m + 330.0) / arm.stiffness_n_per_m
    rest = stiffness * arm.stiffness_n_per_m / (stiffness + arm.stiffness_n_per_m) * (lead + time)
    found = driven_peak(touching(stiffness), LAW, arm, H, time)
    assert rest * (1.0 - 1e-3) <= found < 1.05 * rest


def test_an_arm_that_drives_on_is_harder_than_one_whose_aim_rests() -> None:
    for stiffness in (2e4, 1.6e5, 5e5):
        plant = touching(stiffness)
        resting, driving = (
            max(driven_peak(plant, LAW, arm, H, time) for arm in driving_hands(HAND)) for time in (0.0, REACTION_S)
        )
        pair = build_sampled_contact(build_sampled_plant(plant, H))
        held = [
            led_peaks(each, LAW, [hand_approach(0.1, "holds")])[0] / 0.1 for each in led_contacts(pair, "holds", 5.0)
        ]
        # The bound of a hand that holds is one of arms whose aim rests, and of no others.
        assert resting < 1.002 * max(held) < driving


def test_no_drawn_arm_is_harder_than_the_ends() -> None:
    ends = [touching(stiffness, mass) for stiffness in (2e4, 5e5) for mass in (15.0, 18.0)]
    largest, rng = largest_driven_peak(ends, LAW, HAND, H), np.random.default_rng(7)
    for _ in range(40):
        plant = touching(float(np.exp(rng.uniform(np.log(2e4), np.log(5e5)))), float(rng.uniform(15.0, 18.0)))
        arm = HandImpedance(
            mass_kg=float(rng.uniform(0.0, 5.0)),
            damping_n_s_per_m=float(rng.uniform(0.0, 50.0)),
            stiffness_n_per_m=float(rng.uniform(300.0, 3000.0)),
        )
        assert driven_peak(plant, LAW, arm, H) < largest


def stated(**changes: Any) -> Controller:
    controller = fast_optimized().controller
    predicted = controller.predicted["x"]
    assert predicted.peak_per_speed is not None
    led = replace(predicted.peak_per_speed, **changes)
    return replace(controller, predicted={"x": replace(predicted, peak_per_speed=led)})


def test_the_file_says_what_is_sampled_and_validate_confirms_it(tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", stated())
    read = read_controller(tmp_path / "controller.yaml").controller
    led = read.predicted["x"].peak_per_speed
    assert led is not None
    assert led.drives is not None
    assert led.holds is not None
    assert led.drives > led.pushes_on
    claim = led_claim("x", led)
    assert claim in read.certificate.sampled
    assert claim is not None
    assert "no proof" in claim.method
    assert f"{led.drives:.4g} where a hand of up to 5 kg" in claim.claim
    assert any("driven on for 0.2 s" in line and line.endswith("simulated") for line in led_lines(read))
    checks = {each.name: each for each in validate_controller(read).checks}
    assert checks["led by hand"].passed
    assert "where an arm drives on" in checks["led by hand"].message


def test_a_peak_that_is_too_good_is_found_out() -> None:
    led = stated().predicted["x"].peak_per_speed
    assert led is not None
    assert led.drives is not None
    checks = [each for each in validate_controller(stated(drives=0.95 * led.drives)).checks if not each.passed]
    assert {each.name for each in checks} == {"led by hand", "statements"}


def test_an_older_file_claims_nothing_of_an_arm() -> None:
    led = stated().predicted["x"].peak_per_speed
    assert led is not None
    assert led_claim("x", replace(led, drives=None, drives_for_s=None, arm=None)) is None
    with pytest.raises(ParameterError, match="only then"):
        replace(led, arm=None)


def test_a_surface_with_a_mass_is_refused() -> None:
    moving = touching(1e5).in_contact_with(Environment(stiffness_n_per_m=1e5, mass_kg=1.0))
    with pytest.raises(ParameterError, match="environment"):
        replay_driven(moving, LAW, HAND, H, 0.2)
    domain = stated().certificate.domain["x"]
    listed = stated().predicted["x"].scenarios[0].scenario()
    assert len(driven_plants(domain, listed)) >= 2
