"""The plants of one part of a map, sampled once each, and what every controller is on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..contact.transient import Approach, build_sampled_contact
from ..design.batch import build_batch
from ..model.controller import AdmittanceController
from ..model.plant import FREE_SPACE, Plant
from ..model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from ..stability.margin_kernel import DELAY_S, DISK, GAIN_DB, MARGINS, MODULUS, PHASE_RAD
from ..stability.margins import LARGEST_GAIN_DB, prepare_margins
from .designs import Designs
from .kernel import margins_of_plant
from .loops import PlantLoops, build_plant_loops, check_delay
from .parameters import MapQuantity

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
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

    `free_of` (p,) tells for each plant which free space is its own.
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
        """Tell for every controller on every plant, (m, p), whether the loop is stable wherever that is asked."""
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
