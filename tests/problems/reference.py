"""The same axis by other means: SI units, python-control and scipy, direct-form difference equations."""

from dataclasses import dataclass, field
from typing import Any

import control
import numpy as np
from scipy import signal

from problems.arrays import ComplexArray, FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import SampledLoop, SampledPlant


def rendered_impedance(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return Ē = C_s (1 + P E)/(1 + P E + P C_s), docs/method.md, "The loop"."""
    coupling = plant.coupling.stiffness_n_per_m / s + plant.coupling.damping_n_s_per_m
    payload, wall = payload_admittance(plant, s), environment_impedance(plant, s)
    return np.asarray(coupling * (1.0 + payload * wall) / (1.0 + payload * wall + payload * coupling))


def payload_admittance(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return P = 1/(M_p s + B_p)."""
    return np.asarray(1.0 / (plant.payload.mass_kg * s + plant.payload.drag_n_s_per_m))


def environment_impedance(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return E = M_e s + B_e + K_e/s."""
    e = plant.environment
    return np.asarray(e.mass_kg * s + e.damping_n_s_per_m + e.stiffness_n_per_m / s)


def robot_gain(plant: Plant, s: ComplexArray) -> ComplexArray:
    """Return r(s) without delay."""
    return np.asarray(np.polyval(plant.robot.numerator, s) / np.polyval(plant.robot.denominator, s))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """ds/dt = a s + b (x^d, f) in SI, delay left out; state (robot, x_p, v_p), outputs c s + d (x^d, f)."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray


def continuous_motion(plant: Plant) -> Motion:
    """Return the equations of motion with the outputs (F, x, F_e); F_e is what Newton's law of the payload lacks."""
    a_r, b_r, c_r, _ = signal.tf2ss(plant.robot.numerator, plant.robot.denominator)
    n = len(a_r)
    k, b = plant.coupling.stiffness_n_per_m, plant.coupling.damping_n_s_per_m
    x, v = np.append(c_r[0], [0.0, 0.0]), np.append((c_r @ a_r)[0], [0.0, 0.0])
    x_p, v_p = np.eye(n + 2)[n], np.eye(n + 2)[n + 1]
    force, through = k * (x_p - x) + b * (v_p - v), np.array([-b * float((c_r @ b_r)[0, 0]), 0.0])
    drag, mass, wall = plant.payload.drag_n_s_per_m, plant.payload.mass_kg, plant.environment
    outside = np.array([0.0, 1.0])
    resisting = force + (drag + wall.damping_n_s_per_m) * v_p + wall.stiffness_n_per_m * x_p
    acceleration, at_once = (w / (mass + wall.mass_kg) for w in (-resisting, outside - through))
    a = np.vstack([np.hstack([a_r, np.zeros((n, 2))]), v_p, acceleration])
    drive = np.vstack([np.hstack([b_r, np.zeros((n, 1))]), [0.0, 0.0], at_once])
    contact = -force - drag * v_p - mass * acceleration
    pressed = outside - through - mass * at_once
    lag = plant.wrench_filter.time_constant_s
    if lag > 0.0:
        # The measured force is one more state, the last one: τ dF_m/dt = F − F_m.
        a = np.block([[a, np.zeros((n + 2, 1))], [force / lag, -np.ones((1, 1)) / lag]])
        drive = np.vstack([drive, through / lag])
        x, contact = np.append(x, 0.0), np.append(contact, 0.0)
        force, through = np.eye(n + 3)[n + 2], np.zeros(2)
    return Motion(a=a, b=drive, c=np.vstack([force, x, contact]), d=np.vstack([through, [0.0, 0.0], pressed]))


def continuous_plant(plant: Plant) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D in SI, without delay, from x^d to (F, x); state (robot, x_p, v_p)."""
    m = continuous_motion(plant)
    return m.a, m.b[:, :1], m.c[:2], m.d[:2, :1]


def discretized(
    numerator: list[float], denominator: list[float], h: float, theta: float
) -> tuple[FloatArray, FloatArray]:
    """Replace s by (z − 1)/(h (θ z + 1 − θ)) in polynomials (highest power first); the result is monic below.

    Unlike scipy's conversions this takes improper fractions, which the ideal compensation is.
    """
    order = max(len(numerator), len(denominator)) - 1
    rise, mean = np.array([1.0, -1.0]), h * np.array([theta, 1.0 - theta])

    def substitute(coefficients: list[float]) -> FloatArray:
        total = np.zeros(order + 1)
        for power, coefficient in enumerate(reversed(coefficients)):
            product = np.array([1.0])
            for factor in [rise] * power + [mean] * (order - power):
                product = np.convolve(product, factor)
            total = total + coefficient * product
        return total

    top, bottom = substitute(numerator), substitute(denominator)
    return top / bottom[0], bottom / bottom[0]


def continuous_laws(controller: AdmittanceController) -> dict[str, tuple[list[float], list[float]]]:
    """Return A(1 + C_ff), C_fb and P̂ O_a as polynomials in s, highest power first."""
    c = controller
    corner, second, mass = c.velocity_filter_rad_per_s, c.acceleration_filter_rad_per_s, c.compensation_mass_kg
    acceleration = ([mass * corner * second, 0.0, 0.0], [1.0, corner + second, corner * second])
    return {
        "forward": ([c.lead_s, 1.0] if c.lead_s else [1.0], [c.mass_kg, c.damping_n_s_per_m, 0.0]),
        "feedback": ([c.feedback_damping_s * corner, 0.0], [1.0, corner]),
        "acceleration": ([mass, 0.0, 0.0], [1.0]) if c.compensation == "ideal" else acceleration,
    }


def sampled_laws(controller: AdmittanceController, h: float) -> dict[str, Any]:
    """Return the sampled forms of A(1 + C_ff), C_fb and P̂ O_a as python-control systems, by scipy where it can."""
    out = {}
    for name, (numerator, denominator) in continuous_laws(controller).items():
        if not any(numerator):
            out[name] = control.ss([], [], [], [[0.0]], h)
        elif len(numerator) <= len(denominator):
            held = signal.cont2discrete(signal.tf2ss(numerator, denominator), h, "gbt", alpha=controller.theta)
            out[name] = control.ss(*held[:4], h)
        else:
            out[name] = control.ss(*signal.tf2ss(*discretized(numerator, denominator, h, controller.theta)), h)
    return out


def sampled_controller(controller: AdmittanceController, h: float) -> tuple[Any, Any]:
    """Return x^d per force, A(1 + C_ff), and −x^d per position, C_fb − A(1 + C_ff) P̂ O_a, sampled."""
    laws = sampled_laws(controller, h)
    forward = laws["forward"]
    return forward, laws["feedback"] - forward * laws["acceleration"]


def sampled_plant(plant: Plant, h: float, whole_delay: int) -> Any:
    """Return the held plant behind `whole_delay` shifts as a python-control system."""
    held = control.ss(*signal.cont2discrete(continuous_plant(plant), h, "zoh")[:4], h)
    return held * _shift(whole_delay, h)


def closed_loop(
    plant: Plant, controller: AdmittanceController, h: float, whole_delay: int, *, force_delay: int = 0
) -> Any:
    """Close the loop F^d → F with python-control; `force_delay` holds the force signal back by so many samples.

    x^d = A(1 + C_ff)(F^d + F + P̂ O_a x) − C_fb x: blocks side by side, and what each of them is given.
    """
    laws, unit = sampled_laws(controller, h), h * h  # second differences in place of accelerations
    blocks = control.append(
        sampled_plant(plant, h, whole_delay),
        _shift(force_delay, h),
        laws["forward"] * (1.0 / unit),
        laws["feedback"],
        laws["acceleration"] * unit,
    )
    given = np.zeros((5, 6))  # (x^d, F, e, x, x) from (F, x, F held back, x_a, C_fb x, P̂ O_a x)
    given[0, 3], given[0, 4] = 1.0, -1.0
    given[1, 0] = given[2, 5] = given[3, 1] = given[4, 1] = 1.0
    given[2, 2] = unit
    closed = control.feedback(blocks, control.ss([], [], [], given, h), sign=1)
    return control.ss(closed.A, closed.B[:, 2:3] * unit, closed.C[:1], closed.D[:1, 2:3] * unit, h)


def surplus_poles(controller: AdmittanceController, h: float) -> list[float]:
    """Return the poles of `closed_loop` that cancel inside its controller: what a smaller realisation does without."""
    theta, corner = controller.theta, controller.velocity_filter_rad_per_s * h
    out = []
    if controller.is_ideal:
        # s² brings (θ z + 1 − θ)² below; A(1 + C_ff) has one such factor above, and two without lead.
        out = [1.0 - 1.0 / theta] * (2 if controller.lead_s == 0.0 else 1)
    elif controller.compensates and controller.feedback_damping_s > 0.0:
        out = [(1.0 - corner * (1.0 - theta)) / (1.0 + corner * theta)]
    return out


def transfer(system: Any, z: complex) -> ComplexArray:
    """Evaluate a python-control system at z by one solve; its own way loses digits in badly scaled systems."""
    states = np.linalg.solve(z * np.eye(len(system.A)) - system.A, system.B.astype(complex))
    return np.asarray(system.C @ states + system.D)


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


class DirectForm:
    """y_k = Σ b_i e_{k−i} − Σ a_i y_{k−i}: past inputs and outputs as they were, newest first."""

    def __init__(self, top: FloatArray, bottom: FloatArray, inputs: list[float], outputs: list[float]) -> None:
        self.top, self.bottom, self.inputs, self.outputs = top, bottom, inputs, outputs

    def step(self, value: float) -> float:
        """Return y_k for e_k."""
        entering = [value, *self.inputs]
        newest = float(self.top @ entering - self.bottom[1:] @ self.outputs)
        self.inputs, self.outputs = entering[:-1], [newest, *self.outputs[:-1]]
        return newest


class SampledLaw:
    """A(1 + C_ff), C_fb and P̂ O_a as three difference equations that have approached steadily, or rested, so far."""

    def __init__(
        self,
        controller: AdmittanceController,
        h: float,
        *,
        speed: float = 0.0,
        force: float = 0.0,
        command: float = 0.0,
        position: float = 0.0,
    ) -> None:
        laws = {name: discretized(*law, h, controller.theta) for name, law in continuous_laws(controller).items()}
        # At steady speed O_a x is 0 and C_fb x is B_fb v, so A(1 + C_ff) gives the command and B_fb v.
        positions, damping = [position - i * speed * h for i in (1, 2)], controller.feedback_damping_s * speed
        commands = [command + damping - i * speed * h for i in (1, 2)]
        self.forward = DirectForm(*laws["forward"], [force, force], commands)
        self.feedback = DirectForm(*laws["feedback"], positions[:1], [damping])
        self.acceleration = DirectForm(*laws["acceleration"], positions, [0.0, 0.0])

    def step(self, force: float, position: float) -> float:
        """Return x^d from F^d + F and x at the tick."""
        return self.forward.step(force + self.acceleration.step(position)) - self.feedback.step(position)


def fine_step_response(
    plant: Plant, controller: AdmittanceController, h: float, delay: tuple[int, int, int], samples: int
) -> FloatArray:
    """Return F at the ticks after a unit step of F^d, on a grid of h/q that a delay of (d + p/q) h falls upon."""
    whole, p, q = delay
    a, b, c, d = signal.cont2discrete(continuous_plant(plant), h / q, "zoh")[:4]
    law, state = SampledLaw(controller, h), np.zeros(len(a))
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


@dataclass(frozen=True, kw_only=True)
class SteadyApproach:
    """The loop state at the moment of contact (x_p = 0) while everything moves at `speed_m_s` under one force."""

    state: FloatArray
    command_m: float
    speed_m_s: float
    force_n: float


def steady_approach(
    free: SampledPlant, loop: SampledLoop, *, force: float | None = None, speed: float | None = None, hand: bool = False
) -> SteadyApproach:
    """Solve for the free-space state that moves by the same step every period: linear, one solution.

    (a − 1) s − v h·translation + b F^d = 0 (or b_push f) with x_p = 0 and either the force or v given.
    """
    size, h = len(loop.a), free.sample_time_s
    system, right = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
    system[:size, :size] = loop.a - np.eye(size)
    system[:size, size] = -h * loop.translation
    system[:size, size + 1] = loop.b_push if hand else loop.b
    system[size, free.state_count - 2] = 1.0
    system[size + 1, size + 1 if speed is None else size] = 1.0
    right[size + 1] = force if speed is None else speed
    solution = np.linalg.solve(system, right)
    state, found = solution[:size], float(solution[size + 1])
    command = float(loop.c_command @ state + loop.d_command * (0.0 if hand else found))
    return SteadyApproach(state=np.asarray(state), command_m=command, speed_m_s=float(solution[size]), force_n=found)
