"""A cell that follows a position command, by scipy on the controller's clock: no code of the project takes part."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.signal import chirp
from scipy.spatial.transform import Rotation

from identification.signals.recording import AppliedDeadband, PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray

TOOL_DOWN = Rotation.from_euler("xz", [np.pi, 0.4])


@dataclass(frozen=True, kw_only=True)
class CommandedCell:
    """Robot poles (ω,) or (ω, ζ) behind a delay and a hold of `tick_s`; a payload on a spring and a damper.

    The payload's force moves a robot of two poles by what its inertia `robot_mass` leaves to it.
    """

    robot: tuple[float, ...] = (38.0,)
    delay_s: float = 2.4e-3
    stiffness: float = 3e5
    damping: float = 120.0
    drag: float = 280.0
    mass: float = 14.0
    robot_mass: float = np.inf
    tick_s: float = 8e-4

    @property
    def bandwidth_hz(self) -> float:
        """Where |r| is 1/√2."""
        if len(self.robot) == 1:
            return self.robot[0] / (2.0 * np.pi)
        inner = 1.0 - 2.0 * self.robot[1] ** 2
        return float(self.robot[0] * np.sqrt(inner + np.sqrt(inner**2 + 1.0)) / (2.0 * np.pi))

    def led(self, gains: tuple[float, float, float], driven_n: FloatArray) -> FloatArray:
        """Return the command (n,) of an admittance M_a, B_a, K_l, by the trapezoidal rule.

        It is driven by the force of the same cell under the command so far, and `driven_n` (n,) beside it.
        """
        mass, damping, lead_s = gains
        command = np.zeros(len(driven_n))
        speed = way = pushed = 0.0
        for i, (_, force) in enumerate(self._ticks(command)):
            now = driven_n[i] + force
            before = speed
            speed = ((mass / self.tick_s - 0.5 * damping) * before + 0.5 * (now + pushed)) / (
                mass / self.tick_s + 0.5 * damping
            )
            way, pushed = way + 0.5 * self.tick_s * (speed + before), now
            command[i] = way + lead_s * speed
        return command

    def run(self, command_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and felt force (n,) at the ticks."""
        out = np.array([*self._ticks(command_m)])
        return out[:, 0], out[:, 1]

    def _ticks(self, command_m: FloatArray) -> Iterator[tuple[float, float]]:
        """Yield position and felt force; the command of a tick may be written until the next one is asked for.

        The exponential of each part of a tick is exact.
        """
        k, b, m = self.stiffness, self.damping, self.mass
        order = len(self.robot)
        rows = np.zeros((order + 3, order + 3))  # robot, payload, command
        if order == 1:
            rows[0, 0], rows[0, -1] = -self.robot[0], self.robot[0]
        else:
            omega, zeta = self.robot
            rows[0, 1], rows[1, 0], rows[1, 1], rows[1, -1] = 1.0, -(omega**2), -2.0 * zeta * omega, omega**2
        speed = rows[0]
        rows[order, order + 1] = 1.0
        felt = -b * speed
        felt[0] -= k
        felt[order] += k
        felt[order + 1] += b
        if order == 2:
            rows[1] += felt / self.robot_mass
        rows[order + 1] = -felt / m
        rows[order + 1, order + 1] -= self.drag / m
        whole = int(self.delay_s / self.tick_s + 1e-9)
        older_s = self.delay_s - whole * self.tick_s
        first, second = expm(rows * older_s), expm(rows * (self.tick_s - older_s))
        state = np.zeros(order + 3)
        for i in range(len(command_m)):
            state[-1] = command_m[i - whole - 1] if i > whole else 0.0
            yield float(state[0]), float(felt @ state)
            state = first @ state
            state[-1] = command_m[i - whole] if i >= whole else 0.0
            state = second @ state


@dataclass(frozen=True, kw_only=True)
class Logger:
    """What is recorded, how often, and with what errors."""

    rate_hz: float = 200.0
    force_noise_n: float = 0.3
    pose_noise_m: float = 5e-6
    left_n: float = 0.5
    deadband: AppliedDeadband | None = None
    axis: int = 0
    seed: int = 1
    measured: tuple[str, ...] = field(default=("x", "y", "z", "rx", "ry", "rz"))


def swept(cell: CommandedCell, highest_hz: float, duration_s: float = 20.0) -> FloatArray:
    """Return a sweep whose amplitude falls with frequency, from rest to rest, at the ticks [m]."""
    t = np.arange(0.0, duration_s, cell.tick_s)
    frequency = 0.3 * (highest_hz / 0.3) ** (t / duration_s)
    edge = np.clip(np.minimum(t, duration_s - t) / 0.5, 0.0, 1.0)
    way = np.minimum(0.01, 0.06 / (2.0 * np.pi * frequency)) * edge**2 * (3.0 - 2.0 * edge)
    rest = np.zeros(round(1.5 / cell.tick_s))
    return np.concatenate([rest, way * chirp(t, 0.3, duration_s, highest_hz, method="logarithmic", phi=-90), rest])


def logged(cell: CommandedCell, command_m: FloatArray, logger: Logger) -> Recording:
    """Log a run along one axis of the tool, the weight already removed but for `left_n`."""
    rng = np.random.default_rng(logger.seed)
    position, force = cell.run(command_m)
    time = np.arange(0.0, (len(command_m) - 2) * cell.tick_s, 1.0 / logger.rate_hz)
    ticks = np.round(time / cell.tick_s).astype(int)
    stamps = 1_700_000_000_000_000_000 + np.round(ticks * cell.tick_s * 1e9).astype(np.int64)
    direction, count = np.eye(3)[logger.axis], len(ticks)
    wrench = (force[ticks, None] + logger.left_n) * direction + logger.force_noise_n * rng.standard_normal((count, 3))
    if logger.deadband is not None:
        width = logger.deadband.force_n or 0.0
        beyond = np.maximum(np.abs(wrench) - width, 0.0)
        kept = beyond if logger.deadband.type == "subtractive" else np.where(beyond > 0.0, np.abs(wrench), 0.0)
        wrench = np.sign(wrench) * kept
    quaternion = np.tile(TOOL_DOWN.as_quat(), (count, 1))
    along_B = TOOL_DOWN.apply(direction)
    noise = logger.pose_noise_m * rng.standard_normal((count, 3))
    missing = [i for i, name in enumerate(("x", "y", "z")) if name not in logger.measured]
    wrench[:, missing] = np.nan
    return Recording(
        wrench=WrenchSignal(
            topic="/ft",
            frame_id="tool",
            stamp_ns=stamps,
            force_n=wrench,
            torque_n_m=np.zeros((count, 3)),
            gravity_compensated=True,
            deadband=logger.deadband,
            measured_axes=logger.measured,
        ),
        pose=PoseSignal(
            topic="/pose",
            frame_id="base",
            stamp_ns=stamps,
            position_m=position[ticks, None] * along_B + noise,
            quaternion_xyzw=quaternion,
        ),
        command=PoseSignal(
            topic="/command",
            frame_id="base",
            stamp_ns=stamps,
            position_m=command_m[ticks, None] * along_B,
            quaternion_xyzw=quaternion,
        ),
    )
