"""Controller files for the tests of other controllers: real predictions of plain laws, made without a search."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from autotune.export import fzi_cartesian, ros2_control
from autotune.export.fzi_cartesian import FziOptions
from autotune.export.ros2_control import Ros2Options
from autotune.export.third_party import Translation
from autotune.export.urscript import STEP_TIME_S
from autotune.formats.certificate_record import AxisDomain, Requirement
from autotune.formats.controller import ControllerFile, read_controller, write_controller
from autotune.formats.controller_record import (
    AxisGains,
    AxisPrediction,
    CollisionSettings,
    Controller,
    FreeSpaceAdmittance,
    ScenarioPrediction,
)
from autotune.formats.limits import CollisionResponse
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from autotune.validation.law import AxisTask
from problems.contact.nonlinearities import DeadbandType
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.requirements import AdmittanceTarget
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_sampled_plant
from tests.autotune.formats.samples import DOMAIN, MARGINS, make_controller

PERIOD_S = 8e-4
CELL = replace(
    DOMAIN,
    environment_stiffness_n_per_m=(8e4, 1.2e5),
    payload_mass_kg=(16.0, 16.0),
    coupling_damping_n_s_per_m=150.0,
    drag_n_s_per_m=330.0,
)
LEAD = AxisGains(
    mass=6.0,
    damping=1300.0,
    lead_s=0.0209,
    feedback_damping_s=0.005,
    deadband=5.0,
    deadband_type=DeadbandType.THRESHOLD,
)
"""Gains whose translation, without lead and feedback damping, misses a modulus margin of 0.5."""
PLAIN = replace(LEAD, mass=8.0, damping=3000.0, lead_s=0.0, feedback_damping_s=0.0, deadband=0.0)
"""Gains that need nothing that another controller lacks."""


def requirements(admittance: float = 5.5e-4, **further: Requirement) -> dict[str, Requirement]:
    band = AdmittanceTarget(min_m_s_per_n=admittance, band_hz=(1.0, 2.0))
    margins: dict[str, Requirement] = {"modulus_margin": 0.5, "gain_margin_db": 6.0, "phase_margin_deg": 30.0}
    return {**margins, "delay_margin_s": 1e-3, "free_space_admittance": band, **further}


def peer_controller(
    axes: Mapping[str, AxisGains],
    asked: Mapping[str, Requirement] | None = None,
    *,
    domain: AxisDomain = CELL,
    **parts: Any,
) -> Controller:
    """Return a validated controller with the peaks that its own law has in this cell."""
    whole = make_controller(tuple(axes))
    known = dict(asked if asked is not None else requirements())
    turns = any(name.startswith("r") for name in axes)
    return replace(
        whole,
        axes=axes,
        predicted={name: predicted(gains, domain) for name, gains in axes.items()},
        collision=CollisionSettings(response=CollisionResponse.NONE, threshold_n=None),
        certificate=replace(
            whole.certificate,
            domain=dict.fromkeys(axes, domain),
            margins=dict.fromkeys(axes, MARGINS),
            requirements=known,
            rotational_requirements=known if turns else None,
        ),
        **parts,
    )


EASY = requirements(2.5e-4)
"""Requirements that a plain law meets."""
SLOW = requirements(4e-5)
"""Requirements that a law meets which damps the measured motion, and needs far more mass for that."""


def at_500_hz(controller: Controller) -> Controller:
    """Return the same at the period of a script of Universal Robots; its predictions stay those of its own period."""
    certificate = replace(controller.certificate, sample_time_s=STEP_TIME_S)
    return replace(controller, sample_time_s=STEP_TIME_S, certificate=certificate)


def translated(source: ControllerFile, options: Ros2Options | FziOptions) -> Translation:
    if isinstance(options, Ros2Options):
        return ros2_control.translate(source, options)
    return fzi_cartesian.translate(source, options)


def exported(folder: Path, controller: Controller, options: Ros2Options | FziOptions) -> Translation:
    """Write, read and translate a file."""
    write_controller(folder / "controller.yaml", controller)
    return translated(read_controller(folder / "controller.yaml"), options)


def load_as_ros(text: str) -> dict[str, Any]:
    """Read a text as the readers of ROS do: plain YAML 1.1, in which 1e-05 is text and 5 an integer."""
    reader = YAML(typ="safe", pure=True)
    reader.version = (1, 1)
    found: dict[str, Any] = reader.load(text)
    return found


def parameters(made: Translation) -> dict[str, Any]:
    """Return the parameters of the one controller in the text."""
    tree = load_as_ros(made.text)
    (name,) = set(tree) - {"controller_manager"}
    found: dict[str, Any] = tree[name]["ros__parameters"]
    return found


def predicted(gains: AxisGains, domain: AxisDomain) -> AxisPrediction:
    law = AdmittanceController(
        mass_kg=gains.mass,
        damping_n_s_per_m=gains.damping,
        lead_s=gains.lead_s,
        feedback_damping_s=gains.feedback_damping_s,
    )
    stiffest = Scenario(
        environment_stiffness_n_per_m=domain.environment_stiffness_n_per_m[1],
        payload_mass_kg=domain.payload_mass_kg[0],
    )
    pair = build_sampled_contact(build_sampled_plant(stiffest.plant(domain.plants.nominal), PERIOD_S))
    seen = simulate_contact(pair, law, Approach(force_n=domain.approach_force_n))
    return AxisPrediction(
        scenarios=(
            ScenarioPrediction(
                name=scenario_text(stiffest, axis_units("x")),
                environment_stiffness_n_per_m=stiffest.environment_stiffness_n_per_m,
                payload_mass_kg=stiffest.payload_mass_kg,
                peak_sensor_force_n=seen.peak_sensor_force_n,
                peak_contact_force_n=seen.peak_contact_force_n,
                time_of_peak_s=seen.time_of_peak_s,
            ),
        ),
        free_space_admittance=FreeSpaceAdmittance(
            band_hz=(1.0, 2.0), min_m_s_per_n=1e-4, hand_force_n_per_m_s=gains.damping + domain.drag_n_s_per_m
        ),
    )


def task_of(controller: Controller, axis: str = "x") -> AxisTask:
    return AxisTask(
        axis=axis,
        domain=controller.certificate.domain[axis],
        asked=controller.certificate.requirements,
        margins=controller.certificate.margins[axis],
        predicted=controller.predicted[axis],
        sample_time_s=controller.sample_time_s,
    )


MDK_CASES = {
    "urscript": at_500_hz(peer_controller({"x": PLAIN}, EASY)),
    "lbr_fri_ros2": peer_controller({"x": PLAIN}, SLOW),
    "crisp": peer_controller({"x": PLAIN}, EASY),
    "cartesian_vic": peer_controller({"x": PLAIN}, SLOW),
}
"""A controller for each target whose law is mass, damping and spring."""
