"""Exact slopes against central differences of the compiled evaluation, which shares no code with them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.gradients import (
    admittance_gradient,
    decay_gradient,
    delay_gradient,
    gain_gradient,
    modulus_gradient,
    passivity_gradient,
    peak_gradient,
    phase_gradient,
)
from problems.design.requirements import smallest_admittance
from problems.design.stable_design import Gradient
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_sampled_plant
from problems.stability.margins import Margins, find_margins
from problems.stability.passivity import passive_below_hz

H = 8e-4
NAMES = ("mass_kg", "damping_n_s_per_m", "lead_s", "feedback_damping_s", "velocity_filter_rad_per_s")
CONTROLLERS = (
    AdmittanceController(mass_kg=10.0, damping_n_s_per_m=2600.0, lead_s=0.02, feedback_damping_s=0.01),
    AdmittanceController(mass_kg=40.0, damping_n_s_per_m=3000.0, lead_s=0.0, feedback_damping_s=0.004),
    AdmittanceController(
        mass_kg=15.0, damping_n_s_per_m=2500.0, lead_s=0.01, feedback_damping_s=0.02, compensation_mass_kg=4.0
    ),
)


def sampled(stiffness: float, delay_s: float = 2.7e-3, order: int = 1) -> SampledPlant:
    robot = (
        RobotModel(numerator=np.array([20.0]), denominator=np.array([1.0, 20.0]), delay_s=delay_s)
        if order == 1
        else RobotModel(numerator=np.array([3600.0]), denominator=np.array([1.0, 108.0, 3600.0]), delay_s=delay_s)
    )
    plant = Plant(
        robot=robot,
        coupling=Coupling(stiffness_n_per_m=3.1e5, damping_n_s_per_m=150.0),
        payload=PayloadDynamics(mass_kg=16.2, drag_n_s_per_m=330.0),
        environment=Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=40.0),
    )
    return build_sampled_plant(plant, H)


def differences(value: Callable[[AdmittanceController], float], controller: AdmittanceController) -> list[float]:
    """Central differences by each parameter in NAMES."""
    found = []
    for name in NAMES:
        here = getattr(controller, name)
        step = 1e-5 * max(here, 1e-2)
        if here == 0.0:
            found.append((value(replace(controller, **{name: step})) - value(controller)) / step)
            continue
        up, down = (value(replace(controller, **{name: here + sign * step})) for sign in (1.0, -1.0))
        found.append((up - down) / (2.0 * step))
    return found


def assert_agree(
    slope: Gradient, value: Callable[[AdmittanceController], float], controller: AdmittanceController
) -> None:
    """The value to 1e-6, the slopes beside the largest of them, each by the size of its parameter."""
    assert slope.value == pytest.approx(value(controller), rel=1e-6)
    sizes = np.array([max(getattr(controller, name), 1e-2) for name in NAMES])
    expected = np.array(differences(value, controller)) * sizes
    assert slope.by_controller[: len(NAMES)] * sizes == pytest.approx(expected, abs=2e-4 * np.max(np.abs(expected)))


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize(("stiffness", "order"), [(3e4, 1), (1.2e5, 1), (1.2e5, 2), (0.0, 1)])
@pytest.mark.parametrize(
    ("slope_of", "margin_of"),
    [
        (modulus_gradient, lambda m: m.modulus),
        (gain_gradient, lambda m: m.gain_db),
        (phase_gradient, lambda m: m.phase_deg),
        (delay_gradient, lambda m: m.delay_s),
        (decay_gradient, lambda m: -np.log(m.spectral_radius) / H),
    ],
)
def test_margins(
    controller: AdmittanceController,
    stiffness: float,
    order: int,
    slope_of: Callable[[SampledPlant, AdmittanceController], Gradient | None],
    margin_of: Callable[[Margins], float],
) -> None:
    plant = sampled(stiffness, order=order)
    slope = slope_of(plant, controller)
    margins = find_margins(plant, controller)
    if slope is None:
        assert not np.isfinite(margin_of(margins))
        return
    assert_agree(slope, lambda c: margin_of(find_margins(plant, c)), controller)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_known_frequency_saves_the_search(controller: AdmittanceController) -> None:
    plant = sampled(1.2e5)
    hint = 2.0 * np.pi * find_margins(plant, controller).modulus_hz
    known, searched = modulus_gradient(plant, controller, hint), modulus_gradient(plant, controller)
    assert known.value == pytest.approx(searched.value, rel=1e-9)
    assert known.by_controller == pytest.approx(searched.by_controller, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("band_hz", [(0.1, 5.0), (2.0, 2.0)])
def test_admittance(controller: AdmittanceController, band_hz: tuple[float, float]) -> None:
    free = sampled(0.0)
    assert_agree(
        admittance_gradient(free, controller, band_hz), lambda c: smallest_admittance(free, c, band_hz), controller
    )


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("stiffness", [3e4, 3e5])
@pytest.mark.parametrize("approach", [Approach(force_n=30.0), Approach(speed_m_s=0.02)])
def test_peaks(controller: AdmittanceController, stiffness: float, approach: Approach) -> None:
    pair = build_sampled_contact(sampled(stiffness))
    run = simulate_contact(pair, controller, approach)
    at_sensor = peak_gradient(pair.contact, controller, approach, run.time_of_sensor_peak_s, "sensor")
    assert_agree(at_sensor, lambda c: simulate_contact(pair, c, approach).peak_sensor_force_n, controller)
    inside = peak_gradient(pair.contact, controller, approach, run.time_of_peak_s, "contact")
    assert inside.value == pytest.approx(run.peak_contact_force_n, rel=2e-3)
    sizes = np.array([max(getattr(controller, name), 1e-2) for name in NAMES])
    expected = sizes * differences(lambda c: simulate_contact(pair, c, approach).peak_contact_force_n, controller)
    assert inside.by_controller[: len(NAMES)] * sizes == pytest.approx(expected, abs=0.02 * np.max(np.abs(expected)))


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("order", [1, 2])
def test_the_end_of_the_passive_band(controller: AdmittanceController, order: int) -> None:
    plant = sampled(1.1e5, order=order)
    slope = passivity_gradient(plant, controller, passive_below_hz(plant, controller))
    assert_agree(slope, lambda law: passive_below_hz(plant, law), controller)
