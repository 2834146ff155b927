"""Estimates of the force/torque sensor: bias, noise, deadband, mounting, and what averaged rests show of it."""

from collections.abc import Sequence

import numpy as np

from .conventions.choice import ReadLog
from .conventions.search import rank_conventions
from .payload.gravity import GravityFit, identify_gravity
from .payload.gravity_verdicts import METHOD, WITHOUT_TORQUE, com_estimate, gravity_findings, mass_estimate
from .payload.mounting import identify_mounting
from .payload.static_poses import rows_as_poses
from .result import Estimate, Finding, Identified, PayloadEstimate, SensorEstimate, Status, VectorEstimate
from .signals.recording import Frames, PoseSignal, Recording
from .signals.sensor_noise import SensorNoise, identify_sensor_noise
from .verdicts import missing, unidentifiable, unidentifiable_vector, vector

_FEWEST_DIFFERENCES = 100


def describe_sensor(
    read: ReadLog, gravity: GravityFit, frames: Frames | None
) -> tuple[SensorEstimate, tuple[Finding, ...]]:
    """Return bias, noise, deadband and mounting of the sensor, and findings about them."""
    mounting = identify_mounting(read.poses, gravity, None if frames is None else frames.R_FS)
    noise = identify_sensor_noise(read.log, read.motion.still, read.recording.wrench)
    rms = gravity.noise_rms_n
    within = Estimate(value=rms, std=0.02 * rms, status=Status.IDENTIFIED, method="spread within rests")
    sensor = SensorEstimate(
        force_bias_n=vector(gravity.force_bias_S_n, gravity.force_bias_std_n, method=METHOD),
        torque_bias_n_m=torque_bias(gravity),
        force_noise_rms_n=within if noise is None else noise.force_rms(),
        gravity_residual_rms_n=residual_estimate(gravity),
        deadband_n=_deadband(read, noise),
        torque_noise_rms_n_m=None
        if noise is None or not gravity.has_torque
        else vector(noise.rms[3:], noise.rms_std[3:], method="spread within rests, drift taken out"),
        noise=None if noise is None else noise.spectrum(),
        mounting_rad=mounting.mounting_S_rad,
        base_tilt_rad=mounting.base_tilt_B_rad,
        position_noise_rms_m=position_noise(read.recording.pose, _rests_ns(read)),
    )
    return sensor, (*mounting.findings, *(() if noise is None else noise.findings))


def _deadband(read: ReadLog, noise: SensorNoise | None) -> Estimate:
    """Return the largest deadband of the three forces, 0 where there is none."""
    if noise is None:
        zeros = float(np.mean(read.recording.wrench.force_n == 0.0))
        return unidentifiable(note=f"no rest is long enough; {100.0 * zeros:.1f} % of the forces are exactly 0")
    found = [each for each in noise.deadband[:3] if each is not None]
    method = "exact zeros in the logged force"
    if not found:
        return Estimate(value=0.0, std=0.0, status=Status.IDENTIFIED, method=method)
    widest = max(found, key=lambda each: np.inf if each.width is None else each.width)
    note = f"{widest.kind}, {100.0 * widest.zero_share:.1f} % of the forces on its axis are exactly 0"
    if widest.width is None:
        return unidentifiable(method=method, note=f"{note}; its width cannot be determined")
    return Estimate(value=widest.width, std=0.2 * widest.width, status=Status.WEAK, method=method, note=note)


def position_noise(pose: PoseSignal, rests_ns: Sequence[tuple[int, int]]) -> Estimate | None:
    """Return the noise of one sample and coordinate of the pose as logged [m], None where rests show none.

    Second differences of white noise have the variance 6 σ²; they leave the drift and the slow sway of a rest out.
    """
    squares, count = 0.0, 0
    for start, stop in rests_ns:
        first, last = np.searchsorted(pose.stamp_ns, [start, stop])
        piece = pose.position_m[first:last][:, np.isfinite(pose.position_m[first:last]).all(axis=0)]
        second = np.diff(piece, n=2, axis=0)
        squares, count = squares + float(np.sum(second**2)), count + second.size
    if count < _FEWEST_DIFFERENCES or squares == 0.0:
        return None
    rms = float(np.sqrt(squares / (6.0 * count)))
    # Neighbouring second differences repeat each other: for white noise 35/18 of them show what one would.
    std = rms * float(np.sqrt(35.0 / 18.0 / (2.0 * count)))
    return Estimate(value=rms, std=std, status=Status.IDENTIFIED, method="second differences within rests")


def _rests_ns(read: ReadLog) -> list[tuple[int, int]]:
    start, period = read.log.start_ns, 1e9 * read.log.period_s
    return [(start + round(rest.start * period), start + round(rest.stop * period)) for rest in read.motion.still]


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
        force_bias_n=vector(gravity.force_bias_S_n, gravity.force_bias_std_n, method=METHOD),
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
    return vector(gravity.torque_bias_S_n_m, gravity.torque_bias_std_n_m, method=METHOD)


def residual_estimate(gravity: GravityFit) -> Estimate:
    """Return what the weight leaves of the force at rest, with its deviation."""
    return Estimate(
        value=gravity.residual_rms_n,
        std=gravity.residual_rms_n / np.sqrt(6.0 * max(gravity.pose_count, 1)),
        status=Status.IDENTIFIED,
        method=METHOD,
    )
