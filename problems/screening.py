"""Whole designs at once: for each the worst of stability, margins, admittance and peaks over all its scenarios.

What `PreparedScenarios.evaluate` says of one design, for as many as a population has, in compiled code.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .batch import controller_numbers, stack_contacts
from .batch_kernel import Contacts
from .contact import longest_run
from .controller import AdmittanceController
from .evaluation import Evaluation, PreparedScenarios
from .polynomials import DOUBTFUL, STABLE, UNSTABLE
from .sampled import build_loop, spectral_radius
from .screening_kernel import (
    ADMITTANCE,
    COLUMNS,
    CONTACT,
    DELAY_S,
    FAILED,
    GAIN_DB,
    MODULUS,
    PEAK_COLUMNS,
    PHASE_RAD,
    PLANT_COLUMNS,
    SENSOR,
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
EVERY_REQUIREMENT = "all requirements"
"""The goal that stands for all requirements: the worst required/achieved of any."""
_FAST = (*_MARGINS, "free_space_admittance", "max_peak_force_n")


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Designs (m,): `radius` of the first plant found unstable, 0 where all are stable.

    `rows` maps each requirement to required/achieved (m, k), plant by plant or scenario by scenario as it depends on
    them: each column is smooth in the design, their maximum is not. NaN where unstable, 0 where nobody looked because
    something is missed. `peaks_n` (m, s) of the objective's force, infinite where not looked at.
    """

    radius: FloatArray
    rows: Mapping[str, FloatArray]
    peaks_n: FloatArray

    def towards(self, goal: str) -> "Screened":
        """Return the same with one requirement, or with `EVERY_REQUIREMENT`, in the place of the peaks."""
        rows = dict(self.rows)
        if goal == EVERY_REQUIREMENT:
            sought, rows = np.hstack([np.zeros((len(self.radius), 1)), *rows.values()]), {}
        else:
            sought = rows.pop(goal)
        return Screened(radius=self.radius, rows=rows, peaks_n=np.where(self.is_stable[:, None], sought, np.inf))

    @property
    def is_stable(self) -> BoolArray:
        """Which designs are stable in every scenario."""
        return self.radius < 1.0

    @property
    def requirements(self) -> Mapping[str, FloatArray]:
        """Required/achieved (m,), the worst of all scenarios."""
        return {name: np.max(value, axis=1) for name, value in self.rows.items()}

    @property
    def objective_n(self) -> FloatArray:
        """The largest peak (m,)."""
        return np.asarray(np.max(self.peaks_n, axis=1))

    @property
    def violation(self) -> FloatArray:
        """By how much the worst requirement is missed: 0 where feasible, infinite where unstable."""
        if not self.rows:
            return np.where(self.is_stable, 0.0, np.inf)
        worst = np.max([np.nan_to_num(value, nan=np.inf) for value in self.requirements.values()], axis=0)
        return np.where(self.is_stable, np.maximum(worst - 1.0, 0.0), np.inf)


@dataclass(frozen=True, kw_only=True)
class Screen:
    """Prepared scenarios as the compiled loop takes them; `slow` are requirements that it does not know.

    With a `goal` that requirement is minimised, see `Screened.towards`, and everything of every design is looked at.
    """

    prepared: PreparedScenarios
    plants: Plants
    contacts: Contacts
    band: Band
    required: tuple[FloatArray, float]
    slow: tuple[str, ...]
    goal: str | None = None

    def evaluate(self, designs: FloatArray, *, peaks_if_missed: bool = False) -> Screened:
        """Evaluate designs (m, 4) as `PreparedScenarios.evaluate` does each.

        Where rounding could decide a verdict, and for requirements that no compiled form has, that function is asked.
        """
        problem, peaks_if_missed = self.prepared.problem, peaks_if_missed or self.goal is not None
        controllers = [problem.controller(design) for design in designs]
        numbers, theta, ideal = controller_numbers(controllers)
        h = problem.sample_time_s
        whole = np.empty((len(designs), COLUMNS))
        by_plant = np.empty((len(designs), len(self.prepared.plants), PLANT_COLUMNS))
        by_pair = np.empty((len(designs), len(self.prepared.pairs), PEAK_COLUMNS))
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
            (whole, by_plant, by_pair),
        )
        found = Screened(
            radius=self._radius(whole, controllers),
            rows=self._rows(whole, by_plant, by_pair),
            peaks_n=np.nan_to_num(
                by_pair[:, :, CONTACT if problem.objective == "contact_force" else SENSOR], nan=np.inf
            ),
        )
        missed = found.violation > 0.0
        for i in range(len(designs)):
            slow = self.slow and found.is_stable[i] and (peaks_if_missed or not missed[i])
            if slow or whole[i, VERDICT] == DOUBTFUL:
                _settle(found, i, self.prepared.evaluate(designs[i], peaks_if_missed=peaks_if_missed))
        return found if self.goal is None else found.towards(self.goal)

    def _radius(self, whole: FloatArray, controllers: Sequence[AdmittanceController]) -> FloatArray:
        radius = np.zeros(len(whole))
        for i in np.flatnonzero(whole[:, VERDICT] == UNSTABLE):
            loop = build_loop(self.prepared.plants[int(whole[i, FAILED])].sampled, controllers[int(i)])
            radius[i] = max(spectral_radius(loop), 1.0)
        return radius

    def _rows(self, whole: FloatArray, by_plant: FloatArray, by_pair: FloatArray) -> dict[str, FloatArray]:
        asked, unstable = self.prepared.problem.requirements, whole[:, VERDICT] != STABLE
        degrees = {"phase_margin_deg": 180.0 / np.pi}
        rows = {
            name: getattr(asked, name) / np.maximum(by_plant[:, :, column] * degrees.get(name, 1.0), 1e-300)
            for name, column in _MARGINS.items()
            if getattr(asked, name) is not None
        }
        if asked.free_space_admittance is not None:
            rows["free_space_admittance"] = asked.free_space_admittance.min_m_s_per_n / whole[:, [ADMITTANCE]]
        if asked.max_peak_force_n is not None:
            # Without a peak another requirement is missed anyway.
            rows["max_peak_force_n"] = np.nan_to_num(by_pair[:, :, CONTACT] / asked.max_peak_force_n, nan=0.0)
        rows |= {name: np.zeros((len(whole), 1)) for name in self.slow}
        for value in rows.values():
            value[unstable] = np.nan
        return rows


def _settle(found: Screened, index: int, evaluation: Evaluation) -> None:
    """Write the evaluation of one design over what was screened."""
    found.radius[index] = evaluation.spectral_radius if not evaluation.is_stable else 0.0
    found.peaks_n[index] = evaluation.objective_n
    for name, value in found.rows.items():
        value[index] = evaluation.requirements.get(name, np.nan if not evaluation.is_stable else 0.0)


def build_screen(prepared: PreparedScenarios) -> Screen:
    """Stack prepared scenarios; plants in contact first, then those in free space."""
    asked, target, table = prepared.problem.requirements, prepared.target_response, prepared.table
    margins = np.zeros(PLANT_COLUMNS)
    for name, column in _MARGINS.items():
        margins[column] = getattr(asked, name) or 0.0
    margins[PHASE_RAD] = np.radians(margins[PHASE_RAD])
    wanted = asked.free_space_admittance
    nothing = np.zeros(0, dtype=np.complex128)
    return Screen(
        prepared=prepared,
        plants=(table.loops, table.responses, table.grids),
        contacts=stack_contacts(prepared.pairs),
        band=(np.zeros(0), nothing, nothing)
        if target is None
        else (target.frequency_rad_per_s, target.z, target.position),
        required=(margins, 0.0 if wanted is None else wanted.min_m_s_per_n),
        slow=tuple(
            each.name for each in fields(asked) if each.name not in _FAST and getattr(asked, each.name) is not None
        ),
    )
