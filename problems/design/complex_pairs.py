"""Complex arithmetic on pairs of real expressions, for number types that know no complex ones."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The complex number `re` + j `im` of two real numbers or expressions; the other operand may be real."""

    re: Any
    im: Any

    def __add__(self, other: Any) -> "Pair":
        other = pair(other)
        return Pair(re=self.re + other.re, im=self.im + other.im)

    def __sub__(self, other: Any) -> "Pair":
        return self + -pair(other)

    def __rsub__(self, other: Any) -> "Pair":
        return pair(other) + -self

    def __neg__(self) -> "Pair":
        return Pair(re=-self.re, im=-self.im)

    def __mul__(self, other: Any) -> "Pair":
        other = pair(other)
        return Pair(re=self.re * other.re - self.im * other.im, im=self.re * other.im + self.im * other.re)

    def __truediv__(self, other: Any) -> "Pair":
        return self * (1.0 / pair(other))

    def __rtruediv__(self, other: Any) -> "Pair":
        return pair(other) * Pair(re=self.re / self.squared, im=-self.im / self.squared)

    __radd__, __rmul__ = __add__, __mul__

    @property
    def conjugate(self) -> "Pair":
        """The same with the other sign of the imaginary part."""
        return Pair(re=self.re, im=-self.im)

    @property
    def squared(self) -> Any:
        """The square of the absolute value."""
        return self.re * self.re + self.im * self.im


def pair(value: Any) -> Pair:
    """Return `value`, a real one as the pair it is."""
    return value if isinstance(value, Pair) else Pair(re=value, im=0.0)


def determinant(rows: list[list[Any]]) -> Any:
    """Expand along the first row: no pivot is chosen, so none can vanish; meant for a handful of rows."""
    if len(rows) == 1:
        return rows[0][0]
    total: Any = 0.0
    for j, head in enumerate(rows[0]):
        term = head * determinant([row[:j] + row[j + 1 :] for row in rows[1:]])
        total = total + term if j % 2 == 0 else total - term
    return total


def solve_resolvent(matrix: Any, z: Any, right: list[Any]) -> list[Any]:
    """Return (z − `matrix`)^(-1) `right` by Cramer's rule; `matrix` (n, n) is indexed by pairs of numbers."""
    size = len(right)
    rows = [[(z if i == j else 0.0) - matrix[i, j] for j in range(size)] for i in range(size)]
    share = 1.0 / determinant(rows)
    columns = [[[*row[:j], right[i], *row[j + 1 :]] for i, row in enumerate(rows)] for j in range(size)]
    return [determinant(column) * share for column in columns]
