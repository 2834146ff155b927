"""The command's noise and the passive band by playing impulses: another road to the numbers of `problems`."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.validation.requirements import passive_band_hz, speed_rms, worst_noise
from problems.design.problem import NoiseLimit
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant, WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import (
    SampledPlant,
    build_cut_loop,
    build_loop,
    build_sampled_plant,
    controller_matrix,
    position_input,
)
from problems.stability.noise import command_speed_gain
from problems.stability.noise import speed_rms as exact_speed_rms
from problems.stability.noise_spectrum import RelativeSpectrum
from problems.stability.passivity import prepare_port
from tests.autotune.tuning.cases import design_problem

H = 8e-4
LAWS = {
    "lead and feedback": AdmittanceController(
        mass_kg=5.0, damping_n_s_per_m=1190.0, lead_s=0.021, feedback_damping_s=7.6e-3
    ),
    "compensation": AdmittanceController(
        mass_kg=5.0,
        damping_n_s_per_m=1210.0,
        lead_s=0.03,
        feedback_damping_s=0.014,
        velocity_filter_rad_per_s=300.0,
        acceleration_filter_rad_per_s=60.0,
        compensation_mass_kg=5.0,
    ),
}
DELAYS = (0.0, 5e-4, H, 2.4e-3, 2.6e-3)


def plants(delay_s: float) -> tuple[Plant, ...]:
    """Return plants in contact and in free space behind a coupling with damping, all with this delay."""
    problem = design_problem()
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=delay_s)
    problem = replace(problem, plants=replace(problem.plants, nominal=replace(problem.plants.nominal, robot=robot)))
    touching = [problem.plant(scenario) for scenario in problem.scenarios(3, 2)]
    return (*touching, *(plant.in_contact_with(FREE_SPACE) for plant in touching[::3]))


def of_position_noise(sampled: SampledPlant, law: AdmittanceController) -> float:
    """Return the speed RMS per RMS of noise on the position that is read [1/s]."""
    return exact_speed_rms(build_loop(sampled, law), [(*position_input(sampled, law), 1.0)])


@pytest.mark.parametrize("law", list(LAWS.values()), ids=list(LAWS))
@pytest.mark.parametrize("delay", DELAYS)
def test_squares_of_an_impulse_response_add_up_to_the_variance(delay: float, law: AdmittanceController) -> None:
    set_ = plants(delay)
    found = speed_rms(set_, law, H)
    reported = [command_speed_gain(build_sampled_plant(plant, H), law) for plant in set_]
    # The response is followed until a thousandth is left, whose square is a millionth.
    assert found == pytest.approx(reported, rel=1e-6)
    on_position = [of_position_noise(build_sampled_plant(plant, H), law) for plant in set_]
    assert speed_rms(set_, law, H, on_position=True) == pytest.approx(on_position, rel=1e-6)
    for position in (None, 3e-6):
        asked = NoiseLimit(max_speed_rms_m_s=1.0, force_noise_rms_n=0.2, position_noise_rms_m=position)
        both = [math.hypot(0.2 * a, (position or 0.0) * b) for a, b in zip(reported, on_position, strict=True)]
        assert worst_noise(asked, set_[:6], law, H) == pytest.approx(max(both), rel=1e-6)


@pytest.mark.parametrize("law", list(LAWS.values()), ids=list(LAWS))
def test_its_transform_weighed_by_a_spectrum_is_the_variance_under_that(law: AdmittanceController) -> None:
    spectrum = RelativeSpectrum(frequency_hz=(4.0, 40.0, 60.0, 300.0), relative_density=(5.0, 1.0, 20.0, 0.1))
    set_ = plants(DELAYS[0])
    exact = [command_speed_gain(build_sampled_plant(plant, H), law, spectrum) for plant in set_]
    # The exact form's own sum over frequencies is that near.
    assert speed_rms(set_, law, H, spectrum=spectrum) == pytest.approx(exact, rel=3e-4)
    asked = NoiseLimit(max_speed_rms_m_s=1.0, force_noise_rms_n=0.2, position_noise_rms_m=3e-6, noise_spectrum=spectrum)
    both = [
        math.hypot(0.2 * a, 3e-6 * of_position_noise(build_sampled_plant(plant, H), law))
        for a, plant in zip(exact, set_, strict=True)
    ]
    assert worst_noise(asked, set_[:6], law, H) == pytest.approx(max(both), rel=3e-4)


def test_noise_of_the_pose_is_that_of_a_loop_that_is_simulated_with_it() -> None:
    """Drawn noise on the position that the controller reads, and nothing else: the command's speed is measured."""
    law, plant = LAWS["lead and feedback"], plants(2.4e-3)[0]
    for each in (plant, plant.in_contact_with(FREE_SPACE)):
        sampled = build_sampled_plant(each, H)
        cut = build_cut_loop(sampled, law)
        # A hundred loops side by side, of 2000 ticks until they have forgotten their start and 4000 that count.
        m, n, noise = cut.matrix, cut.state_count, 1e-6 * np.random.default_rng(3).standard_normal((6_000, 100))
        matrix, r = controller_matrix(law, H), len(controller_matrix(law, H)) - 1
        states, commands = np.zeros((n, 100)), np.empty_like(noise)
        for k, off in enumerate(noise):
            # Behind a delay F hangs on the states alone; the command follows from it and from what is read.
            force = m[cut.force, :n] @ states
            commands[k] = m[cut.command, :n] @ states + m[cut.command, n] * force + matrix[r, r + 1] * off
            states = m[:n, :n] @ states + np.outer(m[:n, n], force) + np.outer(m[:n, n + 1], commands[k])
            states[n - r :] += np.outer(matrix[:r, r + 1], off)
        measured = float(np.std(np.diff(commands[2_000:], axis=0))) / H
        assert measured == pytest.approx(1e-6 * of_position_noise(sampled, law), rel=0.01)


def test_a_law_that_does_not_read_the_position_makes_nothing_of_its_noise() -> None:
    law = AdmittanceController(mass_kg=5.0, damping_n_s_per_m=3000.0, lead_s=0.02)
    assert of_position_noise(build_sampled_plant(plants(2.4e-3)[0], H), law) == 0.0


def test_plants_with_different_delays_are_played_together() -> None:
    law = LAWS["compensation"]
    mixed = [plants(delay)[0] for delay in DELAYS]
    assert speed_rms(mixed, law, H) == pytest.approx([speed_rms([plant], law, H)[0] for plant in mixed], rel=1e-9)


@pytest.mark.parametrize("law", list(LAWS.values()), ids=list(LAWS))
@pytest.mark.parametrize("delay", DELAYS)
def test_the_passive_band_ends_where_the_real_part_of_the_response_turns(
    delay: float, law: AdmittanceController
) -> None:
    plant = plants(delay)[0]
    fails = prepare_port(build_sampled_plant(plant, H)).fails_above_hz(law)
    assert fails is not None
    # Frequencies of the transform are 0.005 Hz apart.
    assert passive_band_hz(plant.port, law, H, 600.0) == pytest.approx(fails, abs=0.011)
    assert passive_band_hz(plant.port, law, H, 0.5 * fails) == 0.5 * fails


@pytest.mark.parametrize("wrench", [WrenchFilter.from_corner(50.0), WrenchFilter(time_constant_s=1e-3, delay_s=1.1e-3)])
def test_behind_a_filter_noise_and_passive_band_are_those_of_the_exact_loop(wrench: WrenchFilter) -> None:
    law = replace(LAWS["lead and feedback"], feedback_damping_s=0.0, damping_n_s_per_m=3000.0)
    set_ = [replace(plant, wrench_filter=wrench) for plant in plants(2.4e-3)]
    reported = [command_speed_gain(build_sampled_plant(plant, H), law) for plant in set_]
    assert speed_rms(set_, law, H) == pytest.approx(reported, rel=1e-6)
    fails = prepare_port(build_sampled_plant(set_[0], H)).fails_above_hz(law)
    assert fails is not None
    # Frequencies of the transform are 0.005 Hz apart.
    assert passive_band_hz(set_[0].port, law, H, 600.0) == pytest.approx(fails, abs=0.011)


def test_a_port_that_does_not_come_to_rest_is_passive_nowhere() -> None:
    """Far too much compensation behind a fast filter drives itself."""
    law = replace(LAWS["compensation"], compensation_mass_kg=500.0, acceleration_filter_rad_per_s=2000.0)
    plant = plants(2.4e-3)[0]
    assert prepare_port(build_sampled_plant(plant, H)).fails_above_hz(law) == 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        assert passive_band_hz(plant.port, law, H, 10.0) == 0.0
