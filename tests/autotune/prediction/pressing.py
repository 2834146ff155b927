"""Contacts by scipy's integrator: robot, coupling, payload and one-sided wall, with no code of ours."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One axis in SI; `payload` False: the flange itself presses on the spring `wall`."""

    robot: float = 20.0
    coupling: float = 3e5
    coupling_damping: float = 100.0
    mass: float = 16.0
    drag: float = 630.0
    wall: float = 5e4
    wall_damping: float = 0.0
    payload: bool = True


def contact_peak(
    cell: Cell,
    *,
    mass: float,
    damping: float,
    lead: float,
    force: float,
    after: float | None = None,
    speed: float = 0.0,
) -> float:
    """Return the largest force at the sensor after a steady approach, by the continuous law (no delay, no sampling)."""

    def sensor(state: np.ndarray) -> float:
        """Pressing force between flange and payload, or flange and wall."""
        x, x_p, v_p, _, _ = state
        if not cell.payload:
            return float(max(cell.wall * x, 0.0))
        v = cell.robot * (commanded(state) - x)
        return float(cell.coupling * (x - x_p) + cell.coupling_damping * (v - v_p))

    def commanded(state: np.ndarray) -> float:
        return float(state[3] + lead * state[4])

    def rates(_t: float, state: np.ndarray) -> list[float]:
        x, x_p, v_p, _, v_a = state
        v = cell.robot * (commanded(state) - x)
        pressing = sensor(state)
        pushed = force if after is None else after
        wall = max(cell.wall * x_p + cell.wall_damping * v_p, 0.0) if cell.payload and x_p > 0.0 else 0.0
        a_p = (pressing - cell.drag * v_p - wall) / cell.mass if cell.payload else 0.0
        return [v, v_p if cell.payload else 0.0, a_p, v_a, (pushed - pressing - damping * v_a) / mass]

    steady = speed or force / (damping + (cell.drag if cell.payload else 0.0))
    squeezed = cell.drag * steady / cell.coupling if cell.payload else 0.0
    # At the touch: everything moves at the steady speed, the command ahead of the flange by the robot's lag.
    start = [squeezed, 0.0, steady if cell.payload else 0.0, squeezed + steady / cell.robot - lead * steady, steady]
    found = solve_ivp(rates, (0.0, 1.5), start, method="LSODA", max_step=1e-3, rtol=1e-7, atol=1e-10)
    return max(sensor(state) for state in found.y.T)
