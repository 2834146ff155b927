"""The plants of one part of a map, sampled once each, and what every controller is on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .batch import build_batch
from .batch_kernel import judge_stability
from .contact import Approach, build_sampled_contact
from .controller import AdmittanceController
from .errors import ParameterError
from .map_designs import Designs
from .map_kernel import margins_of_plant
from .map_parameters import MapQuantity
from .margin_kernel import DELAY_S, DISK, GAIN_DB, MARGINS, MODULUS, PHASE_RAD
from .margins import loop_polynomials, margin_grid, response_polynomials
from .plant import FREE_SPACE, Plant
from .polynomials import DOUBTFUL, STABLE, UNSTABLE
from .sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Where = Literal["contact", "free_space", "both"]

# Eigenvalues of larger loops take so long that a map of them would not end.
_MOST_DELAY_SAMPLES = 250
# The loop gain is rounding there (as in `find_margins`), and limits nothing.
_NO_LIMIT_DB = 200.0
_COLUMNS = {
    MapQuantity.MODULUS: MODULUS,
    MapQuantity.GAIN: GAIN_DB,
    MapQuantity.PHASE: PHASE_RAD,
    MapQuantity.DELAY: DELAY_S,
    MapQuantity.DISK: DISK,
}


@dataclass(frozen=True, kw_only=True)
class PlantChunk:
    """Sampled plants: with their environment (empty when only free space is asked), and their distinct free spaces.

    `free_of` (p,) tells for each plant which free space is its own; `free` is empty when only contact is asked.
    """

    contact: tuple[SampledPlant, ...]
    free: tuple[SampledPlant, ...]
    free_of: NDArray[np.int64]

    @property
    def count(self) -> int:
        """How many plants there are."""
        return len(self.free_of)

    def one(self, index: int) -> "PlantChunk":
        """Return the chunk of one of the plants."""
        return PlantChunk(
            contact=self.contact[index : index + 1],
            free=(self.free[self.free_of[index]],) if self.free else (),
            free_of=np.zeros(1, dtype=np.int64),
        )

    def stable(self, designs: Designs) -> BoolArray:
        """Tell for every controller on every plant, (m, p), whether the loop is stable wherever that is asked."""
        out = np.ones((designs.count, self.count), dtype=np.bool_)
        if self.contact:
            out &= _verdicts(self.contact, designs)
        if self.free:
            out &= _verdicts(self.free, designs)[:, self.free_of]
        return out

    def margins(self, designs: Designs, stable: BoolArray, quantity: MapQuantity) -> FloatArray:
        """Return one margin (m, p), the smaller of contact and free space; NaN where `stable` (m, p) is False."""
        out = np.full(stable.shape, np.inf)
        for j, plant in enumerate(self.contact):
            out[:, j] = _margin(plant, designs, stable[:, j], quantity)
        for k, plant in enumerate(self.free):
            own = np.flatnonzero(self.free_of == k)
            found = _margin(plant, designs, np.any(stable[:, own], axis=1), quantity)
            out[:, own] = np.minimum(out[:, own], found[:, None])
        return np.where(stable, out, np.nan)

    def largest_radius(self, controller: AdmittanceController) -> FloatArray:
        """Return the largest |z| (p,) wherever stability is asked, by the eigenvalues of the exact loop."""
        near = [spectral_radius(build_loop(plant, controller)) for plant in self.contact]
        far = np.array([spectral_radius(build_loop(plant, controller)) for plant in self.free])
        if not self.free:
            return np.array(near)
        return np.maximum(near, far[self.free_of]) if near else far[self.free_of]


def build_chunk(plants: Sequence[Plant], sample_time_s: float, where: Where) -> PlantChunk:
    """Sample plants, and each of their free spaces once."""
    for plant in plants:
        check_delay(plant, sample_time_s)
    distinct: dict[Plant, int] = {}
    free_of = [distinct.setdefault(plant.in_contact_with(FREE_SPACE), len(distinct)) for plant in plants]
    return PlantChunk(
        contact=() if where == "free_space" else tuple(build_sampled_plant(plant, sample_time_s) for plant in plants),
        free=() if where == "contact" else tuple(build_sampled_plant(plant, sample_time_s) for plant in distinct),
        free_of=np.array(free_of, dtype=np.int64),
    )


def check_delay(plant: Plant, sample_time_s: float) -> None:
    """Raise ParameterError for a delay of so many samples that a map of such loops would not end."""
    if plant.robot.delay_s > _MOST_DELAY_SAMPLES * sample_time_s:
        must = f"at most {_MOST_DELAY_SAMPLES} samples of {sample_time_s:g} s"
        raise ParameterError("delay_s", plant.robot.delay_s, must)


def peaks_of(
    plants: Sequence[Plant], sample_time_s: float, designs: Designs, approach: Approach, quantity: MapQuantity
) -> tuple[BoolArray, FloatArray]:
    """Return stability in contact and free space, and one peak force [N], (m, p); NaN where the loop is unstable."""
    for plant in plants:
        check_delay(plant, sample_time_s)
    batch = build_batch([build_sampled_contact(build_sampled_plant(plant, sample_time_s)) for plant in plants])
    stable = np.zeros((designs.count, len(plants)), dtype=np.bool_)
    peaks = np.full(stable.shape, np.nan)
    for chosen, _ in designs.alike():
        found = batch.evaluate([designs.controller(i) for i in chosen], approach, margins=False)
        stable[chosen] = found.is_stable
        at_contact = quantity is MapQuantity.PEAK_CONTACT
        peaks[chosen] = found.peak_contact_force_n if at_contact else found.peak_sensor_force_n
    return stable, np.where(stable, peaks, np.nan)


def _verdicts(plants: Sequence[SampledPlant], designs: Designs) -> BoolArray:
    """Do what `are_stable` does, on controllers that are rows of numbers."""
    for plant in plants:
        check_finite(plant)
    found = [loop_polynomials(plant) for plant in plants]
    sizes = np.array([each.shape[1] for each in found], dtype=np.int64)
    polynomials = np.zeros((len(found), 3, int(np.max(sizes))))
    for i, each in enumerate(found):
        polynomials[i, :, : each.shape[1]] = each
    # Without an anchor the loop's integrator is divided out.
    first = np.array([0 if plant.plant.environment.is_anchored else 1 for plant in plants], dtype=np.int64)
    loops, h = (polynomials, sizes, first), plants[0].sample_time_s
    out = np.zeros((designs.count, len(plants)), dtype=np.bool_)
    for chosen, ideal in designs.alike():
        verdicts = judge_stability(loops, designs.parameters[chosen], h, designs.kind.theta, ideal)
        for i, j in np.argwhere(verdicts == DOUBTFUL):
            loop = build_loop(plants[j], designs.controller(chosen[i]))
            verdicts[i, j] = STABLE if spectral_radius(loop) < 1.0 else UNSTABLE
        out[chosen] = verdicts == STABLE
    return out


def _margin(plant: SampledPlant, designs: Designs, wanted: BoolArray, quantity: MapQuantity) -> FloatArray:
    """Return one margin (m,) of the loops that are wanted, in the units of `Margins`; infinite elsewhere."""
    polynomials, grid = response_polynomials(plant), margin_grid(plant)
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
        return np.where(values < _NO_LIMIT_DB, values, np.inf)
    return np.degrees(values) if quantity is MapQuantity.PHASE else values
