"""Two controllers side by side on the same plants: whose the grey curves are, and what both reach."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from autotune.formats.canonical import short
from autotune.formats.controller import ControllerFile
from autotune.validation.validate import admittance_controller
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.response import free_space_admittance
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

from .axis_design import AxisDesign, contact_of
from .controller_tables import number
from .page import Block, Cell, Note, Table, Tone

_UNSTABLE = "unstable"
_BAND_POINTS = 100
_PEAKS = ("peak_contact_force_n", "peak_sensor_force_n")
_MARGINS = (
    ("modulus margin", "modulus", 1.0),
    ("gain margin [dB]", "gain_db", 1.0),
    ("phase margin [°]", "phase_deg", 1.0),
    ("delay margin [ms]", "delay_s", 1e3),
)


def law_before(old: ControllerFile | None, axis: str) -> AdmittanceController | None:
    """Return what another controller runs on an axis, None where it does not know it."""
    return None if old is None or axis not in old.controller.axes else admittance_controller(old.controller, axis)


def compared_blocks(design: AxisDesign, old: ControllerFile | None, checksum: str) -> Iterator[Block]:
    """Yield the comparison of one axis with another controller, nothing where there is none; `checksum` is its own."""
    if old is None:
        return
    law = law_before(old, design.name)
    if law is None:
        yield Note(text=f"{old.path.name} has no axis {design.name} to compare with.", kind="before", tone="quiet")
        return
    if law == design.law:
        yield Note(
            text=f"{old.path.name} has the same gains: what is drawn for before lies under what is drawn for after.",
            kind="before",
            tone="warn",
        )
    yield _table(design, law, old, checksum)


def _table(design: AxisDesign, law: AdmittanceController, old: ControllerFile, checksum: str) -> Table:
    plants, units = _plants(design), design.units
    rows = [("checksum", short(old.checksum), short(checksum))]
    for title, name, scale in (
        (f"M_a [{units.mass}]", "mass_kg", 1.0),
        (f"B_a [{units.damping}]", "damping_n_s_per_m", 1.0),
        ("K_l [ms]", "lead_s", 1e3),
        ("B_fb [ms]", "feedback_damping_s", 1e3),
    ):
        before, after = (f"{scale * getattr(each, name):.6g}" for each in (law, design.law))
        rows.append((title, before, after))
    rows += zip(
        (
            f"largest peak at the contact [{units.force}]",
            f"largest peak at the sensor [{units.force}]",
            *(title for title, _, _ in _MARGINS),
            f"least free-space admittance [{units.admittance}]",
        ),
        *(_reached(design, each, plants) for each in (law, design.law)),
        strict=True,
    )
    return Table(
        caption=f"Axis {design.name}, before and after on the same {len(design.predicted.scenarios)} contacts and "
        f"{len(plants)} plants of the domain, its ends and its worst cases; before is {old.path.name}",
        columns=("", "before", "after"),
        rows=tuple(
            (Cell(text=title), *(Cell(text=text, is_number=True, tone=_tone(text)) for text in (before, after)))
            for title, before, after in rows
        ),
    )


def _tone(text: str) -> Tone:
    return "bad" if text == _UNSTABLE else ""


def _plants(design: AxisDesign) -> tuple[Plant, ...]:
    """Return the ends of the domain in contact, free space, and where the certificate found each margin smallest."""
    worst = (design.worst_plant(name) for _, name, _ in _MARGINS)
    return tuple(dict.fromkeys((*design.corners(), design.free_plant(), *(each for each in worst if each is not None))))


def _reached(design: AxisDesign, law: AdmittanceController, plants: Sequence[Plant]) -> tuple[str, ...]:
    """Return peaks, margins and admittance of one controller; of a loop that is unstable somewhere there are none."""
    runs = [contact_of(design, law, each.scenario()) for each in design.predicted.scenarios]
    stable = [run for run in runs if run is not None]
    peaks = [max((getattr(run, name) for run in stable), default=math.nan) for name in _PEAKS]
    told = [f"{peak:.4g}" if len(stable) == len(runs) else _UNSTABLE for peak in peaks]
    h = design.sample_time_s
    try:
        found = [find_margins(build_sampled_plant(plant, h), law) for plant in plants]
    except UnstableLoopError:
        return (*told, *(_UNSTABLE for _ in _MARGINS), _UNSTABLE)
    told += [number(min(getattr(each, name) for each in found), scale) for _, name, scale in _MARGINS]
    low, high = design.predicted.free_space_admittance.band_hz
    band = 2.0 * np.pi * np.geomspace(low, high, _BAND_POINTS)
    least = np.min(np.abs(free_space_admittance(build_sampled_plant(design.free_plant(), h), law, band)))
    return (*told, f"{least:.4g}")
