"""Plants as the compiled test of stability takes them; everything else about them is built when it is asked for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..design.batch_kernel import Loops, judge_stability
from ..errors import ParameterError
from ..model.plant import PLANT_PARAMETERS, Plant
from ..model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius, split_delay
from ..stability.polynomials import DOUBTFUL, STABLE, UNSTABLE
from .designs import Designs
from .kernel import polynomials_of_plants

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

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
        """Tell for every controller on every plant, (m, p), whether the loop is stable, as `are_stable` does."""
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
