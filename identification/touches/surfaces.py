"""Surfaces of a log: what all contacts with one show of its loading stiffness, its hold and its first blow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray
from problems.frozen import freeze
from problems.text import significant

from ..errors import EstimateError
from ..result import EnvironmentEstimate, Estimate, Finding, LogPhase, Timeline, Touch, TouchCause
from ..signals.recording import Recording
from ..verdicts import judged, missing, unidentifiable
from .find import FoundTouch, find_touches, first_fall, touch_peak
from .findings import NOT_A_SPRING, between_samples, undetermined, withdrawn
from .inertia import KnownMotion, without_known
from .phases import about_led_walls, build_phases
from .signals import AxisSignals, axis_signals, turn_rates
from .signs import check_desired_force, check_force_sign
from .trace import TraceContact, identify_trace

# One more contact with a surface differs from those before it by about this share, where they do not show it.
_USUAL_SPREAD = 0.1
_FEWEST_LEFT_OUT = 3
_WEAK_SHARE = 0.5
_SAME_PLACE_M = 5e-3
_OTHER_STIFFNESS, _OTHER_STDS = 1.5, 3.0
_SAME_STIFFNESS = 1.25
# Of the depth: a displacement that begins no farther before the force is one since contact.
_CONTACT_SHARE = 0.2
# Of the level: between these a line shows how fast a force grows. One that grows with the cube of time took three
# times as long as the line says.
_RISE_SHARES = (0.5, 2.0)
_RISEN_SHARE = 0.75
_LONGEST_GROWTH = 3.5
_FREE_SHARE, _INSTANTS = 1.5, 200
# Of a payload on its coupling against a surface: from heavier ones than robots carry to none at all.
_COUPLED_HZ = np.geomspace(5.0, 500.0, 15)
_FREE_S, _FREE_UNTIL_S = 0.3, 0.05
_NARROW_SAMPLES = 3
# A blow that is too narrow for the samples has no bound; that it is up to twice its sample is taken for its usual size.
_NARROW_BLOW = 2.0
_PRESSED_SHARE = 0.9
_PEAK_OF_NOTE_N = 10.0
_MOST_WHYS = 3
_LOADING = "force over travel while it loads, behind the first blow: mean of its slope through the origin and its peak"
_BLOW = "force of the first blow over the speed of the approach"


@dataclass(frozen=True, kw_only=True)
class _Contact:
    """A touch of a wall; `trace` is None where it is too short, `blow_n` what the first blow may be."""

    touch: Touch
    place_m: float
    trace: TraceContact | None
    refused: str
    blow_n: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class Touched:
    """What a log shows of touches: time line, surfaces and moving mass by axis, and what is to be said of them."""

    timeline: Timeline
    surfaces: Mapping[str, tuple[EnvironmentEstimate, ...]]
    findings: tuple[Finding, ...]
    masses: Mapping[str, Estimate]

    def __post_init__(self) -> None:
        freeze(self, "surfaces", "masses")

    @property
    def shows_a_wall(self) -> bool:
        """Return whether something is touched that is no hand, if only until F^d turns away."""
        return any(touch.cause is TouchCause.WALL for touch in self.timeline.touches)

    @property
    def shows_more_than_a_hand(self) -> bool:
        """Return whether there is a surface, or touches into which no hand led."""
        touches = self.timeline.touches
        return bool(self.surfaces) or (bool(touches) and not any(touch.is_led for touch in touches))


def identify_touches(recording: Recording, known: KnownMotion | None = None) -> Touched:
    """Find the touches of a log without the payload's mass, and what they show of the surfaces.

    A displacement is a trace of one contact. A surface is what walls on one side of an axis are touched at one place,
    or with one stiffness; touches whose cause is not known are named in a finding. What `known` explains is no touch
    here. Raises EstimateError where each held force points along the approach, and where F^d points away from what is
    met.
    """
    signals = axis_signals(recording)
    if not recording.pose.is_displacement:
        check_force_sign(signals)
    touching = find_touches(signals, is_contact=recording.pose.is_displacement)
    found, about_payload, masses = without_known(touching, known, turn_rates(recording) if signals else None)
    check_desired_force(found)
    surfaces: dict[str, tuple[EnvironmentEstimate, ...]] = {}
    names: dict[tuple[str, float], str] = {}
    findings: list[Finding] = [*about_payload]
    for axis in found:
        walls = [each for each in axis.touches if each.touch.cause is TouchCause.WALL and not each.touch.is_withdrawn]
        contacts = [_contact(axis.signals, each, is_trace=recording.pose.is_displacement) for each in walls]
        estimates = []
        for i, group in enumerate(_grouped(contacts)):
            name = f"{axis.signals.axis}{i + 1}"
            surface = _surface(name, group)
            estimates.append(surface)
            findings += _about(surface, group)
            names |= {(axis.signals.axis, contact.touch.peak_s): name for contact in group}
        if estimates:
            surfaces[axis.signals.axis] = tuple(estimates)
        findings += [*about_led_walls(axis), *between_samples(axis)]
    touches = sorted(
        (
            replace(each.touch, surface=names.get((each.touch.axis, each.touch.peak_s)))
            for axis in found
            for each in axis.touches
        ),
        key=lambda touch: (touch.peak_s if touch.onset_s is None else touch.onset_s, touch.axis),
    )
    findings += [*undetermined(touches), *withdrawn(touches)]
    phases: tuple[LogPhase, ...] = build_phases(found, touches)
    return Touched(
        timeline=Timeline(phases=phases, touches=tuple(touches)),
        surfaces=surfaces,
        findings=tuple(findings),
        masses=masses,
    )


def _contact(axis: AxisSignals, found: FoundTouch, *, is_trace: bool) -> _Contact:
    """Return what one contact shows of its surface."""
    touch, start = found.touch, found.span.start
    used = found.span.slice
    depth, pressing = touch.sign * axis.travel_m, -touch.sign * axis.force_n
    open_m: float | None = None
    if is_trace and depth[start] < _CONTACT_SHARE * float(np.max(depth)):
        origin, used = 0.0, slice(None)
    else:
        origin, open_m = _onset_travel(axis, pressing, start)
    depth = depth[used] - touch.sign * origin
    trace, refused = None, ""
    if touch.is_led:
        refused = "a hand pressed with it"
    else:
        try:
            trace = identify_trace(depth, pressing[used], axis.period_s, open_m)
        except EstimateError:
            refused = f"{1e3 * np.max(depth):.2f} mm into it, logged at {axis.rate_hz:.0f} Hz, show no slope"
    return _Contact(
        touch=touch, place_m=touch.sign * origin, trace=trace, refused=refused, blow_n=_blow(axis, found, pressing)
    )


def _onset_travel(axis: AxisSignals, pressing: FloatArray, start: int) -> tuple[float, float]:
    """Return where the flange was when the payload met the surface, and the deviation of that place [m].

    The pressing force (n,) is above the level from the sample `start` on. On the sensor a contact of constant speed
    grows with τ − sin(ωτ)/ω, a payload of unknown mass on its coupling: with τ³ at first, with τ where ω is fast.
    Mean and deviation over all instants and ω, each as likely as its squares leave it.
    """
    time = axis.time_s - axis.time_s[start]
    before = pressing[slice(*np.searchsorted(time, (-_FREE_S, -_FREE_UNTIL_S)))]
    grown = pressing - (float(np.median(before)) if before.size else 0.0)
    longest, stop = _growth(time, grown, start)
    used = slice(int(np.searchsorted(time, -_FREE_SHARE * longest)), stop)
    begun = np.linspace(-longest, 0.0, _INSTANTS)
    since = np.maximum(time[used] - begun[:, None], 0.0)
    phase = 2.0 * np.pi * _COUPLED_HZ[:, None, None] * since
    shape = phase - np.sin(phase)
    square = np.maximum(np.sum(shape**2, axis=2), np.finfo(float).eps ** 2)
    left = np.sum(grown[used] ** 2) - np.maximum(np.sum(shape * grown[used], axis=2), 0.0) ** 2 / square
    least = np.finfo(float).eps * max(float(np.max(grown[used] ** 2)), 1.0)
    variance = max(axis.noise_n**2, float(np.min(left)) / since.shape[1], least)
    likely = np.sum(np.exp(-0.5 * (left - np.min(left)) / variance), axis=0)
    weights, places = likely / np.sum(likely), np.interp(begun, time, axis.travel_m)
    place = float(weights @ places)
    # Wrench and pose are samples of instants up to a step apart.
    step = abs(float(axis.travel_m[start] - axis.travel_m[max(0, start - 1)]))
    return place, float(np.sqrt(weights @ (places - place) ** 2 + step**2 / 12.0))


def _growth(time: FloatArray, grown: FloatArray, start: int) -> tuple[float, int]:
    """Return how long before `start` a force (n,) may have begun [s], and the sample behind its first rise."""
    level = max(float(grown[start]), 0.0)
    below = np.flatnonzero(grown[:start] < _RISE_SHARES[0] * level)
    ahead = grown[start:]
    above = np.flatnonzero(ahead > _RISE_SHARES[1] * level)
    fallen = np.flatnonzero(ahead < _RISEN_SHARE * np.maximum.accumulate(ahead))
    is_rising = above.size and (not fallen.size or above[0] < fallen[0])
    first = min(int(below[-1]) if below.size else 0, max(0, start - 1))
    last = start + int(above[0]) if is_rising else max(start, 1)
    rise = slice(first, last + 1)
    slope = float(np.polyfit(time[rise], grown[rise], 1)[0])
    longest = _LONGEST_GROWTH * level / slope if slope > 0.0 else 0.0
    return max(longest, 2.0 * float(time[rise.stop - 1] - time[rise.stop - 2])), rise.stop


def _blow(axis: AxisSignals, found: FoundTouch, pressing: FloatArray) -> tuple[float, float] | None:
    """Return what the peak of the first blow may be, None where a hand pushed or the speed is not known.

    A force that never falls from what it is then held at is a press, of which no part is a blow.
    """
    if found.touch.is_led or not found.touch.approach_speed or found.touch.approach_speed <= 0.0:
        return None
    fallen = first_fall(pressing[found.span.slice], axis.level_n)
    stop = found.span.stop if fallen is None else found.span.start + fallen
    hold, held = found.touch.hold_s, found.touch.held_force or 0.0
    is_pressed = held > _PRESSED_SHARE * found.touch.peak_force
    if hold is not None and is_pressed and float(axis.time_s[stop - 1]) > hold[0]:
        return None
    top = found.span.start + int(np.argmax(pressing[found.span.start : stop]))
    low, high, _ = touch_peak(axis, pressing, found.span.start, top)
    return low, _NARROW_BLOW * float(pressing[top]) if high is None else high


def _grouped(contacts: Sequence[_Contact]) -> list[list[_Contact]]:
    """Return the contacts by surface: on one side at one place unless their stiffness differs, or of one stiffness."""
    groups: list[list[_Contact]] = []
    for contact in contacts:
        fitting = [group for group in groups if any(_is_same(contact, other) for other in group)]
        if fitting:
            fitting[0].append(contact)
        else:
            groups.append([contact])
    return groups


def _is_same(one: _Contact, other: _Contact) -> bool:
    if one.touch.sign != other.touch.sign:
        return False
    is_near = abs(one.place_m - other.place_m) <= _SAME_PLACE_M
    if one.trace is None or other.trace is None:
        return is_near
    apart = abs(float(np.log(one.trace.loading_n_per_m / other.trace.loading_n_per_m)))
    if not is_near:
        return apart <= float(np.log(_SAME_STIFFNESS))
    # Put where another one was, a surface of another stiffness is another surface.
    known = [each.loading_std_n_per_m / each.loading_n_per_m for each in (one.trace, other.trace)]
    return apart <= max(float(np.log(_OTHER_STIFFNESS)), _OTHER_STDS * float(np.linalg.norm(known)))


def pooled(values: Sequence[float], stds: Sequence[float]) -> tuple[float, float, float | None]:
    """Return the mean of contacts, the deviation of one more contact, and the share by which they differ.

    The variance between contacts is that of the values, together with one contact that differs by a tenth: two contacts
    that happen to agree are no proof that the third will. Of three contacts and more the deviation is no smaller than
    `left_out_error`. The share is None for one contact.
    """
    known, own = np.array(values), np.array(stds)
    mean = float(np.mean(known))
    between = ((_USUAL_SPREAD * mean) ** 2 + float(np.sum((known - mean) ** 2))) / len(known)
    spread = float(np.std(known, ddof=1)) / abs(mean) if len(known) > 1 else None
    std = float(np.sqrt(between + np.mean(own**2) / len(own)))
    return mean, max(std, left_out_error(values) or 0.0), spread


def left_out_error(values: Sequence[float]) -> float | None:
    """Return the RMS error with which each contact is predicted by the mean of the others, None of fewer than three.

    Parameters
    ----------
    values
        What each contact shows of its surface, in any unit.

    """
    known = np.array(values)
    if len(known) < _FEWEST_LEFT_OUT:
        return None
    others = (float(np.sum(known)) - known) / (len(known) - 1)
    return float(np.sqrt(np.mean((known - others) ** 2)))


def _surface(name: str, contacts: Sequence[_Contact]) -> EnvironmentEstimate:
    traces = [contact.trace for contact in contacts if contact.trace is not None]
    refused = "; ".join(dict.fromkeys(contact.refused for contact in contacts if contact.refused))
    secant, relaxed, spread = unidentifiable(method=_LOADING, note=refused), None, None
    if traces:
        value, std, spread = _loading_of(traces)
        note = _spread_note([trace.loading_n_per_m for trace in traces], spread)
        secant = judged(value, std, method=_LOADING, note=note, weak=_WEAK_SHARE)
        relaxed = _relaxed(traces)
    above = "" if secant.value is None else f"; above the secant, {secant.value:.4g} N/m"
    impulses = [trace.spike.impulse_n_s for trace in traces if trace.spike is not None]
    return EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=unidentifiable(note=f"in series with a coupling that this log does not identify{above}"),
        secant_stiffness_n_per_m=secant,
        damping_n_s_per_m=unidentifiable(note="the motion of the payload behind the coupling is not identified"),
        mass_kg=unidentifiable(
            note=f"an impact spike of {np.mean(impulses):.2g} N·s; payload and surface share it"
            if impulses
            else "no impact spike"
        ),
        contacts=len(contacts),
        peak_force_n=tuple(contact.touch.peak_force for contact in contacts),
        relaxed_stiffness_n_per_m=relaxed,
        impact_n_s_per_m=_impact(contacts),
        contact_spread=spread,
    )


def _loading_of(traces: Sequence[TraceContact]) -> tuple[float, float, float | None]:
    return pooled([trace.loading_n_per_m for trace in traces], [trace.loading_std_n_per_m for trace in traces])


def _spread_note(values: Sequence[float], spread: float | None) -> str:
    if spread is None:
        return f"one contact: the next one is taken to differ by {100.0 * _USUAL_SPREAD:.0f} %"
    said, error = f"contacts differ by {100.0 * spread:.0f} %", left_out_error(values)
    if error is None:
        return said
    share = 100.0 * error / abs(float(np.mean(values)))
    return f"{said}; each of {len(values)} predicted by the others: RMS error {share:.0f} %"


def _relaxed(traces: Sequence[TraceContact]) -> Estimate | None:
    """Return force over travel where it is held, None without a hold."""
    held = [(trace.hold_secant_n_per_m, trace) for trace in traces if trace.hold_secant_n_per_m is not None]
    if not held:
        return None
    shares = [trace.secant_std_n_per_m / trace.secant_n_per_m for _, trace in held]
    value, std, _ = pooled([k for k, _ in held], [k * share for (k, _), share in zip(held, shares, strict=True)])
    return judged(value, std, method="mean force over mean travel of the hold", weak=_WEAK_SHARE)


def _impact(contacts: Sequence[_Contact]) -> Estimate | None:
    """Return the force of the first blow over the speed, from the middles of what it may be; None without one."""
    blows = [(c.blow_n, c.touch.approach_speed) for c in contacts]
    known = [(blow, speed) for blow, speed in blows if blow is not None and speed is not None and speed > 0.0]
    if not known:
        return None
    values = [0.5 * (low + high) / speed for (low, high), speed in known]
    stds = [(high - low) / np.sqrt(12.0) / speed for (low, high), speed in known]
    value, std, _ = pooled(values, [float(each) for each in stds])
    return judged(value, std, method=_BLOW, weak=_WEAK_SHARE)


def _without_stiffness(surface: EnvironmentEstimate, contacts: Sequence[_Contact]) -> Finding:
    """Return why contacts with a surface show no stiffness."""
    traces = [contact.trace for contact in contacts if contact.trace is not None]
    whys = [contact.refused for contact in contacts if contact.refused]
    if traces:
        value, std, _ = _loading_of(traces)
        whys.insert(0, f"of {significant(value)} ± {significant(std)} N/m more than half is open")
    different = [*dict.fromkeys(whys)]
    more = f"; and {len(different) - _MOST_WHYS} more" if len(different) > _MOST_WHYS else ""
    return Finding.warning(
        "no-stiffness",
        f"Surface {surface.name}: its stiffness cannot be determined: {'; '.join(different[:_MOST_WHYS])}{more}.",
        "Record wrench and pose at 500 Hz or more, and press harder, under a desired force or a command alone.",
    )


def _about(surface: EnvironmentEstimate, contacts: Sequence[_Contact]) -> list[Finding]:
    """Return what is to be said of a surface: why it has no stiffness, a blow first, and what is no spring."""
    name, is_known = surface.name, surface.secant_stiffness_n_per_m.value is not None
    found = [] if is_known else [_without_stiffness(surface, contacts)]
    traces = [contact.trace for contact in contacts if contact.trace is not None]
    spikes = [(trace.spike, trace.secant_n_per_m * trace.spike.depth_m) for trace in traces if trace.spike is not None]
    if spikes:
        blow = _span([spike.force_n for spike, _ in spikes])
        depth, slope = _span([1e3 * spike.depth_m for spike, _ in spikes]), _span([force for _, force in spikes])
        found.append(
            Finding.warning(
                "impact-spike",
                f"Surface {name}: {_count(spikes)} with a blow of {blow} N at {depth} mm, where the secant explains "
                f"{slope} N: masses meet, so a slope fitted there is no stiffness.",
                "Record wrench, whole pose and command, to determine the masses of payload and surface.",
            )
        )
    odd = [trace for trace in traces if trace.fit_error > NOT_A_SPRING and is_known]
    if odd:
        held = [1e-3 * each.hold_secant_n_per_m for each in odd if each.hold_secant_n_per_m is not None]
        loading, whole = (
            _span([1e-3 * getattr(each, key) for each in odd]) for key in ("loading_n_per_m", "secant_n_per_m")
        )
        found.append(
            Finding.warning(
                "secant-only",
                f"Surface {name}: {_count(odd)} with {loading} N/mm while it loads and {whole} N/mm over the whole "
                f"contact ({f'{_span(held)} N/mm held' if held else 'no hold'}), which leaves "
                f"{_span([100.0 * each.fit_error for each in odd])} % of the force unexplained: no single spring.",
                "Hold the contact for 1 s after the swings have died out.",
            )
        )
    return found


def _count(contacts: Sequence[object]) -> str:
    return "1 contact" if len(contacts) == 1 else f"{len(contacts)} contacts"


def _span(values: Sequence[float]) -> str:
    """Return the least and the largest of some numbers as text, one number where they are alike."""
    low, high = significant(min(values), 3), significant(max(values), 3)
    return low if low == high else f"{low} to {high}"


def no_contact(touched: Touched) -> Finding:
    """Return why a log shows no surface."""
    advice = "Record contacts that are approached under a desired force or a command, hands off."
    if touched.shows_a_wall:
        message = "The log shows no whole blow of what it touches, so no environment is identified."
        advice = "Keep pressing for a second after the touch."
    elif touched.timeline.touches:
        message = "None of the touches of the log can be distinguished from a hand, so no environment is identified."
    else:
        message = "Nothing presses against the motion in this log, so no environment is identified."
    return missing("no-contact", message, advice)
