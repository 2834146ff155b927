"""What to record next, for every parameter that is weak or missing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .result import AxisEstimate, EnvironmentEstimate, Estimate, Finding, Identified, Status, VectorEstimate

_POSES = (
    "Record 6 to 12 rests of 1 s, the tool tilted by 30 degrees or more in different directions, with nothing touching "
    "the payload."
)
_SWEEP = (
    "Record a commanded sweep in free space of 0.5 Hz to {highest}, 10 s or more, with a centimetre at its slow end "
    "and no hand on the payload."
)
_CONTACTS = "Record 3 or more contacts on the same spot: 1 to 3 cm/s, 20 to 50 N, hold for 1 s, back off."
_IMPACTS = "Record 3 or more contacts at 3 to 5 cm/s, as far as the predicted peak force allows."
_SHARP_PERCENT = 5.0
_COMMAND = "Record the position command with the pose, on one clock, at the control rate."


@dataclass(frozen=True, kw_only=True)
class _Lack:
    """A parameter that is not known well; `needed`: no controller is tuned without it."""

    name: str
    estimate: Estimate | VectorEstimate
    advice: str
    needed: bool

    @property
    def code(self) -> str:
        """How it lacks: `unidentifiable`, `bounded` to an interval, `weak`, or nothing."""
        bounded = isinstance(self.estimate, Estimate) and self.estimate.ci95 is not None
        codes = {Status.WEAK: "weak", Status.UNIDENTIFIABLE: "bounded" if bounded else "unidentifiable"}
        return codes.get(self.estimate.status, "")


def advise(result: Identified) -> tuple[Finding, ...]:
    """Return a finding for everything that is weak or missing, those with the same remedy together.

    What is missing and needed is an error, unless another error says why already; what is weak and needed is a warning;
    so is what is needed and told as an interval only; the rest is information.
    """
    findings = list(_findings("", list(_payload_lacks(result))))
    for name, axis in result.axes.items():
        findings += _findings(f"Axis {name}: ", list(_axis_lacks(axis)))
    explained = any(f.severity == "error" for f in result.findings)
    return tuple(f for f in findings if not (explained and f.severity == "error"))


def _findings(where: str, lacks: Sequence[_Lack]) -> Iterator[Finding]:
    for code, verb, severities in (
        ("unidentifiable", "not told by the log", ("error", "info")),
        ("bounded", "told as an interval only", ("warning", "info")),
        ("weak", "weak", ("warning", "info")),
    ):
        for needed, severity in zip((True, False), severities, strict=True):
            mine = [lack for lack in lacks if lack.code == code and lack.needed is needed]
            for advice in dict.fromkeys(lack.advice for lack in mine):
                told = ", ".join(_told(lack) for lack in mine if lack.advice == advice)
                yield Finding(code=code, severity=severity, message=f"{where}{told}: {verb}.", advice=advice)


def _told(lack: _Lack) -> str:
    estimate = lack.estimate
    if isinstance(estimate, Estimate) and estimate.value is None and estimate.ci95 is not None:
        return "{} ({:.3g} to {:.3g} with 95 %)".format(lack.name, *estimate.ci95)
    if isinstance(estimate, VectorEstimate) or not estimate.value or estimate.std is None:
        return lack.name
    share = 100.0 * estimate.std / abs(estimate.value)
    # What is told sharply and weak all the same has its reason in the note.
    why = f"± {share:.0f} %" if share >= _SHARP_PERCENT or not estimate.note else estimate.note
    return f"{lack.name} ({why})"


def _payload_lacks(result: Identified) -> Iterator[_Lack]:
    yield _Lack(name="payload mass", estimate=result.payload.mass_kg, advice=_POSES, needed=True)
    yield _Lack(name="centre of mass", estimate=result.payload.com_m, advice=_POSES, needed=True)


def _axis_lacks(axis: AxisEstimate) -> Iterator[_Lack]:
    sweep = _SWEEP.format(highest=_highest(axis))
    coupling, robot = axis.coupling, axis.robot
    yield _Lack(name="K_s", estimate=coupling.stiffness_n_per_m, advice=sweep, needed=True)
    yield _Lack(name="B_s", estimate=coupling.damping_n_s_per_m, advice=sweep, needed=True)
    yield _Lack(name="B_p", estimate=axis.drag_n_s_per_m, advice=sweep, needed=True)
    if axis.mass_kg is not None:
        yield _Lack(name="mass from motion", estimate=axis.mass_kg, advice=sweep, needed=False)
    known = robot.denominator.value is not None
    yield _Lack(name="r(s)", estimate=robot.denominator, advice=sweep if known else _COMMAND, needed=True)
    yield _Lack(name="T_d", estimate=robot.delay_s, advice=sweep if known else _COMMAND, needed=True)
    for surface in axis.environments:
        contacts = _CONTACTS if not _through_coupling(axis, surface) else sweep
        yield _Lack(name=f"{surface.name} K_e", estimate=surface.stiffness_n_per_m, advice=contacts, needed=True)
        yield _Lack(
            name=f"{surface.name} secant", estimate=surface.secant_stiffness_n_per_m, advice=_CONTACTS, needed=False
        )
        yield _Lack(name=f"{surface.name} B_e", estimate=surface.damping_n_s_per_m, advice=_IMPACTS, needed=False)
        yield _Lack(name=f"{surface.name} M_e", estimate=surface.mass_kg, advice=_IMPACTS, needed=False)


def _highest(axis: AxisEstimate) -> str:
    """Return where a sweep may end: well above the payload's own frequency, where that is known."""
    stiffness, mass = axis.coupling.stiffness_n_per_m.value, None if axis.mass_kg is None else axis.mass_kg.value
    if stiffness is None or mass is None:
        return "50 Hz"
    own = float(np.sqrt(stiffness / mass)) / (2.0 * np.pi)
    return f"{max(1.6 * own, 20.0):.0f} Hz (the payload swings at {own:.0f} Hz)"


def _through_coupling(axis: AxisEstimate, surface: EnvironmentEstimate) -> bool:
    """Return whether K_e is unknown because K_s is: the secant is told, and better than K_e."""
    secant, stiffness = surface.secant_stiffness_n_per_m, surface.stiffness_n_per_m
    k_s = axis.coupling.stiffness_n_per_m
    if secant.value is None or secant.std is None:
        return False
    if k_s.value is None or k_s.std is None or stiffness.value is None:
        return True
    # 1/K_e = 1/secant − 1/K_s: which of both makes most of its variance.
    return k_s.std / k_s.value**2 > secant.std / secant.value**2
