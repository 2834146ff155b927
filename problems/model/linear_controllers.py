"""Linear control laws in general: any difference equation from force and position to the position command."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur

from .._checks import positive
from ..arrays import ComplexArray, FloatArray
from ..errors import ParameterError


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearController:
    """x^d_k = C s_k + D_e e_k + D_x x_k and s_{k+1} = A s_k + B_e e_k + B_x x_k with e = F^d + F.

    `matrix` (r + 1, r + 2) has the states' rows first and the command's last, over (states, e, x). `rest` (r,) is the
    state at rest at one metre with e = 0, where the command is one metre too. A law that `holds_position` pulls back
    to where it started; all others keep the integrator at z = 1 that a position in free space is. `approach` is the
    law without that pull, the same as `matrix` for the others: it has a steady speed in free space. A law that
    `follows_position` adds its output to the measured position, x^d = x + u: what is cut open to ask for margins at
    the command is then u, since x itself comes back with a gain of exactly 1.

    Raises ParameterError for matrices that are not finite or do not rest at one metre.
    """

    matrix: FloatArray
    rest: FloatArray
    sample_time_s: float
    holds_position: bool = False
    follows_position: bool = False
    approach: FloatArray | None = None

    def __post_init__(self) -> None:
        matrix, rest = np.array(self.matrix, dtype=np.float64), np.array(self.rest, dtype=np.float64)
        r = len(rest)
        approach = matrix if self.approach is None else np.array(self.approach, dtype=np.float64)
        if matrix.shape != (r + 1, r + 2) or approach.shape != matrix.shape:
            raise ParameterError("matrix", matrix.shape, f"(states + 1, states + 2) for {r} states")
        if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(approach)) and np.all(np.isfinite(rest))):
            raise ParameterError("matrix", "numbers that are not finite", "finite")
        stays = approach[:, :r] @ rest + approach[:, r + 1]
        if not np.allclose(stays, [*rest, 1.0], rtol=0.0, atol=1e-9 * (1.0 + float(np.max(np.abs(rest), initial=0.0)))):
            raise ParameterError("rest", rest, "a state at which the command stays at one metre")
        for name, array in (("matrix", matrix), ("rest", rest), ("approach", approach)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))

    @property
    def state_count(self) -> int:
        """The states of the law."""
        return len(self.rest)

    def steady(self) -> FloatArray:
        """Return the matrix (r + 1, r + 2) that a steady approach in free space obeys."""
        return self.matrix if self.approach is None else self.approach

    def gains(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return x^d per force e, and −x^d per position x, at the points `z` (n,)."""
        r, m = self.state_count, self.matrix
        direct = np.broadcast_to(m[r, r:].astype(np.complex128), (len(z), 2))
        if r == 0:
            return direct[:, 0].copy(), -direct[:, 1]
        # (z − T) x = Uᴴ B over all points at once, T = Uᴴ A U upper triangular.
        triangle, turned = schur(m[:r, :r].astype(np.complex128), output="complex")
        driven, seen = turned.conj().T @ m[:r, r:], m[r, :r] @ turned
        states = np.empty((r, len(z), 2), dtype=np.complex128)
        for i in reversed(range(r)):
            later = np.tensordot(triangle[i, i + 1 :], states[i + 1 :], axes=1)
            states[i] = (driven[i] + later) / (z - triangle[i, i])[:, None]
        both = np.tensordot(seen, states, axes=1) + direct
        return np.asarray(both[:, 0]), np.asarray(-both[:, 1])
