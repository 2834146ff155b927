"""Read `controller.yaml` on the cell's computer and refuse it unless it is whole, validated and for this cell."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from autotune.errors import CertificateError, UsageError
from autotune.formats.canonical import checksum as checksum_of
from autotune.formats.canonical import short
from autotune.formats.limits import (
    MOST_REST_SAMPLES,
    AxisLimits,
    Biquad,
    CollisionResponse,
    Limits,
    VariableDampingSettings,
)
from autotune.formats.schema import check_format, explain, load_schema, refuse_first
from autotune.formats.units import AXES
from autotune.formats.yaml12 import Document, load_document
from problems.errors import ParameterError

from .controller import RuntimeController
from .law import STANDARD_GRAVITY_M_S2, AxisLaw, Payload
from .loop import corner_plants, is_stable
from .schema_check import breaches

_CHECKSUM = re.compile(r"[0-9a-fA-F]{64}")

# The limits of a file without `limits`. Sensor: this times what weight, bias and the worst predicted contact put on it.
_RANGE = 2.0
# The reduced speed of ISO 10218-1, at which a robot is led by hand; about a turning axis at a lever of 0.2 m.
REDUCED_SPEED_M_S, LEVER_M = 0.25, 0.2
_ABOVE_APPROACH = 2.0
# The command may gain this share of its largest speed in one period.
_SHARE_PER_PERIOD = 0.5
_LEAST_POSE_SPEED_M_S, _LEAST_POSE_SPEED_RAD_S, _ABOVE_COMMAND = 1.0, 5.0, 4.0
_STALE_WRENCH_S, _STALE_POSE_S = 0.05, 0.2
_REST_S = 0.1
# A centre of mass that is so far off, and the residual where no deadband says what is little.
_COM_OFF_M, _REST_FORCE_N, _LEAST_REST_TORQUE_N_M = 0.02, 1.0, 1.0


def load_controller(
    path: Path | str,
    *,
    sample_time_s: float,
    payload_mass_kg: float,
    payload_inertia_kg_m2: Mapping[str, float] | None = None,
    payload: Payload | None = None,
    expected_checksum: str | None = None,
    public_key: Path | str | None = None,
) -> RuntimeController:
    """Return the controller of a file, verified and found right for this cell.

    A file of an earlier release, without `limits`, gets those of `default_limits`.

    `sample_time_s` is the period of the cell's loop, `payload_mass_kg` what it carries; `payload_inertia_kg_m2` by
    axis what it weighs about each of rx, ry, rz that is tuned. `payload` replaces the file's gravity compensation when
    the cell carries another payload of the certified range. `expected_checksum` (64 digits) is what was agreed on.
    `public_key` is a file with the Ed25519 key (PEM or OpenSSH) that must have signed the file, as `autotune validate
    --sign` does; only this needs the package cryptography. Without both, whoever can write the file moves the robot.

    Raises CertificateError: the file is altered, truncated, not validated, not the expected one, not signed by the key,
    false, or not for this cell. UsageError: it or the key cannot be read, the expected checksum is none, a number of
    the cell is none, or an inertia is about an axis that does not turn.
    """
    if expected_checksum is not None:
        check_digits(expected_checksum)
    _check_type("path", path, Path, str)
    _check_type("public_key", public_key, Path, str, type(None))
    _check_type("payload", payload, Payload, type(None))
    document = _read_document(path)
    if public_key is not None:
        verify_signature(path, public_key, document.sha256)
    controller = _verified_law(document, payload)
    if expected_checksum is not None:
        check_expected(expected_checksum, controller.checksum, path)
    if payload is not None:
        controller = replace(controller, payload=payload)
    try:
        controller.check_cell(
            sample_time_s=sample_time_s, payload_mass_kg=payload_mass_kg, payload_inertia_kg_m2=payload_inertia_kg_m2
        )
    except CertificateError as reason:
        raise CertificateError(f"{path}: {reason}") from reason
    return controller


def read_law(path: Path | str, payload: Payload | None = None) -> RuntimeController:
    """Return the controller of a file that is whole, unaltered and validated, whatever cell it is for.

    `payload` is taken where the file's must be set in the cell. Raises as `load_controller`.
    """
    document = _read_document(path)
    law = _verified_law(document, payload)
    return law if payload is None or not document.tree["payload"].get("set_in_cell") else replace(law, payload=payload)


def verify_signature(path: Path | str, public_key: Path | str, digest: str) -> str:
    """Return the fingerprint of the key that signed the bytes of `path`, those of sha256 `digest`.

    Raises CertificateError without such a signature beside the file, UsageError for a key that cannot be read and where
    the package cryptography is missing.
    """
    # The only use of it here, and it comes with a library that a cell need not have.
    from autotune.formats.signature import check_signature, read_public_key  # noqa: PLC0415

    return check_signature(Path(path), read_public_key(Path(public_key)), digest)


def check_digits(expected: object) -> None:
    """Raise UsageError unless `expected` is a whole checksum: the first 8 digits are found again within minutes."""
    if not isinstance(expected, str) or not _CHECKSUM.fullmatch(expected):
        raise UsageError(
            f"The expected checksum must be all 64 hexadecimal digits, found {str(expected)[:80]!r}; the first 8 are "
            "for people to compare, and a file with the same 8 is made within minutes."
        )


def _check_type(name: str, value: object, *kinds: type) -> None:
    if not isinstance(value, kinds):
        must = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
        raise UsageError(f"{name} must be of type {must}, found {type(value).__name__}.")


def check_expected(expected: str, checksum: str, path: Path | str) -> None:
    """Raise CertificateError unless `checksum` is the agreed one of 64 digits, UsageError if that is none."""
    check_digits(expected)
    if checksum != expected.lower():
        found = f"its checksum is {checksum}, not {expected.lower()}"
        raise CertificateError(f"{path}: it is another file: {found}.")


def _read_document(path: Path | str) -> Document:
    return load_document(path, error=CertificateError, exact=True)


def _verified_law(document: Document, payload: Payload | None = None) -> RuntimeController:
    check_format(document, "controller")
    refuse_first(document, map(explain, breaches(document.tree, load_schema("controller"))))
    stated, found = document.tree["checksum"], checksum_of(document.tree)
    if stated != found:
        reason = f"the checksum says {short(stated)}, but the content has {short(found)}; the file is altered."
        document.refuse(("checksum",), reason)
    _check_claims(document)
    if payload is None and document.tree["payload"].get("set_in_cell", False):
        reason = (
            "it was made without the payload's centre of mass and the sensor's bias, so it cannot compensate gravity; "
            "give the payload that the cell carries in payload."
        )
        document.refuse(("payload", "set_in_cell"), reason)
    try:
        law = _law(document.tree)
    except ParameterError as reason:
        raise CertificateError(f"{document.path}: {reason}") from reason
    for axis in law.axes:
        _check_stable(document, axis)
    return law


def _check_stable(document: Document, axis: AxisLaw) -> None:
    """Refuse gains to which the certificate cannot belong: a checksum can be made anew, a stable loop cannot."""
    variable = axis.variable_damping
    dampings = (axis.damping,) if variable is None else (variable.lowest, variable.highest)
    laws = [replace(axis, damping=damping, variable_damping=None) for damping in dampings]
    for plant in corner_plants(document.tree["certificate"]["domain"][axis.name], turns=axis.turns):
        if not all(is_stable(law, plant) for law in laws):
            reason = (
                f"with these gains the loop of axis {axis.name} is unstable on a plant for which it is certified "
                f"(payload {plant.mass:g}, stiffness {plant.stiffness:g}, in SI); the file is false."
            )
            document.refuse(("axes", axis.name), reason)


def _check_claims(document: Document) -> None:
    """Refuse what the schema cannot: not validated, or a certificate that does not speak of this controller."""
    tree, certificate = document.tree, document.tree["certificate"]
    if tree["status"] != "validated":
        document.refuse(("status",), "the controller is not validated; run optimize until its certificate holds.")
    if not certificate["proved"]:
        document.refuse(("certificate", "proved"), "a validated controller proves something; this one proves nothing.")
    if certificate["sample_time_s"] != tree["sample_time_s"]:
        period = f"{certificate['sample_time_s']:g} s, but the controller runs every {tree['sample_time_s']:g} s."
        document.refuse(("certificate", "sample_time_s"), f"the certificate is for {period}")
    if "limits" in tree and set(tree["axes"]) - set(tree["limits"]["axes"]):
        document.refuse(("limits", "axes"), f"limits.axes must hold the tuned axes, {', '.join(tree['axes'])}.")
    for axis in tree["axes"]:
        if axis not in certificate["domain"]:
            document.refuse(("certificate", "domain"), f"the certificate does not speak of axis {axis}.")
        if axis.startswith("r") and tree["compensation_mass_kg"] != 0.0:
            reason = f"it is a mass and says nothing of axis {axis}, which turns; it must be 0."
            document.refuse(("compensation_mass_kg",), reason)


def _law(tree: Mapping[str, Any]) -> RuntimeController:
    payload, collision = tree["payload"], tree["collision"]
    response = CollisionResponse(collision["response"])
    return RuntimeController(
        checksum=tree["checksum"],
        sample_time_s=float(tree["sample_time_s"]),
        axes=tuple(_axis(tree, name) for name in AXES if name in tree["axes"]),
        response=response,
        threshold_n=float("inf") if response is CollisionResponse.NONE else float(collision["threshold_n"]),
        payload=Payload(
            mass_kg=payload["mass_kg"],
            com_S_m=payload["com_m"],
            force_bias_S_n=payload["force_bias_n"],
            torque_bias_S_n_m=payload["torque_bias_n_m"],
        ),
        limits=_limits(tree["limits"]) if "limits" in tree else default_limits(tree),
    )


def _limits(tree: Mapping[str, Any]) -> Limits:
    axes = {name: AxisLimits(**each) for name, each in tree["axes"].items()}
    # The runtime has no use for the noise that they were chosen for.
    return Limits(**{**tree, "axes": axes, "noise": None})


def _axis(tree: Mapping[str, Any], name: str) -> AxisLaw:
    gains, domain = tree["axes"][name], tree["certificate"]["domain"][name]
    variable = tree.get("variable_damping", {}).get(name)
    low, high = domain["payload_inertia_kg_m2" if name.startswith("r") else "payload_mass_kg"]
    return AxisLaw(
        name=name,
        sample_time_s=float(tree["sample_time_s"]),
        mass=float(gains["mass"]),
        damping=float(gains["damping"]),
        lead_s=float(gains["lead_s"]),
        feedback_damping_s=float(gains["feedback_damping_s"]),
        velocity_filter_rad_per_s=float(tree["filters"]["velocity_rad_per_s"]),
        acceleration_filter_rad_per_s=float(tree["filters"]["acceleration_rad_per_s"]),
        compensation_mass_kg=float(tree["compensation_mass_kg"]),
        deadband=float(gains["deadband"]),
        is_subtractive=gains["deadband_type"] == "subtractive",
        payload_range=(float(low), float(high)),
        variable_damping=None if variable is None else VariableDampingSettings(**variable),
        biquad=None if gains.get("biquad") is None else Biquad(**gains["biquad"]),
    )


def default_limits(tree: Mapping[str, Any]) -> Limits:
    """Return the limits of a file that has none, from its payload, approach and predicted peaks.

    They are wider than those that `optimize` chooses.
    """
    payload = tree["payload"]
    weight = payload["mass_kg"] * STANDARD_GRAVITY_M_S2
    lever = math.hypot(*payload["com_m"])
    force = weight + math.hypot(*payload["force_bias_n"]) + _worst_peak(tree, turning=False)
    torque = weight * lever + math.hypot(*payload["torque_bias_n_m"]) + _worst_peak(tree, turning=True)
    # A contact at a lever turns the sensor, whether that is tuned or not.
    torque += LEVER_M * (force - weight)
    axes = {name: _default_axis(tree, name) for name in tree["axes"]}
    straight = [axes[name].speed for name in axes if not name.startswith("r")]
    turning = [axes[name].speed for name in axes if name.startswith("r")]
    return Limits(
        force_n=max(_RANGE * force, _REST_FORCE_N),
        torque_n_m=max(_RANGE * torque, _LEAST_REST_TORQUE_N_M),
        axes=axes,
        pose_speed_m_s=max([_LEAST_POSE_SPEED_M_S, *(_ABOVE_COMMAND * each for each in straight)]),
        pose_speed_rad_s=max([_LEAST_POSE_SPEED_RAD_S, *(_ABOVE_COMMAND * each for each in turning)]),
        stale_wrench_s=_STALE_WRENCH_S,
        stale_pose_s=_STALE_POSE_S,
        rest_samples=max(1, min(MOST_REST_SAMPLES, round(_REST_S / tree["sample_time_s"]))),
        rest_force_n=_smallest_deadband(tree, turning=False) or _REST_FORCE_N,
        rest_torque_n_m=_smallest_deadband(tree, turning=True) or max(_LEAST_REST_TORQUE_N_M, _COM_OFF_M * weight),
    )


def _default_axis(tree: Mapping[str, Any], name: str) -> AxisLimits:
    """Return the limits of the command of one axis."""
    turns = name.startswith("r")
    domain = tree["certificate"]["domain"][name]
    said = domain.get("approach_speed_rad_s" if turns else "approach_speed_m_s")
    force = domain.get("approach_torque_n_m" if turns else "approach_force_n")
    approach = said or (force or 0.0) / tree["axes"][name]["damping"]
    speed = max(REDUCED_SPEED_M_S / LEVER_M if turns else REDUCED_SPEED_M_S, _ABOVE_APPROACH * approach)
    return AxisLimits(speed=speed, acceleration=_SHARE_PER_PERIOD * speed / tree["sample_time_s"])


def _worst_peak(tree: Mapping[str, Any], *, turning: bool) -> float:
    key = "peak_sensor_torque_n_m" if turning else "peak_sensor_force_n"
    peaks: list[float] = [
        each[key]
        for name, predicted in tree["predicted"].items()
        if name.startswith("r") == turning
        for each in predicted["scenarios"]
    ]
    return max([0.0, *peaks])


def _smallest_deadband(tree: Mapping[str, Any], *, turning: bool) -> float:
    widths: list[float] = [gains["deadband"] for name, gains in tree["axes"].items() if name.startswith("r") == turning]
    return min(widths, default=0.0)
