"""Contacts with many plants drawn from a certified set, on all processors, and what share of such plants may be bad."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv

from autotune.formats.certificate_record import AxisDomain
from autotune.processes import count_processors
from problems.arrays import BoolArray, FloatArray, IntArray
from problems.contact.many_contacts import FULL_CONTACT, PEAKS, ManyContacts, simulate_plants
from problems.contact.nonlinear_simulation import DrawnNoise, NonlinearRun, needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import NO_NONLINEARITIES, Nonlinearities
from problems.design.uncertainty import ENVIRONMENT_MASS, Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant_arrays import build_plant_arrays
from problems.model.sampled import check_wrench_delay
from problems.stability.margins import UnstableLoopError
from problems.stability.polynomials import DOUBTFUL, STABLE, UNSTABLE

CHUNK = 256
"""Plants that are drawn together, whatever is asked for: plant and noise of an index hang on the seed alone."""
CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class PlantDraws:
    """A chunk of plants: `values` (CHUNK,) by the parameters' names, and what disturbs each, (CHUNK, ticks)."""

    values: dict[str, FloatArray]
    noise: DrawnNoise

    def scenario(self, place: int) -> Scenario:
        """Return one of the plants."""
        return Scenario(**{name: float(column[place]) for name, column in self.values.items()})

    def noise_of(self, place: int) -> DrawnNoise:
        """Return what disturbs one of the plants."""
        return DrawnNoise(self.noise.force_n[place], self.noise.late[place])


@dataclass(frozen=True, kw_only=True)
class SampledContacts:
    """Contacts of one axis, as its certificate says, with plants drawn independently of each other by a `seed`.

    A contact takes `ticks` samples. K_e is drawn evenly by ratio, the other parameters evenly; what lies outside of the
    ellipsoid is pulled onto its surface (`PlantSet.from_unit`).
    """

    domain: AxisDomain
    law: AdmittanceController
    sample_time_s: float
    ticks: int
    effects: Nonlinearities
    seed: int

    def draw(self, chunk: int, count: int = CHUNK) -> PlantDraws:
        """Draw the plants of a chunk, and their noise and late commands; return the first ones."""
        rng, shape, plants = np.random.default_rng((self.seed, chunk)), (CHUNK, self.ticks), self.domain.plants
        values = plants.from_units(rng.random((CHUNK, len(plants.varying))))
        force = self.effects.force_noise_rms_n * rng.standard_normal(shape)
        late = rng.random(shape) < self.effects.late_share
        some = {name: column[:count] for name, column in values.items()}
        return PlantDraws(values=some, noise=DrawnNoise(force[:count], late[:count]))

    def scenario(self, index: int) -> Scenario:
        """Return the plant of an index."""
        return self.draw(index // CHUNK).scenario(index % CHUNK)

    def run(self, draws: PlantDraws, place: int, *, disturbed: bool = True) -> NonlinearRun:
        """Simulate the contact of one plant in steps of Runge–Kutta alone, see `simulate_nonlinear`."""
        plant = draws.scenario(place).plant(self.domain.plants.nominal)
        return simulate_nonlinear(
            plant,
            self.law,
            self.domain.approach,
            sample_time_s=self.sample_time_s,
            # Half a sample less, so that rounding adds none.
            duration_s=(self.ticks - 0.5) * self.sample_time_s,
            effects=self.effects if disturbed else NO_NONLINEARITIES,
            substeps=needed_substeps(plant, self.sample_time_s),
            noise=draws.noise_of(place) if disturbed else None,
        )

    def simulate_chunk(self, chunk: int, count: int = CHUNK, *, traced: int = 0) -> ManyContacts:
        """Simulate the first plants of a chunk; where rounding could decide, one by one.

        Raises ParameterError for what cannot be simulated.
        """
        draws = self.draw(chunk, count)
        found = self._simulate_together(draws, traced)
        for place in np.flatnonzero((found.verdicts != STABLE) & (found.verdicts != UNSTABLE)):
            try:
                runs = [self.run(draws, int(place), disturbed=disturbed) for disturbed in (False, True)]
            except UnstableLoopError:
                found.verdicts[place] = UNSTABLE
                continue
            found.verdicts[place] = STABLE
            peaks = [(run.peak_contact_force_n, run.peak_sensor_force_n) for run in runs]
            found.peaks_n[place] = np.concatenate(peaks)
            if place < traced:
                found.traces_n[place] = runs[-1].contact_force_n
        return found

    def _simulate_together(self, draws: PlantDraws, traced: int) -> ManyContacts:
        """Simulate plants in one kernel, which knows walls without mass alone: others are left open, one by one."""
        nominal, count = self.domain.plants.nominal, len(draws.noise.late)
        if self.domain.plants.range_of(ENVIRONMENT_MASS)[1] > 0.0:
            return ManyContacts(
                verdicts=np.full(count, DOUBTFUL, dtype=np.int64),
                peaks_n=np.full((count, PEAKS), np.nan),
                traces_n=np.zeros((min(traced, count), self.ticks)),
            )
        plants = build_plant_arrays(nominal, draws.values)
        for place in np.flatnonzero(plants.wrench_delay_s > 0.0)[:1]:
            check_wrench_delay(draws.scenario(int(place)).plant(nominal), self.law)
        return simulate_plants(
            plants,
            self.law,
            self.domain.approach,
            sample_time_s=self.sample_time_s,
            effects=self.effects,
            draws=draws.noise,
            traced=traced,
        )

    def simulate(self, count: int, progress: Callable[[float], None], *, traced: int = 0) -> ManyContacts:
        """Simulate `count` plants and keep the contact force of the first ones, at most `CHUNK`.

        `progress` takes shares of the work. What comes out depends on neither how many processors there are nor how
        many plants come after one. Raises ParameterError for what cannot be simulated.
        """
        sizes = [min(CHUNK, count - done) for done in range(0, count, CHUNK)]
        verdicts: list[IntArray] = []
        peaks: list[FloatArray] = []
        traces = np.empty((0, self.ticks))
        with ThreadPoolExecutor(count_processors()) as pool:
            first, *others = (
                pool.submit(self.simulate_chunk, k, size, traced=traced if k == 0 else 0)
                for k, size in enumerate(sizes)
            )
            try:
                for future in (first, *others):
                    found = future.result()
                    verdicts.append(found.verdicts)
                    peaks.append(found.peaks_n)
                    traces = found.traces_n if future is first else traces
                    progress(1.0 / len(sizes))
            finally:
                for future in others:
                    future.cancel()
        return ManyContacts(verdicts=np.concatenate(verdicts), peaks_n=np.concatenate(peaks), traces_n=traces)

    def worst(self, found: ManyContacts, count: int) -> IntArray:
        """Return the indices of the plants with the largest contact forces, the largest first."""
        forces = np.nan_to_num(found.peaks_n[:, FULL_CONTACT], nan=-np.inf)
        return np.argsort(-forces, kind="stable")[: min(count, int(np.sum(found.verdicts == STABLE)))]


def largest_share(bad: BoolArray) -> float:
    """Return up to which share of all such plants may be bad, of independent draws (n,) of which some are.

    The exact one-sided bound of Clopper and Pearson (1934) at `CONFIDENCE`: with a larger share as few bad plants, or
    fewer, would be drawn less often than once in 1/(1 − `CONFIDENCE`) studies.
    """
    count, found = len(bad), int(np.sum(bad))
    return 1.0 if found == count else float(betaincinv(found + 1, count - found, CONFIDENCE))
