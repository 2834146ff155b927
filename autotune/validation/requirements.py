"""Margins, requirements, admittance, noise and passivity: what was asked of a controller, found again."""

import math
from collections.abc import Iterator

import numpy as np

from autotune.certificate.family import UncertainPlant
from autotune.formats.controller_record import AdmittanceRequirement, AxisMargins, Controller
from autotune.formats.units import axis_units
from problems.design.requirements import NoiseLimit, PassivityTarget
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant

from .admittance import sampled_admittance
from .certified_requirements import asked_of, soft_told
from .command import passive_band_hz, worst_speed_rms
from .margins import SweptMargins
from .report import Check
from .validation_samples import OtherPlants

_MASS_POINTS, _NOISE_STIFFNESS_POINTS = 3, 9
# Two roads to the same margin differ by their frequency grids (measured: 1e-4); what differs by more is another margin.
_SAME_MARGIN = 0.01
_MARGIN_OF = {
    "modulus_margin": "modulus",
    "gain_margin_db": "gain_db",
    "phase_margin_deg": "phase_deg",
    "delay_margin_s": "delay_s",
}


def check_margins(name: str, claimed: AxisMargins, swept: SweptMargins) -> Check:
    """Hold the margins that a file claims against those of a sweep: less may be claimed, more may not."""
    wrong = []
    for key in ("modulus", "gain_db", "phase_deg", "delay_s"):
        said = getattr(claimed, key)
        found = swept.values[key]
        said = math.inf if said is None else float(said)
        if said > found * (1.0 + _SAME_MARGIN) and not (math.isinf(said) and math.isinf(found)):
            wrong.append(f"{key} is claimed as {said:.6g}, found {found:.6g}")
    told = ", ".join(f"{key} {swept.values[key]:.4g}" for key in ("modulus", "gain_db", "phase_deg", "delay_s"))
    return Check(
        axis=name,
        name="margins",
        passed=not wrong and swept.largest_radius < 1.0,
        message="; ".join(wrong) or f"confirmed on {swept.plants} plants: {told}",
    )


def check_requirements(controller: Controller, name: str, swept: SweptMargins) -> Check:
    """Check that the margins and the decay of a sweep meet what was asked of the axis."""
    missed, known = [], 0
    for key, required in asked_of(controller, name).items():
        if isinstance(required, AdmittanceRequirement | NoiseLimit | PassivityTarget):
            continue
        if key in _MARGIN_OF:
            reached = swept.values[_MARGIN_OF[key]]
        elif key == "decay_rate_per_s":
            reached = -math.log(swept.largest_radius) / controller.sample_time_s
        elif key == "max_peak_force_n":
            continue
        else:
            missed.append(f"{key} cannot be verified by this release")
            continue
        known += 1
        if reached < float(required) * (1.0 - _SAME_MARGIN * 0.1):
            missed.append(f"{key} must be at least {required:.6g}, found {reached:.6g}")
    return Check(
        axis=name,
        name="requirements",
        passed=not missed,
        message="; ".join(missed) or f"all {known} margins that were asked are met{soft_told(controller, name)}",
    )


def check_admittance(
    controller: Controller, name: str, plants: UncertainPlant, others: OtherPlants, law: AdmittanceController
) -> Check:
    """Check the steady hand force and |G| in free space against what is claimed and what was asked."""
    predicted = controller.predicted[name].free_space_admittance
    found = sampled_admittance(plants.port, law, controller.sample_time_s, predicted.band_hz)
    wrong = []
    units = axis_units(name)
    hand = law.damping_n_s_per_m + plants.nominal.payload.drag_n_s_per_m
    if abs(predicted.hand_force_n_per_m_s / hand - 1.0) > _SAME_MARGIN:
        said = f"{predicted.hand_force_n_per_m_s:.6g} {units.hand}"
        wrong.append(f"the hand {units.force_name} is claimed as {said}, found {hand:.6g}")
    if abs(found / predicted.min_m_s_per_n - 1.0) > _SAME_MARGIN:
        wrong.append(f"|G| is claimed as {predicted.min_m_s_per_n:.6g} {units.admittance}, found {found:.6g}")
    for required in asked_of(controller, name).values():
        if isinstance(required, AdmittanceRequirement):
            # G does not hang on the payload; among the robots the slowest and the fastest stand for all.
            reached = min(
                sampled_admittance(port, law, controller.sample_time_s, required.band_hz)
                for port in (plants.port, *others.extreme_ports())
            )
            if reached < required.min_m_s_per_n * (1.0 - 0.1 * _SAME_MARGIN):
                wrong.append(
                    f"|G| must be at least {required.min_m_s_per_n:.6g} {units.admittance}, found {reached:.6g}"
                )
    band = f"{predicted.band_hz[0]:g} to {predicted.band_hz[1]:g} Hz"
    return Check(
        axis=name,
        name="free-space admittance",
        passed=not wrong,
        message="; ".join(wrong) or f"at least {found:.4g} {units.admittance} from {band}",
    )


def check_command(
    controller: Controller, name: str, plants: UncertainPlant, others: OtherPlants, law: AdmittanceController
) -> Iterator[Check]:
    """Check the command's noise and the passive band, where they were asked."""
    h, units = controller.sample_time_s, axis_units(name)
    for required in asked_of(controller, name).values():
        if isinstance(required, NoiseLimit):
            found = (required.force_noise_rms_n or 0.0) * worst_speed_rms(_noise_plants(plants, others), law, h)
            met = found <= required.max_speed_rms_m_s * (1.0 + 0.1 * _SAME_MARGIN)
            told = f"{found:.4g} {units.speed} under {units.force_name} noise of {required.force_noise_rms_n:g}"
            limit = f"at most {required.max_speed_rms_m_s:.4g} {units.speed}"
            message = f"the command's speed RMS is {told} {units.force}, {limit}"
            yield Check(
                axis=name, name="command noise", passed=met, message=message if met else f"{message} is claimed"
            )
        if isinstance(required, PassivityTarget):
            ports = (plants.port, *others.extreme_ports())
            reached = min(passive_band_hz(port, law, h, required.passive_below_hz) for port in ports)
            met = reached >= required.passive_below_hz * (1.0 - 0.1 * _SAME_MARGIN)
            message = f"the port is passive up to {reached:.4g} Hz"
            must = f"{message}, claimed up to {required.passive_below_hz:.4g} Hz"
            yield Check(axis=name, name="passivity", passed=met, message=message if met else must)


def _noise_plants(plants: UncertainPlant, others: OtherPlants) -> tuple[Plant, ...]:
    """Return a grid of the set, ends included, and the further plants, all in contact."""
    masses = np.linspace(*plants.payload_mass_kg, _MASS_POINTS)
    low, high = plants.environment_stiffness_n_per_m
    stiffnesses = np.clip(np.geomspace(low, high, _NOISE_STIFFNESS_POINTS), low, high)
    grid = dict.fromkeys((float(m), float(k)) for m in masses for k in stiffnesses)
    return tuple(dict.fromkeys((*(plants.at(m, k) for m, k in grid), *others.plants)))
