"""A point of the uncertainty as people read it, every value with its unit."""

from autotune.formats.units import AxisUnits
from problems.design.uncertainty import SYMBOLS, Scenario


def stiffness_text(value: float, units: AxisUnits) -> str:
    """Return a stiffness (SI of the axis) in the unit in which people read it."""
    scale, unit = units.shown_stiffness
    return f"{scale * value:.4g} {unit}"


def value_text(name: str, value: float, units: AxisUnits) -> str:
    """Return the value of a parameter that may be uncertain (`UNCERTAIN` there), with its symbol and unit."""
    symbol = SYMBOLS[name]
    if name.endswith("stiffness_n_per_m"):
        return f"{symbol} {stiffness_text(value, units)}"
    if name in {"delay_s", "wrench_time_constant_s", "wrench_delay_s"}:
        return f"{symbol} {1e3 * value:.4g} ms"
    unit = {"payload_mass_kg": units.mass, "robot_bandwidth_hz": "Hz", "robot_damping_ratio": ""}.get(
        name, units.damping
    )
    return f"{symbol} {value:.4g} {unit}".rstrip()


def off_nominal(scenario: Scenario, units: AxisUnits) -> str:
    """Return what a scenario says beyond K_e and M_p, as `K_s 310.2 N/mm, T_d 2.4 ms`; empty if nothing."""
    return ", ".join(value_text(name, value, units) for name, value in scenario.further().items())


def scenario_text(scenario: Scenario, units: AxisUnits) -> str:
    """Return a whole scenario, as `K_e 500 N/mm, M_p 16 kg`."""
    always = (
        value_text("environment_stiffness_n_per_m", scenario.environment_stiffness_n_per_m, units),
        value_text("payload_mass_kg", scenario.payload_mass_kg, units),
    )
    return ", ".join(part for part in (*always, off_nominal(scenario, units)) if part)
