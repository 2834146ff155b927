"""Recommendations of what to record next, for every parameter that is weak or missing."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from problems.model.axis_kind import STRAIGHT, TURNING, AxisKind, QuantityKind
from problems.text import significant

from .axes.straight import AXIS_NAMES
from .experiment_design.sweep import SweepLimits, fastest_sweep
from .experiment_design.values import values_of
from .joint_fit.estimates import COARSE_COMMAND
from .payload.gravity_verdicts import WITHOUT_TORQUE
from .result import AxisEstimate, EnvironmentEstimate, Estimate, Finding, Identified, Status, VectorEstimate
from .robot.logged_command import SECOND_POLE, UNKNOWN_PERIOD
from .verdicts import MASS_THAT_MOVES

_POSES = (
    "Record 6 to 12 rests of 1 s, the tool tilted by 30 degrees or more in different directions, with nothing touching "
    "the payload."
)
_SWEEP = (
    "Record a commanded sweep in free space of 0.5 Hz to {highest}, 10 s or more,{speed} with no hand on the payload."
)
_SWEEP_FROM_HZ = 0.5
# A sweep that is slower drowns in the noise of usual sensors.
_SLOWEST_M_S, _AIMED_N = 1e-3, 50.0
_SWEEP_S = 10.0
_SWEEP_TO_HZ = 50.0
_MISFIT_RATIO = 1.5
_PAYLOAD_CODES = frozenset({"second-mode", "coupling-friction", "payload-unclear"})
_FILTERED = (
    "The sweep is there, but one payload on one spring leaves {ratio:.1f} times the sensor's noise of its force. A log "
    "slower than 500 Hz and the pose's noise times K_s do this: see to those first. Else the likeliest cause is a "
    "low-pass in the sensor or its driver: set it to 200 Hz or more, or switch it off, and record again. A second "
    "spring, play or friction in the gripper does this too."
)
_OTHER_ROBOT = (
    "The sweep is there, but the robot does not follow as one or two poles and a delay do. Log the command where the "
    "position loop receives it, behind every interpolator, filter and limit, and when it is sent: one that is logged a "
    "period late in a part of the log does this too. Else the loop has a zero (feed-forward, say): measure its delay "
    "elsewhere, `--given {name}.delay_s=SECONDS`, and use it with care."
)
_BESIDE_PAYLOAD = (
    "The sweep is there, but what the payload has beside one mass on one spring moves this: see the finding on it. "
    "Fasten what swings or rubs and record the sweep again, or measure the delay elsewhere, `--given "
    "{name}.delay_s=SECONDS`."
)
_PERIOD = (
    "Give the control period: half of it is in the delay that this log shows. The log suggests `--given "
    "sample_time_s={period:g}`, its own period; take it where the controller runs at that rate."
)
_SECOND_POLE = (
    "A second pole of the robot would explain the log as well, with less delay: command quicker motion, or measure the "
    "pose with less noise. "
)
_CONTACTS = "Record 3 or more contacts on the same spot: 1 to 3 cm/s, 20 to 50 N, hold for 1 s, back off."
_IMPACTS = "Record 3 or more contacts at 3 to 5 cm/s, as far as the predicted peak force allows."
_SHARP_PERCENT = 5.0
_QUANTITIES: Mapping[str, QuantityKind] = {
    "T_d": "time",
    "K_s": "stiffness",
    "K_e": "stiffness",
    "secant": "stiffness",
    "B_s": "damping",
    "B_p": "damping",
    "B_e": "damping",
}
_DRIFT = "force-follows-drift"
_DRIFTING = "The sensor drifts, which widens this: see to that first. "
_COARSE = (
    "The log does not show that each command was held until the next one: it was smoothed, or the controller is "
    "faster, or what differs is too little to be seen. If it was held, give the control period (`sample_time_s`); else "
    "log the command that the robot receives, and the pose, at the control rate."
)
_BY_NOTE: Mapping[str, str] = {
    WITHOUT_TORQUE: "Record the sensor's torques with its forces.",
    MASS_THAT_MOVES: "Record a commanded sweep in free space with no hand on the payload, or the sensor's wrench "
    "before its weight is taken off.",
}
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
    so is what is needed and known as an interval only; the rest is information.
    """
    first = _DRIFTING if any(finding.code == _DRIFT for finding in result.findings) else ""
    payload: dict[str, Estimate | VectorEstimate] = {
        "payload mass": result.payload.mass_kg,
        "centre of mass": result.payload.com_m,
    }
    lacks = [
        _Lack(name=name, estimate=each, advice=_BY_NOTE.get(each.note, _POSES), needed=True)
        for name, each in payload.items()
    ]
    findings = list(_findings("", lacks, first, STRAIGHT))
    for name in result.axes:
        lacks = list(_axis_lacks(result, name))
        findings += _findings(f"Axis {name}: ", lacks, first, STRAIGHT if name in AXIS_NAMES else TURNING)
    explained = any(f.severity == "error" for f in result.findings)
    return tuple(f for f in findings if not (explained and f.severity == "error"))


def _findings(where: str, lacks: Sequence[_Lack], first: str, units: AxisKind) -> Iterator[Finding]:
    for code, verb, severities in (
        ("unidentifiable", "not identified from the log", ("error", "info")),
        ("bounded", "known as an interval only", ("warning", "info")),
        ("weak", "weak", ("warning", "info")),
    ):
        for needed, severity in zip((True, False), severities, strict=True):
            mine = [lack for lack in lacks if lack.code == code and lack.needed is needed]
            for advice in dict.fromkeys(lack.advice for lack in mine):
                shown = ", ".join(_text(lack, units) for lack in mine if lack.advice == advice)
                text = first + advice
                yield Finding(code=code, severity=severity, message=f"{where}{shown}: {verb}.", advice=text)


def _text(lack: _Lack, units: AxisKind) -> str:
    estimate = lack.estimate
    factor, unit = units.shown(_QUANTITIES.get(lack.name.split()[-1], "mass"))
    if isinstance(estimate, Estimate) and estimate.value is None and estimate.ci95 is not None:
        low, high = (factor * end for end in estimate.ci95)
        return f"{lack.name} ({low:.3g} to {high:.3g} {unit} with 95 %)"
    if isinstance(estimate, VectorEstimate) or estimate.value is None or estimate.std is None:
        return lack.name
    if estimate.std > abs(estimate.value):
        # A share of a number that may as well be 0 says nothing.
        return f"{lack.name} (± {significant(factor * estimate.std)} {unit})"
    share = 100.0 * estimate.std / abs(estimate.value) if estimate.value else 0.0
    # What is known sharply and weak all the same has its reason in the note.
    why = f"± {share:.0f} %" if share >= _SHARP_PERCENT or not estimate.note else estimate.note
    return f"{lack.name} ({why})"


def _axis_lacks(result: Identified, name: str) -> Iterator[_Lack]:
    axis, sweep, period_s = result.axes[name], _sweep(result, name), result.sample_time_s.value
    coupling, robot = axis.coupling, axis.robot
    by_sweep = _about_coupling(axis, sweep)
    by_command, by_period = _about_robot(result, name, by_sweep), _about_delay(axis, period_s)
    by_pole = _SECOND_POLE + sweep if SECOND_POLE in robot.delay_s.note else ""
    delay = _Lack(name="T_d", estimate=robot.delay_s, advice=by_pole or by_period or by_command, needed=True)
    # A number that the user has comes before another recording.
    yield from [delay] if by_period else []
    yield _Lack(name="K_s", estimate=coupling.stiffness_n_per_m, advice=by_sweep, needed=True)
    yield _Lack(name="B_s", estimate=coupling.damping_n_s_per_m, advice=by_sweep, needed=True)
    yield _Lack(name="B_p", estimate=axis.drag_n_s_per_m, advice=by_sweep, needed=True)
    if axis.mass_kg is not None:
        yield _Lack(name="mass from motion", estimate=axis.mass_kg, advice=by_sweep, needed=False)
    yield _Lack(name="r(s)", estimate=robot.denominator, advice=by_command, needed=True)
    yield from [] if by_period else [delay]
    hidden = by_sweep != sweep
    for surface in axis.environments:
        contacts = by_sweep if hidden or _through_coupling(axis, surface) else _CONTACTS
        secant = by_sweep if hidden else _CONTACTS
        if COARSE_COMMAND in surface.secant_stiffness_n_per_m.note:
            contacts = secant = _COARSE
        yield _Lack(name=f"{surface.name} K_e", estimate=surface.stiffness_n_per_m, advice=contacts, needed=True)
        yield _Lack(
            name=f"{surface.name} secant", estimate=surface.secant_stiffness_n_per_m, advice=secant, needed=False
        )
        yield _Lack(name=f"{surface.name} B_e", estimate=surface.damping_n_s_per_m, advice=_IMPACTS, needed=False)
        yield _Lack(name=f"{surface.name} M_e", estimate=surface.mass_kg, advice=_IMPACTS, needed=False)


def _about_coupling(axis: AxisEstimate, sweep: str) -> str:
    """Return what helps where the coupling is not identified: another sweep does not, where the model does not fit."""
    ratio = _misfit_ratio(axis)
    if axis.coupling.stiffness_n_per_m.status is not Status.UNIDENTIFIABLE or ratio <= _MISFIT_RATIO:
        return sweep
    return _FILTERED.format(ratio=ratio)


def _about_robot(result: Identified, name: str, sweep: str) -> str:
    """Return what helps where the delay is not identified though the sweep shows the coupling: another does not."""
    axis = result.axes[name]
    if axis.robot.denominator.value is None:
        return _COMMAND
    is_stated = axis.coupling.stiffness_n_per_m.status is not Status.UNIDENTIFIABLE
    if not is_stated or axis.robot.delay_s.status is not Status.UNIDENTIFIABLE or _misfit_ratio(axis) <= _MISFIT_RATIO:
        return sweep
    beside = [f for f in result.findings if f.code in _PAYLOAD_CODES and f"Axis {name}:" in f.message]
    return (_BESIDE_PAYLOAD if beside else _OTHER_ROBOT).format(name=name)


def _about_delay(axis: AxisEstimate, period_s: float | None) -> str:
    """Return what helps where half a control period that is not known is part of the delay, else nothing."""
    is_open = axis.robot.delay_s.value is not None and UNKNOWN_PERIOD in axis.robot.delay_s.note
    return _PERIOD.format(period=float(f"{period_s:.6g}")) if is_open and period_s is not None else ""


def _misfit_ratio(axis: AxisEstimate) -> float:
    """Return how many times the noise at rest the fit leaves in free motion, in the worst log."""
    return max((fit.noise_ratio_free for fit in axis.fits), default=0.0)


def _sweep(result: Identified, name: str) -> str:
    """Return the sweep to record, as fast as `autotune plan` would make it within its usual limits."""
    axis = result.axes[name]
    stiffness, mass = axis.coupling.stiffness_n_per_m.value, None if axis.mass_kg is None else axis.mass_kg.value
    highest_hz, swings = _SWEEP_TO_HZ, ""
    if stiffness is not None and mass is not None:
        own = float(np.sqrt(stiffness / mass)) / (2.0 * np.pi)
        highest_hz, swings = max(1.6 * own, 20.0), f" (the payload swings at {own:.0f} Hz)"
    speed = _speed(result, name, highest_hz) if name in AXIS_NAMES else ""
    return _SWEEP.format(highest=f"{highest_hz:.0f} Hz{swings}", speed=speed)


def _speed(result: Identified, name: str, highest_hz: float) -> str:
    """Return how fast to sweep; what would be safe in any cell shows nothing where the cell is hardly known."""
    _, values = values_of(result, name)
    sweep = fastest_sweep(values, SweepLimits(), _SWEEP_FROM_HZ, highest_hz, _SWEEP_S).sweep
    if sweep.flange_speed_m_s < _SLOWEST_M_S:
        return f" its amplitude raised from run to run until the force at the sensor reaches {_AIMED_N:.0f} N,"
    travel_m = sweep.flange_speed_m_s / (2.0 * np.pi * _SWEEP_FROM_HZ)
    return f" the flange at {1e3 * sweep.flange_speed_m_s:.2g} mm/s throughout ({1e3 * travel_m:.2g} mm at 0.5 Hz),"


def _through_coupling(axis: AxisEstimate, surface: EnvironmentEstimate) -> bool:
    """Return whether K_e is unknown because K_s is: the secant is known, and better than K_e."""
    secant, stiffness = surface.secant_stiffness_n_per_m, surface.stiffness_n_per_m
    k_s = axis.coupling.stiffness_n_per_m
    if secant.value is None or secant.std is None:
        return False
    if k_s.value is None or k_s.std is None or stiffness.value is None:
        return True
    # 1/K_e = 1/secant − 1/K_s: which of both makes most of its variance.
    return k_s.std / k_s.value**2 > secant.std / secant.value**2
