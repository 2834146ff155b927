"""Contact strategies beside the gains: which B_a the speed may set, chosen for the contacts, then the response."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from autotune.errors import CertificateError, UsageError
from autotune.formats.certificate_record import Certificate, Proof
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import VariableDampingSettings
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES
from autotune.validation.axis_proof import Prover
from autotune.validation.validation_samples import sampled_claims
from autotune.validation.variable_damping import known_modulus, modulus_at_ends, prove_varied
from identification.result import Identified
from problems.contact.nonlinear_simulation import NonlinearRun
from problems.design.objectives import PLACES, force_of
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius

from .first_contacts import FirstContacts, contacts_of, peaks_of, predictions
from .search import SearchResult
from .threshold import SAME_PEAK, ThresholdSettings, choose_threshold, predicted_scenarios, threshold_settings

Interval = tuple[float, float]

# The paper's rate of updates, 100 Hz.
_UPDATE_S = 0.01
# B_a crosses its range in so many time constants of the stiffest contact, and in 0.1 s at least: slow for the loop,
# and not slower than a hand.
_TIME_CONSTANTS, _FASTEST_S = 3.0, 0.1
# With more between the ends B_a(v) v would not rise with the speed everywhere, and one force had two steady speeds.
_MOST_RATIO = 2.7
# So many highest B_a are looked at, and for each the lowest is found to some per cent.
_HIGHEST, _BISECTIONS, _AS_LIGHT, _MORE = 4, 5, 1.02, 1.001
END_SHARE = 0.8
"""Of the modulus asked of the design, what the loops that keep the lowest or the highest B_a must have."""


@dataclass(frozen=True, kw_only=True)
class StrategySettings:
    """What is asked beside gains: bounds [N·s/m] of a B_a that varies, and a collision response; None for none."""

    damping_bounds: Interval | None = None
    threshold: ThresholdSettings | None = None


def strategy_settings(identified: Identified, spec: ProblemSpec) -> StrategySettings | None:
    """Return what a problem asks beside gains; None where it asks for nothing."""
    threshold = threshold_settings(identified, spec)
    if threshold is None and spec.variable_damping is None:
        return None
    return StrategySettings(damping_bounds=spec.variable_damping, threshold=threshold)


def choose_strategies(
    controller: Controller, searches: Mapping[str, SearchResult], settings: StrategySettings, prover: Prover
) -> Controller:
    """Return the controller with the strategies that are asked and are worth having.

    Raises what `choose_threshold` raises, UsageError where the contact cannot be simulated, and CertificateError where
    stability under a B_a that varies cannot be proved.
    """
    if settings.damping_bounds is not None:
        controller = _with_variable_damping(controller, searches, settings.damping_bounds, prover)
    if settings.threshold is not None:
        controller, _ = choose_threshold(controller, searches, settings.threshold)
    return controller


@dataclass(frozen=True, kw_only=True)
class _Tried:
    """One variable damping with the runs of all contacts and their worst peak of the objective's kind."""

    variable: VariableDampingSettings | None
    runs: Mapping[Scenario, NonlinearRun]
    worst: tuple[float, float]

    @property
    def lowest(self) -> float:
        return math.inf if self.variable is None else self.variable.lowest

    @property
    def highest(self) -> float:
        return 0.0 if self.variable is None else self.variable.highest


def _with_variable_damping(
    controller: Controller, searches: Mapping[str, SearchResult], bounds: Interval, prover: Prover
) -> Controller:
    """Return the controller whose straight axes vary B_a, where that makes them lighter or their contacts gentler."""
    straight = [name for name in controller.axes if name not in ROTATIONAL_AXES]
    if not straight:
        raise UsageError(
            "variable_damping_n_s_per_m is of straight axes, and only axes that turn are tuned; leave it out of free."
        )
    found, trees, proofs = {}, {}, []
    predicted = dict(controller.predicted)
    for name in straight:
        try:
            plain, best = _choose(controller, name, searches[name], bounds)
        except ParameterError as error:
            raise UsageError(f"free.variable_damping_n_s_per_m: the contact cannot be simulated: {error}") from error
        trees[name] = _tree(controller, name, bounds, plain, best)
        if best.variable is None:
            continue
        plants, law = controller.certificate.domain[name].plants, admittance_controller(controller, name)
        h = controller.sample_time_s
        proof = prove_varied(prover, plants, law, h, best.variable, known_modulus(controller, name))
        if not proof.holds:
            raise CertificateError(
                f"Axis {name}: stability while B_a varies in [{best.variable.lowest:g}, {best.variable.highest:g}] "
                f"N·s/m needs a modulus of {proof.needed_modulus:.3g} at {proof.centre:g}, which is not proved; narrow "
                "free.variable_damping_n_s_per_m."
            )
        found[name], trees[name]["needed_modulus"] = best.variable, proof.needed_modulus
        trees[name]["modulus_at_ends"] = modulus_at_ends(plants, law, h, best.variable)
        proofs.append(proof.statement(plants, best.variable, name))
        predicted[name] = replace(predicted[name], with_variable_damping=predictions(name, predicted[name], best.runs))
    provenance = {**controller.provenance, "variable_damping": trees}
    return replace(
        controller,
        variable_damping=found or None,
        certificate=_certificate(controller, found, proofs) if found else controller.certificate,
        predicted=predicted,
        provenance=provenance,
    )


def _certificate(
    controller: Controller, varied: Mapping[str, VariableDampingSettings], proofs: Sequence[Proof]
) -> Certificate:
    """Return the certificate with what is proved of a B_a that varies, less what is proved of a constant one alone.

    That is that every motion comes to rest in contact; it is searched for at both ends instead.
    """
    whole = controller.certificate
    bouncing = {name: each for name, each in (whole.bouncing or {}).items() if name not in varied}
    sampled = tuple(
        claim
        for name in controller.axes
        for claim in sampled_claims(
            whole.domain[name],
            whole.margins[name],
            controller.predicted[name],
            name,
            (whole.continuous or {}).get(name, ()),
            bouncing.get(name),
        )
    )
    return replace(whole, proved=(*whole.proved, *proofs), sampled=sampled, bouncing=bouncing or None)


def _choose(controller: Controller, name: str, search: SearchResult, bounds: Interval) -> tuple[_Tried, _Tried]:
    """Return the contacts at the constant B_a, and under the best variable damping: the former where there is none.

    For each highest B_a the lowest that is allowed is found by bisection: the lower it is, the faster and harder is the
    approach. The lightest counts, and of those that are as light to 2 % the one that is heaviest at rest.
    """
    contacts, scenarios = contacts_of(controller, name), predicted_scenarios(controller.predicted[name], search)
    plain = _run(contacts, scenarios, None)
    known, own = known_modulus(controller, name), controller.axes[name].damping
    low, high = min(bounds[0], own), max(bounds[1], own)
    is_allowed = partial(_is_allowed, plain=plain, controller=controller, name=name, search=search)
    found = []
    for highest in dict.fromkeys(_digits(each, own) for each in np.geomspace(own, high, _HIGHEST).tolist()):
        # Around the middle of the range this much of the modulus is needed at least.
        share = (1.0 - known[0]) / (1.0 + known[0]) if known is not None else 1.0
        least = max(low, highest / _MOST_RATIO, _MORE * highest * share)
        found.append(_lighter(contacts, scenarios, highest, (least, own), is_allowed, plain))
    lightest = min((each.lowest for each in found), default=math.inf)
    as_light = [each for each in found if each.lowest <= _AS_LIGHT * lightest]
    return plain, max(as_light, key=lambda each: each.highest, default=plain)


def _lighter(
    contacts: FirstContacts,
    scenarios: tuple[Scenario, ...],
    highest: float,
    span: Interval,
    is_allowed: Callable[[_Tried], bool],
    best: _Tried,
) -> _Tried:
    """Return the variable damping of the least lowest B_a in `span` that is allowed, to some per cent, else `best`."""
    low, high = span

    def at(lowest: float) -> _Tried | None:
        if not span[0] <= lowest <= span[1] or lowest >= highest:
            return None
        tried = _run(contacts, scenarios, _schedule(contacts, lowest, highest))
        return tried if is_allowed(tried) else None

    found = at(_digits(low, high))
    for _ in range(_BISECTIONS if found is None and low < high else 0):
        lowest = float(f"{math.sqrt(low * high):.3g}")
        tried = at(lowest)
        best, low, high = (best, lowest, high) if tried is None else (tried, low, lowest)
    return found or (at(span[1]) or best if best.variable is None else best)


def _digits(value: float, own: float) -> float:
    """Return a number to three digits, but that of the design as it is."""
    return own if math.isclose(value, own) else float(f"{value:.3g}")


def _schedule(contacts: FirstContacts, lowest: float, highest: float) -> VariableDampingSettings:
    """Return the schedule that is at its lowest B_a at the speed of the approach, and slow against the contact."""
    h, domain = contacts.sample_time_s, contacts.domain
    speed = domain.approach_speed_m_s or (domain.approach_force_n or 0.0) / (lowest + domain.drag_n_s_per_m)
    periods = max(1, math.ceil(_UPDATE_S / h - 1e-9))
    stiff = contacts.domain.plants.at(domain.payload_mass_kg[1], domain.environment_stiffness_n_per_m[1])
    radius = spectral_radius(build_loop(build_sampled_plant(stiff, h), contacts.law))
    crossing = max(_FASTEST_S, _TIME_CONSTANTS * h / -math.log(radius)) if 0.0 < radius < 1.0 else _FASTEST_S
    return VariableDampingSettings(
        highest=highest,
        lowest=lowest,
        decay_s_per_m=float(f"{math.log(highest / lowest) / speed:.3g}"),
        update_periods=periods,
        largest_change=float(f"{(highest - lowest) * periods * h / crossing:.3g}"),
    )


def _run(contacts: FirstContacts, scenarios: tuple[Scenario, ...], variable: VariableDampingSettings | None) -> _Tried:
    simulated = replace(contacts, variable=variable)
    runs = {each: simulated.run(each, None) for each in scenarios}
    peaks = np.array([peaks_of(each) for each in runs.values()])
    return _Tried(variable=variable, runs=runs, worst=(float(np.max(peaks[:, 0])), float(np.max(peaks[:, 1]))))


def _is_allowed(each: _Tried, plain: _Tried, controller: Controller, name: str, search: SearchResult) -> bool:
    """Whether peaks and margins under a variable damping are allowed, and it is lighter or gentler than none.

    Allowed are `max_peak_force_n` at the contact where that is asked, else no peak above those at the constant B_a. The
    loops that keep the lowest and the highest B_a have most of the modulus that is asked. One that is no lighter must
    lower the worst peak of the objective.
    """
    asked, kind = search.problem.requirements, PLACES.index(force_of(search.problem.objective).place)
    most = tuple((1.0 + SAME_PEAK) * peak for peak in plain.worst)
    if asked.max_peak_force_n is not None and "max_peak_force_n" not in asked.soft_n:
        most = (max(asked.max_peak_force_n, most[0]), math.inf)
    is_better = each.lowest < controller.axes[name].damping or each.worst[kind] < (1.0 - SAME_PEAK) * plain.worst[kind]
    if each.variable is None or not is_better or any(found > top for found, top in zip(each.worst, most, strict=True)):
        return False
    plants, law = controller.certificate.domain[name].plants, admittance_controller(controller, name)
    modulus = modulus_at_ends(plants, law, controller.sample_time_s, each.variable)
    return modulus > 0.0 and modulus >= END_SHARE * (asked.modulus_margin or 0.0)


def _tree(controller: Controller, name: str, bounds: Interval, plain: _Tried, best: _Tried) -> dict[str, Any]:
    """Return what was chosen as plain data, for the provenance of a controller."""
    own, drag = controller.axes[name].damping, controller.certificate.domain[name].drag_n_s_per_m
    lowest = own if best.variable is None else best.variable.lowest
    return {
        "bounds_n_s_per_m": list(bounds),
        "is_used": best.variable is not None,
        "hand_force_n_per_m_s": {"without": own + drag, "with": lowest + drag},
        "worst_contact_peak_n": {"without": plain.worst[0], "with": best.worst[0]},
        "worst_sensor_peak_n": {"without": plain.worst[1], "with": best.worst[1]},
    }
