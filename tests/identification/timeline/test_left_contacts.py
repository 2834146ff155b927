"""Every touch ends in a surface or in a finding of severity error; scipy integrates payload and wall."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from identification.result import CONTACT_UNEXPLAINED, EnvironmentEstimate, Estimate, Status
from identification.signals.segments import Span
from identification.timeline import left_contacts
from identification.timeline.contacts import find_contacts
from identification.timeline.left_contacts import (
    Accounted,
    ContactSlope,
    ObservedAxis,
    account_for_contacts,
    learn_slope,
)
from identification.timeline.timeline import build_timeline
from identification.verdicts import unidentifiable
from problems.arrays import FloatArray
from tests.identification.signals.test_segments import line, log_of
from tests.identification.synthetic import ramp
from tests.identification.timeline.test_contacts import H_S, LOAD, WALL_M, Press, driven, pressed, there_and_back

K_S = Estimate(value=LOAD.stiffness, std=0.01 * LOAD.stiffness, status=Status.IDENTIFIED)
UNDECIDED = unidentifiable(note="not identified")


@cache
def restless(stiffness: float, force_n: float, chatter_n: float = 0.0) -> Press:
    """Press for a second without ever coming to rest, and with `chatter_n` shaken off the wall 12 times a second."""
    rest, way = np.zeros(round(0.8 / H_S)), ramp(round(0.6 / H_S))
    time = np.arange(round(1.0 / H_S)) * H_S
    steady = WALL_M + force_n / stiffness + force_n / LOAD.stiffness
    swing = (max(chatter_n, 0.4 * force_n) / stiffness) * np.sin(2.0 * np.pi * (12.0 if chatter_n else 3.0) * time)
    # A swing is 3 periods or 12, so the way begins and ends in the middle.
    return driven(stiffness, np.concatenate([rest, steady * way, steady + swing, steady * way[::-1], rest]))


def pushed() -> Press:
    """Move 4 mm, rest for 1.2 s with 30 N on the payload but for the first and last 0.1 s, and go back."""
    rest, way, stay = np.zeros(round(0.8 / H_S)), 4e-3 * ramp(round(0.6 / H_S)), round(1.2 / H_S)
    free = driven(2e5, np.concatenate([rest, way, np.full(stay, way[-1]), way[::-1], rest]))
    force, edge = free.force_n.copy(), round(0.1 / H_S)
    begin = len(rest) + len(way)
    force[begin + edge : begin + stay - edge] -= 30.0
    return replace(free, force_n=force)


def seen(
    *presses: Press, fitted: EnvironmentEstimate | None = None, sign: float = 1.0, coupling: Estimate = K_S
) -> tuple[Accounted, ObservedAxis]:
    """What the time line finds of one axis, and where it ends."""
    position = np.concatenate([press.position_m for press in presses])
    force = np.concatenate([press.force_n for press in presses])
    of, payload, motion = pressed(position, force, sign=sign)
    found = find_contacts(of, payload, motion, H_S)
    log = log_of(line(position))
    phases = build_timeline(log, motion, log.force_S_n, [of], None, LOAD.mass, [found])
    surfaces = () if fitted is None else ((int(sign), fitted),)
    axis = ObservedAxis(of=of, payload=payload, pressed=found, coupling=coupling, surfaces=surfaces)
    return account_for_contacts(phases, [axis], H_S), axis


def surface(name: str, stiffness: float) -> EnvironmentEstimate:
    known = Estimate(value=stiffness, std=1e-3 * stiffness, status=Status.IDENTIFIED)
    return EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=known,
        secant_stiffness_n_per_m=known,
        damping_n_s_per_m=UNDECIDED,
        mass_kg=UNDECIDED,
        contacts=1,
        peak_force_n=(30.0,),
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("chatter_n", [0.0, 60.0])
@pytest.mark.parametrize("stiffness", [3e4, 2e5, 6e5])
def test_a_press_without_a_hold_is_a_weak_surface_whose_range_holds_the_wall(
    stiffness: float, chatter_n: float, sign: float
) -> None:
    accounted, _ = seen(restless(stiffness, 40.0, chatter_n), sign=sign)
    (added,) = accounted.surfaces["x"]
    assert added.name == "x1"
    assert added.stiffness_n_per_m.status is Status.WEAK
    assert added.stiffness_n_per_m.ci95 is not None
    low, high = added.stiffness_n_per_m.ci95
    assert low < stiffness < high
    # Three deviations of 7 % each, and what K_s to 1 % leaves open of a wall twice as stiff as K_s.
    assert high / low < 2.2
    assert {f.severity for f in accounted.findings} == {"warning"}
    assert {p.contact.surface for p in accounted.phases if p.contact is not None} == {"x1"}


def test_a_peak_without_a_hold_is_that_of_the_whole_contact() -> None:
    press = restless(2e5, 40.0, 60.0)
    accounted, _ = seen(press)
    (added,) = accounted.surfaces["x"]
    # Five deviations of 0.1 N of noise.
    assert max(added.peak_force_n) == pytest.approx(float(np.max(-press.force_n)), abs=0.5)
    assert max(p.contact.peak_force_n for p in accounted.phases if p.contact) == pytest.approx(
        float(np.max(-press.force_n)), abs=0.5
    )


def test_a_contact_on_a_fitted_surface_is_one_of_it_and_another_is_not() -> None:
    soft, stiff = restless(3e4, 40.0), restless(2e5, 40.0)
    accounted, _ = seen(soft, stiff, fitted=surface("x1", 3.1e4))
    names = [p.contact.surface for p in accounted.phases if p.contact is not None]
    assert names == ["x1", "x2"]
    assert [s.name for s in accounted.surfaces["x"]] == ["x2"]
    assert accounted.surfaces["x"][0].contacts == 1


def test_what_the_way_in_does_not_show_is_an_error_with_its_time_and_peak() -> None:
    press = there_and_back(1.5e5, 3e-4)
    inside = slice(press.first + 300, press.last - 300)
    cut = Press(position_m=press.position_m[inside], force_n=press.force_n[inside], first=0, last=0)
    accounted, axis = seen(cut)
    assert len(axis.pressed.unclear) == 1
    (finding,) = accounted.findings
    assert (finding.code, finding.severity, finding.axis) == (CONTACT_UNEXPLAINED, "error", "x")
    peak = float(np.max(np.abs(axis.of.axis.force_n)))
    assert f"0.0 s ({peak:.1f} N)" in finding.message


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("read", "hole", "cut_by"),
    [
        ("hold", False, "the beginning of what is read"),
        ("from the hold", False, "the beginning of what is read"),
        ("to the hold", False, "the end of what is read"),
        ("all", True, "a hole of the log"),
        ("all", False, ""),
    ],
)
def test_what_is_cut_is_a_warning_where_its_side_has_a_surface(
    read: str, hole: bool, cut_by: str, sign: float, side: int
) -> None:
    press = there_and_back(1.5e5, 3e-4)
    inside = slice(
        0 if read in {"all", "to the hold"} else press.first + 300,
        None if read in {"all", "from the hold"} else press.last - 300,
    )
    part = Press(position_m=press.position_m[inside], force_n=press.force_n[inside], first=0, last=0)
    # Without a coupling no slope says which surface it is.
    accounted, axis = seen(part, fitted=surface("x1", 1.5e5), coupling=UNDECIDED, sign=sign)
    force_n = axis.of.axis.force_n.copy()
    if hole:
        force_n[press.first - 100 : press.first - 60] = np.nan
    (known_side, known), of = axis.surfaces[0], replace(axis.of, axis=replace(axis.of.axis, force_n=force_n))
    axis = replace(axis, of=of, surfaces=((side * known_side, known),))
    (finding,) = account_for_contacts(accounted.phases, [axis], H_S).findings
    if cut_by and side > 0:
        assert (finding.code, finding.severity) == ("contact-cut", "warning")
        assert finding.message.startswith("Axis x: what was touched at ")
        assert f"is not used: {cut_by} cuts it" in finding.message
    else:
        assert (finding.code, finding.severity) == (CONTACT_UNEXPLAINED, "error")


def test_without_a_coupling_no_slope_is_reported() -> None:
    _, axis = seen(restless(2e5, 40.0))
    (contact,) = axis.pressed.contacts
    assert learn_slope(axis.of, axis.payload, contact, K_S) is not None
    assert learn_slope(axis.of, axis.payload, contact, UNDECIDED) is None
    # K_s to a third leaves more than half of a stiff wall open.
    vague = replace(K_S, std=0.33 * LOAD.stiffness)
    assert learn_slope(axis.of, axis.payload, contact, vague) is None
    # The way out alone is none of a spring: the damping works with it.
    assert learn_slope(axis.of, axis.payload, replace(contact, onset=None), K_S) is None


@pytest.mark.parametrize("coupling", [K_S, replace(K_S, std=0.33 * LOAD.stiffness)])
@pytest.mark.parametrize("order", [(3e4, 2e5), (2e5, 3e4, 3e4)])
def test_as_many_touches_are_found_as_end_in_surfaces_and_findings(
    order: tuple[float, ...], coupling: Estimate
) -> None:
    presses = [pushed(), *(restless(stiffness, 40.0) for stiffness in order), there_and_back(1e5, 4e-4)]
    accounted, axis = seen(*presses, coupling=coupling)
    touches = len(axis.pressed.contacts) + len(axis.pressed.unclear)
    assert touches == len(order) + 1
    # A force that comes and goes while the flange rests is no surface's.
    assert len(axis.pressed.by_hand) == 1
    named = sum(s.contacts for s in accounted.surfaces["x"])
    message = [f.message.count(" N)") for f in accounted.findings if f.code == CONTACT_UNEXPLAINED]
    assert named + sum(message) == touches
    # K_s to a third leaves 3 · 0.33 K_e/K_s open: 0.8 of 2e5, and 0.4 of 1e5.
    assert named == sum(stiffness < 2e5 or coupling is K_S for stiffness in (*order, 1e5))


def slope_of(
    force: FloatArray, way: FloatArray, *, sign: int = 1, std: float | None = 300.0, onset: bool = True
) -> ContactSlope | None:
    """Return what is learned of one contact of these samples, pressed along the axis or against it."""
    count = len(force)
    of = SimpleNamespace(softest_n_per_m=1000.0, axis=SimpleNamespace(force_n=-sign * force))
    payload = SimpleNamespace(touch_n=sign * force, position_m=sign * way)
    span = Span(start=0, stop=count)
    contact = SimpleNamespace(onset=0 if onset else None, span=span, hold=span)
    coupling = Estimate(value=3e5, std=std, status=Status.IDENTIFIED, method="by hand")
    return learn_slope(cast(Any, of), cast(Any, payload), cast(Any, contact), coupling)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("stiffness", [1.2e3, 2e4, 2e5])
def test_the_slope_of_a_spring_is_the_spring_and_as_open_as_the_coupling_and_the_model_leave_it(
    stiffness: float, sign: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(left_contacts, "press_sign", lambda *_: sign)
    force = 40.0 * np.sin(np.linspace(0.0, np.pi, 50))
    found = slope_of(force, 0.01 + force / stiffness, sign=sign)
    assert found is not None
    # dK_e = K_e² d(1/K_s), beside 7 % of what the model leaves out; three deviations.
    left_open = 3.0 * np.hypot(0.07, stiffness * 300.0 / 3e5**2)
    assert found.sign == sign
    assert found.low_n_per_m == pytest.approx(stiffness * (1.0 - left_open), rel=1e-9)
    assert found.high_n_per_m == pytest.approx(stiffness * (1.0 + left_open), rel=1e-9)
    assert found.stiffness_n_per_m == pytest.approx(stiffness, rel=1e-9)
    # What is not known of a sample leaves it out.
    way = np.where(np.arange(50) == 25, np.nan, 0.01 + force / stiffness)
    assert slope_of(force, way, sign=sign) is not None


def test_a_slope_that_is_not_clear_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(left_contacts, "press_sign", lambda *_: 1)
    force = 40.0 * np.sin(np.linspace(0.0, np.pi, 50))
    way = force / 2e4
    assert slope_of(force, way, onset=False) is None
    assert slope_of(force, way, std=None) is None
    assert slope_of(force, np.zeros(50)) is None
    assert slope_of(force, -way) is None
    assert slope_of(force, force / 900.0) is None
    assert slope_of(force[20:31], way[20:31]) is None
    assert slope_of(force[19:31], way[19:31]) is not None
    # K_s to a third: open by more than half where the surface is as stiff.
    assert slope_of(force, force / 3e5, std=6e4) is None
    # Nine tenths of the variance: r² of a way that is shaken.
    shaken = np.random.default_rng(1).normal(size=50)
    assert slope_of(force, way + 0.05 * float(np.std(way)) * shaken) is not None
    assert slope_of(force, way + 0.6 * float(np.std(way)) * shaken) is None
