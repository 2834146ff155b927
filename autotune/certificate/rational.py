"""Transfer functions of a state space in w = z − 1, in whatever arithmetic the entries have.

In z the poles of a sampled loop crowd around 1 and its polynomials are small differences of large numbers; in w they
are not, which keeps balls small.
"""

from collections.abc import Callable
from operator import mul
from typing import Any

import numpy as np

Objects = Any  # arrays of flint numbers


def resolvent(change: Objects) -> tuple[list[Any], list[Objects]]:
    """Return det(wI − Δ), and adj(wI − Δ) as matrices, both by ascending powers of w (Faddeev–LeVerrier)."""
    n = len(change)
    identity = np.array([[int(i == j) for j in range(n)] for i in range(n)], dtype=object)
    characteristic, adjugate = [1], [identity]
    for k in range(1, n + 1):
        product = dot(change, adjugate[-1])
        coefficient = -sum(product[i, i] for i in range(n)) / k
        characteristic.append(coefficient)
        if k < n:
            adjugate.append(product + identity * coefficient)
    return characteristic[::-1], adjugate[::-1]


def dot(left: Objects, right: Objects) -> Objects:
    """Return the product of two object arrays."""
    return np.dot(left, right)


def numerator(row: Objects, adjugate: list[Objects], column: Objects) -> list[Any]:
    """Return row·adj(wI − Δ)·column by ascending powers of w."""
    return [dot(row, dot(each, column)) for each in adjugate]


def add(left: list[Any], right: list[Any]) -> list[Any]:
    """Return the sum of two polynomials."""
    longer, shorter = (left, right) if len(left) >= len(right) else (right, left)
    return [value + (shorter[i] if i < len(shorter) else 0) for i, value in enumerate(longer)]


def times(left: list[Any], right: list[Any], product: Callable[[Any, Any], Any] = mul) -> list[Any]:
    """Return the product of two polynomials, of whose coefficients `product` is that."""
    found: list[Any] = [None] * (len(left) + len(right) - 1)
    for i, a in enumerate(left):
        for j, b in enumerate(right):
            both = product(a, b)
            found[i + j] = both if found[i + j] is None else found[i + j] + both
    return found


def times_z(polynomial: list[Any]) -> list[Any]:
    """Return (1 + w) times a polynomial in w."""
    return add([*polynomial, 0], [0, *polynomial])
