"""Knowledge from outside the log, entered as a prior."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from .errors import EstimateError
from .result import AxisEstimate, Estimate, Finding, Identified, Status

_CONTRADICTION_STDS = 4.0

AXIS_KEYS = (
    "coupling_stiffness_n_per_m",
    "coupling_damping_n_s_per_m",
    "drag_n_s_per_m",
    "delay_s",
)
"""What may be given of an axis, as `x.drag_n_s_per_m`; `mass_kg` and `sample_time_s` stand alone."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """A value known from elsewhere with one standard deviation (0: taken as exact)."""

    value: float
    std: float


def apply_given(result: Identified, given: Mapping[str, Given]) -> Identified:
    """Combine estimates with what is given of them, as independent normal knowledge of one number (Bayes).

    A number that the log did not tell becomes the given one. Where log and prior are more than four joint deviations
    apart, a finding of severity `error` says so. A parameter whose prior is as sharp as the log or sharper is `given`.
    Other parameters are not moved. Raises EstimateError for a name that is unknown or an axis that is not there.
    """
    findings = list(result.findings)
    settled: set[str] = set()

    def known(name: str, estimate: Estimate) -> Estimate:
        settled.add(name)
        found, contradiction = _posterior(name, estimate, given[name])
        findings.extend(contradiction)
        return found

    changed = result
    if "mass_kg" in given:
        mass = known("mass_kg", result.payload.mass_kg)
        changed = replace(changed, payload=replace(changed.payload, mass_kg=mass))
    if "sample_time_s" in given:
        changed = replace(changed, sample_time_s=known("sample_time_s", result.sample_time_s))
    axes = {name: _axis(name, axis, given, known) for name, axis in changed.axes.items()}
    unknown = sorted(set(given) - settled)
    if unknown:
        names = ", ".join(["mass_kg", "sample_time_s", *(f"{axis}.{key}" for axis in axes for key in AXIS_KEYS)])
        raise EstimateError(f"Nothing called {unknown[0]} can be given of this log; what can: {names}.")
    return replace(changed, axes=axes, findings=tuple(findings))


def _axis(
    name: str, axis: AxisEstimate, given: Mapping[str, Given], known: Callable[[str, Estimate], Estimate]
) -> AxisEstimate:
    told = {
        "coupling_stiffness_n_per_m": axis.coupling.stiffness_n_per_m,
        "coupling_damping_n_s_per_m": axis.coupling.damping_n_s_per_m,
        "drag_n_s_per_m": axis.drag_n_s_per_m,
        "delay_s": axis.robot.delay_s,
    }
    new = {
        key: known(f"{name}.{key}", estimate) if f"{name}.{key}" in given else estimate
        for key, estimate in told.items()
    }
    return replace(
        axis,
        coupling=replace(
            axis.coupling,
            stiffness_n_per_m=new["coupling_stiffness_n_per_m"],
            damping_n_s_per_m=new["coupling_damping_n_s_per_m"],
        ),
        drag_n_s_per_m=new["drag_n_s_per_m"],
        robot=replace(axis.robot, delay_s=new["delay_s"]),
    )


def _posterior(name: str, estimate: Estimate, prior: Given) -> tuple[Estimate, list[Finding]]:
    if estimate.value is None or estimate.std is None:
        return (
            Estimate(
                value=prior.value, std=prior.std, status=Status.GIVEN, method="given", note="the log does not tell it"
            ),
            [],
        )
    apart, together = abs(estimate.value - prior.value), math.hypot(estimate.std, prior.std)
    contradiction = []
    if apart > _CONTRADICTION_STDS * together:
        contradiction.append(
            Finding(
                code="given-contradicts",
                severity="error",
                message=f"The log tells {name} as {estimate.value:.5g} ± {estimate.std:.2g}, given is "
                f"{prior.value:.5g} ± {prior.std:.2g}.",
                advice="Check the given value and its unit, and that the log is of this cell and payload.",
            )
        )
    if prior.std == 0.0 or estimate.std == 0.0:
        value, std = (prior.value, prior.std) if prior.std == 0.0 else (estimate.value, estimate.std)
    else:
        precision = estimate.std**-2.0 + prior.std**-2.0
        value = (estimate.value / estimate.std**2 + prior.value / prior.std**2) / precision
        std = precision**-0.5
    is_given = prior.std <= estimate.std
    note = f"given {prior.value:.6g} ± {prior.std:.2g}, the log tells {estimate.value:.6g} ± {estimate.std:.2g}"
    status = Status.GIVEN if is_given else estimate.status
    return Estimate(value=value, std=std, status=status, method=estimate.method, note=note), contradiction
