"""Search a biquad in the path of the force beside the four gains, at the noise of the command that these make."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from autotune.errors import InfeasibleError
from autotune.formats.problem import Structure
from autotune.formats.units import axis_units
from problems.arrays import FloatArray
from problems.design.evaluation import build_scenarios
from problems.design.hand import HandImpedance
from problems.design.problem import (
    BIQUAD_VARIABLES,
    DesignProblem,
    NoiseLimit,
    biquad_bounds,
)
from problems.design.requirements import HeldByHand
from problems.design.requirements.held_by_hand import HeldByHandRequirement
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.progress import no_progress
from problems.stability.noise import command_speed_gain

from .bounds import loosened_bounds
from .record import certified_hand
from .search import SearchResult, solve_design

_HELD = "held_by_hand"
PRICE = 0.01
"""The share of the objective that the four further numbers must save, or the plain law is kept."""
# Of the modulus that the four gains keep in a hand.
_KEPT_IN_A_HAND = 0.9
# Where the admittance has no band, the slowest corner.
_SLOWEST_HZ = 2.0
# Corners [rad/s] at which a biquad that does nothing begins, and its damping.
_CORNERS, _DAMPING = (25.0, 60.0, 120.0, 250.0, 600.0), 0.7
# What the noise of the plain law is rounded up by, so that six digits of it are not in the way.
_ROUNDED = 1e-6


@dataclass(frozen=True, kw_only=True)
class StructureChoice:
    """What a biquad saves: the objective's cost of the four gains and with it, None where no design was found.

    Both make the commanded speed's noise at most `noise_m_s_per_n` per newton of the force's.
    """

    plain: float
    with_biquad: float | None
    noise_m_s_per_n: float

    @property
    def is_worth_it(self) -> bool:
        """Whether the biquad is taken."""
        return self.with_biquad is not None and self.with_biquad < (1.0 - PRICE) * self.plain

    def message(self, name: str, problem: DesignProblem) -> str:
        """Return a sentence on what the biquad does for an axis."""
        units, objective = axis_units(name), problem.objective
        unit = objective.unit_on(turning=units.force != "N")
        title, plain = objective.title, f"{objective.value(self.plain):.4g} {unit}".rstrip()
        noise = f"{1e3 * self.noise_m_s_per_n:.3g} m{units.speed} of command per {units.force}"
        if self.with_biquad is None:
            return (
                f"Axis {name}: no design with a biquad was found, so the four gains are kept; the {title} is {plain}."
            )
        found = f"{objective.value(self.with_biquad):.4g} {unit}".rstrip()
        change = 100.0 * (self.with_biquad / self.plain - 1.0)
        same = f"at the same noise ({noise}), margins and admittance"
        if self.is_worth_it:
            return f"Axis {name}: the biquad takes the {title} from {plain} to {found} ({change:+.0f} %) {same}."
        return (
            f"Axis {name}: a biquad does not help here ({plain} with four gains, {found} with it, {same}), so the four "
            "gains are kept."
        )


class StructureSearch:
    """Searches every axis again with the structure that is asked, and says what it does."""

    def __init__(self, structure: Structure, seed: int) -> None:
        self._structure, self._seed = structure, seed
        self._choices: dict[str, StructureChoice] = {}

    def searched(self, plain: Mapping[str, SearchResult]) -> dict[str, SearchResult]:
        """Return the searches with the structure, where it is worth it."""
        if self._structure == "gains":
            return dict(plain)
        found = {}
        for name, each in plain.items():
            found[name], self._choices[name] = with_biquad(each, certified_hand(name, each.problem), seed=self._seed)
        return found

    def notes(self, searches: Mapping[str, SearchResult]) -> list[str]:
        """Return a sentence for each axis."""
        return [each.message(name, searches[name].problem) for name, each in self._choices.items()]


def with_biquad(
    plain: SearchResult, hand: HandImpedance, *, seed: int, progress: Callable[[float], None] = no_progress
) -> tuple[SearchResult, StructureChoice]:
    """Return the better of the four gains and a law with a biquad, and what was compared.

    The law with a biquad must meet all that is asked of the four gains, make no more noise of the command, and keep
    nine tenths of their modulus in a hand, over the same plants. M_a and K_l, whose bounds stand for that noise, may
    then be lighter and longer.
    """
    noise = _noise(plain)
    problem = biquad_problem(plain.problem, noise)
    starts = [_neutral(problem, plain.design, corner) for corner in _CORNERS]
    try:
        found = solve_design(problem, seed=seed, start=starts[2], others=starts, progress=progress)
        held = _held_as_well(plain, found, hand)
        if held is not None:
            found = solve_design(held, seed=seed, start=starts[2], others=[*starts, found.design])
    except InfeasibleError:
        return plain, StructureChoice(plain=plain.evaluation.cost, with_biquad=None, noise_m_s_per_n=noise)
    choice = StructureChoice(plain=plain.evaluation.cost, with_biquad=found.evaluation.cost, noise_m_s_per_n=noise)
    return (found if choice.is_worth_it else plain), choice


def biquad_problem(plain: DesignProblem, noise_m_s_per_n: float) -> DesignProblem:
    """Return the problem with a biquad free and the noise of the command limited, unless that is limited already."""
    asked = plain.requirements
    if asked.command_noise is None:
        asked = replace(asked, command_noise=NoiseLimit(max_speed_rms_m_s=noise_m_s_per_n, force_noise_rms_n=1.0))
    target = asked.free_space_admittance
    slowest = 2.0 * math.pi * (_SLOWEST_HZ if target is None else target.band_hz[1])
    bounds = {**loosened_bounds(plain), **biquad_bounds(plain.sample_time_s, slowest)}
    return replace(plain, bounds=bounds, requirements=asked)


def _held_as_well(plain: SearchResult, found: SearchResult, hand: HandImpedance) -> DesignProblem | None:
    """Return the problem that asks for the modulus in a hand that the plain law has, where `found` has much less."""
    asked = found.problem.requirements
    if _HELD in asked.asked():
        return None
    # Any modulus does for looking.
    held = HeldByHand(**vars(hand), min_modulus=0.5)
    keeps, has = (_least_held(each, held) for each in (plain, found))
    least = float(f"{_KEPT_IN_A_HAND * keeps:.3g}")
    if has >= least:
        return None
    further = {**asked.further, _HELD: replace(held, min_modulus=least)}
    return replace(found.problem, requirements=replace(asked, further=further))


def _least_held(found: SearchResult, hand: HeldByHand) -> float:
    """Return the least modulus of a design in the hands, over the plants of its search."""
    prepared = build_scenarios(found.problem, found.active.scenarios)
    design = prepared.stable(found.problem.controller(found.design))
    kind = HeldByHandRequirement()
    return min(kind.achieved(hand, design, row) for row in range(kind.count(prepared)))


def _noise(found: SearchResult) -> float:
    """Return the largest noise [m/s per N] of a design over its plants, in contact and free."""
    problem, law = found.problem, found.problem.controller(found.design)
    plants = [problem.plant(each) for each in found.active.scenarios]
    plants += [each.in_contact_with(FREE_SPACE) for each in plants]
    most = max(command_speed_gain(build_sampled_plant(each, problem.sample_time_s), law) for each in plants)
    return float(f"{most * (1.0 + _ROUNDED):.6g}")


def _neutral(problem: DesignProblem, plain: FloatArray, corner: float) -> FloatArray:
    """Return the plain design with a biquad whose zero and pole are the same, as a design of the problem."""
    low, high = problem.bounds[BIQUAD_VARIABLES[0]]
    time = min(max(1.0 / corner, low), high)
    return np.concatenate([plain[: len(problem.variables) - len(BIQUAD_VARIABLES)], [time, _DAMPING, time, _DAMPING]])
