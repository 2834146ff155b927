"""Build one design problem per axis from identified parameters and what is asked."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from autotune.errors import UsageError
from autotune.formats.problem import Interval, ProblemSpec, RotationalSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_key
from autotune.plugins import build_requirements
from identification.errors import EstimateError
from identification.result import (
    AxisEstimate,
    Estimate,
    Identified,
    Status,
    VectorEstimate,
)
from problems.contact.transient import Approach
from problems.design.problem import DEFAULT_BOUNDS, DesignProblem, Requirements
from problems.design.uncertainty import ALWAYS_UNCERTAIN, PlantSet
from problems.model.axis_kind import LEVER_M
from problems.model.plant import WrenchFilter
from problems.model.robot import RobotModel

from .defaults import follow_robot
from .noise_limit import with_noise
from .plausible import check_plausible, unexplained_contacts
from .uncertain import with_measured_error, with_uncertainty
from .wrench import LAG, LATE, build_wrench, check_wrench, without_position

# The default range of a parameter: what the log allows, and not less than a cell changes from day to day.
_STDS = 3.0
_LEAST_STIFFNESS_SHARE = 0.2
_LEAST_MASS_SHARE = 0.02
_SHOWN_DIGITS = 4
_DEFAULT_APPROACH_N = 30.0
_GO_WITH_THE_LEVER = ("mass", "damping")


def within_domain(spec: ProblemSpec, domain: Mapping[str, Interval]) -> ProblemSpec:
    """Return the problem with the set that the plant itself names, wherever `spec` says nothing of it."""
    if not domain:
        return spec
    stiffness = spec.environment_stiffness or domain.get("environment_stiffness_n_per_m")
    further = {name: each for name, each in domain.items() if name not in ALWAYS_UNCERTAIN}
    return replace(
        spec,
        # A stiffness that is still to be chosen has no range.
        environment_stiffness=stiffness if spec.compliance is None else None,
        payload_mass=spec.payload_mass or domain.get("payload_mass_kg"),
        uncertain={**further, **spec.uncertain},
    )


def build_problems(identified: Identified, spec: ProblemSpec) -> dict[str, DesignProblem]:
    """Return a design problem for every axis that the log identified (or for those that `spec` names).

    What `spec` says wins over the identified value with its uncertainty. The problem of a rotational axis is the same
    in rad, N·m and kg·m², with the axis's moment of inertia as its mass. Raises UsageError for an axis that is not
    there, for a compliance still to be chosen and for a payload of which nobody says the inertia, EstimateError for a
    parameter that is missing and was not given.
    """
    if spec.compliance is not None:
        raise UsageError(
            "free.environment_stiffness_n_per_m is chosen by optimize for one controller; elsewhere give a range as "
            "environment_stiffness_n_per_m in problem.yaml."
        )
    if spec.structure not in (None, "gains"):
        raise UsageError(
            f"structure: {spec.structure} is searched by optimize for one controller that runs autotune's own law; "
            "leave it out."
        )
    if spec.bumper is not None:
        raise UsageError(
            "payload.bumper is searched with by optimize for one controller that runs autotune's own law; leave it "
            "out, and hold the file against it with validate --bumper."
        )
    if not identified.axes:
        raise EstimateError("The plant holds no axis, so there is nothing to tune.")
    names = list(identified.axes) if spec.axes is None else list(spec.axes)
    unknown = [name for name in names if name not in identified.axes]
    if unknown:
        raise UsageError(f"Axis {unknown[0]} is not in the plant; it holds {', '.join(identified.axes)}.")
    _check_use(names, spec)
    _check_free(names, spec)
    approach = spec.approach or Approach(force_n=_DEFAULT_APPROACH_N)
    straight = replace(spec, approach=approach)
    turned = through_lever(spec, approach)
    # Forces and torques are of one sensor: what is said of its filter once is said of both.
    shared = {key: value for key, value in spec.uncertain.items() if key in {LAG, LATE}}
    turned = replace(turned, uncertain={**shared, **turned.uncertain})
    check_wrench(identified, spec.uncertain)
    check_plausible(identified, names, straight, turned)
    problems = {}
    for name in names:
        if name in ROTATIONAL_AXES:
            if turned.payload_mass is None:
                _check_same_payload(identified, name, straight.payload_mass)
            problems[name] = _build_problem(identified, name, turned)
        else:
            problems[name] = _build_problem(identified, name, straight)
    return with_measured_error(identified, problems)


def _check_use(names: list[str], spec: ProblemSpec) -> None:
    """Refuse ranges that no axis takes, unless axes were named: their author believes that they are certified."""
    turning, unnamed = ROTATIONAL_AXES.intersection(names), spec.axes is None
    if unnamed and not turning and spec.rotational != RotationalSpec():
        raise UsageError(f"problem.yaml has an entry rotational, and no rotational axis is tuned: {', '.join(names)}.")
    meant = spec.environment_stiffness if unnamed else spec.options.get("environment_stiffness")
    if len(turning) == len(names) and meant is not None:
        raise UsageError(
            f"A surface's stiffness in N/m says nothing of rotation, and only {', '.join(names)} is tuned; say "
            "rotational.environment_stiffness_n_m_per_rad in problem.yaml."
        )


def _check_free(names: list[str], spec: ProblemSpec) -> None:
    """Refuse variables that `controller.yaml` holds once where several axes, or one in other units, would choose."""
    if spec.free and len(names) > 1:
        raise UsageError(
            f"The axes share {', '.join(spec.free)} in controller.yaml, so it can be free for one axis at a time only; "
            f"name it in problem.yaml with axis (to be tuned: {', '.join(names)})."
        )
    if "compensation_mass_kg" in spec.free and ROTATIONAL_AXES.intersection(names):
        raise UsageError(f"compensation_mass_kg is a mass, and {names[0]} turns; leave it out of free.")


def _check_same_payload(identified: Identified, name: str, asked: Interval | None) -> None:
    """Refuse another payload than the identified one on a rotational axis: its moment of inertia is not known."""
    if asked is None:
        return
    low, high = _range(identified.payload.mass_kg, "payload.mass_kg", _LEAST_MASS_SHARE)
    if not low <= asked[0] <= asked[1] <= high:
        payload = f"{asked[0]:g} kg" if asked[0] == asked[1] else f"{asked[0]:g} to {asked[1]:g} kg"
        raise UsageError(
            f"A payload of {payload} is not that of the plant ({low:g} to {high:g} kg), and its "
            f"moment of inertia about {name} does not follow from its mass. Say rotational.payload_inertia_kg_m2 in "
            "problem.yaml, or name the translational axes there with axis."
        )


def runtime_mass_kg(identified: Identified, certified: Interval | None) -> float:
    """Return the mass that the runtime's gravity compensation takes: one that the certificate holds for.

    The identified mass where the range holds it; the end of the range that lies within its deviation, or nearest to the
    middle of a range that a person gave; else the one mass that was asked for. `certified` is None where only
    rotational axes are tuned, whose certificates speak of inertia. Raises UsageError for a range that leaves the
    identified mass out: nobody could say which weight to compensate.
    """
    mass = _value(identified.payload.mass_kg, "payload.mass_kg")
    if certified is None:
        return mass
    low, high = certified
    if low <= mass <= high:
        return mass
    nearest = min(max(mass, low), high)
    if low == high or is_identified_mass(identified, nearest) or is_mass_range(identified):
        return nearest
    raise UsageError(
        f"The payload range {low:g} to {high:g} kg leaves out the {payload_word(identified)} payload of {mass:.4g} kg, "
        "so the weight to compensate is not known; widen the range, or name the one mass that the cell will carry."
    )


def payload_word(identified: Identified) -> str:
    """Return whether the payload was given by a person or identified, for a sentence."""
    return "given" if identified.payload.mass_kg.status is Status.GIVEN else "identified"


def has_no_weight(identified: Identified) -> bool:
    """Return whether the weight was taken off the log's wrench, so that only the mass that moves is known."""
    return any(finding.code == "gravity-removed" for finding in identified.findings)


def is_mass_range(identified: Identified) -> bool:
    """Return whether a person gave a range of mass: a given mass without a deviation, the middle of the range."""
    return identified.payload.mass_kg.status is Status.GIVEN and identified.payload.mass_kg.std is None


def is_identified_mass(identified: Identified, mass_kg: float) -> bool:
    """Return whether a mass is the identified one as far as that is known: to 3 deviations, or to the digits shown."""
    estimate = identified.payload.mass_kg
    mass = _value(estimate, "payload.mass_kg")
    shown = 0.5 * 10.0 ** (math.floor(math.log10(mass)) - _SHOWN_DIGITS + 1)
    return abs(mass_kg - mass) <= max(_STDS * (estimate.std or 0.0), shown)


def certified_mass_kg(problems: Mapping[str, DesignProblem]) -> Interval | None:
    """Return the range of payload mass that the translational axes share, None where there are none."""
    return next((each.plants.payload_mass_kg for name, each in problems.items() if name not in ROTATIONAL_AXES), None)


def _build_problem(identified: Identified, name: str, spec: ProblemSpec) -> DesignProblem:
    axis, coupling = identified.axes[name], identified.axes[name].coupling
    wrench = build_wrench(identified.sensor.wrench_filter, spec.uncertain)
    plants = _nominal_set(identified, name, spec, wrench.nominal)
    sample_time = _value(identified.sample_time_s, "sample_time_s")
    nominal = DesignProblem(
        plants=plants,
        sample_time_s=sample_time,
        approach=spec.approach or Approach(force_n=_DEFAULT_APPROACH_N),
        bounds=without_position({**spec.bounds, **spec.free}, wrench),
        requirements=follow_robot(with_noise(spec, identified, name, sample_time), plants.nominal.robot),
        objective=spec.objective,
    )
    bounded = {
        "coupling_damping_n_s_per_m": coupling.damping_n_s_per_m,
        "drag_n_s_per_m": axis.drag_n_s_per_m,
    }
    intervals = {key: each.ci95 for key, each in bounded.items() if each.value is None and each.ci95 is not None}
    said = {key: value for key, value in spec.uncertain.items() if key not in {LAG, LATE}}
    return with_uncertainty(nominal, axis, name, {**intervals, **said, **wrench.ranges})


def _nominal_set(identified: Identified, name: str, spec: ProblemSpec, wrench: WrenchFilter) -> PlantSet:
    """Return the ranges of K_e and M_p, everything else as it was identified."""
    axis, coupling = identified.axes[name], identified.axes[name].coupling
    return PlantSet.of(
        _robot(axis, name),
        coupling_stiffness_n_per_m=_value(coupling.stiffness_n_per_m, _place(name, "coupling.", "stiffness_n_per_m")),
        coupling_damping_n_s_per_m=_damping(coupling.damping_n_s_per_m, _place(name, "coupling.", "damping_n_s_per_m")),
        drag_n_s_per_m=_damping(axis.drag_n_s_per_m, _place(name, "", "drag_n_s_per_m")),
        environment_stiffness_n_per_m=spec.environment_stiffness or _stiffness_range(identified, name),
        payload_mass_kg=spec.payload_mass or _mass_range(identified, name),
        wrench_filter=wrench,
    )


def _robot(axis: AxisEstimate, name: str) -> RobotModel:
    return RobotModel(
        numerator=_vector(axis.robot.numerator, f"axes.{name}.robot.numerator"),
        denominator=_vector(axis.robot.denominator, f"axes.{name}.robot.denominator"),
        delay_s=_value(axis.robot.delay_s, f"axes.{name}.robot.delay_s"),
    )


def _place(name: str, within: str, key: str) -> str:
    """Return the place of an entry in `identified.yaml`, a rotational one under the name that it has there."""
    return f"axes.{name}.{within}{axis_key(name, key)}"


def _mass_range(identified: Identified, name: str) -> Interval:
    if name not in ROTATIONAL_AXES:
        return _weighed_range(identified, name)
    inertia, where = identified.axes[name].mass_kg, _place(name, "", "mass_kg")
    if inertia is None:
        raise EstimateError(_absent(where, "no motion shows it"))
    return _range(inertia, where, _LEAST_MASS_SHARE)


def _weighed_range(identified: Identified, name: str) -> Interval:
    """Return the range of the payload's mass, which holds that from gravity and, where they disagree, that from motion.

    Which of two masses is right nobody can say, so both must be safe.
    """
    weighed, moved = identified.payload.mass_kg, identified.axes[name].mass_kg
    low, high = _range(weighed, "payload.mass_kg", _LEAST_MASS_SHARE)
    if moved is None or moved.value is None or low <= moved.value <= high:
        return low, high
    other = _range(moved, _place(name, "", "mass_kg"), _LEAST_MASS_SHARE)
    return min(low, other[0]), max(high, other[1])


def _stiffness_range(identified: Identified, name: str) -> Interval:
    """Return the range of K_e that holds every surface; raises EstimateError where a touched one is not identified."""
    axis = identified.axes[name]
    say = (
        "say rotational.environment_stiffness_n_m_per_rad in problem.yaml"
        if name in ROTATIONAL_AXES
        else "say --environment-stiffness LO:HI"
    )
    unexplained = unexplained_contacts(identified, name)
    if unexplained:
        messages = " ".join(finding.message for finding in unexplained)
        raise EstimateError(f"{messages} A default range would leave it out; record that contact again, or {say}.")
    if not axis.environments:
        raise EstimateError(
            f"Axis {name} has no identified environment; record contacts, or {say}. To tune other axes alone, name "
            "them in problem.yaml with axis."
        )
    ranges = [
        _range(
            e.stiffness_n_per_m, _place(name, f"environments[{e.name}].", "stiffness_n_per_m"), _LEAST_STIFFNESS_SHARE
        )
        for e in axis.environments
    ]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _range(estimate: Estimate, where: str, least_share: float) -> Interval:
    value = _value(estimate, where)
    half = max(_STDS * (estimate.std or 0.0), least_share * value)
    low, high = max(value - half, 1e-3 * value), value + half
    if estimate.ci95 is not None and estimate.status is not Status.GIVEN:
        low, high = max(min(low, estimate.ci95[0]), 1e-3 * value), max(high, estimate.ci95[1])
    return _rounded(low, math.floor), _rounded(high, math.ceil)


def _rounded(value: float, towards: Callable[[float], int]) -> float:
    """Return the value with three digits, rounded outwards: a domain that people can read and compare."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    # Dividing by the reciprocal keeps 0.1 at 0.1; a power of ten below one is not exact.
    return towards(value / unit) * unit if unit >= 1.0 else towards(value / unit) / round(1.0 / unit)


def _value(estimate: Estimate, where: str) -> float:
    if estimate.value is None or estimate.status is Status.UNIDENTIFIABLE:
        raise EstimateError(_absent(where, estimate.note))
    return estimate.value


def _damping(estimate: Estimate, where: str) -> float:
    """Return a damping, or the middle of its interval where that is all that the log shows."""
    if estimate.value is None and estimate.ci95 is not None:
        return 0.5 * (estimate.ci95[0] + estimate.ci95[1])
    return max(_value(estimate, where), 0.0)


def _vector(estimate: VectorEstimate, where: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if estimate.value is None:
        raise EstimateError(_absent(where, estimate.note))
    return np.array(estimate.value)


def _absent(where: str, note: str) -> str:
    because = f" ({note})" if note else ""
    return f"{where} is not identified{because}, and no controller is tuned on a guess; record what is missing."


def through_lever(spec: ProblemSpec, approach: Approach) -> ProblemSpec:
    """Return what is asked of a rotational axis: what is asked of x, y, z through a lever of 0.2 m, in rad and N·m.

    A force F at the lever l turns with the torque l F, and a speed v there is the rate v/l. Masses and dampings go with
    l², admittances with 1/l²; margins, times and bands stay. The lever is the one at which the paper's deadbands, 5 N
    and 1 N·m, are the same. `approach` is the one of x, y, z.

    What `spec.rotational` says is kept as it is. Ranges of payload and surface are taken from there alone: what the
    cell is is never derived this way.
    """
    own = spec.rotational
    bounds = {**DEFAULT_BOUNDS, **spec.bounds}
    turned = {name: _interval(bounds[name], LEVER_M**2) for name in _GO_WITH_THE_LEVER}
    return replace(
        spec,
        bounds={**bounds, **turned, **own.bounds},
        approach=own.approach or _turned_approach(approach),
        environment_stiffness=own.environment_stiffness,
        payload_mass=own.payload_mass,
        # A range has a unit and is kept where it was given; where it is to come from holds for every axis.
        uncertain={**{name: each for name, each in spec.uncertain.items() if isinstance(each, str)}, **own.uncertain},
        requirements=_turned_requirements(spec.requirements, own),
        share_of_jitter=None if "command_noise" in own.requirements else spec.share_of_jitter,
    )


def _turned_approach(approach: Approach) -> Approach:
    force, speed = approach.force_n, approach.speed_m_s
    return replace(
        approach,
        force_n=None if force is None else _nine_digits(force * LEVER_M),
        speed_m_s=None if speed is None else _nine_digits(speed / LEVER_M),
    )


def _turned_requirements(asked: Requirements, own: RotationalSpec) -> Requirements:
    # Prices of what the rotational axes are asked otherwise are given there too, or nowhere.
    kept = {name: _nine_digits(price * LEVER_M) for name, price in asked.soft_n.items() if name not in own.requirements}
    turned = {name: asked.kind(name).turned(value, LEVER_M) for name, value in asked.asked().items()}
    prices = {**kept, **own.soft_n}
    return build_requirements({**turned, **own.requirements}, prices, without_defaults=True, plugins=asked.plugins)


def _interval(values: Interval, factor: float) -> Interval:
    return _nine_digits(values[0] * factor), _nine_digits(values[1] * factor)


def _nine_digits(value: float) -> float:
    """Return the value with nine digits: 0.2² is not 0.04 in binary, and people read these numbers."""
    return float(f"{value:.9g}")
