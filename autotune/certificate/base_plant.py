"""One plant, exactly: is its loop stable, and does a claim fail there? Everything in flint's balls."""

from typing import Any

import numpy as np

from problems.arrays import FloatArray
from problems.model.sampled import Controller

from .balls import as_series, at, on_circle, polynomial, with_bits
from .family import Family
from .law import law_polynomials, without_constant
from .plant_polynomials import plant_polynomials

_PRECISIONS = (512, 2048)


def point_polynomials(family: Family, point: FloatArray) -> tuple[list[Any], list[Any], list[Any]]:
    """Return d, n_F and n_x of one plant in w, ascending."""
    cell = np.stack([point, point], axis=1)
    d, force, position = plant_polynomials(family, cell)
    found = [[as_series(each).value for each in part] for part in (d, force, position)]
    if family.is_free_space:
        found[1] = without_constant(found[1])
    return found[0], found[1], found[2]


def is_stable(family: Family, controller: Controller, point: FloatArray) -> bool | None:
    """Return whether all poles lie inside the unit circle, by Schur and Cohn's recursion; None if rounding hides it.

    In free space the integrator at z = 1 is taken out, unless the law holds the position.
    """
    whole, has_fraction = family.delay()
    for bits in _PRECISIONS:
        with with_bits(bits):
            law = law_polynomials(controller, family.sample_time_s)
            d, force, position = point_polynomials(family, point)
            chain = polynomial([1, 1]) ** (whole + int(has_fraction))
            closed = chain * polynomial(law.denominator) * polynomial(d) - polynomial(law.force) * polynomial(force)
            closed -= (polynomial(law.position) + polynomial(law.denominator) * int(law.follows)) * polynomial(position)
            numbers = closed.coeffs()[1 if family.is_free_space and not law.holds_position else 0 :]
            verdict = _schur_cohn(polynomial(numbers)(polynomial([-1, 1])).coeffs())
        if verdict is not None:
            return verdict
    return None


def _schur_cohn(ascending: list[Any]) -> bool | None:
    while len(ascending) > 1:
        first, last = ascending[0], ascending[-1]
        if abs(first) >= abs(last):
            return False
        if not abs(first) < abs(last):
            return None
        share = first / last
        count = len(ascending)
        ascending = [ascending[k + 1] - share * ascending[count - 2 - k] for k in range(count - 1)]
    return True


def fails_at(family: Family, controller: Controller, point: FloatArray, angle: float, modulus: float) -> bool:
    """Return whether |χ| < m |R| is certain at one plant and one angle [rad/sample], for one of the break points."""
    whole, has_fraction = family.delay()
    with with_bits(_PRECISIONS[0]):
        law = law_polynomials(controller, family.sample_time_s)
        d, force, position = point_polynomials(family, point)
        z = on_circle(angle)
        w = z - 1
        opened = at(law.denominator, w) * (
            z ** (whole + int(has_fraction)) * at(d, w) - int(law.follows) * at(position, w)
        )
        inner = opened - at(law.position, w) * at(position, w)
        closed = inner - at(law.force, w) * at(force, w)
        return bool(abs(closed) < modulus * abs(opened)) or bool(abs(closed) < modulus * abs(inner))
