"""The coefficients of the loop's equation over a cell of plants: values in its middle, derivatives all over it."""

from typing import Any

import numpy as np

from problems.arrays import FloatArray

from . import rational
from .balls import Balls, DualBall, as_series, derivatives_of, enclose
from .bounds import PlantCell
from .family import Family
from .law import LawPolynomials, without_constant
from .plant_polynomials import plant_polynomials

Raw = tuple[list[Any], ...]
"""d, n_F and n_x in w = z − 1, ascending."""
Groups = tuple[list[DualBall], ...]


def coefficients(family: Family, cell: FloatArray) -> tuple[Raw, Raw]:
    """Return d, n_F and n_x in the middle of a cell (d, 2), then all over it with derivatives along the coordinates."""
    middle = np.mean(cell, axis=1)
    return (
        plant_polynomials(family, np.stack([middle, middle], axis=1)),
        plant_polynomials(family, cell, with_derivatives=True),
    )


def half_widths(cell: FloatArray) -> FloatArray:
    """Return half the width of a cell along each coordinate, rounded up, as its middle is not exactly in the middle."""
    return np.asarray(0.5 * (cell[:, 1] - cell[:, 0]) * (1.0 + 1e-12) + 2.0 * np.spacing(np.abs(np.mean(cell, axis=1))))


def with_derivatives(cell: FloatArray, middle: Groups, everywhere: Groups) -> PlantCell:
    """Return coefficients over a cell: their values at its middle, and derivatives that hold all over it."""
    groups = []
    for values, slopes in zip(middle, everywhere, strict=True):
        value = enclose([each.value for each in values])
        derivatives = [
            enclose(along).times(h)
            for along, h in zip(derivatives_of(slopes, len(cell)), half_widths(cell), strict=True)
        ]
        rest = value.rad + np.sum([s.rad for s in derivatives], axis=0)
        mid = np.stack([value.mid, *(s.mid for s in derivatives)], axis=1)
        rad = np.zeros_like(mid)
        rad[:, 0] = rest * (1.0 + 1e-12)
        groups.append(Balls(mid=mid, rad=rad))
    return PlantCell(groups=tuple(groups))


def loop_groups(family: Family, law: LawPolynomials, found: Raw, *, is_deflated: bool) -> Groups:
    """Return the groups of coefficients that the circle has factors for."""
    d, force, position = found
    if family.is_free_space:
        # At rest nothing pulls on the flange: the factor w is there for every plant.
        without_constant([as_series(force[0]).value])
        force = force[1:] if is_deflated else [0, *force[1:]]
    groups = [d, force]
    if law.follows:
        groups.append(rational.add(d, [-1 * each for each in position])[1:] if is_deflated else position)
    if law.position:
        groups.append(position)
    return tuple([as_series(each) for each in part] for part in groups)
