"""Two controllers side by side: the tree for `--json` and the table for people."""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from ._table import table_lines
from ._terminal import painted, printable

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from autotune.formats.units import AxisUnits
    from autotune.tuning.compare import SideBySide, Standing


def compare_tree(old: "ControllerFile", found: Mapping[str, "SideBySide"]) -> dict[str, Any]:
    """Return the comparison as plain data; a margin without limit and every number of an unstable loop are null."""
    from autotune.formats.records import rename_axis_keys

    axes = {
        name: {"started_from_old": both.is_start, "old": _standing_tree(both.old), "new": _standing_tree(both.new)}
        for name, both in found.items()
    }
    return {
        "path": str(old.path),
        "checksum": old.checksum,
        "axes": {name: rename_axis_keys(name, tree, reading=False) for name, tree in axes.items()},
    }


def _standing_tree(standing: "Standing") -> dict[str, Any]:
    law, does, at = standing.law, standing.performance, standing.unstable_at
    margins = {} if does is None else does.margins
    return {
        "mass": law.mass_kg,
        "damping": law.damping_n_s_per_m,
        "lead_s": law.lead_s,
        "feedback_damping_s": law.feedback_damping_s,
        "is_stable": does is not None,
        "unstable_at": None if at is None else {"payload_mass_kg": at[0], "environment_stiffness_n_per_m": at[1]},
        "peak_sensor_force_n": None if does is None else does.peak_sensor_force_n,
        "peak_contact_force_n": None if does is None else does.peak_contact_force_n,
        "margins": {name: value if math.isfinite(value) else None for name, value in margins.items()} or None,
        "min_m_s_per_n": None if does is None else does.min_m_s_per_n,
        "hand_force_n_per_m_s": None if does is None else does.hand_force_n_per_m_s,
        "missed": None if does is None else {name: 1.0 / value for name, value in does.missed.items()},
    }


def compare_lines(old: "ControllerFile", found: Mapping[str, "SideBySide"]) -> Iterator[str]:
    """Yield the comparison in words: a table per axis, then what the old controller misses."""
    from autotune.formats.canonical import short
    from autotune.formats.units import axis_units

    yield f"beside {printable(str(old.path))}, checksum {short(old.checksum)}, on the same problem"
    for name, both in found.items():
        units = axis_units(name)
        yield from table_lines([("", "old", "new"), *_rows(both, units)], point=(1, 2), indent=f"  {name}  ")
        for told, standing in (("old", both.old), ("new", both.new)):
            yield f"  {name}  {told}: {_verdict(standing, units)}"


def _rows(both: "SideBySide", units: "AxisUnits") -> Iterator[tuple[str, str, str]]:
    sides = (both.old, both.new)
    for what, name in (
        (f"M_a [{units.mass}]", "mass_kg"),
        (f"B_a [{units.damping}]", "damping_n_s_per_m"),
        ("K_l [s]", "lead_s"),
        ("B_fb [s]", "feedback_damping_s"),
    ):
        old, new = (f"{getattr(side.law, name):.6g}" for side in sides)
        yield what, old, new
    for what, name, scale in (
        (f"peak at sensor [{units.force}]", "peak_sensor_force_n", 1.0),
        (f"peak at contact [{units.force}]", "peak_contact_force_n", 1.0),
        (f"least admittance [{units.admittance}]", "min_m_s_per_n", 1.0),
        (f"hand {units.force_name} [{units.hand}]", "hand_force_n_per_m_s", 1.0),
        ("modulus margin", "modulus", 1.0),
        ("gain margin [dB]", "gain_db", 1.0),
        ("phase margin [deg]", "phase_deg", 1.0),
        ("delay margin [ms]", "delay_s", 1e3),
    ):
        old, new = (_number(side, name, scale) for side in sides)
        yield what, old, new


def _number(side: "Standing", name: str, scale: float) -> str:
    if side.performance is None:
        return "-"
    value = side.performance.margins.get(name)
    value = float(getattr(side.performance, name)) if value is None else value
    return "no limit" if math.isinf(value) else f"{value * scale:.4g}"


def _verdict(side: "Standing", units: "AxisUnits") -> str:
    if side.unstable_at is not None:
        mass, stiffness = side.unstable_at
        where = f"K_e {stiffness:.4g} {units.stiffness}" if stiffness > 0.0 else "free space"
        return f"{painted('UNSTABLE')} in {where} with {mass:.4g} {units.mass} (largest |z| {side.spectral_radius:.5f})"
    missed = {} if side.performance is None else side.performance.missed
    told = ", ".join(f"{name} ({min(100.0 / value, 99.99):.4g} %)" for name, value in missed.items())
    return f"misses {told} of what is asked" if told else "meets every requirement"
