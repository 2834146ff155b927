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


def recorded_contact(
    cell: Cell,
    *,
    mass: float,
    damping: float,
    lead: float,
    feedback: float,
    deadband: float,
    lag_s: float,
    force: float,
) -> np.ndarray:
    """Return time, flange and force on it (n, 3) at 500 Hz: half a second of rest, 20 mm of approach, touch and hold.

    The force has no weight in it; below `deadband` the law sees none. `lag_s` is first order, for delay and hold.
    """
    velocity_filter, gap, rest_s = 120.0, 0.02, 0.5

    def rates(t: float, state: np.ndarray) -> list[float]:
        x, x_p, v_p, x_a, v_a, x_f, late = state
        v = cell.robot * (late - x)
        felt = sensor(state)
        driven = (force if t > rest_s else 0.0) - (felt if abs(felt) > deadband else 0.0)
        into = x_p - gap
        wall = max(cell.wall * into + cell.wall_damping * v_p, 0.0) if into > 0.0 else 0.0
        command = x_a + lead * v_a - feedback * velocity_filter * (x - x_f)
        return [
            v,
            v_p,
            (felt - cell.drag * v_p - wall) / cell.mass,
            v_a,
            (driven - damping * v_a) / mass,
            velocity_filter * (x - x_f),
            (command - late) / lag_s,
        ]

    def sensor(state: np.ndarray) -> float:
        x, x_p, v_p, *_, late = state
        return float(cell.coupling * (x - x_p) + cell.coupling_damping * (cell.robot * (late - x) - v_p))

    time = np.arange(0.0, 4.0, 2e-3)
    found = solve_ivp(rates, (0.0, 4.0), np.zeros(7), method="LSODA", t_eval=time, max_step=5e-4, rtol=1e-7, atol=1e-10)
    return np.column_stack([time, found.y[0], [-sensor(state) for state in found.y.T]])
