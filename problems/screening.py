"""Whole designs at once: for each the worst of stability, margins, admittance and peaks over all its scenarios.

What `PreparedScenarios.evaluate` says of one design, for as many as a population has, in compiled code.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .batch import check_alike, controller_numbers, stack_contacts, stack_grids, stack_loops, stack_responses
from .batch_kernel import Contacts
from .contact import longest_run
from .controller import AdmittanceController
from .evaluation import Evaluation, PreparedScenarios
from .polynomials import DOUBTFUL, STABLE, UNSTABLE
from .sampled import build_loop, spectral_radius
from .screening_kernel import (
    ADMITTANCE,
    COLUMNS,
    DELAY_S,
    FAILED,
    GAIN_DB,
    MODULUS,
    PEAK_CONTACT,
    PEAK_SENSOR,
    PHASE_RAD,
    VERDICT,
    Band,
    Plants,
    screen_designs,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MARGINS = {
    "modulus_margin": MODULUS,
    "gain_margin_db": GAIN_DB,
    "phase_margin_deg": PHASE_RAD,
    "delay_margin_s": DELAY_S,
}
_FAST = (*_MARGINS, "free_space_admittance", "max_peak_force_n")


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Designs (m,): `radius` of the first plant found unstable (0: all are stable), what each misses, the objective.

    `requirements` maps each requirement to required/achieved (m,), NaN where unstable, 0 where nobody looked because
    another one is missed; `objective_n` is infinite where the peaks were not looked at.
    """

    radius: FloatArray
    requirements: Mapping[str, FloatArray]
    objective_n: FloatArray

    @property
    def is_stable(self) -> BoolArray:
        """Which designs are stable in every scenario."""
        return self.radius < 1.0

    @property
    def violation(self) -> FloatArray:
        """By how much the worst requirement is missed: 0 where feasible, infinite where unstable."""
        if not self.requirements:
            return np.where(self.is_stable, 0.0, np.inf)
        worst = np.max([np.nan_to_num(value, nan=np.inf) for value in self.requirements.values()], axis=0)
        return np.where(self.is_stable, np.maximum(worst - 1.0, 0.0), np.inf)


@dataclass(frozen=True, kw_only=True)
class Screen:
    """Prepared scenarios as the compiled loop takes them; `slow` are requirements that it does not know."""

    prepared: PreparedScenarios
    plants: Plants
    contacts: Contacts
    band: Band
    required: FloatArray
    slow: tuple[str, ...]

    def evaluate(self, designs: FloatArray, *, peaks_if_missed: bool = False) -> Screened:
        """Evaluate designs (m, 4) as `PreparedScenarios.evaluate` does each.

        Where rounding could decide a verdict, and for requirements that no compiled form has, that function is asked.
        """
        problem = self.prepared.problem
        controllers = [problem.controller(design) for design in designs]
        numbers, theta, ideal = controller_numbers(controllers)
        h = problem.sample_time_s
        out = np.empty((len(designs), COLUMNS))
        screen_designs(
            self.plants,
            self.contacts,
            self.band,
            numbers,
            (h, theta, ideal),
            problem.approach.numbers(),
            longest_run(h),
            self.required,
            peaks_if_missed,
            out,
        )
        found = self._screened(out, controllers)
        missed = found.violation > 0.0
        for i in range(len(designs)):
            slow = self.slow and found.is_stable[i] and (peaks_if_missed or not missed[i])
            if slow or out[i, VERDICT] == DOUBTFUL:
                _settle(found, i, self.prepared.evaluate(designs[i], peaks_if_missed=peaks_if_missed))
        return found

    def _screened(self, out: FloatArray, controllers: Sequence[AdmittanceController]) -> Screened:
        problem = self.prepared.problem
        asked, contact = problem.requirements, problem.objective == "contact_force"
        stable = out[:, VERDICT] == STABLE
        achieved = {name: out[:, column] for name, column in _MARGINS.items()}
        achieved["phase_margin_deg"] = np.degrees(out[:, PHASE_RAD])
        requirements = {
            name: getattr(asked, name) / np.maximum(value, 1e-300)
            for name, value in achieved.items()
            if getattr(asked, name) is not None
        }
        if asked.free_space_admittance is not None:
            requirements["free_space_admittance"] = asked.free_space_admittance.min_m_s_per_n / out[:, ADMITTANCE]
        if asked.max_peak_force_n is not None:
            # Without a peak another requirement is missed anyway.
            requirements["max_peak_force_n"] = np.nan_to_num(out[:, PEAK_CONTACT] / asked.max_peak_force_n, nan=0.0)
        requirements |= {name: np.zeros(len(out)) for name in self.slow}
        for value in requirements.values():
            value[~stable] = np.nan
        radius = np.zeros(len(out))
        for i in np.flatnonzero(out[:, VERDICT] == UNSTABLE):
            loop = build_loop(self.prepared.plants[int(out[i, FAILED])].sampled, controllers[int(i)])
            radius[i] = max(spectral_radius(loop), 1.0)
        return Screened(
            radius=radius,
            requirements=requirements,
            objective_n=np.nan_to_num(out[:, PEAK_CONTACT if contact else PEAK_SENSOR], nan=np.inf),
        )


def _settle(found: Screened, index: int, evaluation: Evaluation) -> None:
    """Write the evaluation of one design over what was screened."""
    found.radius[index] = evaluation.spectral_radius if not evaluation.is_stable else 0.0
    found.objective_n[index] = evaluation.objective_n
    for name, value in found.requirements.items():
        value[index] = evaluation.requirements.get(name, np.nan if not evaluation.is_stable else 0.0)


def build_screen(prepared: PreparedScenarios) -> Screen:
    """Stack prepared scenarios; plants in contact first, then those in free space."""
    problem, sampled = prepared.problem, [plant.sampled for plant in prepared.plants]
    check_alike(sampled)
    asked, target = problem.requirements, prepared.target_response
    required = np.zeros(COLUMNS)
    for name, column in _MARGINS.items():
        required[column] = getattr(asked, name) or 0.0
    required[PHASE_RAD] = np.radians(required[PHASE_RAD])
    if asked.free_space_admittance is not None:
        required[ADMITTANCE] = asked.free_space_admittance.min_m_s_per_n
    nothing = np.zeros(0, dtype=np.complex128)
    return Screen(
        prepared=prepared,
        plants=(stack_loops(sampled), stack_responses(prepared.plants), stack_grids(prepared.plants)),
        contacts=stack_contacts(prepared.pairs),
        band=(np.zeros(0), nothing, nothing)
        if target is None
        else (target.frequency_rad_per_s, target.z, target.position),
        required=required,
        slow=tuple(
            each.name for each in fields(asked) if each.name not in _FAST and getattr(asked, each.name) is not None
        ),
    )
