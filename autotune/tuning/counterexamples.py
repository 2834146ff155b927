"""Counterexamples that a search takes in: plants at which a proof failed, impacts that bounced for ever."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from autotune.validation.bouncing import LEAST_FORCE, SPEEDS, RefutedError
from problems.contact.bouncing import Ending, follow_contact, settling_window
from problems.contact.transient import Approach, SampledContact, build_sampled_contact
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError

FloatArray = NDArray[np.float64]

# Beside the impact that was found, faster and slower ones on its plant: how a contact ends hangs on the ratio of speed
# and force alone (`validation.bouncing`).
_LADDER = tuple(np.geomspace(4.0, SPEEDS[1] / LEAST_FORCE, 4).tolist())
# Of the settling time, for designs that are only looked at in passing; four of them are still enough to see a bounce.
_WINDOW_SHARE, _SHORTEST_WINDOW = 0.25, 64


@dataclass(frozen=True, kw_only=True)
class Counterexamples:
    """Plants that join the scenarios of a search, and impacts that must come to rest as (plant, ratio s).

    s is the speed at the impact times (B_a + B_p) over F^d, so that it is the same impact whatever the damping.
    """

    scenarios: tuple[Scenario, ...] = ()
    impacts: tuple[tuple[Scenario, float], ...] = ()

    def joined(self, error: RefutedError) -> "Counterexamples":
        """Return the same with what an error names."""
        if error.impact is None:
            return replace(self, scenarios=tuple(dict.fromkeys((*self.scenarios, error.scenario))))
        impact = (error.scenario, error.impact.ratio)
        return replace(self, impacts=tuple(dict.fromkeys((*self.impacts, impact))))


NOTHING = Counterexamples()


class ImpactTest:
    """Tests whether designs of a problem come to rest after the impacts of counterexamples."""

    def __init__(self, problem: DesignProblem, counterexamples: Counterexamples) -> None:
        self._problem = problem
        self._known: dict[bytes, bool] = {}
        self._cases: list[tuple[SampledContact, Sequence[float]]] = []
        for scenario, ratio in counterexamples.impacts:
            pair = build_sampled_contact(build_sampled_plant(problem.plant(scenario), problem.sample_time_s))
            self._cases.append((pair, (ratio, *_LADDER)))

    def __bool__(self) -> bool:
        return bool(self._cases)

    def passes(self, design: FloatArray) -> bool:
        """Return whether every impact comes to rest with a design (n,) that is stable in both loops."""
        key = np.asarray(design).tobytes()
        if key not in self._known:
            controller = self._problem.controller(design)
            self._known[key] = all(_comes_to_rest(pair, controller, ratios) for pair, ratios in self._cases)
        return self._known[key]

    def walk_back(self, passing: FloatArray, end: FloatArray) -> FloatArray:
        """Return the design nearest to `end` on the line from a passing one that passes; `end` where none does."""
        if self.passes(end) or not self.passes(passing):
            return end
        low, high = 0.0, 1.0
        for _ in range(_WALK_STEPS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.passes(passing + middle * (end - passing)) else (low, middle)
        # Not to the very edge: what is written has six digits.
        return np.asarray(passing + _INSIDE * low * (end - passing))


_WALK_STEPS, _INSIDE = 7, 0.98


def _comes_to_rest(pair: SampledContact, controller: AdmittanceController, ratios: Sequence[float]) -> bool:
    try:
        window = max(_SHORTEST_WINDOW, int(_WINDOW_SHARE * settling_window(pair, controller)))
    except UnstableLoopError:
        return False
    resistance = controller.damping_n_s_per_m + pair.free.plant.payload.drag_n_s_per_m
    for ratio in ratios:
        approach = Approach(speed_m_s=ratio / resistance, after_impact_n=1.0)
        if follow_contact(pair, controller, approach, window=window).ending is Ending.BOUNCING:
            return False
    return True
