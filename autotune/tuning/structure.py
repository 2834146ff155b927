"""Search laws freer than four gains in their bounds, at the noise of the command that the robot has anyway."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError
from autotune.formats.canonical import lines_to_paste
from autotune.formats.problem import ProblemSpec, Structure
from autotune.formats.units import ROTATIONAL_AXES
from identification.result import Identified
from problems.arrays import FloatArray
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.evaluation import build_scenarios
from problems.design.hand import HandImpedance
from problems.design.problem import BIQUAD_VARIABLES, DesignProblem, NoiseLimit, biquad_bounds
from problems.design.requirements import AdmittancePeak, HeldByHand, NoiseRequirement
from problems.design.requirements.held_by_hand import HeldByHandRequirement
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.stability.noise_spectrum import RelativeSpectrum

from .bounds import loosened_bounds
from .noise_limit import UNKNOWN, NoiseOf, jitter_speed, measured_noise
from .record import certified_hand
from .relax import find_met, find_nearest
from .search import SearchResult, solve_design
from .structure_choice import PRICE, StructureChoice

_ORDER: tuple[Structure, ...] = ("gains", "noise", "biquad")
DEFAULT: Structure = "noise"
_HELD, _RISE = "held_by_hand", "admittance_peak"
# What nobody sees of a payload that starts; the least that the search has to move in.
_MOST_RISE = 1.05
# Of the modulus that the four gains keep in a hand.
_KEPT_IN_A_HAND = 0.9
# Where the admittance has no band, the slowest corner.
_SLOWEST_HZ = 2.0
# Corners [rad/s] at which a biquad that does nothing begins, and its damping.
_CORNERS, _DAMPING = (25.0, 60.0, 120.0, 250.0, 600.0), 0.4
# M_a is held this much above h B_a of the usual law at first, then above that of the law found, which moves with it:
# more where that was too little.
_USUAL_ABOVE, _NEAR_A_TICK = 1.06, 1.08
_ABOVE_A_TICK = (1.01, 1.01, 1.05, 1.1, 1.25, 1.5)
# What the noise of the plain law is rounded up by, so that six digits of it are not in the way.
_ROUNDED = 1e-6


class StructureSearch:
    """Searches every axis again with the structure that is asked, and says what it does.

    Unless it is said, the noise of the command is limited in the place of bounds.
    """

    def __init__(self, spec: ProblemSpec, identified: Identified, seed: int) -> None:
        self._structure, self._identified, self._seed = spec.structure or DEFAULT, identified, seed
        self._said, self._said_turning = {*spec.bounds}, {*spec.bounds, *spec.rotational.bounds}
        self.choices: dict[str, StructureChoice] = {}
        self.suggested: dict[str, SearchResult] = {}
        self._unweighed: list[str] = []

    def searched(self, plain: Mapping[str, SearchResult]) -> dict[str, SearchResult]:
        """Return the searches with the structure, where it is worth it."""
        found = dict(plain)
        for name, each in plain.items():
            if self._structure == "gains" or name in self.choices:
                continue
            if not self._is_weighed(name, each.problem):
                self._unweighed.append(name)
                continue
            found[name], choice = self._chosen(name, each, self._structure)
            if len(choice.costs) > 1:
                self.choices[name] = choice
        return found

    def beyond_gains(self, name: str, problem: DesignProblem) -> SearchResult | None:
        """Return a design of a freer structure where four gains in their bounds meet no requirements; None without one.

        It makes no more noise of the command than the four gains that come nearest, or the robot's jitter. What only a
        structure would meet that is not asked is kept in `suggested`. None too where gains meet them after all.
        """
        if self._structure == "gains" or not self._is_weighed(name, problem):
            return None
        nearest = nearest_gains(problem, self._seed)
        if nearest is None or nearest.evaluation.violation <= 0.0:
            return None
        for structure in _ORDER[_ORDER.index(self._structure) :]:
            try:
                found, choice = self._chosen(name, nearest, structure)
            except InfeasibleError:
                continue
            if structure == self._structure:
                self.choices[name] = choice
                return found
            self.suggested[name] = found
        return None

    def noise_limitable(self, problems: Mapping[str, DesignProblem]) -> frozenset[str]:
        """Return the axes of which a limit of the command's noise, which was not asked, could take the place of bounds.

        None of a sensor without noise.
        """
        if self._structure != "gains":
            return frozenset()
        weighed = [name for name, problem in problems.items() if self._is_weighed(name, problem)]
        return frozenset(name for name in weighed if measured_noise(self._identified, name).force != 0.0)

    def suggestion(self, name: str) -> dict[str, Any]:
        """Return the part of problem.yaml with which an axis has a design that four gains have not; empty without."""
        return {"structure": "biquad"} if name in self.suggested else {}

    def suggestion_message(self, name: str) -> str:
        """Return a sentence on it; empty without."""
        if name not in self.suggested:
            return ""
        found, turning = self.suggested[name], name in ROTATIONAL_AXES
        objective = found.problem.objective
        best = f"{objective.title} {objective.value(found.evaluation.cost):.4g} {objective.unit_on(turning=turning)}"
        lines = "; ".join(lines_to_paste(self.suggestion(name)))
        return (
            "All of it is met with a second-order section in the path of the force, "
            f"{best.rstrip()}, which --structure biquad asks for, or this line in problem.yaml: {lines}"
        )

    def _is_weighed(self, name: str, problem: DesignProblem) -> bool:
        """Return whether there is something to weigh the pose's noise against, which B_fb brings into the command."""
        noise = measured_noise(self._identified, name)
        return not noise.position or bool(noise.force) or problem.requirements.command_noise is not None

    def _chosen(self, name: str, plain: SearchResult, structure: Structure) -> tuple[SearchResult, StructureChoice]:
        hand, said = certified_hand(name, plain.problem), self._said_turning if name in ROTATIONAL_AXES else self._said
        noise = measured_noise(self._identified, name)
        return choose_structure(plain, structure, hand, seed=self._seed, said=said, measured=noise)

    def notes(self, searches: Mapping[str, SearchResult]) -> list[str]:
        """Return a sentence for each axis."""
        unweighed = [
            f"Axis {name}: the four gains stay in their bounds: the log shows noise of the pose but none of the "
            "sensor, so that no limit of the command's noise follows; say requirements.command_noise in problem.yaml "
            "for more."
            for name in self._unweighed
        ]
        return [*unweighed, *(each.message(name, searches[name].problem) for name, each in self.choices.items())]


def choose_structure(
    plain: SearchResult,
    structure: Structure,
    hand: HandImpedance,
    *,
    seed: int,
    said: Collection[str] = (),
    measured: NoiseOf = UNKNOWN,
) -> tuple[SearchResult, StructureChoice]:
    """Return the best law up to a structure, and what was compared; `plain` are four gains in their bounds.

    A law with more freedom must meet all that is asked of the four gains, make no more noise of the command, or of the
    command's speed than two poses at rest seem to have where that is more, and keep nine tenths of their modulus in a
    hand, over the same plants. The bounds of M_a, K_l and B_fb, which stand for that
    noise, are then wider, but those that somebody `said`. One that saves less than `PRICE` beside a simpler one is not
    taken. Where `plain` misses something it is no design but the nearest to one: its noise is the limit, and a hand and
    a start from rest are asked of the others as by default, not as it has them. Raises InfeasibleError where they have
    no design either.
    """
    has_gains, whole = plain.evaluation.violation <= 0.0, plain.problem
    if not has_gains:
        whole = _calm(whole, hand)
    asked, jitter = whole.requirements.command_noise, None
    gains = equal_noise(plain, measured.spectrum) if asked is None else math.nan
    if asked is not None:
        noise = asked.max_speed_rms_m_s / (asked.force_noise_rms_n or math.nan)
    else:
        if measured.force and measured.position:
            jitter = jitter_speed(measured.position, plain.problem.sample_time_s) / measured.force
        noise = max(gains, jitter or 0.0)
    found: dict[Structure, SearchResult | None] = {"gains": plain if has_gains else None}
    for each in _ORDER[1 : _ORDER.index(structure) + 1]:
        problem = limited_problem(whole, noise, has_biquad=each == "biquad", said=said, measured=measured)
        if problem.bounds != whole.bounds:
            known = [plain, *(at for name, at in found.items() if at is not None and name != "gains")]
            found[each] = solve_limited(plain, problem, hand, known, seed=seed)
    taken, best = structure, None
    for name, result in found.items():
        if result is not None and (best is None or result.evaluation.cost < (1.0 - PRICE) * best.evaluation.cost):
            taken, best = name, result
    if best is None:
        raise InfeasibleError(f"No design was found with more freedom, up to {structure}, either.")
    costs = {name: None if result is None else result.evaluation.cost for name, result in found.items()}
    counts_pose = bool(measured.force and measured.position) if asked is None else bool(asked.position_noise_rms_m)
    return best, StructureChoice(
        costs=costs,
        taken=taken,
        noise_m_s_per_n=noise,
        is_asked=asked is not None,
        counts_pose=counts_pose,
        gains_m_s_per_n=gains,
        total_m_s_per_n=_largest_noise(
            plain, measured.spectrum, (measured.position or 0.0) / (measured.force or math.inf)
        ),
        jitter_m_s_per_n=jitter,
        approach_m_s=_approach_speed(plain),
        measured=measured,
        bounds=plain.problem.bounds,
    )


def solve_limited(
    plain: SearchResult, problem: DesignProblem, hand: HandImpedance, known: Sequence[SearchResult], *, seed: int
) -> SearchResult | None:
    """Search a `limited_problem` from `known` designs of fewer variables too; None where no design is found.

    All keep nine tenths of the plain law's modulus in a hand, which is asked for where four gains have much less, and
    of a biquad at once. None lets the admittance rise above what it is at rest by more than the plain law does, or by
    a twentieth. Where the bounds of M_a became wider, M_a/B_a is a tick h at least: what is faster no robot follows.
    """
    has_gains, ends = plain.evaluation.violation <= 0.0, list[FloatArray]()
    if not has_gains and BIQUAD_VARIABLES[0] not in problem.variables:
        # A look over few plants, since a whole search takes long where there is nothing.
        met = find_met(problem, seed=seed)
        if met is None:
            return None
        ends = [met]

    def search(asked: DesignProblem) -> SearchResult | None:
        found = _solve_limited(plain, asked, hand, [*ends, *(each.design for each in known)], seed)
        if found is not None and not has_gains:
            # Nothing else that is known leads there.
            ends[:] = [found.design]
        return found

    return search_above_a_tick(search, problem, plain)


def search_above_a_tick(
    search: Callable[[DesignProblem], SearchResult | None], problem: DesignProblem, usual: SearchResult
) -> SearchResult | None:
    """Return what a search finds with M_a/B_a a tick at least, or M_a at its bound in the `usual` search or above.

    None where it finds nothing, or B_a grows with M_a each time.
    """
    (loosest, high), h = problem.bounds["mass"], problem.sample_time_s
    most = usual.problem.bounds["mass"][0]
    if loosest >= most:
        return search(problem)
    best = None
    guess, bound = 0.0, loosest
    if BIQUAD_VARIABLES[0] not in problem.variables:
        # Most often that is enough, and saves a search.
        damping = usual.problem.controller(usual.design).damping_n_s_per_m
        guess = bound = max(loosest, _USUAL_ABOVE * h * damping)
    for share in _ABOVE_A_TICK:
        # Held above h B_a the best may lie in another valley: each time it is looked for anew.
        bound = min(float(f"{bound:.3g}"), most)
        found = search(replace(problem, bounds={**problem.bounds, "mass": (bound, high)}))
        if found is None:
            if guess == 0.0:
                break
            guess, bound = 0.0, loosest
            continue
        law = found.problem.controller(found.design)
        tick = h * law.damping_n_s_per_m
        if law.mass_kg < min(tick, most):
            guess, bound = 0.0, share * tick
        elif guess > _NEAR_A_TICK * tick:
            # B_a is less than the usual law's, so that the guess kept out lighter masses that are slow enough.
            best, guess, bound = found, 0.0, loosest
        else:
            return found if best is None or found.evaluation.cost <= best.evaluation.cost else best
    return best


def _solve_limited(
    plain: SearchResult, problem: DesignProblem, hand: HandImpedance, starts: Sequence[FloatArray], seed: int
) -> SearchResult | None:
    problem, count = without_rise(plain, problem), len(problem.variables)
    if BIQUAD_VARIABLES[0] in problem.variables:
        # What has a biquad already, then those that get one.
        whole = [each for each in starts if len(each) == count]
        corners = [_neutral(problem, each, at) for each in starts if len(each) < count for at in _CORNERS]
        starts = [*whole, *corners]
        # From biquads that do nothing descents lead farther than a population does, and sooner.
        return solve_or_none(_held(plain, problem, hand), starts, seed, explores=False)
    found = solve_or_none(problem, starts, seed)
    if found is None or _HELD in found.problem.requirements.asked():
        return found
    held = _held(plain, problem, hand)
    asked = held.requirements.asked().get(_HELD)
    if not isinstance(asked, HeldByHand):
        return found
    if _least_held(found, asked) >= asked.min_modulus:
        return found
    # Descents from these know the way.
    return solve_or_none(held, [*starts, found.design], seed, explores=False)


def limited_problem(
    plain: DesignProblem,
    noise_m_s_per_n: float,
    *,
    has_biquad: bool,
    said: Collection[str] = (),
    measured: NoiseOf = UNKNOWN,
) -> DesignProblem:
    """Return the problem with the noise of the command limited, unless it is already, in the place of bounds.

    The limit is a speed under the noise that was measured, or under 1 N or N·m where that of the sensor is not known.
    The pose's noise, which B_fb brings into the command, has to find room in what the sensor's alone makes.
    """
    asked = plain.requirements
    if asked.command_noise is None:
        rms = measured.force or 1.0
        limit = NoiseLimit(
            max_speed_rms_m_s=float(f"{rms * noise_m_s_per_n:.6g}"),
            force_noise_rms_n=rms,
            position_noise_rms_m=measured.position if measured.force else None,
            noise_spectrum=measured.spectrum if measured.force else None,
        )
        asked = replace(asked, command_noise=limit)
    target = asked.free_space_admittance
    slowest = 2.0 * math.pi * (_SLOWEST_HZ if target is None else target.band_hz[1])
    biquad = biquad_bounds(plain.sample_time_s, slowest) if has_biquad else {}
    return replace(plain, bounds={**loosened_bounds(plain, said), **biquad}, requirements=asked)


def solve_or_none(
    problem: DesignProblem, starts: Sequence[FloatArray], seed: int, *, explores: bool = True
) -> SearchResult | None:
    """Search a problem from `starts` too; None where no design is found."""
    try:
        return solve_design(problem, seed=seed, others=starts, explores=explores)
    except InfeasibleError:
        return None


def nearest_gains(problem: DesignProblem, seed: int) -> SearchResult | None:
    """Return the four gains that miss all requirements by the least share; None where none is stable."""
    design = find_nearest(problem, seed=seed)
    if design is None:
        return None
    active = build_scenarios(problem, problem.scenarios(3, 2))
    return SearchResult(
        problem=problem,
        design=design,
        evaluation=active.evaluate(design, peaks_if_missed=True),
        margins=(),
        active=active,
        scenario_count=len(active.scenarios),
        rounds=0,
        evaluations=0,
    )


def _calm(problem: DesignProblem, hand: HandImpedance) -> DesignProblem:
    """Return the problem with nine tenths of its modulus asked in a hand, and no rise of |G|, unless they are asked."""
    asked = problem.requirements
    if _HELD not in asked.asked() and asked.modulus_margin is not None:
        asked = asked.with_asked(_HELD, HeldByHand(**vars(hand), min_modulus=_KEPT_IN_A_HAND * asked.modulus_margin))
    if _RISE not in asked.asked():
        asked = asked.with_asked(_RISE, _MOST_RISE)
    return replace(problem, requirements=asked)


def _held(plain: SearchResult, problem: DesignProblem, hand: HandImpedance) -> DesignProblem:
    """Return the problem with most of the plain law's modulus in a hand asked for, unless one is, or it has none."""
    asked = problem.requirements
    if _HELD in asked.asked():
        return problem
    # Any modulus does for looking.
    held = HeldByHand(**vars(hand), min_modulus=0.5)
    kept = min(_least_held(plain, held), asked.modulus_margin or math.inf)
    least = float(f"{_KEPT_IN_A_HAND * kept:.3g}")
    if least == 0.0:
        return problem
    return replace(
        problem, requirements=replace(asked, further={**asked.further, _HELD: replace(held, min_modulus=least)})
    )


def without_rise(plain: SearchResult, problem: DesignProblem) -> DesignProblem:
    """Return the problem with a limit of the admittance's peak, unless one is asked."""
    asked = problem.requirements
    if _RISE in asked.asked():
        return problem
    prepared = build_scenarios(plain.problem, plain.active.scenarios)
    rise = AdmittancePeak().achieved(1.0, prepared.stable(plain.problem.controller(plain.design)), 0)
    return replace(problem, requirements=asked.with_asked(_RISE, max(_MOST_RISE, math.ceil(1e3 * rise) / 1e3)))


def _least_held(found: SearchResult, hand: HeldByHand) -> float:
    """Return the least modulus of a design in the hands, over the plants of its search."""
    prepared = build_scenarios(found.problem, found.active.scenarios)
    design = prepared.stable(found.problem.controller(found.design))
    kind = HeldByHandRequirement()
    return min(kind.achieved(hand, design, row) for row in range(kind.count(prepared)))


def equal_noise(found: SearchResult, spectrum: RelativeSpectrum | None = None) -> float:
    """Return the largest noise [m/s per N] of a design over its plants, in contact and free, rounded up by a hair.

    That of the force is white unless it has a spectrum.
    """
    return float(f"{_largest_noise(found, spectrum) * (1.0 + _ROUNDED):.6g}")


def _largest_noise(found: SearchResult, spectrum: RelativeSpectrum | None, position_per_force: float = 0.0) -> float:
    """Return it [m/s per N], where the pose's noise is so much [m/N] of the sensor's."""
    limit = NoiseLimit(
        max_speed_rms_m_s=1.0,
        force_noise_rms_n=1.0,
        position_noise_rms_m=position_per_force,
        noise_spectrum=spectrum,
    )
    problem, law = found.problem, found.problem.controller(found.design)
    plants = [problem.plant(each) for each in found.active.scenarios]
    free = [each.in_contact_with(FREE_SPACE) for each in plants]
    h = problem.sample_time_s
    return max(NoiseRequirement().verified(limit, build_sampled_plant(each, h), law) for each in (*plants, *free))


def _approach_speed(found: SearchResult) -> float:
    """Return the steady speed [m/s] at which a design approaches the nominal plant."""
    problem = found.problem
    pair = build_sampled_contact(build_sampled_plant(problem.plants.nominal, problem.sample_time_s))
    return simulate_contact(pair, problem.controller(found.design), problem.approach).contact_speed_m_s


def _neutral(problem: DesignProblem, plain: FloatArray, corner: float) -> FloatArray:
    """Return a design of four gains with a biquad whose zero and pole are the same, as a design of the problem."""
    low, high = problem.bounds[BIQUAD_VARIABLES[0]]
    time = min(max(1.0 / corner, low), high)
    return np.concatenate([plain, [time, _DAMPING, time, _DAMPING]])
