"""The margins of one design on many plants in one compiled pass."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .batch import check_alike, stack_grids, stack_loops, stack_responses
from .batch_kernel import Grids, Loops, margins_of_plants
from .controller import AdmittanceController
from .margin_kernel import MARGINS
from .margins import Margins, PreparedMargins, margins_from
from .polynomials import STABLE

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MarginTable:
    """Plants (p,) of one robot order and sample time, laid out one after the other."""

    loops: Loops
    responses: FloatArray
    grids: Grids
    plants: tuple[PreparedMargins, ...]

    def find(self, controller: AdmittanceController) -> tuple[Margins, ...] | None:
        """Return the margins on every plant, their spectral radius NaN; None unless every loop is surely stable.

        Raises ParameterError when a loop's response is not finite.
        """
        out = np.empty((len(self.plants), 1 + MARGINS))
        sampling = (self.plants[0].sampled.sample_time_s, controller.theta, controller.is_ideal)
        margins_of_plants(self.loops, self.responses, self.grids, controller.parameters(), sampling, out)
        if not np.all(out[:, 0] == STABLE):
            return None
        rows = zip(out[:, 1:], self.plants, strict=True)
        return tuple(margins_from(found, math.nan, plant.sampled.plant) for found, plant in rows)


def build_margin_table(plants: Sequence[PreparedMargins]) -> MarginTable:
    """Lay out plants that are prepared one by one."""
    check_alike([plant.sampled for plant in plants])
    return MarginTable(
        loops=stack_loops([plant.sampled for plant in plants]),
        responses=stack_responses(plants),
        grids=stack_grids(plants),
        plants=tuple(plants),
    )
