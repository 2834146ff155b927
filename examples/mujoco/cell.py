"""A six-axis robot cell in MuJoCo: physics that shares no equation with `problems`.

Robot: three slides and three hinges, each with a position servo of second order (reflected inertia, gain, damping),
dry friction, and a command that arrives after a delay of any length. Payload: a rigid body on six springs and dampers,
with dry friction where asked, and a part that swings on it where asked; drag is a dashpot to the ground along z. Wall:
a plane whose contact is a spring and a damper. Sensor: the forces in the coupling's joints, filtered, noisy, rounded.
Integrated by Runge-Kutta of fourth order, with a step that ends where a command arrives.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

AXES = ("x", "y", "z")
# The tool points down, turned about the vertical, so that no sensor axis is a base axis by accident. World from tool.
TURN_RAD = 0.4
R_0 = np.array(
    [
        [math.cos(TURN_RAD), -math.sin(TURN_RAD), 0.0],
        [-math.sin(TURN_RAD), -math.cos(TURN_RAD), 0.0],
        [0.0, 0.0, -1.0],
    ]
)
P_0 = np.array([0.85, 0.10, 0.90])
TOOL_END_M, EDGE_M = 0.28, 0.005
# From so far away a dashpot acts along one line, wherever the payload is.
FAR_M = 1e4
# The impedance of a contact: small, since 1/R is a mass that the contact adds, d/(1 − d) of the payload's.
IMPEDANCE = 1e-3
LONGEST_STEP_S = 6e-4
# What is heard of MuJoCo's constraints: dry friction gives way by this rate before it slides.
FRICTION_TIME_S = 0.002


@dataclass(frozen=True, kw_only=True)
class Wall:
    """A plane below the tool, square to it but for the inclination; K_e [N/m], B_e [N·s/m]."""

    stiffness_n_per_m: float = 6e4
    damping_n_s_per_m: float = 40.0
    distance_m: float = 0.015
    inclination_rad: float = 0.0
    edge_m: tuple[float, float] = (0.0, 0.0)  # where the tool touches, off its axis


@dataclass(frozen=True, kw_only=True)
class Hand:
    """A hand that holds the payload at a handle: mass, the grip and the arm as spring and damper each, and a force."""

    mass_kg: float = 1.5
    grip_n_per_m: float = 6e3
    grip_n_s_per_m: float = 80.0
    arm_n_per_m: float = 300.0
    arm_n_s_per_m: float = 40.0
    handle_S_m: tuple[float, float, float] = (0.12, 0.0, 0.15)


@dataclass(frozen=True, kw_only=True)
class MujocoCell:
    """What the cell is, SI; the sensor frame S is the flange's, z the approach."""

    mass_kg: float = 16.0
    com_S_m: tuple[float, float, float] = (0.012, -0.008, 0.14)
    inertia_kg_m2: tuple[float, float, float] = (0.35, 0.33, 0.15)  # about the centre of mass
    stiffness_n_per_m: float = 3e5
    damping_n_s_per_m: float = 150.0
    turning_n_m_per_rad: float = 4e4
    turning_n_m_s_per_rad: float = 12.0
    coupling_friction_n: float = 0.0
    drag_n_s_per_m: float = 300.0
    part_share: float = 0.0  # of the mass that swings along z
    part_hz: float = 35.0
    part_damping_ratio: float = 0.03
    servo_mass_kg: float = 3000.0
    servo_hz: float = 6.0
    servo_damping_ratio: float = 0.9
    joint_friction_n: float = 0.0
    delay_s: float = 2.63e-3
    period_s: float = 1e-3
    force_noise_n: float = 0.12
    torque_noise_n_m: float = 0.01
    resolution_n: float = 0.02
    filter_hz: float | None = None
    position_noise_m: float = 2e-6
    bias: tuple[float, float, float, float, float, float] = (4.2, -7.5, 11.0, 0.35, -0.22, 0.11)

    def bandwidth_hz(self) -> float:
        """Return where the servo's response falls to 1/sqrt(2)."""
        a = 1.0 - 2.0 * self.servo_damping_ratio**2
        return self.servo_hz * math.sqrt(a + math.sqrt(a * a + 1.0))

    def with_mass(self, factor: float) -> "MujocoCell":
        """Return the cell with a payload of another mass, and of the same shape."""
        inertia = self.inertia_kg_m2
        return replace(
            self,
            mass_kg=self.mass_kg * factor,
            inertia_kg_m2=(inertia[0] * factor, inertia[1] * factor, inertia[2] * factor),
        )


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _inertial(position: tuple[float, ...], mass: float, inertia: tuple[float, ...]) -> str:
    return f'<inertial pos="{_numbers(*position)}" mass="{mass!r}" diaginertia="{_numbers(*inertia)}"/>'


def _joints(prefix: str, axes: str, kind: str, extra: str) -> str:
    rows = ("1 0 0", "0 1 0", "0 0 1")
    return "".join(f'<joint name="{prefix}{a}" type="{kind}" axis="{rows["xyz".index(a)]}" {extra}/>' for a in axes)


def _payload_xml(cell: MujocoCell, wall: Wall, hand: Hand | None) -> str:
    part = cell.mass_kg * cell.part_share
    slack = f'solreffriction="{FRICTION_TIME_S} 1" frictionloss="{cell.coupling_friction_n!r}"'
    slide = f'stiffness="{cell.stiffness_n_per_m!r}" damping="{cell.damping_n_s_per_m!r}" {slack}'
    hinge = f'stiffness="{cell.turning_n_m_per_rad!r}" damping="{cell.turning_n_m_s_per_rad!r}"'
    swing = 2.0 * math.pi * cell.part_hz
    spring = f'stiffness="{part * swing**2!r}" damping="{2.0 * cell.part_damping_ratio * swing * part!r}"'
    return (
        f'<body name="payload" gravcomp="0">{_joints("c", "xyz", "slide", slide)}{_joints("cr", "xyz", "hinge", hinge)}'
        + _inertial(cell.com_S_m, cell.mass_kg - part, cell.inertia_kg_m2)
        + f'<geom name="edge" type="sphere" size="{EDGE_M}" mass="0" '
        f'pos="{_numbers(*wall.edge_m, TOOL_END_M)}" contype="0" conaffinity="0"/>'
        + '<site name="dragged"/>'
        + (f'<site name="handle" pos="{_numbers(*hand.handle_S_m)}"/>' if hand else "")
        + (
            f'<body name="part">{_joints("part", "z", "slide", spring)}'
            f"{_inertial(cell.com_S_m, part, (1e-6 * part,) * 3)}</body>"
            if part > 0.0
            else ""
        )
        + "</body>"
    )


def build_model(cell: MujocoCell, wall: Wall, hand: Hand | None = None) -> mujoco.MjModel:
    """Return the compiled model."""
    friction = f'solreffriction="{FRICTION_TIME_S} 1" frictionloss="{cell.joint_friction_n!r}"'
    servo, inertia = 2.0 * math.pi * cell.servo_hz, 0.1 * cell.servo_mass_kg
    motors = "".join(
        f'<position joint="{name}" kp="{load * servo**2!r}" kv="{2.0 * cell.servo_damping_ratio * servo * load!r}"/>'
        for name, load in [(f"p{a}", cell.servo_mass_kg) for a in AXES] + [(f"w{a}", inertia) for a in AXES]
    )
    tilt = wall.inclination_rad
    normal = R_0 @ np.array([math.sin(tilt), 0.0, -math.cos(tilt)])
    touched = P_0 + R_0 @ np.array([*wall.edge_m, TOOL_END_M + wall.distance_m]) - normal * EDGE_M
    holder = "" if hand is None else (
        f'<body name="hand" pos="{_numbers(*(P_0 + R_0 @ np.array(hand.handle_S_m)))}" gravcomp="1">'
        + _joints("h", "xyz", "slide", f'stiffness="{hand.arm_n_per_m!r}" damping="{hand.arm_n_s_per_m!r}"')
        + f'{_inertial((0.0,) * 3, hand.mass_kg, (1e-6,) * 3)}<site name="palm"/></body>'
    )  # fmt: skip
    felt = "".join(f'<framelinvel objtype="site" objname="{s}"/>' for s in ("handle", "palm")) if hand else ""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option integrator="RK4" gravity="0 0 -9.81" '
        f'tolerance="1e-12"/><worldbody>'
        f'<site name="ground" pos="{_numbers(*(P_0 - FAR_M * R_0[:, 2]))}"/>'
        f'<geom name="wall" type="plane" size="1 1 0.1" pos="{_numbers(*touched)}" zaxis="{_numbers(*normal)}" '
        f'contype="0" conaffinity="0"/><body name="flange" pos="{_numbers(*P_0)}" '
        f'quat="{_numbers(0.0, math.cos(TURN_RAD / 2), -math.sin(TURN_RAD / 2), 0.0)}" gravcomp="1">'
        + _joints("p", "xyz", "slide", f'armature="{cell.servo_mass_kg!r}" {friction}')
        + _joints("w", "xyz", "hinge", f'armature="{inertia!r}"')
        + _inertial((0.0,) * 3, 1.0, (1e-4,) * 3)
        + f'<site name="S"/>{_payload_xml(cell, wall, hand)}</body>{holder}</worldbody>'
        f'<contact><pair geom1="wall" geom2="edge" condim="1" solimp="{IMPEDANCE} {IMPEDANCE} 0.001"/></contact>'
        f'<tendon><spatial name="drag" damping="{cell.drag_n_s_per_m!r}"><site site="ground"/>'
        f'<site site="dragged"/></spatial></tendon>'
        f'<actuator>{motors}</actuator><sensor><framepos objtype="site" objname="S"/>'
        f'<framequat objtype="site" objname="S"/>{felt}</sensor></mujoco>'
    )
    # f = (−b v − k r − a)/R with R = (1 − d)/d Â, where Â is MuJoCo's own measure of the payload's inverse mass.
    inverse_mass = float(model.body_invweight0[model.body("payload").id, 0])
    scale = (1.0 - IMPEDANCE) * inverse_mass
    model.pair_solref[0] = (-wall.stiffness_n_per_m * scale, -wall.damping_n_s_per_m * scale)
    return model


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What the cell's computer sees in a period, and the true force on the wall."""

    wrench_S: tuple[float, ...]
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    contact_n: float
    depth_m: float


class Running:
    """The cell in motion: `read`, then `send` a command, period by period."""

    def __init__(self, cell: MujocoCell, wall: Wall, *, hand: Hand | None = None, seed: int = 0) -> None:
        self.cell, self.hand = cell, hand
        self.model = build_model(cell, wall, hand)
        self.data = mujoco.MjData(self.model)
        self.ticks = 0
        self._rng = np.random.default_rng(seed)
        self._first = {name: int(self.model.joint(name).dofadr[0]) for name in ("cx", "crx")}
        whole, self._early = divmod(cell.delay_s / cell.period_s, 1.0)
        self._queue = deque([np.zeros(6)] * (int(whole) + 2), maxlen=int(whole) + 2)
        self._filtered: np.ndarray[Any, np.dtype[np.float64]] = np.zeros(6)
        self._last: np.ndarray[Any, np.dtype[np.float64]] = np.zeros(6)
        self.settle(2.0)

    def settle(self, duration_s: float) -> None:
        """Let weight and springs come to rest, unseen."""
        for _ in range(round(duration_s / self.cell.period_s)):
            self._advance()
        self.ticks = 0

    def command_pose(self, displacement_m: tuple[float, ...], rotation_rad: tuple[float, ...]) -> tuple[float, ...]:
        """Return the commanded pose, x y z and quaternion x y z w, of a way and a turn in the first tool frame."""
        place, turned, out = P_0 + R_0 @ np.array(displacement_m), np.zeros(4), np.zeros(4)
        angle = math.hypot(*rotation_rad)
        axis = np.array(rotation_rad) / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
        mujoco.mju_axisAngle2Quat(turned, axis, angle)
        mujoco.mju_mulQuat(out, self.model.body("flange").quat, turned)
        return (*place.tolist(), *out[1:].tolist(), float(out[0]))

    def send(self, displacement_m: tuple[float, ...], rotation_rad: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        """Send the robot to a way and a turn in the first tool frame, and let a period pass."""
        self._queue.append(np.array([*displacement_m, *_hinges(rotation_rad)]))
        self._advance()
        self.ticks += 1

    def push(self, force_S_n: tuple[float, ...]) -> None:
        """Push on the payload's end for the next period, along the first tool frame."""
        body = self.model.body("payload").id
        point = self.data.body(body).xipos
        self.data.qfrc_applied[:] = 0.0
        mujoco.mj_applyFT(
            self.model, self.data, R_0 @ np.array(force_S_n), np.zeros(3), point, body, self.data.qfrc_applied
        )

    def read(self) -> Reading:
        """Return what is measured now."""
        mujoco.mj_forward(self.model, self.data)
        cell, noise, data = self.cell, self._rng.standard_normal, self.data
        felt = self._coupling_wrench() if cell.filter_hz is None else self._filtered
        wrench = felt + np.array(cell.bias)
        wrench += np.repeat([cell.force_noise_n, cell.torque_noise_n_m], 3) * noise(6)
        if cell.resolution_n > 0.0:
            step = np.repeat([cell.resolution_n, 0.1 * cell.resolution_n], 3)
            wrench = step * np.round(wrench / step)
        place = data.sensordata[:3] + cell.position_noise_m * noise(3)
        w, x, y, z = data.sensordata[3:7].tolist()
        contact = np.zeros(6)
        if data.ncon:
            mujoco.mj_contactForce(self.model, data, 0, contact)
        return Reading(
            wrench_S=tuple(wrench.tolist()),
            position_m=tuple(place.tolist()),
            quaternion_xyzw=(x, y, z, w),
            contact_n=float(contact[0]),
            depth_m=float(-data.contact[0].dist) if data.ncon else 0.0,
        )

    def _advance(self) -> None:
        """Let a period pass: the command before the delay's fraction of it is over, then the next one."""
        period = self.cell.period_s
        for command, duration in ((self._queue[0], self._early * period), (self._queue[1], (1 - self._early) * period)):
            if duration < 1e-9:
                continue
            steps = math.ceil(duration / LONGEST_STEP_S)
            self.model.opt.timestep = duration / steps
            self.data.ctrl[:] = command
            if self.hand is not None:
                self._hold(self.hand)
            if self.cell.filter_hz is not None:
                # Dry friction jumps with the acceleration where a command arrives.
                mujoco.mj_forward(self.model, self.data)
                self._last = self._coupling_wrench()
            for _ in range(steps if self.cell.filter_hz else 1):
                mujoco.mj_step(self.model, self.data, nstep=1 if self.cell.filter_hz else steps)
                self._filter(self.model.opt.timestep)

    def _hold(self, hand: Hand) -> None:
        """Pull payload and hand together with the grip."""
        data, model = self.data, self.model
        handle, palm = data.site("handle").xpos, data.site("palm").xpos
        speed = data.sensordata[7:10] - data.sensordata[10:13]
        pull = hand.grip_n_per_m * (palm - handle) - hand.grip_n_s_per_m * speed
        data.qfrc_applied[:] = 0.0
        for name, force, point in (("payload", pull, handle), ("hand", -pull, palm)):
            mujoco.mj_applyFT(model, data, force, np.zeros(3), point, model.body(name).id, data.qfrc_applied)

    def _coupling_wrench(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return what the payload puts on the flange through the coupling's joints, about the origin of S."""
        data = self.data
        slide, hinge = self._first["cx"], self._first["crx"]
        # Of the joints alone: MuJoCo's own sums hold the drag as well. Every joint has one degree of freedom here.
        joints = -self.model.jnt_stiffness * data.qpos - self.model.dof_damping * data.qvel
        for row in range(data.nefc):
            if data.efc_type[row] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF:
                joints[data.efc_id[row]] += data.efc_force[row]
        force, torque, shift = joints[slide : slide + 3], joints[hinge : hinge + 3], data.qpos[slide : slide + 3]
        return -np.concatenate([force, torque + np.cross(shift, force)])

    def _filter(self, duration_s: float) -> None:
        """Let a step of the physics pass through the sensor's filter of first order, its input straight in the step."""
        if self.cell.filter_hz is None:
            return
        mujoco.mj_forward(self.model, self.data)
        wrench = self._coupling_wrench()
        share = 2.0 * math.pi * self.cell.filter_hz * duration_s
        slope = (wrench - self._last) / share
        self._filtered = wrench - slope + (self._filtered - self._last + slope) * math.exp(-share)
        self._last = wrench


def _hinges(rotation_rad: tuple[float, ...]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the angles of the wrist's hinges, about x, y and z one after the other, of a rotation vector."""
    angle = math.hypot(*rotation_rad)
    if angle == 0.0:
        return np.zeros(3)
    quaternion, flat = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.array(rotation_rad) / angle, angle)
    mujoco.mju_quat2Mat(flat, quaternion)
    r = flat.reshape(3, 3)
    return np.array([math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0])])
