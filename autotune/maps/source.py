"""Read the source of a map: plant parameters of one axis, and a controller if the file holds one."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from autotune.errors import UsageError
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller import read_controller
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.kinds import unknown_file
from autotune.formats.plant_file import read_plant
from autotune.formats.schema import head_of
from autotune.formats.units import ROTATIONAL_AXES
from autotune.formats.yaml12 import kind_of_file
from autotune.prediction.as_run_by import own_law_notes
from autotune.tuning.wrench import build_wrench
from identification.errors import EstimateError
from identification.result import AxisEstimate, Estimate, Identified, Status
from problems.contact.transient import Approach
from problems.frozen import freeze
from problems.maps.parameters import PLANT_NAMES
from problems.model.axis_kind import LEVER_M
from problems.model.controller import AdmittanceController
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import RobotModel

_DEFAULT_APPROACH_N = 30.0


@dataclass(frozen=True, kw_only=True)
class MapSource:
    """One axis of a file: `known` by the names of `problems.maps.parameters`, `missing` with the reason.

    `checksums` holds those of the controller files that were read, by path, `notes` what must be known of them.

    The environment is without damping and mass unless a certificate says otherwise, as when a controller is tuned.
    """

    path: Path
    axis: str
    robot: RobotModel
    sample_time_s: float
    known: Mapping[str, float]
    missing: Mapping[str, str]
    controller: AdmittanceController | None
    approach: Approach
    wrench_filter: WrenchFilter = NO_FILTER
    checksums: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "known", "missing", "checksums")

    @property
    def is_rotational(self) -> bool:
        """Whether units are those of a rotation."""
        return self.axis in ROTATIONAL_AXES


def read_source(path: Path, *, axis: str | None, controller: Path | None) -> MapSource:
    """Read an identified plant or a controller with the plant of its certificate.

    A certificate speaks of ranges: the map takes the geometric middle of the stiffness, and the payload that the
    runtime compensates (the middle of the range where that lies outside or turns). Of several identified surfaces it
    takes the stiffest. `controller` names another file whose controller is used.

    Raises UsageError: not such a file, or not such an axis. CertificateError: the controller file is altered or not
    validated. EstimateError: the robot or the sample time is not identified.
    """
    kind = kind_of_file(path)
    if kind == "controller":
        read = read_controller(path)
        source = replace(_certified(path, read.controller, axis), checksums={str(path): read.checksum})
        source = replace(source, notes=tuple(own_law_notes(read.controller)))
    elif kind in {"identified", "plant"}:
        source = _identified(path, read_plant(path).result, axis)
    else:
        raise unknown_file(
            path,
            f"{path} is neither a plant nor a controller; give what identify or optimize wrote, or a plant.yaml.",
            without_format=f" A plant.yaml begins with {head_of('plant')}.",
        )
    if controller is None:
        return source
    read = read_controller(controller)
    other, checksums = read.controller, {**source.checksums, str(controller): read.checksum}
    law, domain = _law(controller, other, source.axis), other.certificate.domain.get(source.axis)
    approach = source.approach if domain is None else _approach(domain)
    notes = tuple(own_law_notes(other))
    return replace(source, controller=law, approach=approach, checksums=checksums, notes=notes)


def _axis(path: Path, axes: Mapping[str, object], wanted: str | None) -> str:
    names = ", ".join(axes) or "none"
    if wanted is None and len(axes) == 1:
        return next(iter(axes))
    if wanted is None:
        raise UsageError(f"{path} holds the axes {names}; say which one with --axis.")
    if wanted not in axes:
        raise UsageError(f"{path} does not hold axis {wanted}; it holds {names}.")
    return wanted


def _law(path: Path, controller: Controller, axis: str) -> AdmittanceController:
    name = _axis(path, controller.axes, axis)
    return replace(
        admittance_controller(controller, name),
        acceleration_filter_rad_per_s=controller.filters.acceleration_rad_per_s,
        compensation_mass_kg=controller.compensation_mass_kg,
    )


def _certified(path: Path, controller: Controller, wanted: str | None) -> MapSource:
    axis = _axis(path, controller.axes, wanted)
    domain = controller.certificate.domain[axis]
    nominal = domain.plants.nominal
    (low, high), (light, heavy) = domain.environment_stiffness_n_per_m, domain.payload_mass_kg
    carried = controller.payload.mass_kg
    is_carried = axis not in ROTATIONAL_AXES and light <= carried <= heavy
    known = {name: PARAMETERS[each].value(nominal) for name, each in PLANT_NAMES.items()} | {
        "payload_mass": carried if is_carried else 0.5 * (light + heavy),
        "environment_stiffness": low if low == high else math.sqrt(low * high) or 0.5 * high,
    }
    return MapSource(
        path=path,
        axis=axis,
        robot=nominal.robot,
        sample_time_s=controller.sample_time_s,
        known=known,
        missing={},
        controller=_law(path, controller, axis),
        approach=_approach(domain),
        wrench_filter=nominal.wrench_filter,
    )


def _approach(domain: AxisDomain) -> Approach:
    if domain.approach_speed_m_s is not None:
        return Approach(speed_m_s=domain.approach_speed_m_s)
    return Approach(force_n=domain.approach_force_n or _DEFAULT_APPROACH_N)


def _identified(path: Path, found: Identified, wanted: str | None) -> MapSource:
    name = _axis(path, found.axes, wanted)
    axis = found.axes[name]
    estimates = {
        "drag": axis.drag_n_s_per_m,
        "coupling_stiffness": axis.coupling.stiffness_n_per_m,
        "coupling_damping": axis.coupling.damping_n_s_per_m,
    }
    known, missing = {}, {}
    moving = axis.mass_kg if name in ROTATIONAL_AXES else found.payload.mass_kg
    if moving is None:
        missing["payload_mass"] = "the log does not identify the payload's inertia about this axis"
    else:
        estimates["payload_mass"] = moving
    for key, estimate in estimates.items():
        value = _number(estimate)
        if value is None:
            missing[key] = estimate.note or "not identified from the log"
        else:
            # An estimate near zero may come out below it.
            known[key] = max(value, 0.0)
    stiffest = max((_number(each.stiffness_n_per_m) or 0.0 for each in axis.environments), default=0.0)
    if stiffest > 0.0:
        known["environment_stiffness"] = stiffest
    else:
        missing["environment_stiffness"] = "the log holds no contact that identifies it"
    sample_time_s = _number(found.sample_time_s)
    if sample_time_s is None:
        raise EstimateError(f"{path}: sample_time_s is not identified, and nothing can be computed without it.")
    return MapSource(
        path=path,
        axis=name,
        robot=_robot(path, name, axis),
        sample_time_s=sample_time_s,
        known=known,
        missing=missing,
        controller=None,
        approach=Approach(force_n=_DEFAULT_APPROACH_N * (LEVER_M if name in ROTATIONAL_AXES else 1.0)),
        wrench_filter=build_wrench(found.sensor.wrench_filter, {}).nominal,
    )


def _robot(path: Path, name: str, axis: AxisEstimate) -> RobotModel:
    numerator, denominator, delay_s = (
        axis.robot.numerator.value,
        axis.robot.denominator.value,
        _number(axis.robot.delay_s),
    )
    if numerator is None or denominator is None or delay_s is None:
        raise EstimateError(f"{path}: the robot's r(s) and delay on axis {name} are not identified.")
    return RobotModel(numerator=np.array(numerator), denominator=np.array(denominator), delay_s=delay_s)


def _number(estimate: Estimate) -> float | None:
    return None if estimate.status is Status.UNIDENTIFIABLE else estimate.value
