"""Charts of a controller: contacts, admittance, Nyquist, margin and peak over stiffness, and maps of its gains."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from contourpy import contour_generator

from autotune.charts.chart import Band, Chart, Element, Heat, Limit, Line, Panel, Points, Role, Scale, Stretch
from autotune.errors import UsageError
from autotune.text import scenario_text, stiffness_text
from problems.arrays import ComplexArray, FloatArray
from problems.contact.transient import ContactTransient
from problems.design.requirements import AdmittanceTarget
from problems.maps.maps import MapAxis, MapRequest, compute_map
from problems.maps.parameters import CONTROLLER_FIELDS, MapQuantity, find_parameter
from problems.model.axis_kind import AxisKind, for_people
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.response import free_space_admittance, loop_response
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import frequency_grid

from .axis_design import AxisDesign, OverStiffness, contact_of, over_stiffness

_SHORTEST_S, _LONGEST_S = 0.15, 2.0
_SETTLED = 0.03
_LOOP_POINTS = 700
# What the picture shows of the plane of L, and how far its curves are carried, so that they end at the frame.
_RE, _IM, _FAR = (-2.3, 1.1), (-1.8, 1.1), 30.0
_STIFFNESS_POINTS, _BEYOND = 40, 3.0
_MAP_COUNT, _MAP_LOW, _MAP_HIGH = 40, 0.4, 2.5
_LEAST = {"lead_s": 0.02, "feedback_damping_s": 0.01}
_GAINS = {"mass": "mass", "damping": "damping", "lead": "lead_s", "feedback_damping": "feedback_damping_s"}
"""What a map of gains may vary, by the names of the Python interface."""


def contact_chart(design: AxisDesign, old: AdmittanceController | None = None) -> Chart | None:
    """Draw the hardest predicted contact, and the band of all of them; None where one of them is unstable.

    `old` is drawn on the same plants: its hardest contact at the surface, where it is stable.
    """
    scenarios = design.predicted.scenarios
    runs = [run for each in scenarios if (run := contact_of(design, design.law, each.scenario())) is not None]
    if not runs or len(runs) < len(scenarios):
        return None
    before = [] if old is None else [contact_of(design, old, each.scenario()) for each in scenarios]
    stable = [run for run in before if run is not None]
    hardest = max(stable, key=lambda run: run.peak_contact_force_n) if stable else None
    worst = max(range(len(runs)), key=lambda i: runs[i].peak_contact_force_n)
    units, run, case = design.units, runs[worst], scenarios[worst]
    duration = max(_duration(each) for each in (*runs, *(() if hardest is None else (hardest,))))
    lost = len(before) - len(stable)
    return Chart(
        key=f"{design.name}-contact",
        title=f"Predicted contact, {len(runs)} surfaces and payloads of the domain",
        alternative=f"{units.force_name.capitalize()} over time after touching {len(runs)} plants; the largest peak is "
        f"{run.peak_contact_force_n:.4g} {units.force} at the surface, {1e3 * run.time_of_peak_s:.0f} ms after "
        f"touching {stiffness_text(case.environment_stiffness_n_per_m, units)}."
        + ("" if hardest is None else f" Before it was up to {hardest.peak_contact_force_n:.4g} {units.force}."),
        caption=f"Line: the hardest of them, {scenario_text(case.scenario(), units)}. Shaded: what all of them reach."
        + ("" if hardest is None else " Grey: the hardest with the gains before, on the same plants.")
        + (f" In {lost} of them the loop before is unstable and not drawn." if lost else ""),
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]", limits=(0.0, 1e3 * duration)),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=tuple(_contact_elements(runs, run, hardest, duration)),
            ),
        ),
    )


def _mass(design: AxisDesign, mass: float) -> str:
    return f"{mass:.4g} {design.units.mass}"


def _contact_elements(
    runs: Sequence[ContactTransient], worst: ContactTransient, before: ContactTransient | None, duration: float
) -> Iterator[Element]:
    count = int(np.searchsorted(max(runs, key=lambda run: len(run.time_s)).time_s, duration)) + 1
    time = 1e3 * max(runs, key=lambda run: len(run.time_s)).time_s[:count]
    # A contact that has come to rest stays at its last force.
    forces = np.array([run.contact_force_n[np.minimum(np.arange(len(time)), len(run.time_s) - 1)] for run in runs])
    if len(runs) > 1:
        yield Band(
            x=time, low=forces.min(axis=0), high=forces.max(axis=0), label="all of them, at the surface", role="after"
        )
    if before is not None:
        used = before.time_s <= duration
        yield Line(x=1e3 * before.time_s[used], y=before.contact_force_n[used], label="before", role="before")
    used = worst.time_s <= duration
    seen = 1e3 * worst.time_s[used]
    yield Line(x=seen, y=worst.contact_force_n[used], label="the hardest, at the surface", role="after")
    yield Line(x=seen, y=worst.sensor_force_n[used], label="at the sensor", role="after", dashed=True)
    if worst.time_of_peak_s <= duration:
        peak = np.array([1e3 * worst.time_of_peak_s]), np.array([worst.peak_contact_force_n])
        yield Points(x=peak[0], y=peak[1], role="after", marker="diamond", names=("peak",))


def _duration(run: ContactTransient) -> float:
    """Return until when there is something to see [s]."""
    force = run.contact_force_n
    moving = np.flatnonzero(np.abs(force - force[-1]) > _SETTLED * run.peak_contact_force_n)
    last = float(run.time_s[moving[-1]]) if len(moving) else 0.0
    return min(max(1.15 * last, _SHORTEST_S), _LONGEST_S, max(float(run.time_s[-1]), _SHORTEST_S))


def admittance_chart(design: AxisDesign, old: AdmittanceController | None) -> Chart:
    """Draw the rendered admittance G = V/F in free space beside what was asked over the band."""
    frequency = np.geomspace(0.05, min(0.45 / design.sample_time_s, 200.0), 400)
    free, units = build_sampled_plant(design.free_plant(), design.sample_time_s), design.units
    asked = _admittance_asked(design)
    gains: list[Element] = []
    phases: list[Element] = []
    if asked is not None:
        band = Stretch(low=asked.band_hz[0], high=asked.band_hz[1], label="band that is asked", role="target")
        least = np.full(2, asked.min_m_s_per_n)
        gains += [band, Line(x=np.array(asked.band_hz), y=least, label="asked", role="target")]
        phases.append(band)
    for name, law in (("before", old), ("after", design.law)):
        if law is not None:
            role: Role = "after" if name == "after" else "before"
            found = free_space_admittance(free, law, 2.0 * np.pi * frequency)
            label = "" if old is None else name
            gains.append(Line(x=frequency, y=np.abs(found), label=label, role=role))
            phases.append(Line(x=frequency, y=np.degrees(np.unwrap(np.angle(found))), label=label, role=role))
    x = Scale(label="frequency [Hz]", spacing="log")
    reached = design.predicted.free_space_admittance
    target = "" if asked is None else f"; asked are {asked.min_m_s_per_n:.3g} {units.admittance}"
    return Chart(
        key=f"{design.name}-admittance",
        title="How freely it moves: admittance in free space",
        alternative=f"Magnitude and phase of the velocity per {units.force_name} from 0.05 to {frequency[-1]:.0f} Hz. "
        f"From {reached.band_hz[0]:g} to {reached.band_hz[1]:g} Hz it is at least {reached.min_m_s_per_n:.3g} "
        f"{units.admittance}{target}.",
        panels=(
            Panel(x=x, y=Scale(label=f"|G| [{units.admittance}]", spacing="log"), elements=tuple(gains)),
            Panel(x=x, y=Scale(label="phase [°]"), elements=tuple(phases), height=0.7),
        ),
        linked=True,
    )


def _admittance_asked(design: AxisDesign) -> AdmittanceTarget | None:
    soft = design.soft.get("free_space_admittance")
    asked = design.asked.get("free_space_admittance") if soft is None else soft.asked
    return asked if isinstance(asked, AdmittanceTarget) else None


def nyquist_chart(design: AxisDesign, old: AdmittanceController | None) -> Chart:
    """Draw L at both break points, and the disk that it must not enter."""
    h = design.sample_time_s
    worst = design.worst_plant() or design.corners()[-1]
    curves: list[tuple[str, Role, tuple[ComplexArray, ComplexArray]]] = []
    for i, plant in enumerate(design.corners()):
        corner = build_sampled_plant(plant, h)
        found = loop_response(corner, design.law, frequency_grid(corner, _LOOP_POINTS))
        name = "" if i else "ends of the domain"
        curves.append((name, "quiet", (found.at_force, found.at_command)))
    sampled = build_sampled_plant(worst, h)
    frequency = frequency_grid(sampled, _LOOP_POINTS)
    if old is not None and spectral_radius(build_loop(sampled, old)) < 1.0:
        found = loop_response(sampled, old, frequency)
        curves.append(("before, same plant", "before", (found.at_force, found.at_command)))
    found = loop_response(sampled, design.law, frequency)
    curves.append(("worst plant", "after", (found.at_force, found.at_command)))
    radius, asked = design.margins.modulus, design.modulus_asked
    panels = tuple(
        Panel(
            title=f"cut at the {where}",
            x=Scale(label="Re L", limits=_RE),
            y=Scale(label="Im L", limits=_IM),
            elements=(*_disk(asked, radius), *(_locus(name, role, pair[k]) for name, role, pair in curves)),
            height=1.45,
            equal=True,
        )
        for k, where in enumerate(("force", "command"))
    )
    required = "" if asked is None else f" Asked are {asked:g}: the dashed circle."
    return Chart(
        key=f"{design.name}-nyquist",
        title="How far from instability: Nyquist",
        alternative=f"The open loop, cut at the force and at the command, around the point −1. Over the whole domain "
        f"it stays {radius:.3f} away from it.{required}",
        caption="Positive frequencies; at low ones the curves go on beyond the frame. "
        f"Over the whole domain L stays {radius:.3f} away from −1 (modulus margin)."
        + ("" if asked is None else f" The dashed circle is what was asked, {asked:g}."),
        panels=panels,
        beside=True,
    )


def _disk(asked: float | None, reached: float) -> Iterator[Element]:
    turn = np.linspace(0.0, 2.0 * np.pi, 121)
    for radius, role, name in ((reached, "bad", "reached"), (asked, "target", "asked")):
        if radius is not None:
            shade: Role = "target" if role == "target" else "bad"
            x, y = -1.0 + radius * np.cos(turn), radius * np.sin(turn)
            yield Line(x=x, y=y, label=f"{name} {radius:.3g}", role=shade, dashed=name == "asked")
    yield Points(x=np.array([-1.0]), y=np.array([0.0]), role="bad", names=("−1",))


def _locus(name: str, role: Role, loop: ComplexArray) -> Line:
    inside = np.abs(loop) <= _FAR
    shown = np.where(inside, loop, np.nan + 0j)
    imaginary = np.where(inside, shown.imag, np.nan)
    return Line(x=shown.real, y=imaginary, label=name, role=role, dashed=role == "before")


def stiffness_chart(design: AxisDesign, old: AdmittanceController | None) -> Chart:
    """Draw modulus margin and peak over K_e, inside the certified interval and beyond it."""
    low, high = design.domain.environment_stiffness_n_per_m
    grid = np.geomspace(max(low, 1e-3 * high) / _BEYOND, high * _BEYOND, _STIFFNESS_POINTS)
    units, masses = design.units, sorted(set(design.domain.payload_mass_kg))
    scale, unit = units.shown_stiffness
    now = [over_stiffness(design, design.law, mass, grid) for mass in masses]
    roles: tuple[Role, ...] = ("after", "model")
    before = [] if old is None else [over_stiffness(design, old, mass, grid) for mass in masses[-1:]]
    certified = Stretch(low=scale * low, high=scale * high, label="certified", role="target")
    x = Scale(label=f"environment stiffness K_e [{unit}]", spacing="log")
    asked = design.modulus_asked
    limits = () if asked is None else (Limit(value=asked, label="asked", role="bad"),)
    cases: list[tuple[str, Role, OverStiffness]] = [
        (f"before, {_mass(design, each.payload_mass_kg)}", "before", each) for each in before
    ]
    cases += [(_mass(design, each.payload_mass_kg), roles[i], each) for i, each in enumerate(now)]
    predicted = design.predicted.scenarios
    dots = Points(
        x=scale * np.array([each.environment_stiffness_n_per_m for each in predicted]),
        y=np.array([each.peak_contact_force_n for each in predicted]),
        label="predicted in the file",
        role="other",
        names=tuple(each.name for each in predicted),
    )
    return Chart(
        key=f"{design.name}-stiffness",
        title="How it depends on what is touched",
        alternative=f"Modulus margin and peak contact {units.force_name} over the environment stiffness from "
        f"{scale * grid[0]:.3g} to {scale * grid[-1]:.3g} {unit}. {_extremes_inside(now, low, high, units)}",
        caption="Shaded: the interval that the certificate speaks of; beyond it nothing is promised. "
        "A curve ends where the loop is unstable.",
        panels=(
            Panel(
                x=x,
                y=Scale(label="modulus margin", limits=(0.0, _highest(now, before))),
                elements=(certified, *limits, *_proved(design, scale), *_curves(cases, scale, "modulus")),
            ),
            Panel(
                x=x,
                y=Scale(label=f"peak [{units.force}]"),
                elements=(certified, *_curves(cases, scale, "peak_n"), dots),
            ),
        ),
        linked=True,
    )


def _proved(design: AxisDesign, scale: float) -> Iterator[Line]:
    """Yield the modulus that is proved over K_e and M_p, as far as it is."""
    for region in design.regions[:1]:
        ends = scale * np.array(region.environment_stiffness_n_per_m)
        if ends[1] > ends[0]:
            yield Line(x=ends, y=np.full(2, region.modulus), label="proved", role="good")


def _highest(*cases: Sequence[OverStiffness]) -> float:
    """Return the end of the margin's side: it begins at 0, so that a flat curve looks flat."""
    values = np.concatenate([each.modulus for group in cases for each in group])
    return 1.15 * float(np.nanmax(values, initial=0.5))


def _curves(cases: Sequence[tuple[str, Role, OverStiffness]], scale: float, what: str) -> Iterator[Line]:
    for name, role, each in cases:
        yield Line(x=scale * each.stiffness, y=getattr(each, what), label=name, role=role, dashed=role == "before")


def _extremes_inside(now: Sequence[OverStiffness], low: float, high: float, units: AxisKind) -> str:
    inside = [(each.stiffness >= low) & (each.stiffness <= high) for each in now]
    margins = np.concatenate([each.modulus[kept] for each, kept in zip(now, inside, strict=True)])
    peaks = np.concatenate([each.peak_n[kept] for each, kept in zip(now, inside, strict=True)])
    if not np.any(np.isfinite(margins)) or not np.any(np.isfinite(peaks)):
        return ""
    return (
        f"Inside the certified interval the margin is at least {np.nanmin(margins):.3f} and the peak at most "
        f"{np.nanmax(peaks):.4g} {units.force}."
    )


def map_chart(design: AxisDesign) -> Chart:
    """Draw the smallest modulus margin over two pairs of gains, with the design in them."""
    return _gain_maps(design, (("damping", "lead_s"), ("mass", "feedback_damping_s")))


def gain_map_chart(design: AxisDesign, x: str, y: str) -> Chart:
    """Draw the same over two gains of choice; raises UsageError for another name than of `_GAINS`, or one twice.

    Names are those of `_GAINS` or of `autotune map`.
    """
    first, second = (next((key for name, key in _GAINS.items() if each in (name, key)), "") for each in (x, y))
    if "" in (first, second) or first == second:
        raise UsageError(f"A map takes two different gains of {', '.join(_GAINS)}; found {x} and {y}.")
    return _gain_maps(design, ((first, second),))


def _gain_maps(design: AxisDesign, pairs: Sequence[tuple[str, str]]) -> Chart:
    worst = design.worst_plant()
    plants = tuple(dict.fromkeys((*design.corners(), *(() if worst is None else (worst,)))))
    axes = [(_gain_axis(design, x), _gain_axis(design, y)) for x, y in pairs]
    margins = [_smallest_margin(design, plants, x, y) for x, y in axes]
    highest = max(float(np.nanmax(margin, initial=design.margins.modulus)) for margin in margins)
    shares = [
        f"{find_parameter(x.name).label} and {find_parameter(y.name).label} ({np.mean(np.isfinite(margin)):.0%} stable)"
        for (x, y), margin in zip(axes, margins, strict=True)
    ]
    return Chart(
        key="-".join((design.name, "map", *(pairs[0] if len(pairs) == 1 else ()))),
        title="Where the gains are stable",
        alternative=f"The smallest modulus margin over {', and over '.join(shares)}, with the design marked at "
        f"{design.margins.modulus:.3f}.",
        caption=f"Colour: the smallest modulus margin over {len(plants)} plants, the ends of the domain and its worst "
        "case, free space included. Grey: unstable.",
        panels=tuple(
            _map_panel(design, x, y, margin, (0.0, highest), (_gain(design, x.name), _gain(design, y.name)))
            for (x, y), margin in zip(axes, margins, strict=True)
        ),
        beside=True,
    )


def _gain(design: AxisDesign, name: str) -> float:
    return float(getattr(design.law, CONTROLLER_FIELDS[name]))


def _gain_axis(design: AxisDesign, name: str) -> MapAxis:
    """Return an axis around a gain of the design; one that may be 0 begins there and goes on at least to `_LEAST`."""
    value, least = _gain(design, name), _LEAST.get(name)
    low, high = (_MAP_LOW * value, _MAP_HIGH * value) if least is None else (0.0, max(_MAP_HIGH * value, least))
    return MapAxis(name=name, low=low, high=high, count=_MAP_COUNT)


def _smallest_margin(design: AxisDesign, plants: Sequence[Plant], x: MapAxis, y: MapAxis) -> FloatArray:
    found = np.full((y.count, x.count), np.inf)
    for plant in plants:
        request = MapRequest(
            plant=plant,
            controller=design.law,
            sample_time_s=design.sample_time_s,
            x=x,
            y=y,
            quantity=MapQuantity.MODULUS,
            where="free_space" if plant.environment.is_free_space else "both",
        )
        found = np.minimum(found, compute_map(request).values)
    return found


def _map_panel(
    design: AxisDesign,
    x: MapAxis,
    y: MapAxis,
    margin: FloatArray,
    colours: tuple[float, float],
    point: tuple[float, float],
) -> Panel:
    of: dict[str, Any] = {"label": "smallest modulus margin", "limits": colours, "hole": "unstable"}
    heat = Heat(x=x.values(), y=y.values(), values=margin, **of)
    elements: list[Element] = [heat]
    if design.modulus_asked is not None:
        edge = level_lines(heat, design.modulus_asked)
        if len(edge[0]):
            elements.append(Line(x=edge[0], y=edge[1], label="margin as asked", role="bad", dashed=True))
    star: dict[str, Any] = {"role": "bad", "marker": "star", "names": ("the design",)}
    elements.append(Points(x=np.array(point[:1]), y=np.array(point[1:]), label="the design", **star))
    sides, factors = [], []
    for axis in (x, y):
        parameter = find_parameter(axis.name)
        factor, unit = for_people(parameter.unit_of(rotational=design.units.force != "N"))
        factors.append(factor)
        label = f"{parameter.label} {parameter.symbol}" + (f" [{unit}]" if unit else "")
        sides.append(Scale(label=label, spacing=axis.spacing))
    return Panel(x=sides[0], y=sides[1], elements=tuple(elements), height=1.35).in_units(*factors)


def level_lines(heat: Heat, level: float) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the lines on which a map has the value `level`, each ended by NaN; unstable counts as 0."""
    found = contour_generator(heat.x, heat.y, np.nan_to_num(heat.values, nan=0.0)).lines(level)
    gap = np.array([[np.nan, np.nan]])
    points = np.concatenate([part for line in found for part in (np.asarray(line), gap)] or [np.empty((0, 2))])
    return points[:, 0], points[:, 1]
