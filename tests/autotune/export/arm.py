"""Two public controllers in six axes on a real arm, step by step, written from what they compute.

The arm is a UR10e by its Denavit–Hartenberg parameters. Nothing here knows of axes that do not act on each other:
turning makes sideways speed, and every link has its mass.
"""

from dataclasses import dataclass

import numpy as np

from autotune.export.ros_yaml import INVERSE_DAMPING
from problems.arrays import FloatArray
from problems.compiled import compiled

UR10E = np.array(
    [
        [0.1807, 0.0, np.pi / 2.0],
        [0.0, -0.6127, 0.0],
        [0.0, -0.57155, 0.0],
        [0.17415, 0.0, np.pi / 2.0],
        [0.11985, 0.0, -np.pi / 2.0],
        [0.11655, 0.0, 0.0],
    ]
)
"""d (m), a (m) and α (rad) of each joint, as the maker publishes them."""
LINK_INERTIA = 1e-6
"""The inertia (kg·m²) of every link of the virtual robot but the last."""
# The wrist well bent, so that no singularity is near; the second one turned and further out.
POSES = (np.array([0.3, -1.2, 1.6, -1.9, -1.4, 0.5]), np.array([-0.6, -1.9, 1.9, -0.9, -1.9, 1.2]))

# Upright with the tool pointing down, as such an arm mostly works: moving along x moves the wrist's links most there.
UPRIGHT = (np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0]), np.radians([0.0, -120.0, 120.0, -90.0, -90.0, 0.0]))


@compiled
def chain(dh: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the joints' axes z_0..z_5 (6, 3), the origins o_0..o_6 (7, 3) and the flange's orientation R_BS (3, 3)."""
    axes, origins, turn = np.empty((6, 3)), np.zeros((7, 3)), np.eye(3)
    for i in range(6):
        d, a, alpha = dh[i]
        axes[i] = turn[:, 2]
        c, s, ca, sa = np.cos(q[i]), np.sin(q[i]), np.cos(alpha), np.sin(alpha)
        origins[i + 1] = origins[i] + turn @ np.array([a * c, a * s, d])
        turn = turn @ np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0.0, sa, ca]])
    return axes, origins, turn


@compiled
def jacobian(axes: FloatArray, origins: FloatArray, point: FloatArray, joints: int) -> FloatArray:
    """Return (6, 6): what the first `joints` joints move a point with, and turn it with."""
    found = np.zeros((6, 6))
    for j in range(joints):
        found[:3, j] = np.cross(axes[j], point - origins[j])
        found[3:, j] = axes[j]
    return found


@compiled
def rotation_vector(turn: FloatArray) -> FloatArray:
    """Return the axis times the angle of a rotation of less than half a turn."""
    seen = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    sine = np.sqrt(np.sum(seen**2))
    if sine > 1e-12:
        seen *= np.arctan2(sine, (np.trace(turn) - 1.0) / 2.0) / sine
    return seen


@compiled
def both(turn: FloatArray, wrench: FloatArray) -> FloatArray:
    """Return a force and a torque, or a twist, in the frame that `turn` leads to."""
    return np.concatenate((turn @ wrench[:3], turn @ wrench[3:]))


@compiled
def _play_admittance(
    dh: FloatArray,
    start: FloatArray,
    rows: FloatArray,
    numbers: FloatArray,
    wrench: FloatArray,
    steps: tuple[int, int, int],
) -> FloatArray:
    """Return the flange's way (samples, 6) in its first frame; `rows` are mass, damping, stiffness and selected."""
    joint_damping, alpha, coefficient, h = numbers
    pushed, total, every = steps
    offset, speed, felt, twist = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    _, first, home = chain(dh, start)
    found = np.empty((total // every, 6))
    for k in range(total):
        q = start + offset
        axes, origins, turn = chain(dh, q)
        away = np.concatenate((origins[6] - first[6], rotation_vector(turn @ home.T)))
        if k % every == 0:
            found[k // every] = both(home.T, away)
        # The filter works on the wrench in the world's axes, the selection on the control frame's.
        felt = coefficient * (wrench if k < pushed else np.zeros(6)) + (1.0 - coefficient) * felt
        force = both(turn, rows[3] * both(turn.T, felt))
        force = force - both(turn, rows[1] * both(turn.T, twist)) - both(turn, rows[2] * both(turn.T, away))
        seen = jacobian(axes, origins, origins[6], 6)
        acceleration = np.linalg.solve(seen.T @ seen + alpha * np.eye(6), seen.T @ (force / rows[0]))
        acceleration -= joint_damping * speed
        speed = speed + h * acceleration
        offset = offset + h * speed
        twist = seen @ speed
    return found


@dataclass(frozen=True, kw_only=True)
class AdmittanceFile:
    """What the file of ros2_control says of the rule, in its own terms; six numbers are x, y, z, rx, ry, rz."""

    mass: list[float]
    damping_ratio: list[float]
    stiffness: list[float]
    selected_axes: list[bool]
    joint_damping: float
    alpha: float = INVERSE_DAMPING
    filter_coefficient: float = 1.0

    def after_a_push(
        self, start: FloatArray, wrench: FloatArray, *, push_s: float, total_s: float, h: float, every_s: float
    ) -> FloatArray:
        """Return the flange's way in its first frame (m and rad) for every `every_s`, `wrench` in that frame."""
        mass, stiffness = np.array(self.mass), np.array(self.stiffness)
        damping = 2.0 * np.array(self.damping_ratio) * np.sqrt(mass * stiffness)
        rows = np.array([mass, damping, stiffness, np.array(self.selected_axes, dtype=np.float64)])
        numbers = np.array([self.joint_damping, self.alpha, self.filter_coefficient, h])
        steps = (round(push_s / h), round(total_s / h) + 1, round(every_s / h))
        base = both(chain(UR10E, start)[2], wrench)
        found: FloatArray = _play_admittance(UR10E, start, rows, numbers, base, steps)
        return found


@compiled
def _inertia(axes: FloatArray, origins: FloatArray, link_mass: float, link_inertia: float) -> FloatArray:
    """Return the joints' inertia (6, 6): links on their own joint's axis, and 1 kg, 1 kg·m² at the tip."""
    seen = jacobian(axes, origins, origins[6], 6)
    found = seen.T @ seen
    for i in range(6):
        # Shoulder and upper arm begin at o_1, the forearm at o_2, and each part of the wrist where its own offset ends.
        place = origins[1] if i < 2 else origins[2] if i == 2 else origins[i + 1]
        link = jacobian(axes, origins, place, i + 1)
        found += link_mass * (link[:3].T @ link[:3]) + link_inertia * (link[3:].T @ link[3:])
    return found


@compiled
def play_forward_dynamics(
    dh: FloatArray,
    start: FloatArray,
    gains: FloatArray,
    link_mass: float,
    follows: float,
    wrench: FloatArray,
    steps: tuple[int, int],
) -> FloatArray:
    """Return the flange's way (steps, 6) in the base's axes under a wrench there, which ends after `steps[0]` of them.

    `gains` are p and d (2, 6); of the way to the command each joint goes the share `follows` in a period.
    """
    step, kept = 0.02, 0.9
    q, speed, error = start.copy(), np.zeros(6), np.zeros(6)
    _, first, home = chain(dh, start)
    pushed, total = steps
    found = np.empty((total, 6))
    for k in range(total):
        axes, origins, turn = chain(dh, q)
        found[k] = np.concatenate((origins[6] - first[6], rotation_vector(turn @ home.T)))
        felt = wrench if k < pushed else np.zeros(6)
        pull = gains[0] * felt + gains[1] * (felt - error) / step
        error = felt
        seen = jacobian(axes, origins, origins[6], 6)
        acceleration = np.linalg.solve(_inertia(axes, origins, link_mass, LINK_INERTIA), seen.T @ pull)
        q = q + follows * step * speed
        speed = kept * (speed + step * acceleration)
    return found
