"""How far a design is from what any linear controller could reach under the same requirements."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from autotune.certificate.least_peak import Asked, LeastPeak, find_least_peak
from autotune.charts.chart import Chart, Line, Panel, Role, Scale
from autotune.charts.chart import Limit as ChartLimit
from autotune.errors import InfeasibleError
from autotune.text import scenario_text
from problems.contact.transient import (
    Approach,
    ContactTransient,
    SampledContact,
    build_sampled_contact,
    simulate_contact,
)
from problems.design.objectives import PeakObjective
from problems.design.problem import DesignProblem
from problems.design.requirements import MARGINS, Requirements, band_frequencies
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import STRAIGHT, AxisKind
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.sampled import build_loop, build_sampled_plant
from problems.progress import no_progress
from problems.stability.margins import UnstableLoopError
from problems.stability.noise_spectrum import RelativeSpectrum

from .judge import LoopJudge, ReachedPeak
from .noise_trade import NoisePoint
from .programs import ConvexStep, EqualDemands, LowerBound, NoSolutionError, lower_bound
from .signals import ContactSignals, contact_signals
from .youla import YoulaBasis

# Ticks of the finite response, and time constants of the exponentials in samples.
_TAPS, _TIME_CONSTANTS = 150, (12.0, 40.0, 120.0, 400.0)
_MOST_STEPS, _SETTLED = 8, 1e-3
_SHORTEST, _LONGEST, _PEAK_TIMES = 250, 900, 8
_BOUND_SHORTEST, _BOUND_LONGEST, _BOUND_PEAK_TIMES = 120, 450, 2
_SHOWN_S = 0.2
_MET = 1.0 + 1e-9
# Within this share of the force that it rests with, nothing better is looked for.
_AT_REST = 1.005
# A limit of the noise that lies this near to that of the design is the same in a sentence.
_SAME_NOISE = 0.01

NEGLECTED_BELOW = (
    "free space, the admittance beyond its speed of approach, the other margins, what noise and modulus ask after the "
    "ticks that count, and the force between two ticks"
)
NEGLECTED_AT_REST = "a deadband, with which the robot may stop short of F^d"
NEGLECTED_ABOVE = (
    "requirements beside modulus, noise and admittance, of which other margins are compared on the exact loops, plants "
    "beside those looked at, deadband and command limits"
)


@dataclass(frozen=True, kw_only=True)
class LimitResult:
    """The design, a linear controller that gets nearer, and the force that none gets below, over `scenarios`.

    `attained` is None where nothing better than the design was found. `states` is the order of that controller,
    `noise_factor` how often the design's noise it may have, `missed` the margins that it was not asked to keep and that
    lie below what the problem asks, by name: what is asked and what it has. `trade` is what four gains reach with other
    noise, where that was looked for; `two_gains` what no other B_a and K_l in their bounds get below on the hardest
    contact, M_a and B_fb as they are, None where that cannot be bounded (`certificate.least_peak`) or F^d is the bound.
    """

    scenarios: tuple[Scenario, ...]
    place: str
    approach_speed_m_s: float
    asked: EqualDemands
    noise_factor: float
    design: ReachedPeak
    attained: ReachedPeak | None
    controller: LinearController | None
    bound: LowerBound
    missed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    trade: tuple[NoisePoint, ...] = ()
    two_gains: LeastPeak | None = None

    @property
    def neglected_below(self) -> str:
        """What the bound from below leaves out."""
        return NEGLECTED_AT_REST if self.bound.is_at_rest else NEGLECTED_BELOW

    @property
    def reached_n(self) -> float:
        """The least peak [N] that a known controller reaches."""
        return self.design.peak_force_n if self.attained is None else self.attained.peak_force_n

    def summary(self, unit: str = "N") -> str:
        """Return the answer in one sentence."""
        said = f"{self.design.peak_force_n:.4g} {unit}; "
        if self.two_gains is not None:
            said += (
                f"no other B_a and K_l in their bounds beside its M_a and B_fb get below {self.two_gains.force_n:.4g} "
                f"{unit}, proved; "
            )
        noise = (
            "of this noise"
            if abs(self.noise_factor - 1.0) < _SAME_NOISE
            else f"of {self.noise_factor:.3g} times its noise"
        )
        if self.bound.is_at_rest:
            said += (
                f"no controller gets below {self.bound.force_n:.4g} {unit}, the F^d that presses on when it has stopped"
            )
        else:
            said += f"at this speed of approach no linear controller {noise} gets below {self.bound.force_n:.4g} {unit}"
        if self.attained is None:
            is_least = self.bound.is_at_rest and self.design.peak_force_n <= self.bound.force_n * _AT_REST
            return said if is_least else f"{said}, and none better than the design was found"
        said = f"{said}; {self.reached_n:.4g} {unit} is reached"
        misses = [
            f"{each.title} of {each.shown_scale * has:.4g} where {each.shown_scale * asked:.4g} {each.unit}".replace(
                " °", "°"
            )
            + " is asked"
            for each in MARGINS
            if each.name in self.missed
            for asked, has in (self.missed[each.name],)
        ]
        return f"{said}, with a {' and a '.join(misses)}" if misses else said

    def chart(self, title: str, unit: str = "N") -> Chart:
        """Return the picture: the force of both contacts over time, and the force that none gets below."""
        lines = [_line(self.design.trace, self.place, "the design", "before")]
        if self.attained is not None:
            lines.append(_line(self.attained.trace, self.place, "a linear controller of any order", "after"))
        label = "F^d, no controller below" if self.bound.is_at_rest else "no linear controller below"
        floor = ChartLimit(value=self.bound.force_n, label=label)
        what = "force" if unit == "N" else "torque"
        panel = Panel(
            x=Scale(label="time after touching [ms]"),
            y=Scale(label=f"{what} at the {self.place} [{unit}]"),
            elements=(*lines, floor),
            title=title,
        )
        key = f"{title.removeprefix('axis ')}-limit"
        return Chart(key=key, title="How far from the limit", alternative=self.summary(unit), panels=(panel,))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "scenarios": [
                {
                    "environment_stiffness_n_per_m": each.environment_stiffness_n_per_m,
                    "payload_mass_kg": each.payload_mass_kg,
                    **each.further(),
                }
                for each in self.scenarios
            ],
            "peak_at": self.place,
            "approach_speed_m_s": self.approach_speed_m_s,
            "modulus_margin": self.asked.modulus,
            "noise_m_s_per_n": self.asked.noise_m_s_per_n,
            "noise_factor": self.noise_factor,
            "design": self.design.to_dict(),
            "attained": None if self.attained is None else self.attained.to_dict(),
            "missed": {name: {"asked": asked, "attained": has} for name, (asked, has) in self.missed.items()},
            "states": None if self.controller is None else self.controller.state_count,
            "lower_bound": asdict(self.bound),
            "two_gains": None if self.two_gains is None else {"force_n": self.two_gains.force_n},
            **({"noise_trade": [each.to_dict() for each in self.trade]} if self.trade else {}),
            "neglected": {"attained": NEGLECTED_ABOVE, "lower_bound": self.neglected_below},
        }


def _line(trace: ContactTransient, place: str, label: str, role: Role) -> Line:
    force = trace.contact_force_n if place == "contact" else trace.sensor_force_n
    shown = trace.time_s <= max(_SHOWN_S, 3.0 * trace.time_of_peak_s)
    return Line(x=1e3 * trace.time_s[shown], y=force[shown], label=label, role=role)


def hardest(
    problem: DesignProblem,
    law: AdmittanceController,
    scenarios: Sequence[Scenario],
    count: int,
    *,
    units: AxisKind = STRAIGHT,
) -> tuple[Scenario, ...]:
    """Return the `count` scenarios of the largest peaks; raises InfeasibleError where the law is unstable on one."""
    peaks = []
    for each in dict.fromkeys(scenarios):
        pair = build_sampled_contact(build_sampled_plant(problem.plant(each), problem.sample_time_s))
        try:
            trace = simulate_contact(pair, law, problem.approach)
        except UnstableLoopError as error:
            raise InfeasibleError(
                f"The design is unstable at {scenario_text(each, units)} ({error}), so it has no peak."
            ) from error
        place = problem.objective.place if isinstance(problem.objective, PeakObjective) else "contact"
        peaks.append((trace.peak_contact_force_n if place == "contact" else trace.peak_sensor_force_n, each))
    return tuple(each for _, each in sorted(peaks, key=lambda pair: -pair[0])[:count])


def find_limit(
    problem: DesignProblem,
    law: AdmittanceController,
    scenarios: Sequence[Scenario],
    *,
    noise_factor: float = 1.0,
    spectrum: RelativeSpectrum | None = None,
    progress: Callable[[float], None] | None = None,
) -> LimitResult:
    """Return how near `law` is to the limit over `scenarios`, the hardest contact first.

    All controllers approach with the speed of the law, meet the modulus and the free-space admittance of the problem,
    and have at most `noise_factor` times the noise of the law, or of what the problem allows where it limits the noise.
    The force's noise is that of the limit; where nothing limits it, of a `spectrum`, or white.
    Raises InfeasibleError where the law itself is unstable on one of the plants.
    """
    report = progress or no_progress
    pairs = tuple(
        build_sampled_contact(build_sampled_plant(problem.plant(each), problem.sample_time_s)) for each in scenarios
    )
    at_contact = not isinstance(problem.objective, PeakObjective) or problem.objective.place == "contact"
    requirements, target = problem.requirements, problem.requirements.free_space_admittance
    if (allowed := requirements.command_noise) is not None:
        spectrum = allowed.noise_spectrum
    band = np.zeros(0) if target is None else band_frequencies(pairs[0].contact.plant.robot, target.band_hz)
    judge = LoopJudge(
        pairs=pairs,
        approach=problem.approach,
        band_rad_per_s=band if len(band) else np.array([2.0 * math.pi]),
        at_contact=at_contact,
        spectrum=spectrum,
    )
    try:
        design = judge(law)
    except UnstableLoopError as error:
        raise InfeasibleError(f"The design is unstable on a plant of the set ({error}), so it has no peak.") from error
    noise = design.noise_m_s_per_n
    if allowed is not None and allowed.force_noise_rms_n:
        noise = allowed.max_speed_rms_m_s / allowed.force_noise_rms_n
    noise *= noise_factor
    asked = EqualDemands(
        modulus=requirements.modulus_margin or design.modulus,
        min_m_s_per_n=None if target is None else target.min_m_s_per_n,
        band_rad_per_s=band,
        noise_m_s_per_n=noise,
        driving_force_n=design.trace.driving_force_n,
        at_contact=at_contact,
        spectrum=spectrum,
    )
    attained, controller, bound = _solve(pairs, law, problem.approach, asked, judge, design.peak_force_n, report)
    two_gains = None
    if at_contact and not bound.is_at_rest:
        two_gains = _bound_two_gains(problem, law, scenarios, asked, design.peak_force_n)
    better = attained is not None and attained.peak_force_n < design.peak_force_n
    return LimitResult(
        scenarios=tuple(scenarios),
        place="contact" if at_contact else "sensor",
        approach_speed_m_s=design.trace.contact_speed_m_s,
        asked=asked,
        noise_factor=noise / design.noise_m_s_per_n,
        design=design,
        attained=attained if better else None,
        controller=controller if better else None,
        bound=bound,
        missed=_missed(requirements, attained) if better and attained is not None else {},
        two_gains=two_gains,
    )


def _solve(
    pairs: Sequence[SampledContact],
    law: AdmittanceController,
    approach: Approach,
    asked: EqualDemands,
    judge: LoopJudge,
    peak_force_n: float,
    report: Callable[[float], None],
) -> tuple[ReachedPeak | None, LinearController | None, LowerBound]:
    """Return the best controller that met everything, if any was looked for and found, and the bound from below."""
    # A law that approaches under a force does not rest before the contact's force is that.
    rest = LowerBound(force_n=approach.force_n or 0.0, ticks=0, inputs=0, is_at_rest=True)
    if peak_force_n <= rest.force_n * _AT_REST:
        report(1.0)
        return None, None, rest
    signals = _signals(pairs, law, approach)
    attained, controller = _attain(signals, law, asked, judge, lambda share: report(0.8 * share))
    bounds = (lower_bound(each, asked, _bound_ticks(each, law, approach)) for each in signals)
    bound = max((rest, *bounds), key=lambda found: found.force_n)
    report(0.2)
    return attained, controller, bound


def _bound_two_gains(
    problem: DesignProblem,
    law: AdmittanceController,
    scenarios: Sequence[Scenario],
    asked: EqualDemands,
    reached_n: float,
) -> LeastPeak | None:
    """Return the bound over B_a and K_l, None for plants and laws that it is not made for."""
    plants = dict.fromkeys(problem.plant(each) for each in (*scenarios, *problem.scenarios(2, 2)))
    demands = Asked(
        modulus=asked.modulus,
        min_m_s_per_n=asked.min_m_s_per_n,
        band_rad_per_s=asked.band_rad_per_s,
        noise_m_s_per_n=asked.noise_m_s_per_n,
        noise_spectrum=asked.spectrum,
    )
    bounds = problem.bounds["damping"], problem.bounds["lead_s"]
    try:
        return find_least_peak(
            list(plants), law, problem.approach, problem.sample_time_s, bounds, demands, reached_n=reached_n
        )
    except ParameterError:
        return None


def _missed(requirements: Requirements, found: ReachedPeak) -> dict[str, tuple[float, float]]:
    """Return the margins that are asked and not held, by name: what is asked, what it has."""
    missed = {}
    for each in MARGINS:
        asked, has = requirements.asked().get(each.name), float(getattr(found, each.margin))
        if isinstance(asked, float | int) and has < asked:
            missed[each.name] = (float(asked), has)
    return missed


def _signals(
    pairs: Sequence[SampledContact], law: AdmittanceController, approach: Approach
) -> tuple[ContactSignals, ...]:
    traces = [simulate_contact(pair, law, approach) for pair in pairs]
    h = pairs[0].contact.sample_time_s
    latest = max(trace.time_of_peak_s for trace in traces)
    count = min(_LONGEST, max(_SHORTEST, math.ceil(_PEAK_TIMES * latest / h)))
    return tuple(
        contact_signals(pair, trace.contact_speed_m_s, count) for pair, trace in zip(pairs, traces, strict=True)
    )


def _bound_ticks(signals: ContactSignals, law: AdmittanceController, approach: Approach) -> int:
    peak_s = simulate_contact(signals.pair, law, approach).time_of_peak_s
    ticks = math.ceil(_BOUND_PEAK_TIMES * peak_s / signals.pair.contact.sample_time_s)
    return min(max(ticks, _BOUND_SHORTEST), _BOUND_LONGEST, len(signals.wall_force))


def _attain(
    signals: tuple[ContactSignals, ...],
    law: AdmittanceController,
    asked: EqualDemands,
    judge: LoopJudge,
    report: Callable[[float], None],
) -> tuple[ReachedPeak | None, LinearController | None]:
    """Return the best controller that met everything on the exact loops, None where there was none."""
    first = signals[0]
    basis = YoulaBasis(
        taps=_TAPS, decays=np.exp(-1.0 / np.array(_TIME_CONSTANTS)), loop=build_loop(first.pair.contact, law)
    )
    step, best = ConvexStep(basis, signals, asked), None
    theta, kept, trust = step.start(basis.start()), None, 1.0
    for i in range(_MOST_STEPS):
        try:
            moved = step.solve(theta, 0.3 * trust)
        except NoSolutionError:
            break
        made = basis.controller(moved, first.open, first.pair.contact.sample_time_s)
        found, met = _judged(judge, made), step.met(moved)
        report(1.0 / _MOST_STEPS)
        if found is None or met < 0.5:
            trust *= 0.5
            continue
        theta = moved
        if _meets(found, asked, met):
            settled = best is not None and found.peak_force_n > best.peak_force_n * (1.0 - _SETTLED)
            if best is None or found.peak_force_n < best.peak_force_n:
                best, kept = found, made
            if settled:
                report(1.0 - (i + 1.0) / _MOST_STEPS)
                break
    return best, kept


def _judged(judge: LoopJudge, law: LinearController) -> ReachedPeak | None:
    try:
        return judge(law)
    except UnstableLoopError:
        return None


def _meets(found: ReachedPeak, asked: EqualDemands, met: float) -> bool:
    """Return whether a controller meets everything; `met` is the modulus over what is asked, by Q itself."""
    is_free = asked.min_m_s_per_n is None or found.min_m_s_per_n >= asked.min_m_s_per_n
    is_quiet = found.noise_m_s_per_n <= asked.noise_m_s_per_n * _MET
    return min(found.modulus, met * asked.modulus) >= asked.modulus and is_quiet and is_free
