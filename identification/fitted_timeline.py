"""Time line, touches and surfaces of a log, by the payload and the coupling that the fit of each axis knows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from .axes.straight import AXIS_NAMES
from .axes.turning import LEVER_M
from .axis_estimate import AxisResult, CellSignals
from .result import AxisEstimate, EnvironmentEstimate, Finding, Timeline
from .timeline.contacts import find_contacts
from .timeline.left_contacts import Accounted, ObservedAxis, account_for_contacts
from .timeline.payload import observe_payload
from .timeline.timeline import build_timeline, name_surfaces
from .timeline.touches import touches_of


def account_for_log(cell: CellSignals, results: Mapping[str, AxisResult], mass_kg: float) -> tuple[Accounted, Timeline]:
    """Return the surfaces of all contacts, and what happened when.

    Parameters
    ----------
    cell
        The signals that the axes share.
    results
        The axes by name, with the contacts and the fit of each.
    mass_kg
        M_p [kg].

    """
    contacts, period = [axis.contacts for axis in results.values()], cell.log.period_s
    payloads = [observe_payload(of, period) for of in contacts]
    pressed = [find_contacts(of, seen, cell.motion, period) for of, seen in zip(contacts, payloads, strict=True)]
    phases = build_timeline(cell.log, cell.motion, cell.force_S_n, contacts, cell.recording.command, mass_kg, pressed)
    axes = []
    for (name, axis), payload, found in zip(results.items(), payloads, pressed, strict=True):
        surfaces = () if axis.fit is None else axis.fit.surfaces
        # What the fit leaves without a stiffness is none of its surfaces: the slope of force over depth may show one.
        known = [each.stiffness_n_per_m.value is not None for each in axis.estimate.environments]
        onsets = [[t * period for t in each.onsets] if ok else [] for each, ok in zip(surfaces, known, strict=True)]
        phases = name_surfaces(phases, name, onsets)
        signs = [surface.sign for surface in surfaces]
        axes.append(
            ObservedAxis(
                of=axis.contacts,
                payload=payload,
                pressed=found,
                coupling=axis.estimate.coupling.stiffness_n_per_m,
                surfaces=tuple(zip(signs, axis.estimate.environments, strict=True)),
                lever_m=1.0 if name in AXIS_NAMES else LEVER_M,
            )
        )
    accounted = account_for_contacts(phases, axes, period)
    touches = touches_of(cell.recording, cell.log, axes, accounted.phases)
    return accounted, Timeline(phases=accounted.phases, touches=touches)


def with_surfaces(axis: AxisEstimate, added: Sequence[EnvironmentEstimate]) -> AxisEstimate:
    """Return the axis with the surfaces that slopes show, in place of those that the fit leaves without a stiffness."""
    fitted = [each for each in axis.environments if not added or each.stiffness_n_per_m.value is not None]
    return replace(axis, environments=(*fitted, *added))


def without_surface(findings: Sequence[Finding], accounted: Accounted) -> Iterator[Finding]:
    """Yield the findings without those that no contact was found where a slope shows the surface."""
    return (each for each in findings if each.code != "no-contact" or not accounted.surfaces.get(each.axis or ""))


def hand_findings(timeline: Timeline) -> list[Finding]:
    """Report of contacts during which somebody pushed."""
    pushed = [p for p in timeline.phases if p.contact is not None and p.contact.hand_suspected]
    if not pushed:
        return []
    when = ", ".join(f"{phase.start_s:.1f} s" for phase in pushed)
    return [
        Finding(
            code="hand-in-contact",
            severity="warning",
            message=f"During the contact at {when} the force does not follow depth and speed as on a surface: a hand "
            "may have pushed, or what is touched gave way.",
            advice="Keep hands off the payload while it touches, clamp what it presses on, and record these contacts "
            "again.",
        )
    ]
