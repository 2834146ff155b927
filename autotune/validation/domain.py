"""Check that an identified plant lies inside the domain that a certificate speaks of."""

from collections.abc import Iterator

from autotune.files.controller_record import AxisDomain, Controller
from autotune.files.records import ROTATIONAL_AXES
from autotune.files.units import axis_units
from identification.result import AxisEstimate, Estimate, Identified, Status

from .validate import Check

_STDS = 3.0
_LEAST_SHARE = 0.01


def check_domain(controller: Controller, identified: Identified) -> tuple[Check, ...]:
    """Compare payload, coupling, drag, delay and environments of every tuned axis with the certificate's domain.

    The payload of a rotational axis is the moment of inertia about it.
    """
    checks = []
    for name, domain in controller.certificate.domain.items():
        axis = identified.axes.get(name)
        problems = (
            ["the identified file does not hold this axis"] if axis is None else list(_outside(name, domain, axis))
        )
        if name not in ROTATIONAL_AXES:
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


def _outside(name: str, domain: AxisDomain, axis: AxisEstimate) -> Iterator[str]:
    units = axis_units(name)
    if name in ROTATIONAL_AXES:
        inertia = axis.mass_kg or Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
        yield from _interval(f"payload inertia [{units.mass}]", inertia, domain.payload_mass_kg)
    for surface in axis.environments:
        yield from _interval(
            f"K_e of {surface.name} [{units.stiffness}]",
            surface.stiffness_n_per_m,
            domain.environment_stiffness_n_per_m,
        )
    uncertain = domain.uncertain or {}
    for key, what, estimate, certified in (
        (
            "coupling_stiffness_n_per_m",
            f"K_s [{units.stiffness}]",
            axis.coupling.stiffness_n_per_m,
            domain.coupling_stiffness_n_per_m,
        ),
        (
            "coupling_damping_n_s_per_m",
            f"B_s [{units.damping}]",
            axis.coupling.damping_n_s_per_m,
            domain.coupling_damping_n_s_per_m,
        ),
        ("drag_n_s_per_m", f"B_p [{units.damping}]", axis.drag_n_s_per_m, domain.drag_n_s_per_m),
        ("delay_s", "T_d [s]", axis.robot.delay_s, domain.delay_s),
    ):
        if key in uncertain:
            yield from _interval(what, estimate, uncertain[key])
        else:
            yield from _same(what, estimate, certified)
    if "robot_bandwidth_hz" in uncertain:
        yield from _interval("robot bandwidth [Hz]", axis.robot.bandwidth_hz, uncertain["robot_bandwidth_hz"])


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
