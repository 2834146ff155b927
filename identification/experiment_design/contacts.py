"""Contacts and taps to record: how often, how fast and how hard, within the force limits."""

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.contact.transient import Approach, SampledContact, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.frozen import AboveZero, Count
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius

from ..merging.values import noise_stds
from ..signals.contact_rule import CONTACT
from ..signals.segments import low_pass
from .sweep import standard_deviations
from .values import Known, PlanValues

_SPEEDS_M_S = (0.005, 0.01, 0.02, 0.03, 0.05)
_HOLDS_N = (10.0, 20.0, 30.0, 50.0, 80.0)
_COUNTS = (3, 4, 6, 10)
_AIM = 0.5
_DAMPINGS_N_S_PER_M = (1000.0, 1400.0, 2000.0, 2800.0, 4000.0, 5600.0, 8000.0)
_ADMITTANCE_MASS_KG = 10.0
_BAND_HZ = 60.0
_ONSET_SKIP_S = 0.012
_SIMULATED_S = 0.7
_INDEPENDENT_MISFITS = 40.0
_LARGEST_IMPULSE_N_S = 1.0  # a soft hammer in the hand
_TAPS = 5
_SPACING_S = 2.0
_TAP_BAND_HZ = 250.0
_YIELD_SHARE = 0.02  # a robot that holds its position gives way a little
_POINTS = 20_000


@dataclass(frozen=True, kw_only=True)
class ContactPlan:
    """Approach at `speed_m_s`, press with `hold_force_n`, `count` times.

    The peaks are those of the exact sampled loop with the usual controller of damping `assumed_damping_n_s_per_m`;
    `rigid_peak_n` is hold force plus v sqrt(K_e M_p), an impact on the environment's spring alone, for comparison.
    `std` is keyed as `PlanValues` and holds for a K_s that is known; `through_coupling` shows what else K_e misses by.
    """

    count: Count
    speed_m_s: AboveZero
    hold_force_n: AboveZero
    peak_sensor_force_n: AboveZero
    peak_contact_force_n: AboveZero
    rigid_peak_n: AboveZero
    assumed_damping_n_s_per_m: AboveZero
    std: dict[str, float] = field(compare=False)


@dataclass(frozen=True, kw_only=True)
class _Touch:
    speed_m_s: float
    hold_n: float
    peak_sensor_n: float
    peak_contact_n: float
    std: FloatArray  # K_e, B_e of one contact, from noise
    misfit_std: FloatArray  # the same from what the model misses, however often it is repeated


def plan_contacts(values: PlanValues, *, max_force_n: float, allowed: dict[str, float]) -> ContactPlan | None:
    """Choose the gentlest contacts that bring K_e and B_e to half of what is allowed, else the ones that come closest.

    None when every contact peaks above `max_force_n`, or no usual controller is stable on the surface.
    """
    found = _stable_contact(values)
    if found is None:
        return None
    pair, controller = found
    touches = []
    least = 2.0 * CONTACT.hold_threshold_n(values.pose_force_std_n.value)
    for speed, hold in product(_SPEEDS_M_S, [hold for hold in _HOLDS_N if hold >= least]):
        touch = _touch(values, pair, controller, speed, hold)
        if touch is not None and max(touch.peak_contact_n, touch.peak_sensor_n) <= max_force_n:
            touches.append(touch)
    plans = [_repeated(values, touch, count, controller) for count in _COUNTS for touch in touches]
    if not plans:
        return None

    def worst(plan: ContactPlan) -> float:
        return max(plan.std[name] / allowed[name] for name in (_STIFFNESS, _DAMPING))

    enough = [plan for plan in plans if worst(plan) <= _AIM]
    if not enough:
        return min(plans, key=worst)
    return min(enough, key=lambda plan: (plan.count, plan.peak_contact_force_n))


_STIFFNESS, _DAMPING = "environment_stiffness_n_per_m", "environment_damping_n_s_per_m"


def through_coupling(values: PlanValues, stiffness_std_n_per_m: float) -> float:
    """Return what K_e inherits from K_s, (K_e/K_s)² σ(K_s), from 1/K_e = 1/secant − 1/K_s [N/m]."""
    ratio = values.environment_stiffness_n_per_m.value / values.stiffness_n_per_m.value
    return ratio**2 * stiffness_std_n_per_m


def plant_of(values: PlanValues) -> Plant:
    """Return the plant in contact of the values."""
    return Plant(
        robot=values.robot,
        coupling=Coupling(
            stiffness_n_per_m=values.stiffness_n_per_m.value, damping_n_s_per_m=values.damping_n_s_per_m.value
        ),
        payload=PayloadDynamics(mass_kg=values.mass_kg.value, drag_n_s_per_m=values.drag_n_s_per_m.value),
        environment=Environment(
            stiffness_n_per_m=values.environment_stiffness_n_per_m.value,
            damping_n_s_per_m=values.environment_damping_n_s_per_m.value,
        ),
    )


def stable_controller(values: PlanValues) -> AdmittanceController | None:
    """Return the usual controller with which contacts are planned, None where none is stable on the surface."""
    found = _stable_contact(values)
    return None if found is None else found[1]


def _stable_contact(values: PlanValues) -> tuple[SampledContact, AdmittanceController] | None:
    """Return the pair of plants and a usual controller that is stable there with something to spare."""
    try:
        pair = build_sampled_contact(build_sampled_plant(plant_of(values), values.sample_time_s.value))
    except ParameterError:
        return None  # a contact that swings too fast for this rate
    usual = (AdmittanceController(mass_kg=_ADMITTANCE_MASS_KG, damping_n_s_per_m=b) for b in _DAMPINGS_N_S_PER_M)
    loops = ((law, [build_loop(plant, law) for plant in (pair.free, pair.contact)]) for law in usual)
    stable = [law for law, both in loops if max(map(spectral_radius, both)) < 1.0]
    # The least damped stable one may oscillate long; nobody leaves a cell like that.
    return (pair, stable[min(1, len(stable) - 1)]) if stable else None


def _touch(
    values: PlanValues, pair: SampledContact, controller: AdmittanceController, speed: float, hold_n: float
) -> _Touch | None:
    """Simulate one contact and return what it shows; None if the payload does not come to rest on the surface."""
    h = values.sample_time_s.value
    approach = Approach(speed_m_s=speed, after_impact_n=hold_n)
    run = simulate_contact(pair, controller, approach, samples=round(_SIMULATED_S / h))
    force = run.contact_force_n
    away = np.flatnonzero(force[: len(force) // 2] <= 0.0)
    start = (int(away[-1]) + 1 if away.size else 0) + round(_ONSET_SKIP_S / h)
    if np.any(force[len(force) // 2 :] <= 0.0):
        return None
    std, misfit = _fit_std(values, force, start)
    return _Touch(
        speed_m_s=speed,
        hold_n=hold_n,
        peak_sensor_n=run.peak_sensor_force_n,
        peak_contact_n=run.peak_contact_force_n,
        std=std,
        misfit_std=misfit,
    )


def _fit_std(values: PlanValues, contact_force_n: FloatArray, start: int) -> tuple[FloatArray, FloatArray]:
    """Return deviations of K_e and B_e (2,) from noise and from misfit, for F_e = K_e (x_p − x_w) + B_e v_p.

    Force noise n enters the equation as n (1 + (M_p s² + (B_p + B_e) s + K_e)/K_s): through F_e, and through x_p, which
    is seen through the coupling.
    """
    h = values.sample_time_s.value
    stiffness, damping = values.environment_stiffness_n_per_m.value, values.environment_damping_n_s_per_m.value
    position = np.empty_like(contact_force_n)
    before = 0.0
    for k, force in enumerate(contact_force_n):
        before = position[k] = (force + damping / h * before) / (stiffness + damping / h)
    position = low_pass(position, h, _BAND_HZ)
    speed = np.gradient(position, h)
    rows = np.column_stack([position, speed, np.gradient(speed, h), np.ones_like(position)])[start:]
    estimator = np.linalg.pinv(rows)
    s = 2j * np.pi * np.fft.rfftfreq(2 * len(rows), h)
    drag = values.drag_n_s_per_m.value + damping
    heard = 1.0 + (values.mass_kg.value * s**2 + drag * s + stiffness) / values.stiffness_n_per_m.value
    heard /= 1.0 + (np.abs(s) / (2.0 * np.pi * _BAND_HZ)) ** 6  # third-order Butterworth there and back
    noise = np.fft.irfft(np.fft.rfft(estimator, 2 * len(rows), axis=1) * heard, axis=1)
    from_noise = values.force_noise_rms_n.value * np.linalg.norm(noise, axis=1)
    misfit = (
        values.misfit_share.value * float(np.std(contact_force_n[start:])) * np.sqrt(len(rows) / _INDEPENDENT_MISFITS)
    )
    return from_noise[:2], misfit * np.linalg.norm(estimator, axis=1)[:2]


def _apart_from_coupling(values: PlanValues) -> Known:
    """Return K_e with the deviation that does not come from K_s."""
    stiffness, coupling = values.environment_stiffness_n_per_m, values.stiffness_n_per_m.std
    if stiffness.std is None or coupling is None or stiffness.std == 0.0:
        return stiffness
    own, _ = noise_stds([stiffness.std], through_coupling(values, coupling))
    return replace(stiffness, std=float(own[0]))


def _repeated(values: PlanValues, touch: _Touch, count: int, controller: AdmittanceController) -> ContactPlan:
    stiffness = values.environment_stiffness_n_per_m
    damping = values.environment_damping_n_s_per_m
    # The secant misses by the misfit's share, which counts the more the stiffer the environment is.
    model = values.misfit_share.value * stiffness.value * (1.0 + stiffness.value / values.stiffness_n_per_m.value)
    deviations = np.hypot(touch.std / np.sqrt(count), touch.misfit_std)
    alone = float(np.hypot(deviations[0], model))
    std = [_apart_from_coupling(values).std_after(alone, "K_e"), damping.std_after(float(deviations[1]), "B_e")]
    return ContactPlan(
        count=count,
        speed_m_s=touch.speed_m_s,
        hold_force_n=touch.hold_n,
        peak_sensor_force_n=touch.peak_sensor_n,
        peak_contact_force_n=touch.peak_contact_n,
        rigid_peak_n=touch.hold_n + touch.speed_m_s * float(np.sqrt(stiffness.value * values.mass_kg.value)),
        assumed_damping_n_s_per_m=controller.damping_n_s_per_m,
        std={_STIFFNESS: std[0], _DAMPING: std[1]},
    )


@dataclass(frozen=True, kw_only=True)
class TapPlan:
    """Taps along the axis while the robot holds its position: each peaks at the sensor near `peak_force_n`.

    `std` is keyed as `PlanValues`: K_s and the total damping B_s + B_p (as `damping_n_s_per_m`) that the ring-down
    shows, with the mass taken from the poses.
    """

    count: Count
    impulse_n_s: AboveZero
    peak_force_n: AboveZero
    spacing_s: AboveZero
    std: dict[str, float] = field(compare=False)


def plan_taps(values: PlanValues, *, max_force_n: float, mass_std_kg: float) -> TapPlan:
    """Predict K_s and the total damping from the ring-down after taps of unknown strength, the flange held.

    F(s) = J C/(M_p s² + B s + K_s), C = K_s, B = B_s + B_p: ringing shows frequency and decay alone, so the
    mass, known to `mass_std_kg`, turns them into stiffness and damping. Information (2/(σ² h)) ∫ |dF/dθ|² df.
    """
    mass, stiffness = values.mass_kg.value, values.stiffness_n_per_m.value
    damping = values.damping_n_s_per_m.value + values.drag_n_s_per_m.value
    swing = float(np.sqrt(stiffness / mass))
    impulse = min(_LARGEST_IMPULSE_N_S, max_force_n / swing)
    highest = min(_TAP_BAND_HZ, 0.4 / values.sample_time_s.value)
    frequency = np.linspace(0.1, highest, _POINTS)
    s = np.asarray(2j * np.pi * frequency, dtype=np.complex128)
    gradients = _ring_gradients(s, stiffness, damping, mass, impulse)
    density = 2.0 * (highest - 0.1) / _POINTS / (values.force_noise_rms_n.value**2 * values.sample_time_s.value)
    information = np.real(np.conj(gradients).T @ gradients) * density
    # Every tap has a strength of its own; alike, they are one tap seen so many times.
    information *= _TAPS
    information[2, 2] += 1.0 / max(mass_std_kg, 1e-6 * mass) ** 2
    std = standard_deviations(np.asarray(information))
    return TapPlan(
        count=_TAPS,
        impulse_n_s=impulse,
        peak_force_n=min(impulse * swing, max_force_n),
        spacing_s=_SPACING_S,
        std={
            "stiffness_n_per_m": float(np.hypot(std[0], _YIELD_SHARE * stiffness)),
            "damping_n_s_per_m": float(np.hypot(std[1], _YIELD_SHARE * values.critical_damping_n_s_per_m)),
        },
    )


def _ring_gradients(s: ComplexArray, stiffness: float, damping: float, mass: float, impulse: float) -> ComplexArray:
    """Return dF/dθ (n, 4) for K_s, B, M_p and J of F = J K_s/(M_p s² + B s + K_s)."""
    below = mass * s**2 + damping * s + stiffness
    force = impulse * stiffness / below
    return np.stack(
        [force / stiffness - force / below, -force * s / below, -force * s**2 / below, force / impulse], axis=1
    )
