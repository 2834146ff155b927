"""Check that an identified plant lies inside the domain that a certificate speaks of."""

from collections.abc import Iterator

from autotune.files.controller_record import AxisDomain, Controller
from identification.result import AxisEstimate, Estimate, Identified

from .validate import Check

_STDS = 3.0
_LEAST_SHARE = 0.01


def check_domain(controller: Controller, identified: Identified) -> tuple[Check, ...]:
    """Compare payload, coupling, drag, delay and environments of every tuned axis with the certificate's domain."""
    checks = []
    for name, domain in controller.certificate.domain.items():
        axis = identified.axes.get(name)
        problems = ["the identified file does not hold this axis"] if axis is None else list(_outside(domain, axis))
        problems += _interval("payload mass [kg]", identified.payload.mass_kg, domain.payload_mass_kg)
        checks.append(
            Check(
                axis=name,
                name="identified plant",
                passed=not problems,
                message="; ".join(problems) or "lies inside the certified domain",
            )
        )
    return tuple(checks)


def _outside(domain: AxisDomain, axis: AxisEstimate) -> Iterator[str]:
    for surface in axis.environments:
        yield from _interval(
            f"K_e of {surface.name} [N/m]", surface.stiffness_n_per_m, domain.environment_stiffness_n_per_m
        )
    yield from _same("K_s [N/m]", axis.coupling.stiffness_n_per_m, domain.coupling_stiffness_n_per_m)
    yield from _same("B_s [N·s/m]", axis.coupling.damping_n_s_per_m, domain.coupling_damping_n_s_per_m)
    yield from _same("B_p [N·s/m]", axis.drag_n_s_per_m, domain.drag_n_s_per_m)
    yield from _same("T_d [s]", axis.robot.delay_s, domain.delay_s)


def _interval(what: str, estimate: Estimate, interval: tuple[float, float]) -> list[str]:
    if estimate.value is None:
        return [f"{what} is not identified"]
    if not interval[0] <= estimate.value <= interval[1]:
        return [f"{what} is {estimate.value:.6g}, certified for [{interval[0]:.6g}, {interval[1]:.6g}]"]
    return []


def _same(what: str, estimate: Estimate, certified: float) -> list[str]:
    if estimate.value is None:
        return [f"{what} is not identified"]
    tolerance = max(_STDS * (estimate.std or 0.0), _LEAST_SHARE * abs(estimate.value))
    if abs(estimate.value - certified) > tolerance:
        return [f"{what} is {estimate.value:.6g}, certified for {certified:.6g}"]
    return []
