"""Closed loops of many controllers on many plants: stability, margins and peak forces, for the maps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..compiled import compiled
from ..contact.kernel_types import POSITION, SENSED, Traces
from ..contact.transient import Approach, build_sampled_contact, longest_run
from ..design.batch_kernel import (
    PEAK_COLUMNS,
    PEAK_CONTACT,
    PEAK_SENSOR,
    Contacts,
    Loops,
    judge_stability,
    simulate_pair,
    stack_contacts,
)
from ..errors import ParameterError
from ..model.controller import SMALLEST_FEEDBACK_DAMPING_S, AdmittanceController, blocks_of
from ..model.difference import DAMPING
from ..model.hold import hold_columns
from ..model.plant import ENVIRONMENT_STIFFNESS, FREE_SPACE, OF_FORCE, PLANT_PARAMETERS, Plant, write_plant
from ..model.sampled import (
    SampledPlant,
    build_loop,
    build_sampled_plant,
    check_wrench_delay,
    spectral_radius,
    split_delay,
)
from ..stability.margin_kernel import (
    DELAY_S,
    DISK,
    EVERY_MARGIN,
    GAIN_DB,
    MARGINS,
    MODULUS,
    MODULUS_ALONE,
    PHASE_RAD,
    Grid,
    PolynomialLoop,
    find_loop_margins,
)
from ..stability.margins import LARGEST_GAIN_DB, prepare_margins
from ..stability.polynomials import (
    CONTROLLER_POWERS,
    DOUBTFUL,
    STABLE,
    UNSTABLE,
    controller_polynomials,
    plant_polynomials,
)
from .parameters import CONTROLLER_FIELDS, MapQuantity


@compiled
def polynomials_of_plants(
    robots: tuple[FloatArray, FloatArray],
    parameters: FloatArray,
    delays: tuple[IntArray, FloatArray],
    h: float,
    out: FloatArray,
) -> None:
    """Write the polynomials of many plants into `out` (p, 3, L), see `plant_polynomials`.

    `robots` are numerators (p, n) and denominators (p, n + 1) as `RobotModel.ascending` gives them, `parameters`
    (p, 7), or (p, 8) of a filtered wrench, as `Plant.parameters`, `delays` whole samples (p,) and fractions (p,). The
    same steps as in `build_sampled_plant`, without what stability does not need. NaN where the motion overflows.
    """
    (numerators, denominators), (wholes, fractions) = robots, delays
    n = denominators.shape[1] + 1 + parameters.shape[1] - PLANT_PARAMETERS
    for k in range(len(parameters)):
        whole, fraction = wholes[k], fractions[k]
        a, b, outputs = np.zeros((n, n)), np.zeros(n), np.zeros((2, n + 2))
        push, c_contact, direct = np.zeros(n), np.zeros(n), np.zeros(3)
        c_position, c_force = outputs[POSITION, :n], outputs[SENSED, :n]
        write_plant(
            a, b, push, c_position, c_force, c_contact, direct, numerators[k], denominators[k], parameters[k], h
        )
        outputs[SENSED, n] = direct[OF_FORCE]
        whole_step = hold_columns(a, b.reshape(n, 1), 1.0)
        phi, gamma = np.ascontiguousarray(whole_step[:n, :n]), np.ascontiguousarray(whole_step[:n, n])
        if not np.all(np.isfinite(phi)):
            out[k, :, :] = np.nan
            continue
        gamma_old = np.zeros(n)
        if fraction > 0.0:
            newer = np.ascontiguousarray(hold_columns(a, b.reshape(n, 1), 1.0 - fraction)[:n, n])
            gamma_old[:] = gamma - newer
            gamma = newer
        chain = whole + (1 if fraction > 0.0 else 0)
        delay, free = (whole, chain, fraction), parameters[k, ENVIRONMENT_STIFFNESS] == 0.0
        found = plant_polynomials(phi, gamma, gamma_old, outputs, delay, free)
        out[k, :, : found.shape[1]] = found


@compiled
def margins_of_plant(
    polynomials: FloatArray,
    grid: Grid,
    designs: FloatArray,
    wanted: NDArray[np.bool_],
    sampling: tuple[float, float, bool],
    everything: bool,
    out: FloatArray,
) -> None:
    """Write the margins of the wanted, stable loops into rows of `out` (m, MARGINS), see `find_loop_margins`.

    `polynomials` and `grid` are the plant's as in `PreparedMargins`, `designs` (m, 7) controller parameters, `sampling`
    (h, θ, ideal).
    """
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        if wanted[i]:
            degree = controller_polynomials(designs[i], ideal, controller)
            loop = PolynomialLoop(polynomials, controller, degree, h, theta)
            find_loop_margins(loop, grid, EVERY_MARGIN if everything else MODULUS_ALONE, out[i])


@dataclass(frozen=True, kw_only=True)
class Designs:
    """Controllers of one discretisation: `parameters` (m, 7) as `AdmittanceController.parameters` orders them."""

    kind: AdmittanceController
    parameters: FloatArray

    @property
    def count(self) -> int:
        """How many controllers there are."""
        return len(self.parameters)

    def controller(self, index: int) -> AdmittanceController:
        """Return one of the controllers."""
        names = CONTROLLER_FIELDS.values()
        return replace(self.kind, **dict(zip(names, map(float, self.parameters[index]), strict=True)))  # type: ignore[arg-type]

    def alike(self) -> Iterator[tuple[NDArray[np.int64], bool]]:
        """Yield the indices of controllers with and without ideal compensation, and whether it is ideal."""
        ideal = (self.parameters[:, -1] > 0.0) & (self.kind.compensation == "ideal")
        for value in (False, True):
            chosen = np.flatnonzero(ideal == value)
            if len(chosen):
                yield chosen, value


def designs_around(controller: AdmittanceController, varied: dict[str, FloatArray]) -> Designs:
    """Return the controllers that differ from one by values (m,) of each of the parameters in `varied`.

    The ranges are the caller's to check. A feedback damping too small to be a value in seconds is none at all
    (docs/method.md, erratum 2), so that a range may begin at 0.
    """
    count = max((len(values) for values in varied.values()), default=1)
    parameters = np.tile(controller.parameters(), (count, 1))
    for name, values in varied.items():
        column = list(CONTROLLER_FIELDS).index(name)
        parameters[:, column] = values
        if name == "feedback_damping_s":
            parameters[:, column] *= values >= SMALLEST_FEEDBACK_DAMPING_S
    return Designs(kind=controller, parameters=parameters)


# Eigenvalues of larger loops take so long that a map of them would not end.
MOST_DELAY_SAMPLES = 250


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantLoops:
    """Plants (p,) of one robot order, and their polynomials, see `problems.stability.polynomials`."""

    plants: tuple[Plant, ...]
    sample_time_s: float
    loops: Loops

    def only(self, index: int) -> "PlantLoops":
        """Return one of the plants."""
        part = slice(index, index + 1)
        polynomials, sizes, first = self.loops
        return PlantLoops(
            plants=self.plants[part],
            sample_time_s=self.sample_time_s,
            loops=(polynomials[part], sizes[part], first[part]),
        )

    def sampled(self, index: int) -> SampledPlant:
        """Return one of the plants, sampled."""
        return build_sampled_plant(self.plants[index], self.sample_time_s)

    def stable(self, designs: Designs) -> BoolArray:
        """Return for every controller on every plant, (m, p), whether the loop is stable.

        Routh's test in w; where rounding could decide it, the eigenvalues of the exact loop do.
        """
        out = np.zeros((designs.count, len(self.plants)), dtype=np.bool_)
        for chosen, ideal in designs.alike():
            parameters = designs.parameters[chosen]
            verdicts = judge_stability(self.loops, parameters, self.sample_time_s, designs.kind.theta, ideal)
            for i, j in np.argwhere(verdicts == DOUBTFUL):
                loop = build_loop(self.sampled(j), designs.controller(chosen[i]))
                verdicts[i, j] = STABLE if spectral_radius(loop) < 1.0 else UNSTABLE
            out[chosen] = verdicts == STABLE
        return out


def build_plant_loops(plants: Sequence[Plant], sample_time_s: float) -> PlantLoops:
    """Sample plants of one robot order as far as stability needs it.

    Raises ParameterError for a delay that is too long, or a plant whose motion over one sample overflows.
    """
    for plant in plants:
        check_delay(plant, sample_time_s)
    robots = [plant.robot.ascending() for plant in plants]
    delays = [split_delay(plant.loop_delay_s, sample_time_s) for plant in plants]
    whole, fraction = np.array([each[0] for each in delays], dtype=np.int64), np.array([each[1] for each in delays])
    parameters = np.array([plant.parameters() for plant in plants])
    numerators, denominators = np.array([each[0] for each in robots]), np.array([each[1] for each in robots])
    sizes = denominators.shape[1] + 2 + parameters.shape[1] - PLANT_PARAMETERS + whole + (fraction > 0.0)
    polynomials = np.zeros((len(plants), 3, int(np.max(sizes))))
    polynomials_of_plants((numerators, denominators), parameters, (whole, fraction), sample_time_s, polynomials)
    bad = np.flatnonzero(~np.all(np.isfinite(polynomials), axis=(1, 2)))
    if len(bad):
        raise ParameterError("plant", plants[bad[0]], "one whose motion over one sample is finite")
    # Without an anchor the loop's integrator is divided out.
    first = np.array([0 if plant.environment.is_anchored else 1 for plant in plants], dtype=np.int64)
    return PlantLoops(plants=tuple(plants), sample_time_s=sample_time_s, loops=(polynomials, sizes, first))


def check_delay(plant: Plant, sample_time_s: float) -> None:
    """Raise ParameterError for a delay of so many samples that a map of such loops would not end."""
    if plant.loop_delay_s > MOST_DELAY_SAMPLES * sample_time_s:
        must = f"at most {MOST_DELAY_SAMPLES} samples of {sample_time_s:g} s"
        raise ParameterError("delay_s", plant.loop_delay_s, must)


Where = Literal["contact", "free_space", "both"]

_COLUMNS = {
    MapQuantity.MODULUS: MODULUS,
    MapQuantity.GAIN: GAIN_DB,
    MapQuantity.PHASE: PHASE_RAD,
    MapQuantity.DELAY: DELAY_S,
    MapQuantity.DISK: DISK,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantChunk:
    """Plants with their environment (None when only free space is asked), and their distinct free spaces (or None).

    `free_of` (p,) gives for each plant which free space is its own.
    """

    contact: PlantLoops | None
    free: PlantLoops | None
    free_of: NDArray[np.int64]

    def one(self, index: int) -> "PlantChunk":
        """Return the chunk of one of the plants."""
        return PlantChunk(
            contact=None if self.contact is None else self.contact.only(index),
            free=None if self.free is None else self.free.only(int(self.free_of[index])),
            free_of=np.zeros(1, dtype=np.int64),
        )

    def stable(self, designs: Designs) -> BoolArray:
        """Return for every controller on every plant, (m, p), whether the loop is stable wherever that is asked."""
        out = np.ones((designs.count, len(self.free_of)), dtype=np.bool_)
        if self.contact is not None:
            out &= self.contact.stable(designs)
        if self.free is not None:
            out &= self.free.stable(designs)[:, self.free_of]
        return out

    def margins(self, designs: Designs, stable: BoolArray, quantity: MapQuantity) -> FloatArray:
        """Return one margin (m, p), the smaller of contact and free space; NaN where `stable` (m, p) is False."""
        out = np.full(stable.shape, np.inf)
        for loops, place in ((self.contact, np.arange(len(self.free_of))), (self.free, self.free_of)):
            if loops is None:
                continue
            for k in range(len(loops.plants)):
                own = np.flatnonzero(place == k)
                found = _margin(loops.sampled(k), designs, np.any(stable[:, own], axis=1), quantity)
                out[:, own] = np.minimum(out[:, own], found[:, None])
        return np.where(stable, out, np.nan)

    def largest_radius(self, controller: AdmittanceController) -> float:
        """Return the largest |z| on the first plant wherever stability is asked, by the eigenvalues."""
        asked = [loops.sampled(0) for loops in (self.contact, self.free) if loops is not None]
        return max(spectral_radius(build_loop(plant, controller)) for plant in asked)


def build_chunk(plants: Sequence[Plant], sample_time_s: float, where: Where) -> PlantChunk:
    """Sample plants, and each of their free spaces once."""
    distinct: dict[Plant, int] = {}
    free_of = [distinct.setdefault(plant.in_contact_with(FREE_SPACE), len(distinct)) for plant in plants]
    return PlantChunk(
        contact=None if where == "free_space" else build_plant_loops(plants, sample_time_s),
        free=None if where == "contact" else build_plant_loops(tuple(distinct), sample_time_s),
        free_of=np.array(free_of, dtype=np.int64),
    )


@compiled
def peaks_of_pairs(
    contacts: Contacts,
    designs: FloatArray,
    wanted: NDArray[np.bool_],
    sampling: tuple[float, float, bool],
    approach: tuple[float, float, bool, float],
    longest: int,
    out: FloatArray,
) -> None:
    """Write the peaks of the wanted, stable pairs (m, p) of designs (m, 7) and plants into `out` (m, p, PEAK_COLUMNS).

    `sampling` is (h, θ, ideal), `approach` as `Approach.numbers`.
    """
    h, theta, ideal = sampling
    traces = Traces(np.empty(longest), np.empty(longest))
    for i in range(len(designs)):
        blocks = blocks_of(designs[i], h, theta, ideal)
        for j in range(out.shape[1]):
            if wanted[i, j]:
                simulate_pair(contacts, j, blocks, designs[i, DAMPING], h, approach, traces, out[i, j])


def peaks_of(
    plants: Sequence[Plant], sample_time_s: float, designs: Designs, approach: Approach, quantity: MapQuantity
) -> tuple[BoolArray, FloatArray]:
    """Return stability in contact and free space, and one peak force [N], (m, p); NaN where the loop is unstable."""
    late = [plant for plant in plants if plant.wrench_filter.delay_s > 0.0]
    for index in range(designs.count if late else 0):
        check_wrench_delay(late[0], designs.controller(index))
    stable = build_chunk(plants, sample_time_s, "both").stable(designs)
    pairs = [build_sampled_contact(build_sampled_plant(plant, sample_time_s)) for plant in plants]
    contacts, peaks = stack_contacts(pairs), np.full((*stable.shape, PEAK_COLUMNS), np.nan)
    longest, numbers = longest_run(sample_time_s), approach.numbers()
    for chosen, ideal in designs.alike():
        sampling, out = (sample_time_s, designs.kind.theta, ideal), peaks[chosen]
        peaks_of_pairs(contacts, designs.parameters[chosen], stable[chosen], sampling, numbers, longest, out)
        peaks[chosen] = out
    return stable, peaks[:, :, PEAK_CONTACT if quantity is MapQuantity.PEAK_CONTACT else PEAK_SENSOR]


def _margin(plant: SampledPlant, designs: Designs, wanted: BoolArray, quantity: MapQuantity) -> FloatArray:
    """Return one margin (m,) of the loops that are wanted, in the units of `Margins`; infinite elsewhere."""
    prepared = prepare_margins(plant)
    found = np.full((designs.count, MARGINS), np.inf)
    everything = quantity is not MapQuantity.MODULUS
    for chosen, ideal in designs.alike():
        sampling = (plant.sample_time_s, designs.kind.theta, ideal)
        out = np.full((len(chosen), MARGINS), np.inf)
        margins_of_plant(
            prepared.polynomials, prepared.grid, designs.parameters[chosen], wanted[chosen], sampling, everything, out
        )
        found[chosen] = out
    values = found[:, _COLUMNS[quantity]]
    if quantity is MapQuantity.GAIN:
        return np.where(values < LARGEST_GAIN_DB, values, np.inf)
    return np.degrees(values) if quantity is MapQuantity.PHASE else values
