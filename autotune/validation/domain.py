"""Check that an identified plant lies inside the domain that a certificate speaks of."""

import math
from collections.abc import Iterator, Sequence

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, RuntimePayload
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.result import AxisEstimate, Estimate, Identified, Status, VectorEstimate, WrenchFilterEstimate
from problems.model.plant import NO_FILTER
from problems.model.plant_parameters import PARAMETERS

from .report import Check

_STDS = 3.0
_LEAST_SHARE = 0.01
_ABSENT = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
# The payload in the file is a copy of what was identified, not another estimate of it.
_COMPENSATED_STDS, _ROUNDING = 5.0, 1e-6


def check_domain(controller: Controller, identified: Identified) -> tuple[Check, ...]:
    """Compare payload, coupling, drag, delay, environments and the wrench's filter with the certificate's domain.

    The payload of a rotational axis is the moment of inertia about it. What the runtime compensates, which is of all
    axes, is compared with the identified payload once, with the first axis.
    """
    checks = []
    for name, domain in controller.certificate.domain.items():
        axis = identified.axes.get(name)
        problems = ["the plant does not hold this axis"] if axis is None else list(_outside(name, domain, axis))
        problems += _wrench(domain, identified.sensor.wrench_filter)
        if name not in ROTATIONAL_AXES:
            problems += _carried_mass(identified.payload.mass_kg, domain.payload_mass_kg)
        checks.append(
            Check(
                axis=name,
                name="identified plant",
                passed=not problems,
                message="; ".join(problems) or "lies inside the certified domain",
            )
        )
    return (*checks, _compensated(next(iter(controller.axes)), controller.payload, identified))


def _compensated(name: str, payload: RuntimePayload, identified: Identified) -> Check:
    """Compare what the gravity compensation takes off the wrench with what was identified, number by number."""
    if payload.set_in_cell:
        message = "the file holds no centre of mass and bias; the runtime starts only with those that the cell gives"
        return Check(axis=name, name="gravity compensation", passed=True, warns=True, message=message)
    sensor, com, mass = identified.sensor, identified.payload.com_m, identified.payload.mass_kg
    alone = VectorEstimate(
        value=None if mass.value is None else (mass.value,),
        std=None if mass.std is None else (mass.std,),
        status=mass.status,
    )
    problems = [
        *_same_vector("payload mass [kg]", alone, (payload.mass_kg,)),
        *_same_vector("centre of mass [mm]", com, payload.com_m, scale=1e3),
        *_same_vector("force bias [N]", sensor.force_bias_n, payload.force_bias_n),
        *_same_vector("torque bias [N·m]", sensor.torque_bias_n_m, payload.torque_bias_n_m),
    ]
    message = "; ".join(problems) or "mass, centre of mass and bias that the runtime takes off are those identified"
    return Check(axis=name, name="gravity compensation", passed=not problems, message=message)


def _same_vector(what: str, estimate: VectorEstimate, said: Sequence[float], *, scale: float = 1.0) -> list[str]:
    if estimate.value is None:
        return [f"{what} is not identified"]
    stds = estimate.std or (0.0,) * len(estimate.value)
    if all(
        abs(one - value) <= _COMPENSATED_STDS * std + _ROUNDING * abs(value)
        for one, value, std in zip(said, estimate.value, stds, strict=True)
    ):
        return []
    file, found, deviations = (
        ", ".join(f"{scale * number:.6g}" for number in numbers) for numbers in (said, estimate.value, stds)
    )
    return [f"{what} is {file} in the file, identified as {found} with deviations of {deviations}"]


def _carried_mass(mass: Estimate, interval: tuple[float, float]) -> list[str]:
    """Compare the identified mass, as well as it is known, with the certified ones."""
    low, high = interval
    margin = _STDS * (mass.std or 0.0)
    return _interval("payload mass [kg]", mass, (low - margin, high + margin), certified=interval)


def _wrench(domain: AxisDomain, estimate: WrenchFilterEstimate | None) -> list[str]:
    """Compare the filter or delay that was identified with the certified one; a file may say nothing of it."""
    if estimate is None:
        return []
    certified, uncertain = domain.wrench_filter or NO_FILTER, domain.uncertain or {}
    if estimate.delay_s is not None:
        what, span = "wrench delay [s]", uncertain.get("wrench_delay_s")
        return _interval(what, estimate.delay_s, span) if span else _same(what, estimate.delay_s, certified.delay_s)
    corner, lag = estimate.corner_hz or _ABSENT, certified.time_constant_s
    if lag == 0.0:
        corner_text = "not identified" if corner.value is None else f"filtered at {corner.value:.6g} Hz"
        return [f"the wrench is {corner_text}, certified for a wrench without a filter"]
    fast, slow = uncertain.get("wrench_time_constant_s", (lag, lag))
    ends = 1.0 / (2.0 * math.pi * slow), 1.0 / (2.0 * math.pi * fast)
    if "wrench_time_constant_s" in uncertain:
        return _interval("corner of the wrench's filter [Hz]", corner, ends)
    return _same("corner of the wrench's filter [Hz]", corner, ends[0])


def _outside(name: str, domain: AxisDomain, axis: AxisEstimate) -> Iterator[str]:
    units = axis_units(name)
    if name in ROTATIONAL_AXES:
        inertia = axis.mass_kg or Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
        yield from _interval(f"payload inertia [{units.mass}]", inertia, domain.payload_mass_kg)
    scale, unit = units.shown_stiffness
    for surface in axis.environments:
        what, span = f"K_e of {surface.name} [{unit}]", domain.environment_stiffness_n_per_m
        yield from _interval(what, surface.stiffness_n_per_m, span, scale=scale)
    for key, estimate in axis.plant_estimates().items():
        of, (low, high) = PARAMETERS[key], domain.plants.range_of(key)
        scale, unit = units.shown(of.kind)
        what = f"{of.label if of.kind == 'frequency' else of.symbol} [{unit}]"
        if key in domain.plants.ranges:
            yield from _interval(what, estimate, (low, high), scale=scale)
        elif of.kind != "frequency":
            # A robot's nominal bandwidth is in its coefficients, which nothing here compares.
            yield from _same(what, estimate, low, scale=scale)


def _interval(
    what: str,
    estimate: Estimate,
    interval: tuple[float, float],
    *,
    certified: tuple[float, float] | None = None,
    scale: float = 1.0,
) -> list[str]:
    """Say what lies outside of an interval, shown times `scale`; `certified` is shown where it was widened.

    Of what is known as an interval only, both ends must lie inside.
    """
    ends = estimate.ci95 if estimate.value is None else (estimate.value,)
    if ends is None:
        return [f"{what} is not identified"]
    if not interval[0] <= ends[0] <= ends[-1] <= interval[1]:
        low, high = (scale * each for each in certified or interval)
        found = " to ".join(f"{scale * each:.6g}" for each in ends)
        return [f"{what} is {found}, certified for [{low:.6g}, {high:.6g}]"]
    return []


def _same(what: str, estimate: Estimate, certified: float, *, scale: float = 1.0) -> list[str]:
    if estimate.value is None:
        return [f"{what} is not identified"]
    tolerance = max(_STDS * (estimate.std or 0.0), _LEAST_SHARE * abs(estimate.value))
    if abs(estimate.value - certified) > tolerance:
        return [f"{what} is {scale * estimate.value:.6g}, certified for {scale * certified:.6g}"]
    return []
