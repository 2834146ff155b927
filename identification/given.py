"""Prior knowledge from outside the log, and its conflicts with the log."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from problems.frozen import FrozenDict
from problems.model.axis_kind import rotational_name
from problems.text import significant

from .errors import EstimateError
from .result import AxisEstimate, Estimate, Finding, Identified, Status

_CONTRADICTION_STDS = 4.0
# Of a value that is given as exact: no stamp is free of rounding.
_ROUNDING_SHARE = 1e-6

_AXIS_KEYS = {
    "coupling_stiffness_n_per_m": "stiffness_n_per_m",
    "coupling_damping_n_s_per_m": "damping_n_s_per_m",
    "drag_n_s_per_m": "drag_n_s_per_m",
    "delay_s": "delay_s",
}
_ROTATIONAL_KEYS = {rotational_name(key): name for key, name in _AXIS_KEYS.items()}


def axis_keys(axis: str) -> Mapping[str, str]:
    """Return what may be given of an axis, in its units as in `x.drag_n_s_per_m`, and what the joint fit calls it.

    `mass_kg` and `sample_time_s` stand alone.
    """
    return FrozenDict(_ROTATIONAL_KEYS if axis.startswith("r") else _AXIS_KEYS)


@dataclass(frozen=True, kw_only=True)
class Given:
    """A value known from elsewhere with one standard deviation (0: taken as exact)."""

    value: float
    std: float


# A log that has fewer samples of its controller is more likely of another unit.
_SLOWEST_LOG = 50.0


def check_names(given: Mapping[str, Given], axes: Iterable[str]) -> None:
    """Raise EstimateError for a name that is unknown or an axis that is not there."""
    known = ["mass_kg", "sample_time_s", *(f"{axis}.{key}" for axis in axes for key in axis_keys(axis))]
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise EstimateError(f"Nothing called {unknown[0]} can be given of this log; what can: {', '.join(known)}.")


def settle_cell(result: Identified, given: Mapping[str, Given]) -> Identified:
    """Combine mass and control period with what is given of them, as independent normal knowledge (Bayes).

    A number that the log did not show becomes the given one. Where log and prior are more than four joint deviations
    apart, a finding of severity `error` says so. A parameter whose prior is as sharp as the log or sharper is `given`.
    """
    findings = list(result.findings)
    changed = result
    if "mass_kg" in given:
        mass, contradiction = _posterior("mass_kg", result.payload.mass_kg, None, given["mass_kg"])
        changed = replace(changed, payload=replace(changed.payload, mass_kg=mass))
        findings += contradiction
    if "sample_time_s" in given:
        period, contradiction = _control_period(result.sample_time_s, given["sample_time_s"])
        changed = replace(changed, sample_time_s=period)
        findings += contradiction
    return replace(changed, findings=tuple(findings))


def settle_axis(
    name: str, alone: AxisEstimate, both: AxisEstimate | None, given: Mapping[str, Given]
) -> tuple[AxisEstimate, list[Finding]]:
    """Give the parameters of an axis that are known from elsewhere their verdict.

    `alone` is what the log shows, `both` what it shows with the priors in the fit; where there was none (None), each
    prior moves its own number only.
    """
    changed, findings = alone if both is None else both, []
    for key, own in axis_keys(name).items():
        full = f"{name}.{key}"
        if full in given:
            found, contradiction = _posterior(
                full, _get(alone, own), None if both is None else _get(both, own), given[full]
            )
            changed = _set(changed, own, found)
            findings += contradiction
    return changed, findings


def _get(axis: AxisEstimate, name: str) -> Estimate:
    return {
        "stiffness_n_per_m": axis.coupling.stiffness_n_per_m,
        "damping_n_s_per_m": axis.coupling.damping_n_s_per_m,
        "drag_n_s_per_m": axis.drag_n_s_per_m,
        "delay_s": axis.robot.delay_s,
    }[name]


def _set(axis: AxisEstimate, name: str, estimate: Estimate) -> AxisEstimate:
    if name == "drag_n_s_per_m":
        return replace(axis, drag_n_s_per_m=estimate)
    if name == "delay_s":
        return replace(axis, robot=replace(axis.robot, delay_s=estimate))
    return replace(axis, coupling=replace(axis.coupling, **{name: estimate}))


def _posterior(name: str, estimate: Estimate, fitted: Estimate | None, prior: Given) -> tuple[Estimate, list[Finding]]:
    """Return what log and prior show together: as the fit found it, else the product of two normal densities.

    Beside it what the user should know: that it was used, or that it contradicts the log.
    """
    if estimate.value is None or estimate.std is None:
        return _without_log(name, fitted, prior)
    if fitted is not None and fitted.value is not None and fitted.std is not None and prior.std > 0.0:
        value, std = fitted.value, fitted.std
    elif prior.std == 0.0 or estimate.std == 0.0:
        value, std = (prior.value, prior.std) if prior.std == 0.0 else (estimate.value, estimate.std)
    else:
        precision = estimate.std**-2.0 + prior.std**-2.0
        value = (estimate.value / estimate.std**2 + prior.value / prior.std**2) / precision
        std = precision**-0.5
    shown = f"{estimate.value:.6g} ± {significant(estimate.std)}"
    note = f"given {prior.value:.6g} ± {significant(prior.std)}, the log shows {shown}"
    status = Status.GIVEN if prior.std <= estimate.std else estimate.status
    apart, alone = abs(estimate.value - prior.value), f"{estimate.value:.5g} ± {significant(estimate.std)}"
    if apart > _CONTRADICTION_STDS * math.hypot(estimate.std, prior.std) + _ROUNDING_SHARE * abs(prior.value):
        about = Finding(
            code="given-contradicts",
            severity="error",
            message=f"The log shows {name} as {alone}, given is {prior.value:.5g} ± {significant(prior.std)}.",
            advice="Check the given value and its unit, and that the log is of this cell and payload.",
        )
    else:
        stated = f"{value:.5g} ± {significant(std)}" if std else f"{value:.5g}"
        about = _used(f"{name}: given is {_number(prior)}, the log alone shows {alone}; {stated} was taken.")
    return Estimate(value=value, std=std, status=status, method=estimate.method, note=note), [about]


def _control_period(logged: Estimate, given: Given) -> tuple[Estimate, list[Finding]]:
    """Return the control period: a log may be slower than the controller, so that a shorter one contradicts nothing."""
    if logged.value is None or not 1.0 < logged.value / given.value * (1.0 - _ROUNDING_SHARE) < _SLOWEST_LOG:
        return _posterior("sample_time_s", logged, None, given)
    note = f"given {_number(given)}, the log has a sample every {logged.value:.5g} s"
    found = Estimate(value=given.value, std=given.std, status=Status.GIVEN, method="given", note=note)
    return found, [_used(f"sample_time_s: {note}.")]


def _without_log(name: str, fitted: Estimate | None, prior: Given) -> tuple[Estimate, list[Finding]]:
    note = "the log alone does not show it"
    found = Estimate(value=prior.value, std=prior.std, status=Status.GIVEN, method="given", note=note)
    if fitted is not None and fitted.value is not None:
        found = replace(found, value=fitted.value, std=fitted.std, method=fitted.method)
    return found, [_used(f"{name}: given is {_number(prior)}; {note}.")]


def _number(prior: Given) -> str:
    return f"{prior.value:.5g} ± {significant(prior.std)}" if prior.std else f"{prior.value:.5g}, taken as exact"


def _used(message: str) -> Finding:
    return Finding(code="given-used", severity="info", message=message, advice="")
