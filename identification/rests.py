"""What poses at rest show by themselves: payload and sensor, from averaged rows and from logs without positions."""

from collections.abc import Sequence

import numpy as np

from .conventions.search import rank_conventions
from .payload.gravity import GravityFit, identify_gravity
from .payload.gravity_verdicts import WITHOUT_TORQUE, com_estimate, gravity_findings, mass_estimate
from .payload.mounting import identify_mounting
from .payload.static_poses import rows_as_poses
from .result import Estimate, Finding, Identified, PayloadEstimate, SensorEstimate, Status, VectorEstimate
from .signals.recording import Frames, Recording
from .verdicts import missing, unidentifiable, unidentifiable_vector, vector

_METHOD = "least squares over static poses"


def identify_from_rows(recording: Recording, frames: Frames | None = None) -> Identified:
    """Identify mass, centre of mass and bias from a table whose rows are the means of rests.

    Of forces alone mass and force bias.

    Parameters
    ----------
    recording
        Force, torque (may be missing) and orientation, one row per pose (`rows_are_poses`), without positions and
        times.
    frames
        What the cell declares; other signs, frames and orders are tried as for a log, and taken where only they fit.

    Returns
    -------
    Identified
        Payload and sensor; the noise of a sample, robot, coupling and surfaces are not in such a table.

    Raises
    ------
    EstimateError
        The poses do not separate mass from bias, or several conventions fit alike.
    LogError
        The tables of wrench and pose differ in length.

    """
    poses = rows_as_poses(recording)
    ranking = rank_conventions(poses, frames)
    chosen = ranking.chosen()
    if chosen is not None and chosen.changes:
        poses = rows_as_poses(chosen.apply(recording, frames))
    gravity = identify_gravity(poses)
    mounting = identify_mounting(poses, gravity, None if frames is None else frames.R_FS)
    averaged = unidentifiable(note="each row is a mean, so it shows nothing of single samples")
    sensor = SensorEstimate(
        force_bias_n=vector(gravity.force_bias_S_n, gravity.force_bias_std_n, method=_METHOD),
        torque_bias_n_m=torque_bias(gravity),
        force_noise_rms_n=averaged,
        gravity_residual_rms_n=residual_estimate(gravity),
        deadband_n=averaged,
        mounting_rad=mounting.mounting_S_rad,
        base_tilt_rad=mounting.base_tilt_B_rad,
    )
    timeless = unidentifiable(note="a table of poses has no time")
    return at_rest_only(gravity, sensor, timeless, (*ranking.findings(), *mounting.findings))


def at_rest_only(
    gravity: GravityFit, sensor: SensorEstimate, sample_time_s: Estimate, findings: Sequence[Finding]
) -> Identified:
    """Return payload and sensor with the finding, of severity `error`, that nothing else is in such a log."""
    return Identified(
        sample_time_s=sample_time_s,
        payload=PayloadEstimate(mass_kg=mass_estimate(gravity), com_m=com_estimate(gravity)),
        axes={},
        sensor=sensor,
        findings=(
            *findings,
            *gravity_findings(gravity),
            missing(
                "payload-only",
                "Orientation and wrench at rest show payload and sensor only; robot, coupling and surfaces are not in "
                "this log.",
                "Take them with --allow-partial, and record pose, command and wrench of a sweep and of contacts.",
            ),
        ),
    )


def torque_bias(gravity: GravityFit) -> VectorEstimate:
    """Return the sensor's torque bias, unidentifiable without torques."""
    if not gravity.has_torque:
        return unidentifiable_vector(WITHOUT_TORQUE)
    return vector(gravity.torque_bias_S_n_m, gravity.torque_bias_std_n_m, method=_METHOD)


def residual_estimate(gravity: GravityFit) -> Estimate:
    """Return what the weight leaves of the force at rest, with its deviation."""
    return Estimate(
        value=gravity.residual_rms_n,
        std=gravity.residual_rms_n / np.sqrt(6.0 * max(gravity.pose_count, 1)),
        status=Status.IDENTIFIED,
        method=_METHOD,
    )
