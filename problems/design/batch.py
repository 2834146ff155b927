"""Many controllers on many plants at once: stability, modulus margin and peak forces, compiled.

The same equations as `problems.model.sampled`, `problems.stability.margins` and `problems.contact.transient`,
without their tables in between: the memory is that of the result and of the plants.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from ..contact.transient import Approach, SampledContact, longest_run, simulate_contact
from ..errors import ParameterError
from ..model.controller import THETA, AdmittanceController
from ..model.sampled import SampledPlant, build_loop, check_wrench_delay, spectral_radius
from ..stability.margins import PreparedMargins, check_finite, find_margins, loop_polynomials, prepare_margins
from ..stability.polynomials import DOUBTFUL
from .batch_kernel import (
    COLUMNS,
    MODULUS,
    MODULUS_RAD_PER_S,
    PEAK_CONTACT,
    PEAK_SENSOR,
    STABILITY,
    TIME_OF_PEAK,
    Contacts,
    Grids,
    Loops,
    evaluate_pairs,
    judge_stability,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_KIND = attrgetter("discretization", "compensation", "compensation_mass_kg")


@dataclass(frozen=True, kw_only=True)
class BatchResult:
    """Controllers × scenarios, (m, p) each; what an unstable loop does not have is NaN.

    `is_stable` is about the contact and the free space of the scenario. `modulus` is the smallest |1 + L| of the loop
    in contact over both break points, at `modulus_hz`. Peaks as in `ContactTransient`.
    """

    is_stable: BoolArray
    modulus: FloatArray
    modulus_hz: FloatArray
    peak_sensor_force_n: FloatArray
    peak_contact_force_n: FloatArray
    time_of_peak_s: FloatArray


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Contact scenarios with everything that does not depend on the controller already computed."""

    pairs: tuple[SampledContact, ...]
    in_contact: Loops
    in_free_space: Loops
    responses: FloatArray
    grids: Grids
    contacts: Contacts

    def evaluate(
        self,
        controllers: Sequence[AdmittanceController],
        approach: Approach,
        *,
        margins: bool = True,
        peaks: bool = True,
    ) -> BatchResult:
        """Evaluate every controller in every scenario; without `margins` or `peaks` those stay NaN."""
        _check_wrench_delays([pair.free for pair in self.pairs], controllers)
        parameters, theta, ideal = controller_numbers(controllers)
        h = self.pairs[0].contact.sample_time_s
        out = np.full((len(parameters), len(self.pairs), COLUMNS), np.nan)
        evaluate_pairs(
            self.in_contact,
            self.in_free_space,
            self.responses,
            self.grids,
            self.contacts,
            parameters,
            (h, theta, ideal),
            approach.numbers(),
            longest_run(h),
            (margins, peaks),
            out,
        )
        for i, j in np.argwhere(out[:, :, STABILITY] == DOUBTFUL):
            out[i, j] = _decided(self.pairs[j], controllers[i], approach)
        return BatchResult(
            is_stable=out[:, :, STABILITY] == 1.0,
            modulus=out[:, :, MODULUS],
            modulus_hz=out[:, :, MODULUS_RAD_PER_S] / (2.0 * np.pi),
            peak_sensor_force_n=out[:, :, PEAK_SENSOR],
            peak_contact_force_n=out[:, :, PEAK_CONTACT],
            time_of_peak_s=out[:, :, TIME_OF_PEAK],
        )


def build_batch(pairs: Sequence[SampledContact]) -> Batch:
    """Prepare scenarios of one robot order and one sample time."""
    check_alike([pair.contact for pair in pairs])
    plants = [prepare_margins(pair.contact) for pair in pairs]
    return Batch(
        pairs=tuple(pairs),
        in_contact=stack_loops([pair.contact for pair in pairs]),
        in_free_space=stack_loops([pair.free for pair in pairs]),
        responses=stack_responses(plants),
        grids=stack_grids(plants),
        contacts=stack_contacts(pairs),
    )


def stack_responses(plants: Sequence[PreparedMargins]) -> FloatArray:
    """Return the response polynomials (p, 4, n) of plants, as `find_loop_margins` takes them."""
    return stacked([plant.polynomials for plant in plants])


def stack_grids(plants: Sequence[PreparedMargins]) -> Grids:
    """Return the grids of plants one after the other."""
    grids = [plant.grid for plant in plants]
    return (
        np.concatenate([grid[0] for grid in grids]),
        np.concatenate([grid[1] for grid in grids]),
        np.concatenate([grid[2] for grid in grids]),
        np.concatenate([grid[3] for grid in grids]),
        offsets_of([len(grid[0]) for grid in grids]),
    )


def stack_contacts(pairs: Sequence[SampledContact]) -> Contacts:
    """Return what `run_contact` takes of every pair, with a leading axis."""
    plants = [pair.arguments for pair in pairs]
    return (
        (
            np.array([plant.step for plant in plants]),
            np.array([plant.flow for plant in plants]),
            np.array([plant.rows for plant in plants]),
            np.array([plant.wall for plant in plants]),
            np.array([pair.ramp for pair in pairs]),
        ),
        np.array([(plant.delay.whole, plant.delay.chain) for plant in plants], dtype=np.int64),
        np.array([plant.delay.fraction for plant in plants]),
        np.concatenate([plant.inside for plant in plants]),
        offsets_of([len(plant.inside) for plant in plants]),
    )


def are_stable(plants: Sequence[SampledPlant], controllers: Sequence[AdmittanceController]) -> BoolArray:
    """Tell for every controller on every plant, (m, p), whether the sampled loop is stable.

    Routh's test in w; where rounding could decide it, the eigenvalues of the exact loop do.
    """
    check_alike(plants)
    _check_wrench_delays(plants, controllers)
    parameters, theta, ideal = controller_numbers(controllers)
    verdicts = judge_stability(stack_loops(plants), parameters, plants[0].sample_time_s, theta, ideal)
    for i, j in np.argwhere(verdicts == DOUBTFUL):
        verdicts[i, j] = int(spectral_radius(build_loop(plants[j], controllers[i])) < 1.0)
    return np.asarray(verdicts == 1)


def _check_wrench_delays(plants: Sequence[SampledPlant], controllers: Sequence[AdmittanceController]) -> None:
    """Refuse controllers that read the position where a wrench is late."""
    late = [plant.plant for plant in plants if plant.plant.wrench_filter.delay_s > 0.0]
    for controller in controllers if late else ():
        check_wrench_delay(late[0], controller)


def _decided(pair: SampledContact, controller: AdmittanceController, approach: Approach) -> FloatArray:
    """Return one row of a result by the exact loop's eigenvalues."""
    row = np.full(COLUMNS, np.nan)
    row[STABILITY] = max(spectral_radius(build_loop(plant, controller)) for plant in (pair.free, pair.contact)) < 1.0
    if row[STABILITY]:
        margins, run = find_margins(pair.contact, controller), simulate_contact(pair, controller, approach)
        row[MODULUS], row[MODULUS_RAD_PER_S] = margins.modulus, 2.0 * np.pi * margins.modulus_hz
        row[PEAK_SENSOR], row[PEAK_CONTACT] = run.peak_sensor_force_n, run.peak_contact_force_n
        row[TIME_OF_PEAK] = run.time_of_peak_s
    return row


def stack_loops(plants: Sequence[SampledPlant]) -> Loops:
    """Return the polynomials of plants of one robot order and sample time, as `judge_loop` takes them."""
    found = [loop_polynomials(plant) for plant in plants]
    sizes = np.array([each.shape[1] for each in found], dtype=np.int64)
    first = np.array([0 if plant.plant.environment.is_anchored else 1 for plant in plants], dtype=np.int64)
    return stacked(found), sizes, first


def stacked(polynomials: Sequence[FloatArray]) -> FloatArray:
    """Return one array of polynomials of different length: the higher powers of the shorter ones are zero."""
    most = max(each.shape[1] for each in polynomials)
    return np.array([np.pad(each, ((0, 0), (0, most - each.shape[1]))) for each in polynomials])


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


def offsets_of(lengths: Sequence[int]) -> NDArray[np.int64]:
    """Return where each of several pieces begins, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
