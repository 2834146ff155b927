"""Play one contact with the paper's own difference equation and a finely stepped plant, from far away until rest."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Coupling, PayloadDynamics, Plant, build_plant_matrices
from problems.model.robot import RobotModel
from problems.model.sampled import (
    build_loop,
    build_sampled_plant,
    check_wrench_delay,
    hold,
    spectral_radius,
    stability_matrix,
)

_SUBSTEPS = 20
_SHORTEST_APPROACH_S = 0.8
SHORTEST_AFTER_S = 1.6
# A part of the motion has gone when it has decayed to exp(-7), a thousandth.
_DECAY_EXPONENTS = 7.0
_LONGEST_S = 10.0
_FAR_SAMPLES = 4.0


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Peaks of one replayed contact, at the sensor (pressing positive) and at the surface.

    `detected_after_s` counts from the tick that first saw the touch, below 0 for a detection in free motion; None
    without one. `largest_speed_m_s` and `largest_acceleration_m_s2` are those of the command, the start from rest
    included.
    """

    peak_sensor_force_n: float
    peak_contact_force_n: float
    detected_after_s: float | None = None
    largest_speed_m_s: float = 0.0
    largest_acceleration_m_s2: float = 0.0


def replay_contact(
    plant: Plant,
    controller: AdmittanceController,
    sample_time_s: float,
    desired_force_n: float,
    *,
    deadband_n: float = 0.0,
    reset_threshold_n: float = math.inf,
) -> Replay:
    """Approach with F^d from rest, touch, and follow until rest; `deadband_n` is a threshold deadband on the force.

    At the first tick at which the force opposes the motion by more than `reset_threshold_n` the command and its
    predecessor become the one sent last (the paper's Algorithm 1).

    Approach and contact each last as long as the slowest part of their loop needs to decay, ten seconds at most; of a
    force that only creeps to its value at rest by then, that value counts. The plant advances in twentieths of a
    sample, contact begins and ends on that grid, and the delay is rounded to it.
    """
    # A wrench that is late makes the same loop as commands that are (for a law that reads nothing but the wrench).
    check_wrench_delay(plant, controller)
    late = round(plant.loop_delay_s / sample_time_s * _SUBSTEPS)
    step = _Stepper(plant, sample_time_s, late % _SUBSTEPS)
    law = DifferenceEquation(controller, sample_time_s)
    approach_speed = desired_force_n / (controller.damping_n_s_per_m + plant.payload.drag_n_s_per_m)
    approach = settling_samples(plant.in_contact_with(FREE_SPACE), controller, sample_time_s, _SHORTEST_APPROACH_S)
    after = settling_samples(plant, controller, sample_time_s, SHORTEST_AFTER_S)
    start = -approach_speed * approach * sample_time_s
    n = len(step.c_force)
    state = np.zeros(n)
    state[0] = state[n - 2] = start
    law.rest_at(start)
    commands = [start] * (late // _SUBSTEPS + 1)
    sensor = contact = speed = fastest = hardest = 0.0
    touch: int | None = None
    detection: int | None = None
    for tick in range(approach + after):
        force = float(step.c_force @ state + step.d_force * commands[-1 - late // _SUBSTEPS])
        if touch is None and step.touching(state):
            touch = tick
        if touch is not None:
            # A payload that has left the wall again still shakes the sensor.
            sensor, contact = max(sensor, -force), max(contact, step.wall_force(state))
        felt, position = force if abs(force) > deadband_n else 0.0, float(step.c_position @ state)
        if detection is None and -felt * np.sign(position - law.seen) > reset_threshold_n:
            detection = tick
        commands.append(law.step(desired_force_n + felt, position, reset=detection == tick))
        before, speed = speed, commands[-1] - commands[-2]
        fastest = max(fastest, abs(speed))
        # That a response stops the command is not limited.
        hardest = hardest if detection == tick else max(hardest, abs(speed - before))
        # A delay of `late` substeps: what acts first is a command one period older than what acts then.
        state = step.over_sample(state, commands[-2 - late // _SUBSTEPS], commands[-1 - late // _SUBSTEPS])
        commands = commands[-(late // _SUBSTEPS + 3) :]
    if deadband_n == 0.0 and step.touching(state) and _creeps(plant, controller, sample_time_s, after):
        # The admittance integrates F^d + F: on a very soft surface the force is still on its way to F^d.
        sensor, contact = max(sensor, desired_force_n), max(contact, desired_force_n)
    return Replay(
        peak_sensor_force_n=sensor,
        peak_contact_force_n=contact,
        detected_after_s=None if detection is None or touch is None else (detection - touch) * sample_time_s,
        largest_speed_m_s=fastest / sample_time_s,
        largest_acceleration_m_s2=hardest / sample_time_s**2,
    )


def settling_samples(plant: Plant, controller: AdmittanceController, h: float, shortest_s: float) -> int:
    """Return how many samples the loop needs to settle, a wall that is soft or a light damping taking longer."""
    radius = spectral_radius(build_loop(build_sampled_plant(plant, h), controller))
    decay = math.ceil(_DECAY_EXPONENTS / -math.log(radius)) if radius > 0.0 else 0
    return max(round(shortest_s / h), min(decay, math.ceil(_LONGEST_S / h)))


def _creeps(plant: Plant, controller: AdmittanceController, h: float, samples: int) -> bool:
    """Say whether after so many samples one part of the motion in contact has not decayed, and that without swinging.

    What is left of the force is then one exponential, so that it does not overshoot its value at rest.
    """
    poles = np.linalg.eigvals(stability_matrix(build_loop(build_sampled_plant(plant, h), controller)))
    left = poles[np.abs(poles) ** samples > math.exp(-_DECAY_EXPONENTS)]
    return len(left) == 1 and bool(left[0].imag == 0.0 and 0.0 < left[0].real < 1.0)


class _Stepper:
    """The plant in contact and in free space, advanced by a twentieth of a sample; `late` of these come a command late.

    A sample throughout which the payload is far from the wall's surface, on either side, is the same in two steps.
    """

    def __init__(self, plant: Plant, sample_time_s: float, late: int) -> None:
        near = build_plant_matrices(plant, sample_time_s)
        far = build_plant_matrices(plant.in_contact_with(FREE_SPACE), sample_time_s)
        self.near, self.far = hold(near.a, near.b, 1.0 / _SUBSTEPS), hold(far.a, far.b, 1.0 / _SUBSTEPS)
        self.late = late
        self.parts = [
            [hold(side.a, side.b, share / _SUBSTEPS) for share in (late, _SUBSTEPS - late)] for side in (near, far)
        ]
        self.c_force, self.c_position, self.d_force = near.c_force, near.c_position, near.d_force
        self.stiffness, damping, _ = plant.environment.coefficients
        self.damping = damping / sample_time_s

    def wall_force(self, state: FloatArray) -> float:
        """Return the force on the environment of a payload behind the wall."""
        return max(0.0, self.stiffness * float(state[-2]) + self.damping * float(state[-1]))

    def touching(self, state: FloatArray) -> bool:
        """Whether the payload presses on the wall."""
        return float(state[-2]) > 0.0 and self.wall_force(state) > 0.0

    def over_sample(self, state: FloatArray, older: float, newer: float) -> FloatArray:
        """Advance one sample; the older command acts until the newer one arrives."""
        if self._is_far(state):
            (phi_0, gamma_0), (phi_1, gamma_1) = self.parts[0 if state[-2] > 0.0 else 1]
            ahead = np.asarray(phi_1 @ (phi_0 @ state + gamma_0 * older) + gamma_1 * newer)
            if self._is_far(ahead) and (ahead[-2] > 0.0) == (state[-2] > 0.0):
                return ahead
        for sub in range(_SUBSTEPS):
            state = self.advance(state, older if sub < self.late else newer)
        return state

    def _is_far(self, state: FloatArray) -> bool:
        """Say whether no surface is reached within some samples at this speed, which is that per sample."""
        away = float(state[-2])
        return abs(away) > _FAR_SAMPLES * abs(float(state[-1])) and (away < 0.0 or self.damping == 0.0)

    def advance(self, state: FloatArray, command: float) -> FloatArray:
        """Advance one substep under a held command."""
        phi, gamma = self.near if self.touching(state) else self.far
        return np.asarray(phi @ state + gamma * command)


class DifferenceEquation:
    """x^d of the paper's eq. (discretized admittance), with C_fb and P̂ O_a by the trapezoidal rule."""

    def __init__(self, controller: AdmittanceController, h: float) -> None:
        ratio = controller.damping_n_s_per_m * h / (2.0 * controller.mass_kg)
        lead = 2.0 * controller.lead_s / h
        self.old, self.new = 1.0 - ratio, 1.0 + ratio
        self.gain = h * h / (4.0 * controller.mass_kg)
        self.weights = (1.0 + lead, 2.0, 1.0 - lead)
        self.feedback, self.compensation = controller.feedback_damping_s, controller.compensation_mass_kg
        self.corner, self.second_corner = controller.velocity_filter_rad_per_s, controller.acceleration_filter_rad_per_s
        self.h = h
        self.rest_at(0.0)

    def rest_at(self, position: float) -> None:
        """Start at rest: C_fb x is zero there, so the admittance's own position is the command."""
        self.before = self.last = position
        self.force_before = self.force_last = 0.0
        self.seen, self.velocity, self.acceleration = position, 0.0, 0.0
        self.sent = position

    def step(self, force: float, position: float, *, reset: bool = False) -> float:
        """Return the next command for F^d + F and the measured position; `reset` repeats the last one, from rest."""
        # dv/dt = ω_v dx/dt − ω_v v and da/dt = ω_a dv/dt − ω_a a, by the trapezoidal rule.
        before, self.velocity = self.velocity, self._filtered(self.velocity, position - self.seen, self.corner)
        self.acceleration = self._filtered(self.acceleration, self.velocity - before, self.second_corner)
        self.seen = position
        force = force + self.compensation * self.acceleration
        w0, w1, w2 = self.weights
        pushed = self.gain * (w0 * force + w1 * self.force_last + w2 * self.force_before)
        following = (2.0 * self.last - self.old * self.before + pushed) / self.new
        if reset:
            # What the admittance put out is the command without C_fb, which goes on seeing the robot move.
            following = self.sent + self.feedback * self.velocity
        self.before, self.last = following if reset else self.last, following
        self.force_before, self.force_last = self.force_last, force
        self.sent = following - self.feedback * self.velocity
        return self.sent

    def _filtered(self, value: float, moved: float, corner: float) -> float:
        half = 0.5 * corner * self.h
        return ((1.0 - half) * value + corner * moved) / (1.0 + half)


def robot_stepper(robot: RobotModel, sample_time_s: float) -> Callable[[float], float]:
    """Return a function that takes the next command and returns the robot's position one sample later, exactly."""
    alone = Plant(
        robot=robot,
        coupling=Coupling(stiffness_n_per_m=1.0, damping_n_s_per_m=0.0),
        payload=PayloadDynamics(mass_kg=1.0, drag_n_s_per_m=0.0),
    )
    matrices, order = build_plant_matrices(alone, sample_time_s), robot.order
    rate, drive, output = matrices.a[:order, :order], matrices.b[:order], matrices.c_position[:order]
    late = robot.delay_s / sample_time_s
    whole, fraction = math.floor(late), late - math.floor(late)
    before, after = hold(rate, drive, fraction), hold(rate, drive, 1.0 - fraction)
    commands = [0.0] * (whole + 2)
    state = np.zeros(order)

    def step(command: float) -> float:
        nonlocal state
        commands.append(command)
        del commands[0]
        state = before[0] @ state + before[1] * commands[-2 - whole]
        state = after[0] @ state + after[1] * commands[-1 - whole]
        return float(output @ state)

    return step
