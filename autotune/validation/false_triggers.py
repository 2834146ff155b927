"""How often a collision response begins where nothing was touched: by the sensor's noise, and by a hand that brakes.

The response is spent once it began, so what counts is how often noise on top of what opposes the motion anyway crosses
the threshold from below. Of stationary Gaussian noise with the correlation r between two ticks, above a level of u
deviations, one tick is below and the next one above with P = ∫_u^∞ φ(x) Φ((u − r x)/√(1 − r²)) dx: Q(u)(1 − Q(u)) for
white noise, and Rice's rate (1944) for noise that is slow against the ticks. The noise is that of the closed loop in
free space: the robot moves by it, and the payload answers.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_ndtr

from autotune.formats.controller_record import Controller, FalseTriggers, admittance_controller, file_deadband
from autotune.formats.units import ROTATIONAL_AXES
from identification.result import NoiseSpectrum
from problems.arrays import FloatArray
from problems.contact.nonlinear_simulation import Operator, needed_substeps, simulate_operator
from problems.contact.nonlinearities import Nonlinearities
from problems.model.sampled import build_sampled_plant
from problems.stability.noise import FeltNoise, felt_noise

from .disturbances import file_strategy

MOST_PER_HOUR = 1e-3
"""What a threshold that is chosen may be passed by noise alone."""
MOVEMENTS_PER_HOUR = 240.0
"""Movements of an operator who works all the time: one every 15 s."""
_HOUR_S = 3600.0
# Noise of an axis that stands opposes a motion of either sign.
_SIGNS = 2.0
_FARTHEST = 40.0
# The operator (docs/method.md): 2 kg, 50 N·s/m; spring, way and mean speed are drawn by equal ratios.
_HAND_KG, _HAND_N_S_PER_M = 2.0, 50.0
_SPRING_N_PER_M, _WAY_M, _MEAN_M_S = (500.0, 2000.0), (0.05, 0.3), (0.05, 0.13)
# Of four movements one goes its way, one is broken off (the hand stops within so long), and two go back at once.
_STOP_S, _AFTER_S, _AWAY_M = 0.15, 0.5, 0.2
_MOVEMENTS, SEED = 64, 7919


def crossings(deviations: float, correlation: float) -> float:
    """Return P(X_0 ≤ u < X_1) of two ticks of standard normal noise with this correlation."""
    from scipy.integrate import quad  # noqa: PLC0415 - few controllers have a threshold

    if correlation >= 1.0:
        return 0.0
    apart = math.sqrt(1.0 - correlation**2)

    def density(x: float) -> float:
        return math.exp(-0.5 * x * x + float(log_ndtr((deviations - correlation * x) / apart)))

    # The integrand falls with e^(−x²/2) from u on.
    end = deviations + _FARTHEST / max(1.0, abs(deviations))
    whole, _ = quad(density, deviations, end, epsabs=0.0, epsrel=1e-9, limit=200)
    return float(whole) / math.sqrt(2.0 * math.pi)


def noise_per_hour(
    threshold_n: float, free_motion_n: float, noise_rms_n: float, correlation: float, sample_time_s: float, axes: int
) -> float:
    """Return how often an hour noise alone is expected to pass the threshold, as if all of it was the hardest start."""
    room = threshold_n - free_motion_n
    if noise_rms_n == 0.0:
        return 0.0 if room >= 0.0 else _HOUR_S / sample_time_s
    return axes * _SIGNS * _HOUR_S / sample_time_s * crossings(room / noise_rms_n, correlation)


def needed_deviations(correlation: float, sample_time_s: float, axes: int) -> float:
    """Return by how many deviations a threshold lies above free motion to be passed `MOST_PER_HOUR` times an hour."""
    least = MOST_PER_HOUR * sample_time_s / (axes * _SIGNS * _HOUR_S)
    return float(brentq(lambda u: math.log(crossings(u, correlation) / least), 0.0, 12.0, xtol=1e-6))


def correlation_of(spectrum: NoiseSpectrum | None, sample_time_s: float) -> float:
    """Return the correlation of noise between two ticks, ∫S cos(2πfh)df/∫S df; 0, the most crossings, if not known."""
    if spectrum is None or len(spectrum.frequency_hz) < 2:
        return 0.0
    frequency, density = np.array(spectrum.frequency_hz), np.array(spectrum.force_n2_per_hz)
    whole = float(np.trapezoid(density, frequency))
    if not whole > 0.0:
        return 0.0
    together = float(np.trapezoid(density * np.cos(2.0 * np.pi * frequency * sample_time_s), frequency))
    return min(max(together / whole, 0.0), 0.999)


def count_false_triggers(
    controller: Controller, *, free_motion_n: float, noise_rms_n: float, correlation: float
) -> FalseTriggers:
    """Return how often a controller's response is expected to begin in free motion."""
    straight, threshold = [name for name in controller.axes if name not in ROTATIONAL_AXES], _threshold(controller)
    h, felt = controller.sample_time_s, {name: noise_in_free_space(controller, name, correlation) for name in straight}
    opposing = [each for name in straight for each in braked(controller, name)]
    share = braking_share(opposing, threshold, noise_rms_n * max(each.gain for each in felt.values()))
    return FalseTriggers(
        free_motion_n=free_motion_n,
        noise_rms_n=noise_rms_n,
        noise_correlation=correlation,
        noise_per_hour=sum(
            noise_per_hour(threshold, free_motion_n, noise_rms_n * each.gain, each.correlation, h, 1)
            for each in felt.values()
        ),
        movements_per_hour=MOVEMENTS_PER_HOUR,
        braking_n=max(float(np.max(each, initial=0.0)) for each in opposing),
        braking_share=share,
        braking_per_hour=1.0 - (1.0 - share) ** MOVEMENTS_PER_HOUR,
    )


def noise_in_free_space(controller: Controller, name: str, correlation: float) -> FeltNoise:
    """Return the sensor's noise as the law of an axis reads it in free space, the largest over the ends of M_p."""
    plants, law = controller.certificate.domain[name].plants, admittance_controller(controller, name)
    loops = [build_sampled_plant(plants.at(mass, 0.0), controller.sample_time_s) for mass in plants.payload_mass_kg]
    return max((felt_noise(each, law, correlation) for each in loops), key=lambda each: each.gain)


def _threshold(controller: Controller) -> float:
    return math.inf if controller.collision.threshold_n is None else controller.collision.threshold_n


def braking_share(opposing: Sequence[FloatArray], threshold_n: float, noise_rms_n: float) -> float:
    """Return the share of movements that pass the threshold, from what opposes each (n,) [N].

    Of one movement it is 1 − Π_k (1 − Q((T − f_k)/σ)), with noise that is white from tick to tick.
    """
    missed = []
    for each in opposing:
        if noise_rms_n == 0.0:
            missed.append(float(np.max(each) <= threshold_n))
            continue
        below = log_ndtr((threshold_n - each) / noise_rms_n)
        missed.append(math.exp(float(np.sum(below))))
    return 1.0 - float(np.mean(missed))


def braked(controller: Controller, name: str) -> list[FloatArray]:
    """Return what opposes the motion [N] at the ticks of each drawn movement of an operator, as it is detected."""
    domain, h, effects = controller.certificate.domain[name], controller.sample_time_s, _effects(controller, name)
    plant, law = domain.plants.nominal, admittance_controller(controller, name)
    found = []
    for path, spring in _movements(h):
        hand = Operator(mass_kg=_HAND_KG, damping_n_s_per_m=_HAND_N_S_PER_M, stiffness_n_per_m=spring, path_m=path)
        substeps = needed_substeps(hand.held(plant), h)
        run = simulate_operator(plant, law, hand, sample_time_s=h, effects=effects, substeps=substeps)
        way = np.diff(run.flange_position_m, prepend=run.flange_position_m[0])
        found.append(np.asarray(run.seen_force_n * np.sign(way)))
    return found


def _effects(controller: Controller, name: str) -> Nonlinearities:
    """Return what acts in free motion: deadband and variable damping of the file, and no response."""
    strategy = file_strategy(controller, name)
    return Nonlinearities(deadband=file_deadband(controller.axes[name]), variable_damping=strategy.variable_damping)


def _movements(h: float) -> list[tuple[FloatArray, float]]:
    """Return ways (n,) [m] that end before the wall, and springs [N/m], drawn from one seed."""
    rng, drawn = np.random.default_rng(SEED), []
    for number in range(_MOVEMENTS):
        spring, way, mean = (
            float(low * (high / low) ** rng.random()) for low, high in (_SPRING_N_PER_M, _WAY_M, _MEAN_M_S)
        )
        duration, moment = way / mean, rng.uniform(0.3, 0.7)
        goes_back = number % 4 > 1
        time = np.arange(0.0, (2.0 if goes_back else 1.0) * duration + _AFTER_S, h)
        share = np.clip(time / duration, 0.0, 1.0)
        if number % 4 == 1:
            # Its time runs ever slower, and stands still after `_STOP_S`.
            begun = np.clip(time - moment * duration, 0.0, _STOP_S)
            share = np.where(time < moment * duration, share, moment + (begun - 0.5 * begun**2 / _STOP_S) / duration)
        if goes_back:
            share = np.minimum(share, np.clip(2.0 - time / duration, 0.0, 1.0))
        moved = way * (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)
        drawn.append((moved - (way + _AWAY_M), spring))
    return drawn


# Sums of the same terms; a probability of nearly 1 hangs on tails by rounding.
_SAME, _SAME_BRAKED, _NOTHING = 1e-6, 1e-3, 1e-12


def wrong_false_triggers(controller: Controller, opposed_n: float) -> list[str]:
    """Return what of the stated false triggers is not so; `opposed_n` is what replays found in free motion."""
    stated = controller.collision.false_triggers
    if stated is None:
        return []
    found = count_false_triggers(
        controller,
        free_motion_n=stated.free_motion_n,
        noise_rms_n=stated.noise_rms_n,
        correlation=stated.noise_correlation,
    )
    same = {"noise_per_hour": _SAME, **dict.fromkeys(("braking_n", "braking_share", "braking_per_hour"), _SAME_BRAKED)}
    wrong = [
        f"false_triggers.{name} is stated as {getattr(stated, name):.4g}, found {getattr(found, name):.4g}"
        for name, share in same.items()
        if not math.isclose(getattr(stated, name), getattr(found, name), rel_tol=share, abs_tol=_NOTHING)
    ]
    if stated.free_motion_n < 0.98 * opposed_n:
        wrong.append(f"false_triggers.free_motion_n is stated as {stated.free_motion_n:.4g} N, found {opposed_n:.4g}")
    return wrong


def describe_false_triggers(stated: FalseTriggers) -> str:
    """Return in words how often a response begins where nothing was touched."""
    hand = (
        f"{stated.braking_share:.3g} of an operator's movements do, and {stated.braking_per_hour:.2g} is the "
        f"probability of one in an hour ({stated.movements_per_hour:g} movements, the hardest opposes with "
        f"{stated.braking_n:.3g} N)"
    )
    return (
        f"false triggers: noise of {stated.noise_rms_n:.3g} N RMS passes the threshold {stated.noise_per_hour:.1e} "
        f"times an hour; {hand}"
    )
