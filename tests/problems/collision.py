"""An impact by other means: a Runge–Kutta solver that looks for meetings and departures, direct-form controllers."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant
from tests.problems.reference import SampledLaw, SteadyApproach, continuous_motion


@dataclass(kw_only=True)
class Collision:
    """F and F_e at the ticks, the largest F_e with its time, and the impulses on the environment's mass."""

    sensed: list[float] = field(default_factory=list)
    pressed: list[float] = field(default_factory=list)
    peak: float = 0.0
    time_of_peak: float = 0.0
    impulses: list[float] = field(default_factory=list)
    departures: int = 0


class Encounter:
    """The payload (SI state y = (robot, x_p, v_p)) on and off an environment, by a Runge–Kutta solver with events.

    Straight from docs/method.md; off the payload the environment goes its own way: with its mass on spring and damper,
    without mass with its damper alone.
    """

    def __init__(self, plant: Plant, state: FloatArray, outside_force: float) -> None:
        self.plant, self.force, self.found = plant, outside_force, Collision()
        self.on, self.off = continuous_motion(plant), continuous_motion(plant.in_contact_with(FREE_SPACE))
        self.y, self.time, self.touching = np.append(state, [0.0, 0.0]), 0.0, True
        self._meet()

    def sense(self, held: float) -> tuple[float, float, float]:
        """Return F, x and F_e."""
        motion = self.on if self.touching else self.off
        force, position, pressed = motion.c @ self.y[:-2] + motion.d @ [held, self.force]
        return float(force), float(position), max(0.0, float(pressed)) if self.touching else 0.0

    def advance(self, held: float, duration: float) -> None:
        """Move on under a held command, through as many meetings and departures as there are."""
        left = duration
        while left > 0.0:
            left = self._advance_on(held, left) if self.touching else self._advance_off(held, left)

    def _meet(self) -> None:
        mass, own = self.plant.environment.mass_kg, self.plant.payload.mass_kg
        common = (own * self.y[-3] + mass * self.y[-1]) / (own + mass)
        if mass > 0.0:
            self.found.impulses.append(mass * (common - self.y[-1]))
        self.y[-3], self.touching = common, True

    def _advance_on(self, held: float, duration: float) -> float:
        m, inputs = self.on, np.array([held, self.force])

        def rate(_: float, y: FloatArray) -> FloatArray:
            return np.asarray(m.a @ y + m.b @ inputs)

        def pressed(_: float, y: FloatArray) -> float:
            return float(m.c[2] @ y + m.d[2] @ inputs)

        def rise(_: float, y: FloatArray) -> float:
            return float(m.c[2] @ (m.a @ y + m.b @ inputs))

        pressed.terminal, pressed.direction, rise.direction = True, -1.0, -1.0  # type: ignore[attr-defined]
        start = self.y[:-2]
        if pressed(0.0, start) < -1e-9:  # as an impact or a step of the command may leave an environment with mass
            self.y[-2:] = start[-2:]
            self.touching, self.found.departures = False, self.found.departures + 1
            return duration
        run = solve_ivp(rate, (0.0, duration), start, "DOP853", events=(pressed, rise), rtol=1e-11, atol=1e-16)
        times, states = [0.0, run.t[-1], *run.t_events[1]], [start, run.y[:, -1], *run.y_events[1]]
        for moment, state in zip(times, states, strict=True):
            if pressed(moment, state) > self.found.peak:
                self.found.peak, self.found.time_of_peak = pressed(moment, state), self.time + moment
        self.y[:-2], self.y[-2:] = run.y[:, -1], run.y[-2:, -1]
        self.time += run.t[-1]
        if run.status == 1:
            self.touching, self.found.departures = False, self.found.departures + 1
        return float(duration - run.t[-1])

    def _advance_off(self, held: float, duration: float) -> float:
        a, stiff = self._apart()
        if not stiff and self.plant.environment.mass_kg == 0.0:
            self.y[-2] = 0.0
        drive = np.append(self.off.b @ [held, self.force], [0.0, 0.0])

        def meet(_: float, y: FloatArray) -> float:
            # Just after it has left the payload moves as the surface does: the gap is rounding at first.
            return float(y[-4] - y[-2]) - 1e-15

        meet.terminal, meet.direction = True, 1.0  # type: ignore[attr-defined]
        run = solve_ivp(
            lambda _, y: a @ y + drive,
            (0.0, duration),
            self.y,
            "Radau" if stiff else "DOP853",
            events=meet,
            rtol=1e-11,
            atol=1e-16,
        )
        self.y = run.y[:, -1]
        self.time += run.t[-1]
        if run.status == 1:
            self._meet()
        return float(duration - run.t[-1])

    def _apart(self) -> tuple[FloatArray, bool]:
        """Return the motion of payload and environment apart, and whether the environment creeps back."""
        n, wall = len(self.y), self.plant.environment
        a = np.zeros((n, n))
        a[:-2, :-2] = self.off.a
        if wall.mass_kg > 0.0:
            a[-2, -1] = 1.0
            a[-1, -2:] = -wall.stiffness_n_per_m / wall.mass_kg, -wall.damping_n_s_per_m / wall.mass_kg
        elif wall.damping_n_s_per_m > 0.0:
            a[-2, -2] = -wall.stiffness_n_per_m / wall.damping_n_s_per_m
        return a, wall.mass_kg == 0.0 and wall.damping_n_s_per_m > 0.0


def collide(
    plant: Plant,
    controller: AdmittanceController,
    h: float,
    start: SteadyApproach,
    forces: tuple[float, float],
    samples: int,
) -> Collision:
    """Follow an impact from a steady approach, with F^d and the outside force of `forces` after it.

    `start` gives plant state and past commands in the layout of `SampledLoop`; the controller is one of its own.
    """
    order, delay = plant.robot.order, plant.robot.delay_s / h
    late = math.ceil(delay - 1e-9)
    part = late - delay if late - delay > 1e-9 else 0.0
    chain, past = start.state[: order + 2], list(start.state[order + 2 : order + 2 + late])
    # scipy's controllable form counts derivatives of a signal w with den(s) w = x^d from the highest down.
    lowest = plant.robot.denominator[-1] / plant.robot.denominator[0]
    robot = [chain[i] / h**i / lowest for i in reversed(range(order))]
    world = Encounter(plant, np.array([*robot, chain[-2], chain[-1] / h]), forces[1])
    position = world.sense(0.0)[1]
    effort = controller.damping_n_s_per_m * start.speed_m_s
    law = SampledLaw(controller, h, speed=start.speed_m_s, force=effort, command=start.command_m, position=position)
    for _ in range(samples):
        force, position, pressed = world.sense(past[-1] if past else 0.0)
        world.found.sensed.append(force)
        world.found.pressed.append(pressed)
        past = [law.step(forces[0] + force, position), *past]
        oldest = past.pop() if late else past[0]
        for held, share in ((oldest, 1.0 - part), (past[-1], part)):
            world.advance(held, share * h)
        past = past[:late]
    return world.found
