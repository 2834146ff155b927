"""Texts of the page beside the figures, as safe HTML."""

import math
from html import escape

from autotune.plugins import find_requirement
from problems.design.requirements import MARGINS
from problems.model.axis_kind import AxisKind

from .view import View

_UNSEEN = "–"


def requirement_title(name: str) -> str:
    """Return what a requirement is called on the page."""
    found = find_requirement(name)
    return name.replace("_", " ") if found is None else found.title


def verdict(view: View, count: int) -> str:
    """Say in one sentence whether the design holds on the plants that are looked at."""
    if view.evaluation.is_stable and not view.missed:
        return line("good", f"Meets every requirement on all {count} plants of the map.")
    if view.evaluation.is_stable:
        missed = ", ".join(f"{requirement_title(name)} ({_share(value)})" for name, value in view.missed.items())
        return line("warn", f"Stable, but misses {missed}, worst of {count} plants.")
    here = f"|z| = {view.radius:.4f}" if view.radius >= 1.0 else f"|z| = {view.evaluation.spectral_radius:.4f}"
    where = "on the plant that you look at" if view.radius >= 1.0 else "on another plant of the range"
    return line("bad", f"Unstable {where} (largest {here}), so it has no peak.")


def _share(ratio: float) -> str:
    return f"{min(100.0 / ratio, 99.9):.3g}\u00a0% of it" if math.isfinite(ratio) else "none of it"


def facts(view: View, units: AxisKind, hand: float) -> str:
    """Return the numbers of one view as a list of terms."""
    run, margins, worst = view.transient, view.margins, view.evaluation.peaks
    peak = max((each.peak_contact_force_n for each in worst), default=math.nan)
    terms = [
        ("peak at the contact", _number(run.peak_contact_force_n if run else None, units.force)),
        ("peak at the sensor", _number(run.peak_sensor_force_n if run else None, units.force)),
        ("worst peak of all plants", _number(None if math.isnan(peak) else peak, units.force)),
        *(
            (of.title, _number(of.shown_scale * getattr(margins, of.margin) if margins else None, of.unit))
            for of in MARGINS
        ),
        (f"hand {units.force_name} per speed", _number(hand, units.hand)),
    ]
    rows = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in terms)
    return f"<dl>{rows}</dl>"


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return _UNSEEN
    return f"{value:.4g} {unit}".rstrip() if math.isfinite(value) else "no limit"


def plain_line(text: str) -> str:
    """Return a remark."""
    return line("quiet", text) if text else ""


def line(tone: str, text: str) -> str:
    """Return a paragraph of the class `tone`."""
    return f'<p class="{tone}">{escape(text)}</p>'
