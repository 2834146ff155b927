"""Plan of the next recording: poses, sweep, taps and contacts, the most useful first."""

import numpy as np

from problems.model.controller import AdmittanceController
from problems.text import significant

from ..errors import EstimateError
from .contacts import ContactPlan, TapPlan, plan_contacts, plan_taps, through_coupling
from .poses import PosePlan, plan_poses, smallest_tilt_deg
from .result import LABELS, UNITS, ExperimentLimits, ExperimentPlan, PeakEffect, Prediction, Step, StepKind, peak_effect
from .sweep import SweepLimits, SweepPlan, careful_force_n, plan_sweep
from .values import PlanValues

_SHARE = 0.05
_COM_M = 2e-3
_DAMPING_FLOOR = 0.1
_DELAY_SAMPLES = 0.2
_AIM = 0.5
_UNKNOWN_FACTOR = 20.0  # times what is allowed: a deviation as large as the value
_PEAK_SHARE = 0.01
_NOTHING = 0.002  # of the peak
_AIM_SHARE = 0.9  # of the force limit, for a repeated sweep

_STEP_OF = {
    "mass_kg": "poses",
    "com_m": "poses",
    "stiffness_n_per_m": "sweep",
    "damping_n_s_per_m": "sweep",
    "drag_n_s_per_m": "sweep",
    "motion_mass_kg": "sweep",
    "bandwidth_hz": "sweep",
    "delay_s": "sweep",
    "environment_stiffness_n_per_m": "contacts",
    "environment_damping_n_s_per_m": "contacts",
}


def allowed_std(values: PlanValues) -> dict[str, float]:
    """Return the deviation with which each parameter counts as identified: 5 % of it, 2 mm for the centre of mass.

    A damping counts beside a tenth of the critical one, a delay beside a fifth of a sample.
    """
    contact = 2.0 * float(np.sqrt(values.environment_stiffness_n_per_m.value * values.mass_kg.value))
    floors = {
        "damping_n_s_per_m": _DAMPING_FLOOR * values.critical_damping_n_s_per_m,
        "drag_n_s_per_m": _DAMPING_FLOOR * values.critical_damping_n_s_per_m,
        "environment_damping_n_s_per_m": _DAMPING_FLOOR * contact,
    }
    known = values.known()
    allowed = {name: _SHARE * max(known[name].value, floors.get(name, 0.0)) for name in _STEP_OF}
    allowed["com_m"] = _COM_M
    allowed["delay_s"] = max(allowed["delay_s"], _DELAY_SAMPLES * values.sample_time_s.value)
    return allowed


def plan_experiment(
    axis: str, values: PlanValues, limits: ExperimentLimits, controller: AdmittanceController | None = None
) -> ExperimentPlan:
    """Plan the next recording on one axis within `limits`.

    Parameters
    ----------
    axis
        Name of the axis, x to rz.
    values
        The cell as far as it is known, in SI.
    limits
        What the cell allows: speed, force, stroke, time, tilt.
    controller
        An uncertainty is weighed by the newtons that it moves the peak force with this controller; a usual one is taken
        for None, or where this one is not stable on the surface.

    Raises
    ------
    EstimateError
        Poses are needed, and no orientations within the limit on the tilt determine mass and centre.

    """
    allowed = allowed_std(values)
    now = {name: values.known()[name].std for name in _STEP_OF}
    after = dict(now)
    poses = _poses(values, limits, allowed, after)
    speeds = SweepLimits(
        max_speed_m_s=limits.max_speed_m_s,
        max_force_n=limits.max_force_n,
        max_stroke_m=limits.max_stroke_m,
        max_duration_s=limits.max_duration_s,
        max_frequency_hz=limits.max_frequency_hz,
    )
    aim = _AIM_SHARE * _force_limit(limits, after, "damping_n_s_per_m", "drag_n_s_per_m")
    sweep = plan_sweep(values, speeds, {name: allowed[name] for name in _named("sweep")}, aim_force_n=aim)
    _improve(after, sweep.std)
    taps = _taps(values, limits, allowed, after)
    gentle = _force_limit(limits, now, "environment_stiffness_n_per_m")
    contacts = plan_contacts(values, max_force_n=gentle, allowed=allowed)
    if contacts is not None:
        _improve(after, _with_coupling(values, contacts.std, after["stiffness_n_per_m"]))
    effect = (None if controller is None else peak_effect(values, controller)) or peak_effect(values)
    predictions = {
        name: _prediction(name, values, allowed[name], now[name], after[name], effect)
        for name in _STEP_OF
        if limits.pose_count or _STEP_OF[name] != "poses"
    }
    return _ordered(axis, values, limits, predictions, (poses, sweep, taps, contacts), effect)


def _prediction(
    name: str, values: PlanValues, allowed: float, now: float | None, after: float | None, effect: PeakEffect | None
) -> Prediction:
    stated = None if after is None or after > _UNKNOWN_FACTOR * allowed else after
    return Prediction(
        name=name,
        value=values.known()[name].value,
        allowed_std=allowed,
        std_now=now,
        std_after=stated,
        peak_now_n=None if effect is None else effect.moves_n(name, now),
        peak_after_n=None if effect is None else effect.moves_n(name, stated),
    )


def _rank(entry: Prediction, effect: PeakEffect | None) -> float:
    """Return how much an entry binds: what is not known at all most, then by newtons of the peak, per 1 % of it.

    Without an effect on the peak it is std over allowed std, and what does not act on the peak comes after all that do.
    """
    if entry.std_now is None or effect is None:
        return entry.urgency
    if entry.peak_now_n is None:
        return 0.0
    return entry.peak_now_n / (_PEAK_SHARE * effect.peak_force_n)


def _is_needed(entry: Prediction, effect: PeakEffect | None) -> bool:
    """Return whether more should be known: std above what is allowed, unless the peak hardly moves with it."""
    if entry.peak_now_n is not None and effect is not None and entry.peak_now_n < _NOTHING * effect.peak_force_n:
        return False
    return entry.urgency > 1.0


def _force_limit(limits: ExperimentLimits, std: dict[str, float | None], *names: str) -> float:
    return careful_force_n(limits.max_force_n, [std[name] for name in names])


def _named(step: str) -> list[str]:
    return [name for name, of in _STEP_OF.items() if of == step]


def _improve(after: dict[str, float | None], std: dict[str, float]) -> None:
    for name, value in std.items():
        known = after[name]
        after[name] = value if known is None else min(known, value)


def _poses(
    values: PlanValues, limits: ExperimentLimits, allowed: dict[str, float], after: dict[str, float | None]
) -> PosePlan | None:
    if limits.pose_count == 0:
        return None
    plan = plan_poses(values, count=limits.pose_count, max_tilt_deg=limits.max_tilt_deg)
    needed = any((known := after[name]) is None or known > allowed[name] for name in _named("poses"))
    enough = plan is not None and plan.is_excited
    if plan is not None and enough:
        enough = plan.mass_std_kg <= allowed["mass_kg"] and plan.com_std_m <= allowed["com_m"]
        if enough or not needed:
            _improve(after, {"mass_kg": plan.mass_std_kg, "com_m": plan.com_std_m})
            return plan
    if not needed:
        return None
    least = smallest_tilt_deg(
        values, count=limits.pose_count, mass_std_kg=allowed["mass_kg"], com_std_m=allowed["com_m"]
    )
    stated = "no tilt up to 90 degrees would" if least is None else f"it takes {least:.0f} degrees"
    raise EstimateError(
        f"No {limits.pose_count} poses tilted by at most {limits.max_tilt_deg:g} degrees determine the payload's mass "
        f"to {allowed['mass_kg']:.2g} kg and its centre to {significant(1e3 * allowed['com_m'])} mm; {stated}. "
        "Allow a larger tilt, change the number of poses, or leave them out (0) where mass and centre of mass are "
        "known from elsewhere."
    )


def _taps(
    values: PlanValues, limits: ExperimentLimits, allowed: dict[str, float], after: dict[str, float | None]
) -> TapPlan | None:
    """Return taps where the sweep leaves K_s above half of what is allowed and they show it better."""
    swept = after["stiffness_n_per_m"]
    if swept is not None and swept <= _AIM * allowed["stiffness_n_per_m"]:
        return None
    mass_std = after["mass_kg"] if after["mass_kg"] is not None else allowed["mass_kg"]
    gentle = _force_limit(limits, {"stiffness_n_per_m": values.stiffness_n_per_m.std}, "stiffness_n_per_m")
    plan = plan_taps(values, max_force_n=gentle, mass_std_kg=mass_std)
    if swept is not None and plan.std["stiffness_n_per_m"] >= swept:
        return None
    _improve(after, {"stiffness_n_per_m": plan.std["stiffness_n_per_m"]})
    return plan


def _with_coupling(values: PlanValues, std: dict[str, float], stiffness_std: float | None) -> dict[str, float]:
    name = "environment_stiffness_n_per_m"
    inherited = np.inf if stiffness_std is None else through_coupling(values, stiffness_std)
    return {**std, name: float(np.hypot(std[name], inherited))}


def _ordered(
    axis: str,
    values: PlanValues,
    limits: ExperimentLimits,
    predictions: dict[str, Prediction],
    settings: tuple[PosePlan | None, SweepPlan, TapPlan | None, ContactPlan | None],
    effect: PeakEffect | None,
) -> ExperimentPlan:
    """Put the phases in the order of what they cut; a K_e that waits for K_s asks for the sweep."""
    poses, sweep, taps, contacts = settings
    # M_p from motion is a second opinion: it makes no recording necessary.
    counted = [entry for name, entry in predictions.items() if name != "motion_mass_kg"]
    binding = max(counted, key=lambda entry: _rank(entry, effect))
    waits = coupling_binds(values)
    urgency: dict[str, float] = {}
    asked: set[str] = set()
    for entry in counted:
        step = "sweep" if waits and entry.name == "environment_stiffness_n_per_m" else _STEP_OF[entry.name]
        urgency[step] = max(urgency.get(step, 0.0), _rank(entry, effect))
        asked |= {step} if _is_needed(entry, effect) else set()
    plans: dict[str, PosePlan | SweepPlan | ContactPlan | None] = {
        "poses": poses,
        "sweep": sweep,
        "contacts": contacts,
    }
    steps = []
    for kind in sorted(urgency, key=lambda step: (step not in asked, -urgency[step])):
        mine = tuple(predictions[name] for name in _named(kind))
        needed = kind in asked
        why = _why(kind, max(mine, key=lambda entry: (_is_needed(entry, effect), _rank(entry, effect))), needed, waits)
        if kind == "contacts" and values.surface:
            why += f"; planned for surface {values.surface}"
        if kind == "contacts" and contacts is None:
            why += f"; no contact stays surely below {limits.max_force_n:g} N"
        steps.append(Step(kind=StepKind(kind), is_needed=needed, why=why, predictions=mine, settings=plans[kind]))
        if kind == "sweep" and taps is not None:
            stiffness = (predictions["stiffness_n_per_m"],)
            why = _why_taps(values, sweep)
            steps.append(Step(kind=StepKind.TAPS, is_needed=needed, why=why, predictions=stiffness, settings=taps))
    return ExperimentPlan(
        axis=axis, binding=binding.name, effect=effect, steps=tuple(steps), values=values, limits=limits
    )


def coupling_binds(values: PlanValues) -> bool:
    """Return whether most of what is not known of K_e is not known of K_s, so that more contacts would not help."""
    stiffness, environment = values.stiffness_n_per_m, values.environment_stiffness_n_per_m
    if stiffness.std is None or environment.std is None:
        return False
    return through_coupling(values, stiffness.std) ** 2 > 0.5 * environment.std**2


def _why(kind: str, worst: Prediction, needed: bool, waits: bool) -> str:
    label = LABELS[worst.name]
    if worst.std_now is None:
        sentence = f"{label} is not known yet"
    else:
        unit, scale = UNITS[worst.name]
        known, times = significant(worst.std_now * scale), significant(worst.urgency)
        sentence = f"{label} is known to ± {known} {unit}, {times} times what is allowed"
        if worst.peak_now_n is not None:
            sentence += f", which moves the peak by {significant(worst.peak_now_n)} N"
    if waits and kind == "sweep":
        return "most of what is not known of environment K_e comes from coupling K_s, which the sweep identifies"
    if waits and kind == "contacts":
        return "more contacts do not help environment K_e: coupling K_s binds it, and the sweep identifies that"
    return sentence if needed else f"{sentence}: nothing asks for more"


def _why_taps(values: PlanValues, sweep: SweepPlan) -> str:
    return (
        f"the payload swings at {values.payload_frequency_hz:.1f} Hz, the sweep ends at {sweep.sweep.high_hz:.1f} Hz "
        f"and {sweep.bound_by} holds it down: taps on the payload identify coupling K_s better"
    )
