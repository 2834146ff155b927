"""Render the runtime's step with the numbers of one controller as one C99 source and its header.

The templates in `c/` are `autotune.runtime.step` and `guard` operation by operation, with `$words` to be filled in.
"""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from string import Template
from typing import Any

from autotune.formats.canonical import short
from autotune.formats.limits import CollisionResponse
from autotune.formats.units import axis_units
from autotune.runtime.change import LEAST_MEMORY
from autotune.runtime.controller import SAME_SAMPLE_TIME, RuntimeController
from autotune.runtime.frames import LARGEST_SKEW, LARGEST_WAY, SMALLEST_TRACE
from autotune.runtime.guard import (
    ACROSS,
    LEAST_SHARE,
    MEAN_PERIODS,
    MOST_HELD,
    MOST_PERIODS,
    UNFELT_WAY,
    UNSEEN_WAY,
    WEIGHT_WAY,
)
from autotune.runtime.law import AxisLaw
from autotune.version import __version__
from problems.model.difference import BLOCK_ROWS

_RESPONSES = (CollisionResponse.NONE, CollisionResponse.RESET, CollisionResponse.STOP)


@dataclass(frozen=True, kw_only=True)
class CSource:
    """The text of `NAME.h` and `NAME.c`."""

    header: str
    source: str


def render_c(
    controller: RuntimeController, name: str, provenance: Mapping[str, Any], signed_by: str | None = None
) -> CSource:
    """Return header and source whose functions begin with `name`; every number is the exact double, in hexadecimal.

    `signed_by` is the fingerprint of the key whose signature of the file was verified, None where none was asked for.
    """
    payload, threshold, guard = controller.payload, controller.threshold_n, controller.guard
    words = {
        "prefix": name,
        "PREFIX": name.upper(),
        "tool_version": __version__,
        "about": _about(controller, provenance),
        "signed_by": signed_by or "",
        "signature": f"signature verified, key {signed_by}" if signed_by else "signature not verified",
        "checksum": controller.checksum,
        "head": short(controller.checksum),
        "tuned": len(controller.axes),
        "response": _RESPONSES.index(controller.response),
        "laws": ",\n".join(
            map(_law, controller.axes, zip(guard.speeds, guard.changes, guard.followed, guard.weights, strict=True))
        ),
        "threshold": _number(0.0 if controller.response is CollisionResponse.NONE else threshold),
        "sample_time": _number(controller.sample_time_s),
        "mass": _number(payload.mass_kg),
        "com": _numbers(payload.com_S_m),
        "force_bias": _numbers(payload.force_bias_S_n),
        "torque_bias": _numbers(payload.torque_bias_S_n_m),
        "gravity": _numbers(payload.gravity_W_m_s2),
        "skew": _number(LARGEST_SKEW),
        "way": _number(LARGEST_WAY),
        "trace": _number(SMALLEST_TRACE),
        "same": _number(SAME_SAMPLE_TIME),
        "least_memory": _number(LEAST_MEMORY),
        **_limits(controller),
    }
    return CSource(header=_filled("controller.h.in", words), source=_filled("controller.c.in", words))


def _limits(controller: RuntimeController) -> dict[str, object]:
    guard, limits = controller.guard, controller.limits
    numbers = {
        "force": limits.force_n,
        "torque": limits.torque_n_m,
        "way_m": guard.way_m,
        "way_rad": guard.way_rad,
        "rest_force": guard.rest_force,
        "rest_torque": guard.rest_torque,
        "least_weight": guard.least_weight,
        "mean_periods": MEAN_PERIODS,
        "least_share": LEAST_SHARE,
        "across": ACROSS,
        "weight_way": WEIGHT_WAY,
        "unfelt": UNFELT_WAY,
        "unseen": UNSEEN_WAY,
    }
    return {
        **{name: _number(value) for name, value in numbers.items()},
        "wrench_periods": guard.wrench_periods,
        "pose_periods": guard.pose_periods,
        "weight_periods": guard.weight_periods,
        "rest_samples": limits.rest_samples,
        "most_held": MOST_HELD,
        "most_periods": MOST_PERIODS,
    }


def _filled(template: str, words: Mapping[str, object]) -> str:
    text = (files("autotune.export") / "c" / template).read_text("utf-8")
    # `$prefix_step` is `$prefix` and `_step`: a word ends where C's underscore goes on.
    return Template(re.sub(r"\$prefix(?=_)", "${prefix}", text)).substitute(words)


def gains_text(axis: AxisLaw) -> str:
    """Return an axis and its four gains with their units."""
    units = axis_units(axis.name)
    times = f"K_l {1e3 * axis.lead_s:g} ms, B_fb {1e3 * axis.feedback_damping_s:g} ms"
    biquad = "" if axis.biquad is None else f", biquad {axis.biquad.describe()}"
    return f"{axis.name}: M_a {axis.mass!r} {units.mass}, B_a {axis.damping!r} {units.damping}, {times}{biquad}"


def _about(controller: RuntimeController, provenance: Mapping[str, Any]) -> str:
    """Return lines of a comment: checksum, axes and what the file says of its origin, as JSON, which cannot end it."""
    lines = [f" * checksum {controller.checksum}, period {controller.sample_time_s!r} s"]
    for axis in controller.axes:
        (low, high), unit = axis.payload_range, axis_units(axis.name).mass
        lines.append(_ascii(f" * {gains_text(axis)}; payload {low!r} to {high!r} {unit}"))
    lines += [f" * {_quoted(key)}: {_quoted(value)}" for key, value in provenance.items()]
    return "\n".join(lines)


def _ascii(text: str) -> str:
    return text.replace("·", " ").replace("²", "^2").replace("ζ", "zeta")


def _quoted(value: object) -> str:
    plain = json.dumps(value, sort_keys=True, default=_mapping)
    return plain.replace("*", "\\u002a").replace("?", "\\u003f").replace("\x7f", "\\u007f")


def _mapping(value: Any) -> dict[str, Any]:
    return dict(value)


def _law(axis: AxisLaw, limits: tuple[float, float, float, float]) -> str:
    rows = ",\n".join(f"            {{{_numbers(axis.blocks[row, i] for i in range(3))}}}" for row in range(BLOCK_ROWS))
    numbers = _numbers((axis.deadband, *axis.payload_range, *limits))
    start = f"    {{{axis.index}, {int(axis.is_subtractive)}, {numbers}, /* {axis.name} */"
    variable, periods, vary = axis.variable_damping, 0, (0.0, 0.0, 0.0, 0.0)
    if variable is not None:
        periods = variable.update_periods
        vary = (variable.highest, variable.lowest, variable.decay_s_per_m, variable.largest_change)
    gains = _numbers((axis.mass, axis.start_damping, axis.lead_s))
    return f"{start}\n        {{\n{rows}\n        }},\n        {gains}, {periods}, {{{_numbers(vary)}}}}}"


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float) -> str:
    return float(value).hex()
