"""The same axis by other means: SI units, python-control and scipy, the paper's difference equation."""

from dataclasses import dataclass, field
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray
from scipy import signal

from problems.controller import AdmittanceController
from problems.plant import Plant

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def rendered_impedance(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return Ē = C_s (1 + P E)/(1 + P E + P C_s), MODEL.md "Continuous blocks"."""
    coupling = plant.coupling.stiffness_n_per_m / s + plant.coupling.damping_n_s_per_m
    payload = 1.0 / (plant.payload.mass_kg * s + plant.payload.drag_n_s_per_m)
    wall = plant.environment.stiffness_n_per_m / s + plant.environment.damping_n_s_per_m
    return np.asarray(coupling * (1.0 + payload * wall) / (1.0 + payload * wall + payload * coupling))


def robot_gain(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return r(s) without delay."""
    return np.asarray(np.polyval(plant.robot.numerator, s) / np.polyval(plant.robot.denominator, s))


def continuous_plant(plant: Plant) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D in SI, without delay, from x^d to (F, x); state (robot, x_p, v_p)."""
    a_r, b_r, c_r, _ = signal.tf2ss(plant.robot.numerator, plant.robot.denominator)
    n = len(a_r)
    k, b = plant.coupling.stiffness_n_per_m, plant.coupling.damping_n_s_per_m
    x, v = np.append(c_r[0], [0.0, 0.0]), np.append((c_r @ a_r)[0], [0.0, 0.0])
    x_p, v_p = np.eye(n + 2)[n], np.eye(n + 2)[n + 1]
    force, through = k * (x_p - x) + b * (v_p - v), -b * float((c_r @ b_r)[0, 0])
    wall = plant.environment.stiffness_n_per_m * x_p + plant.environment.damping_n_s_per_m * v_p
    m = plant.payload.mass_kg
    acceleration = -(force + plant.payload.drag_n_s_per_m * v_p + wall) / m
    a = np.vstack([np.hstack([a_r, np.zeros((n, 2))]), v_p, acceleration])
    drive = np.concatenate([b_r[:, 0], [0.0, -through / m]])[:, None]
    return a, drive, np.vstack([force, x]), np.array([[through], [0.0]])


def sampled_controller(controller: AdmittanceController, h: float) -> tuple[Any, Any]:
    """Return the Tustin forms of A(1 + C_ff) and C_fb as python-control systems."""
    m, b = controller.mass_kg, controller.damping_n_s_per_m
    corner, lead = controller.velocity_filter_rad_per_s, controller.lead_s
    # scipy warns of a leading zero.
    forward = signal.cont2discrete(signal.tf2ss([lead, 1.0] if lead else [1.0], [m, b, 0.0]), h, "bilinear")
    feedback = signal.cont2discrete(signal.tf2ss([corner, 0.0], [1.0, corner]), h, "bilinear")
    return control.ss(*forward[:4], h), control.ss(*feedback[:4], h) * controller.feedback_damping_s


def sampled_plant(plant: Plant, h: float, whole_delay: int) -> Any:
    """Return the held plant behind `whole_delay` shifts as a python-control system."""
    held = control.ss(*signal.cont2discrete(continuous_plant(plant), h, "zoh")[:4], h)
    return held * _shift(whole_delay, h)


def closed_loop(
    plant: Plant, controller: AdmittanceController, h: float, whole_delay: int, *, force_delay: int = 0
) -> Any:
    """Close the loop F^d → F with python-control; `force_delay` holds the force signal back by so many samples."""
    forward, feedback = sampled_controller(controller, h)
    back = control.ss(feedback.A, np.hstack([np.zeros_like(feedback.B), feedback.B]), -feedback.C, [[0.0, 0.0]], h)
    back.D[0, 1] = -feedback.D[0, 0]
    damped = control.feedback(sampled_plant(plant, h, whole_delay), back, sign=1)
    force_only = control.ss(damped.A, damped.B, damped.C[:1], damped.D[:1], h)
    return control.feedback(force_only * forward, _shift(force_delay, h), sign=1)


def step_response(system: Any, desired: FloatArray) -> FloatArray:
    """Iterate a single-input single-output state-space system over `desired`."""
    state, out = np.zeros(len(system.A)), []
    for value in desired:
        out.append(float(system.C[0] @ state + system.D[0, 0] * value))
        state = system.A @ state + system.B[:, 0] * value
    return np.array(out)


def _shift(samples: int, h: float) -> Any:
    n = samples
    return control.ss(np.eye(n, k=-1), np.eye(n, 1), np.eye(1, n, k=n - 1), [[0.0 if n else 1.0]], h)


@dataclass
class DifferenceEquation:
    """The controller as the paper prints it, equation "discretized_adm", with C_fb in the same manner."""

    controller: AdmittanceController
    h: float
    command: list[float] = field(default_factory=lambda: [0.0, 0.0])
    force: list[float] = field(default_factory=lambda: [0.0, 0.0])
    position: float = 0.0
    damping: float = 0.0

    def step(self, force: float, position: float) -> float:
        """Return x^d_{t+1} from the driving force u_{t+1} = F^d + F_{t+1} and the position x_{t+1}."""
        c, h = self.controller, self.h
        ratio = c.damping_n_s_per_m * h / (2.0 * c.mass_kg)
        lead = 2.0 * c.lead_s / h
        newest = (
            2.0 * self.command[0]
            - (1.0 - ratio) * self.command[1]
            + h**2 / (4.0 * c.mass_kg) * ((1.0 + lead) * force + 2.0 * self.force[0] + (1.0 - lead) * self.force[1])
        ) / (1.0 + ratio)
        w, corner = 2.0 / h, c.velocity_filter_rad_per_s
        rise = c.feedback_damping_s * corner * w * (position - self.position)
        self.damping = (rise - (corner - w) * self.damping) / (corner + w)
        self.command, self.force, self.position = [newest, self.command[0]], [force, self.force[0]], position
        return newest - self.damping


def fine_step_response(
    plant: Plant, controller: AdmittanceController, h: float, delay: tuple[int, int, int], samples: int
) -> FloatArray:
    """Return F at the ticks after a unit step of F^d, on a grid of h/q that a delay of (d + p/q) h falls upon."""
    whole, p, q = delay
    a, b, c, d = signal.cont2discrete(continuous_plant(plant), h / q, "zoh")[:4]
    law, state = DifferenceEquation(controller, h), np.zeros(len(a))
    commands: list[float] = []
    out: list[float] = []
    for k in range(samples):
        for j in range(q):
            held = (k * q + j - p) // q - whole
            old = commands[held] if 0 <= held < len(commands) else 0.0
            if j == 0:
                output = c @ state + d[:, 0] * old
                out.append(float(output[0]))
                commands.append(law.step(1.0 + out[-1], float(output[1])))
                old = commands[held] if held >= 0 else 0.0
            state = a @ state + b[:, 0] * old
    return np.array(out)
