"""What the page says beside the figures, as safe HTML."""

import math
from html import escape
from pathlib import Path

from autotune.formats.units import AxisUnits

from .save import Saved
from .view import View

_UNSEEN = "–"
_TITLES = {
    "gain_margin_db": "gain margin",
    "phase_margin_deg": "phase margin",
    "delay_margin_s": "delay margin",
    "decay_rate_per_s": "decay rate",
    "max_peak_force_n": "peak force",
    "free_space_admittance": "free-space admittance",
}

BUSY = '<p class="quiet busy">Judging the design over the whole set, proving, validating …</p>'


def requirement_title(name: str) -> str:
    """Return what a requirement is called on the page."""
    return _TITLES.get(name, name.replace("_", " "))


def verdict(view: View, count: int) -> str:
    """Say in one sentence whether the design holds on the plants that are looked at."""
    if view.evaluation.is_stable and not view.missed:
        return _line("good", f"Meets every requirement on all {count} plants of the map.")
    if view.evaluation.is_stable:
        missed = ", ".join(f"{requirement_title(name)} ({_share(value)})" for name, value in view.missed.items())
        return _line("warn", f"Stable, but misses {missed}, worst of {count} plants.")
    here = f"|z| = {view.radius:.4f}" if view.radius >= 1.0 else f"|z| = {view.evaluation.spectral_radius:.4f}"
    where = "on the plant that you look at" if view.radius >= 1.0 else "on another plant of the range"
    return _line("bad", f"Unstable {where} (largest {here}): a peak of it is not a number.")


def _share(ratio: float) -> str:
    return f"{min(100.0 / ratio, 99.9):.3g} %" if math.isfinite(ratio) else "none of it"


def facts(view: View, units: AxisUnits, hand: float) -> str:
    """Return the numbers of one view as a list of terms."""
    run, margins, worst = view.transient, view.margins, view.evaluation.peaks
    peak = max((each.peak_contact_force_n for each in worst), default=math.nan)
    told = [
        ("peak at the contact", _number(run.peak_contact_force_n if run else None, units.force)),
        ("peak at the sensor", _number(run.peak_sensor_force_n if run else None, units.force)),
        ("worst peak of all plants", _number(None if math.isnan(peak) else peak, units.force)),
        ("modulus margin", _number(margins.modulus if margins else None, "")),
        ("gain margin", _number(margins.gain_db if margins else None, "dB")),
        ("phase margin", _number(margins.phase_deg if margins else None, "°")),
        ("delay margin", _number(1e3 * margins.delay_s if margins else None, "ms")),
        (f"hand {units.force_name} per speed", _number(hand, units.hand)),
    ]
    rows = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in told)
    return f"<dl>{rows}</dl>"


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return _UNSEEN
    return f"{value:.4g} {unit}".rstrip() if math.isfinite(value) else "no limit"


def saved_line(saved: Saved, force: str) -> str:
    """Say what was written."""
    peaks = ", ".join(f"{name} {value:.4g} {force}" for name, value in saved.peak_n.items())
    replaced = f", in place of {saved.replaced}" if saved.replaced else ""
    return _line(
        "good",
        f"Validated ({saved.checks} checks) and written: {saved.path}, checksum {saved.checksum}{replaced}. "
        f"Worst peak: {peaks}.",
    )


def held_line(path: Path, standing: str) -> str:
    """Say what saving to `path` replaces; `standing` is what stands there, "" for nothing."""
    return plain_line(f"Replaces {path}, {standing}." if standing else f"Writes {path}, which does not exist yet.")


def earlier_line(line: str) -> str:
    """Return a line with the remark that it is about another design than the present one."""
    return f'<div class="earlier">{plain_line("Of an earlier design:")}{line}</div>'


def refused_line(reason: str) -> str:
    """Say why nothing was written."""
    return _line("bad", f"Not written. {reason}")


def plain_line(text: str) -> str:
    """Return a remark."""
    return _line("quiet", text) if text else ""


def _line(tone: str, text: str) -> str:
    return f'<p class="{tone}">{escape(text)}</p>'
