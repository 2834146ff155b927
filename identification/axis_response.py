"""Measured frequency responses of one axis, out of the spans that its joint fit used, and how the model differs."""

from collections.abc import Iterator

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.model.axis_kind import LEVER_M
from problems.model.plant import FREE_SPACE, Coupling, PayloadDynamics, Plant
from problems.model.response import plant_response
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant

from .axes.straight import AXIS_NAMES
from .joint_fit.data import JointData
from .joint_fit.result import JointFit
from .measured_response import FrequencyResponse, MeasuredResponse
from .result import RESPONSE_DIFFERS, Finding
from .robot.coupling import felt_impedance
from .robot.frequency_response import MotionRecord, measure_responses
from .signals.recording import Recording

# Of the rate of wrench and pose. Without a command the pose is the input, and smooth only far below its rate.
_HIGHEST_SHARE, _HIGHEST_SMOOTH_SHARE = 0.4, 0.12
# Sixty circles of 95 % hold all at once where they are this much wider: sqrt(ln(60/0.05)/ln(1/0.05)).
_ALL_AT_ONCE = 1.54
_SMALL_SHARE = 0.03


def measure_axis(
    name: str, data: JointData, fit: JointFit, pose_rate_hz: float, recording: Recording
) -> FrequencyResponse | None:
    """Return the frequency responses that free motion shows without a model; `fit` is that of the signals of `data`.

    A command that the gains make of the force is no reference: what is measured would be the gains. Neither is one that
    was not held from sample to sample.
    """
    command = None if recording.command is None or data.is_smooth else data.command
    used = [slice(span.start, span.start + len(span.measured)) for span in fit.spans if span.surface is None]
    records = [
        MotionRecord(
            position=data.position_m[part],
            force=data.force_n[part],
            command=None if command is None else command.command_m[part],
        )
        for part in used
    ]
    share = _HIGHEST_SMOOTH_SHARE if command is None else _HIGHEST_SHARE
    highest_hz = share * min(1.0 / data.period_s, pose_rate_hz)
    found = measure_responses(records, data.period_s, highest_hz)
    if found is None:
        return None
    lever = 1.0 if name in AXIS_NAMES else LEVER_M
    return found.on_time(
        command_s=0.0 if command is None else command.shift_s,
        force_s=fit.latency.applied_s - fit.latency.advanced_s,
        time_constant_s=fit.latency.seconds if fit.latency.is_filter else 0.0,
        force_scale=lever**2,
    )


def response_findings(
    name: str, coupling: FloatArray, robot: RobotModel | None, measured: FrequencyResponse, period_s: float
) -> Iterator[Finding]:
    """Yield where model and measured response of a straight axis differ by more than the circles and 3 %.

    `coupling` is K_s, B_s, B_p, M_p (4,). One frequency alone may be chance, or a resonance that polynomials round off:
    a neighbour differs too. About an axis the payload's weight takes part, which the model of the path does not hold.
    """
    if name not in AXIS_NAMES:
        return
    for what, response, is_force in (
        ("from command to pose", measured.command_to_pose, False),
        ("from pose to force", measured.pose_to_force, True),
    ):
        if response is None or (robot is None and not is_force):
            continue
        model = _model_response(response, coupling, robot, period_s, is_force=is_force)
        share = (np.abs(response.values - model) - _ALL_AT_ONCE * response.radius_95) / np.abs(model)
        beside = share > _SMALL_SHARE
        runs = beside & (np.append(beside[1:], False) | np.append(False, beside[:-1]))
        if not np.any(runs):
            continue
        worst = int(np.argmax(np.where(runs, share, 0.0)))
        apart = abs(response.values[worst] / model[worst] - 1.0)
        circle = response.radius_95[worst] / abs(model[worst])
        at = response.frequency_hz[runs]
        yield Finding(
            code=RESPONSE_DIFFERS,
            severity="warning",
            axis=name,
            message=f"Axis {name}: the measured frequency response {what} differs from the model by "
            f"{100.0 * apart:.3g} % at {response.frequency_hz[worst]:.3g} Hz, where it is known to "
            f"{100.0 * circle:.2g} % (95 %); beyond that and {100.0 * _SMALL_SHARE:g} % at {len(at)} of "
            f"{len(response.points)} frequencies, {at[0]:.3g} to {at[-1]:.3g} Hz.",
            advice="Friction, a second mode or a filter that the model does not hold do this: see the Bode pictures of "
            "the report. optimize asks for the modulus margin beside that error (`multiplicative_error`), and "
            "`validate --identified` computes |1 + L| on the measured response.",
        )


def _model_response(
    response: MeasuredResponse, coupling: FloatArray, robot: RobotModel | None, period_s: float, *, is_force: bool
) -> ComplexArray:
    """Return the sampled model's response (k,), the hold taken out; without a robot that of a smooth pose."""
    omega = 2.0 * np.pi * response.frequency_hz
    if robot is None:
        return felt_impedance(coupling, np.asarray(1j * omega, dtype=np.complex128))
    stiffness, damping, drag, mass = np.maximum(coupling, 0.0).tolist()
    plant = Plant(
        robot=robot,
        coupling=Coupling(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=drag),
        environment=FREE_SPACE,
    )
    found = plant_response(build_sampled_plant(plant, period_s), omega)
    hold = -np.expm1(-1j * omega * period_s) / (1j * omega * period_s)
    return np.asarray(found.force / found.position if is_force else found.position / hold)
