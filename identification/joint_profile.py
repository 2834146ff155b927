"""Profile likelihood: intervals of parameters whose likelihood a bound cuts off."""

from collections.abc import Sequence
import numpy as np
from numpy.typing import NDArray

from .joint_covariance import Spread
from .joint_solve import Block, Point, Problem

FloatArray = NDArray[np.float64]


def bounded_intervals(
    problem: Problem, point: Point, blocks: Sequence[Block], spread: Spread
) -> dict[str, tuple[float, float]]:
    return {}
