"""Many controllers on many plants at once, compiled: of each design its requirements.

The same equations as `problems.model.sampled`, `problems.stability.margins` and `problems.contact.transient`,
without their tables in between: the memory is that of the result and of the plants.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter

import numpy as np

from ..arrays import FloatArray, IntArray
from ..contact.transient import Approach, SampledContact, longest_run
from ..errors import ParameterError
from ..model.controller import THETA, AdmittanceController
from ..model.radii import spectral_radii
from ..model.sampled import SampledPlant, build_loop
from ..stability.margin_kernel import DELAY_S, GAIN_DB, MARGINS, MODULUS, PHASE_RAD
from ..stability.margins import check_finite
from ..stability.polynomials import DOUBTFUL, STABLE, UNSTABLE
from .batch_kernel import (
    ADMITTANCE,
    ADMITTANCE_PEAK,
    COLUMNS,
    FAILED,
    HELD_COLUMNS,
    HELD_MODULUS,
    PEAK_COLUMNS,
    PEAK_CONTACT,
    PEAK_SENSOR,
    VERDICT,
    Band,
    Contacts,
    Loops,
    Plants,
    Spectrum,
    evaluate_designs,
    find_contact_peaks,
    find_moduli,
    find_speed_noises,
    stack_contacts,
    stack_grids,
    stack_loops,
    stack_responses,
    times_spectral_ratios,
)
from .batch_result import BatchEvaluation, Places
from .batch_stacks import (
    HELD,
    LED,
    hands_of,
    led_limit,
    stack_band,
    stack_held,
    stack_judged,
    stack_led,
    stack_spectrum,
)
from .evaluation import Evaluation, PreparedScenarios
from .nearby_kernel import evaluate_beside, find_moduli_beside
from .objectives import admittance_target
from .requirements import NoiseLimit, peak_responses, target_response
from .requirements.contact_at_speed import led_peaks
from .stable_design import StableDesign

_MARGINS = {
    "modulus_margin": MODULUS,
    "gain_margin_db": GAIN_DB,
    "phase_margin_deg": PHASE_RAD,
    "delay_margin_s": DELAY_S,
}
_NOISE, _RISE = "command_noise", "admittance_peak"
_FAST = (*_MARGINS, "free_space_admittance", _RISE, "max_peak_force_n", HELD, _NOISE, LED)
_CROSSOVERS = ("gain_margin_db", "phase_margin_deg", "delay_margin_s")

_KIND = attrgetter("discretization", "compensation", "compensation_mass_kg")


def controller_numbers(controllers: Sequence[AdmittanceController]) -> tuple[FloatArray, float, bool]:
    """Return the parameters (m, 7) with θ and whether the compensation is ideal, which all controllers must share."""
    kinds = {(THETA[rule], kind == "ideal" and mass > 0.0) for rule, kind, mass in set(map(_KIND, controllers))}
    if len(kinds) != 1:
        raise ParameterError("controllers", kinds, "at least one, all of one discretisation and kind of compensation")
    theta, ideal = kinds.pop()
    numbers = chain.from_iterable(map(AdmittanceController.numbers, controllers))
    return np.fromiter(numbers, dtype=np.float64).reshape(len(controllers), -1), theta, ideal


def check_alike(plants: Sequence[SampledPlant]) -> None:
    """Raise ParameterError unless the plants share robot order and sample time, and are finite."""
    kinds = {(plant.state_count, plant.sample_time_s) for plant in plants}
    if len(kinds) != 1:
        raise ParameterError(
            "plants", kinds, "at least one, all of one robot order and sample time, all or none with a filter"
        )
    for plant in plants:
        check_finite(plant)


@dataclass(frozen=True, kw_only=True)
class BatchEvaluator:
    """Prepared scenarios as the compiled loop takes them; `slow` are requirements that it does not know.

    `held` are all plants in all hands, one plant after the other, where a modulus with a hand is asked for; `led` the
    contacts that are led by hand where their peak is limited, those without the hand's mass first; `spectrum` the
    noise of the force that is limited where it is not white.

    With a `goal` that requirement is minimised in place of the objective, see `BatchEvaluation.towards`, and every
    design is evaluated in full; contacts are simulated only where a requirement asks for their peaks.
    """

    prepared: PreparedScenarios
    plants: Plants
    contacts: Contacts
    bands: tuple[Band, Band]
    required: tuple[FloatArray, float, float, bool]
    slow: tuple[str, ...]
    held: Plants | None = None
    led: tuple[Loops, Contacts] | None = None
    spectrum: Spectrum | None = None
    goal: str | None = None

    def evaluate(
        self, designs: FloatArray, *, margins_if_missed: bool = False, peaks_if_missed: bool = False
    ) -> BatchEvaluation:
        """Evaluate designs (m, n) as `PreparedScenarios.evaluate` does each.

        Of a stable design that misses a requirement the others are found too where `margins_if_missed`, all but a
        contact's, or `peaks_if_missed`, all. Where rounding could decide a verdict, and for requirements that no
        compiled form has, that function is asked. A feedback damping that is too small to be a value in seconds counts
        here, so that all numbers go over into those without it, where that function jumps to them.
        """
        peaks_if_missed = peaks_if_missed or self.goal is not None
        margins_if_missed = margins_if_missed or peaks_if_missed
        numbers, sampling = self._controllers(designs)
        whole, _, _ = out = self._results(len(designs))
        evaluate_designs(
            self.plants,
            self.contacts,
            self.bands,
            numbers,
            sampling,
            self.prepared.problem.approach.numbers(),
            longest_run(sampling[0]),
            self.required,
            (margins_if_missed, peaks_if_missed),
            out,
        )
        found = self._found(out, self._radius(whole, designs))
        limit = self.prepared.problem.requirements.command_noise
        if limit is not None and len(looked_at := _looked_at(found, everywhere=margins_if_missed)):
            self._ask_noise(limit, found, looked_at, designs, numbers, sampling)
        if self.held is not None and len(looked_at := _looked_at(found, everywhere=margins_if_missed)):
            self._ask_hands(self.held, found, looked_at, numbers, sampling)
        if self.led is not None and len(looked_at := _looked_at(found, everywhere=margins_if_missed)):
            self._ask_led(self.led, found, looked_at, designs, numbers, sampling)
        if not self.is_compiled:
            for i in _looked_at(found, everywhere=margins_if_missed).tolist():
                if whole[i, VERDICT] != DOUBTFUL:
                    self._evaluate_slowly(found, i, self.prepared.problem.controller(designs[i]))
        for i in np.flatnonzero(whole[:, VERDICT] == DOUBTFUL).tolist():
            _settle(found, i, self.prepared.evaluate(designs[i], peaks_if_missed=peaks_if_missed))
        if not peaks_if_missed and (self.slow or limit is not None or self.held is not None or self.led is not None):
            found.objective_rows[found.violation > 0.0] = np.inf
        return found if self.goal is None else found.towards(self.goal)

    def evaluate_beside(self, known: BatchEvaluation, designs: FloatArray) -> BatchEvaluation:
        """Evaluate designs (m, n) a tiny step from the first of them, which was evaluated in full: for differences.

        Every number is read where that of the first design was found, which is right but for the square of the step
        (`problems.design.nearby_kernel`). Where that does not carry, all are evaluated as any others.
        """
        limit, places = self.prepared.problem.requirements.command_noise, known.places
        if not (known.is_stable[0] and places.are_known[0]):
            return self.evaluate(designs, peaks_if_missed=True)
        numbers, sampling = self._controllers(designs)
        out = self._results(len(designs))
        evaluate_beside(
            self.plants,
            self.contacts,
            self.bands,
            numbers,
            sampling,
            self.prepared.problem.approach.numbers(),
            longest_run(sampling[0]),
            (numbers[0], places.margins[0], places.peaks[0]),
            out,
        )
        found, everywhere = self._found(out, np.zeros(len(designs))), np.arange(len(designs))
        if limit is not None:
            self._ask_noise(limit, found, everywhere, designs, numbers, sampling)
        if self.held is not None:
            moduli = np.empty((len(designs), len(self.prepared.plants)))
            find_moduli_beside(self.held, numbers, sampling, places.hands[0], places.held[0], moduli)
            self._write_hands(found, everywhere, moduli)
        if self.led is not None:
            self._ask_led(self.led, found, everywhere, designs, numbers, sampling)
        for i in range(0 if self.is_compiled else len(designs)):
            self._evaluate_slowly(found, i, self.prepared.problem.controller(designs[i]))
        return found if self.goal is None else found.towards(self.goal)

    def _controllers(self, designs: FloatArray) -> tuple[FloatArray, tuple[float, float, bool]]:
        """Return the parameters of designs as the kernels take them, with period, θ and kind of compensation."""
        problem = self.prepared.problem
        first = problem.controller(designs[0])
        numbers = problem.parameters(designs, first=first, keeps_small=True)
        return numbers, (problem.sample_time_s, first.theta, first.is_ideal)

    def _results(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the arrays of so many designs that `evaluate_designs` fills."""
        pairs = len(self.prepared.pairs) if self._has_contacts else 0
        return (
            np.empty((count, COLUMNS)),
            np.empty((count, len(self.prepared.plants), MARGINS)),
            np.empty((count, pairs, PEAK_COLUMNS)),
        )

    def _found(self, out: tuple[FloatArray, FloatArray, FloatArray], radius: FloatArray) -> BatchEvaluation:
        """Return what was written of designs, without the requirements that are asked one by one."""
        whole, by_plant, by_pair = out
        hard, soft = self._rows(whole, by_plant, by_pair)
        shape = by_plant.shape[:2] if self.held is not None else (len(whole), 0)
        return BatchEvaluation(
            radius=radius,
            rows=hard,
            objective_rows=self._objective_rows(whole, by_plant, by_pair),
            soft_rows=soft,
            asked=self.prepared.problem.requirements,
            places=Places(
                margins=by_plant,
                peaks=by_pair,
                hands=np.zeros(shape, dtype=np.int64),
                held=np.full((*shape, HELD_COLUMNS), np.nan),
            ),
        )

    def _ask_noise(
        self,
        limit: NoiseLimit,
        found: BatchEvaluation,
        looked_at: IntArray,
        designs: FloatArray,
        numbers: FloatArray,
        sampling: tuple[float, float, bool],
    ) -> None:
        """Write the command's noise of the designs that are looked at."""
        asked, (loops, _, _), numbers = self.prepared.problem.requirements, self.plants, numbers[looked_at]
        speeds = np.empty((len(looked_at), len(self.prepared.plants)))
        force, position = limit.force_noise_rms_n or 0.0, limit.position_noise_rms_m or 0.0
        if self.spectrum is None:
            find_speed_noises(loops, numbers, sampling, (force, position), speeds)
        else:
            find_speed_noises(loops, numbers, sampling, (force, 0.0), speeds)
            times_spectral_ratios(self.spectrum, numbers, sampling, speeds)
            find_speed_noises(loops, numbers, sampling, (0.0, position), of_position := np.empty_like(speeds))
            np.hypot(speeds, of_position, out=speeds)
        rows = found.soft_rows if _NOISE in asked.soft_n else found.rows
        rows[_NOISE][looked_at] = speeds / limit.max_speed_rms_m_s
        for i in looked_at[np.isnan(speeds).any(axis=1)].tolist():
            law = self.prepared.problem.controller(designs[i])
            rows[_NOISE][i] = asked.kind(_NOISE).ratios(limit, StableDesign(self.prepared, law))

    def _ask_hands(
        self,
        held: Plants,
        found: BatchEvaluation,
        looked_at: IntArray,
        numbers: FloatArray,
        sampling: tuple[float, float, bool],
    ) -> None:
        """Write the least modulus in the hands of the designs that are looked at."""
        count = len(self.prepared.plants)
        moduli = np.empty((len(looked_at), len(held[1]), HELD_COLUMNS))
        find_moduli(held, numbers[looked_at], sampling, moduli)
        # A verdict that rounding could turn counts as unstable: the exact evaluation has the last word.
        of_hands = np.nan_to_num(moduli[:, :, HELD_MODULUS]).reshape(len(looked_at), count, -1)
        hands = np.argmin(of_hands, axis=2) + np.arange(count) * of_hands.shape[2]
        found.places.hands[looked_at] = hands
        found.places.held[looked_at] = np.take_along_axis(moduli, hands[:, :, None], axis=1)
        self._write_hands(found, looked_at, np.min(of_hands, axis=2))

    def _write_hands(self, found: BatchEvaluation, looked_at: IntArray, least: FloatArray) -> None:
        """Write the row of the least modulus in the hands (m, p) of designs."""
        asked = self.prepared.problem.requirements
        rows = found.soft_rows if HELD in asked.soft_n else found.rows
        rows[HELD][looked_at] = hands_of(asked).min_modulus / np.maximum(least, 1e-300)

    def _ask_led(
        self,
        led: tuple[Loops, Contacts],
        found: BatchEvaluation,
        looked_at: IntArray,
        designs: FloatArray,
        numbers: FloatArray,
        sampling: tuple[float, float, bool],
    ) -> None:
        """Write the peaks of contacts that are led by hand of the designs that are looked at."""
        asked, (loops, contacts) = self.prepared.problem.requirements, led
        limit = led_limit(asked)
        peaks = np.empty((len(looked_at), len(contacts[2])))
        longest = longest_run(self.prepared.problem.sample_time_s)
        find_contact_peaks(loops, contacts, numbers[looked_at], sampling, limit.approach.numbers(), longest, peaks)
        worst = np.max(peaks.reshape(len(looked_at), -1, len(self.prepared.pairs)), axis=1)
        rows = found.soft_rows if LED in asked.soft_n else found.rows
        rows[LED][looked_at] = worst / limit.max_force_n
        for i in looked_at[np.isnan(worst).any(axis=1)].tolist():
            law = self.prepared.problem.controller(designs[i])
            rows[LED][i] = asked.kind(LED).ratios(limit, StableDesign(self.prepared, law))

    @property
    def _has_contacts(self) -> bool:
        return self.goal is None or self.prepared.problem.requirements.max_peak_force_n is not None

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled loop knows all requirements and the objective."""
        return not (self.slow or self._has_slow_objective)

    @property
    def _has_slow_objective(self) -> bool:
        return self.goal is None and self.prepared.problem.objective.batch_column is None

    def _objective_rows(self, whole: FloatArray, by_plant: FloatArray, by_pair: FloatArray) -> FloatArray:
        """Return the objective's costs (m, k), infinite where not evaluated and of one without a compiled form."""
        objective = self.prepared.problem.objective
        if objective.batch_column is None or not self._has_contacts:
            return np.full((len(whole), objective.count(self.prepared)), np.inf)
        numbers = {
            "contact_peak": by_pair[:, :, PEAK_CONTACT],
            "sensor_peak": by_pair[:, :, PEAK_SENSOR],
            "modulus": by_plant[:, :, MODULUS],
            "admittance": whole[:, [ADMITTANCE]],
        }
        costs = objective.value(numbers[objective.batch_column])
        # Where no contact was simulated something is missed, and then no number counts.
        return np.where(np.isnan(costs) | np.isnan(by_pair[:, :1, PEAK_CONTACT]), np.inf, costs)

    def _evaluate_slowly(self, found: BatchEvaluation, index: int, controller: AdmittanceController) -> None:
        """Write the rows that no compiled form has."""
        asked, design = self.prepared.problem.requirements, StableDesign(self.prepared, controller)
        for requirement, value in asked.of("loop", "robot", "contact"):
            if requirement.name in self.slow:
                rows = found.soft_rows if requirement.name in asked.soft_n else found.rows
                rows[requirement.name][index] = requirement.ratios(value, design)
        if self._has_slow_objective:
            found.objective_rows[index] = self.prepared.problem.objective.costs(asked, design)

    def _radius(self, whole: FloatArray, designs: FloatArray) -> FloatArray:
        radius, unstable = np.zeros(len(whole)), np.flatnonzero(whole[:, VERDICT] == UNSTABLE)
        failed = [self.prepared.plants[int(plant)].sampled for plant in whole[unstable, FAILED]]
        laws = [self.prepared.problem.controller(design) for design in designs[unstable]]
        radius[unstable] = np.maximum(spectral_radii(list(map(build_loop, failed, laws))), 1.0)
        return radius

    def _rows(
        self, whole: FloatArray, by_plant: FloatArray, by_pair: FloatArray
    ) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """Return the rows of hard requirements, and those of soft ones."""
        asked, unstable = self.prepared.problem.requirements, whole[:, VERDICT] != STABLE
        degrees = {"phase_margin_deg": 180.0 / np.pi}
        rows = {
            name: getattr(asked, name) / np.maximum(by_plant[:, :, column] * degrees.get(name, 1.0), 1e-300)
            for name, column in _MARGINS.items()
            if getattr(asked, name) is not None
        }
        if asked.free_space_admittance is not None:
            rows["free_space_admittance"] = asked.free_space_admittance.min_m_s_per_n / whole[:, [ADMITTANCE]]
        if _RISE in asked.asked():
            rows[_RISE] = whole[:, [ADMITTANCE_PEAK]] / asked.threshold(_RISE)
        if asked.max_peak_force_n is not None:
            # Without a peak another requirement is missed anyway.
            rows["max_peak_force_n"] = np.nan_to_num(by_pair[:, :, PEAK_CONTACT] / asked.max_peak_force_n, nan=0.0)
        written_later = [each for each in asked.asked() if each in (*self.slow, HELD, _NOISE, LED)]
        rows |= {name: np.zeros((len(whole), asked.kind(name).count(self.prepared))) for name in written_later}
        for value in rows.values():
            value[unstable] = np.nan
        soft = {name: rows.pop(name) for name in asked.soft_n}
        return rows, soft


def _looked_at(found: BatchEvaluation, *, everywhere: bool) -> IntArray:
    """Return the designs a dear requirement is asked of: stable ones, and if not `everywhere` that miss nothing."""
    return np.flatnonzero(found.is_stable if everywhere else found.violation == 0.0)


def _settle(found: BatchEvaluation, index: int, evaluation: Evaluation) -> None:
    """Write the evaluation of one design over what was screened."""
    found.radius[index] = evaluation.spectral_radius if not evaluation.is_stable else 0.0
    found.objective_rows[index] = evaluation.objective_cost
    for rows, said in ((found.rows, evaluation.requirements), (found.soft_rows, evaluation.soft)):
        for name, value in rows.items():
            value[index] = said.get(name, np.nan if not evaluation.is_stable else 0.0)


def build_batch_evaluator(prepared: PreparedScenarios) -> BatchEvaluator:
    """Stack prepared scenarios; plants in contact first, then those in free space."""
    asked = prepared.problem.requirements
    looks_at_band = asked.free_space_admittance is not None or prepared.problem.objective.batch_column == "admittance"
    target = target_response(prepared, admittance_target(asked)) if looks_at_band else None
    sampled = [plant.sampled for plant in prepared.plants]
    check_alike(sampled)
    margins = np.zeros(MARGINS)
    for name, column in _MARGINS.items():
        margins[column] = 0.0 if name in asked.soft_n else getattr(asked, name) or 0.0
    margins[PHASE_RAD] = np.radians(margins[PHASE_RAD])
    if prepared.problem.objective.batch_column == "modulus":
        # Also where none is asked for, it is found.
        margins[MODULUS] = max(margins[MODULUS], np.finfo(np.float64).tiny)
    wanted = None if "free_space_admittance" in asked.soft_n else asked.free_space_admittance
    crosses = any(getattr(asked, name) is not None for name in _CROSSOVERS)
    rise = asked.threshold(_RISE) if _RISE in asked.asked() else math.inf
    responses = stack_responses(prepared.plants)
    return BatchEvaluator(
        prepared=prepared,
        plants=(stack_loops(sampled), responses, stack_grids(prepared.plants)),
        contacts=stack_contacts(prepared.pairs),
        bands=(
            stack_band([] if target is None else [target]),
            stack_band(peak_responses(prepared) if _RISE in asked.asked() else []),
        ),
        required=(
            margins,
            0.0 if wanted is None else wanted.min_m_s_per_n,
            math.inf if _RISE in asked.soft_n else rise,
            crosses,
        ),
        slow=tuple(name for name in asked.asked() if name not in _FAST),
        held=stack_held(prepared) if HELD in asked.asked() else None,
        led=stack_led(prepared) if LED in asked.asked() else None,
        spectrum=stack_spectrum(asked.command_noise, responses, prepared.problem.sample_time_s),
    )


def batch_led_peaks(
    contacts: Sequence[SampledContact], law: AdmittanceController, approaches: Sequence[Approach]
) -> FloatArray:
    """Return the peak forces on the environment [N] (a, s) of one law as `led_peaks` does, compiled."""
    loops, stacked = stack_judged(contacts)
    h = contacts[0].free.sample_time_s
    numbers, theta, ideal = controller_numbers([law])
    out = np.empty((len(approaches), len(contacts)))
    for row, approach in zip(out, approaches, strict=True):
        find_contact_peaks(loops, stacked, numbers, (h, theta, ideal), approach.numbers(), longest_run(h), row[None])
    for j in np.flatnonzero(np.isnan(out).any(axis=0)).tolist():
        out[:, j] = led_peaks(contacts[j], law, approaches)
    return out
