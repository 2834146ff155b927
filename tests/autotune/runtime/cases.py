"""Controllers, readings and a cell for the tests of the runtime and of its C twin."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from autotune.formats.limits import VariableDampingSettings
from autotune.runtime import AXES, START, AxisLaw, AxisLimits, CollisionResponse, Limits, Payload, RuntimeController
from autotune.simulation.simulate import _advance
from problems.arrays import FloatArray
from problems.contact.events import contact_force
from problems.contact.kernel_types import HeldInputs, Inputs
from problems.contact.transient import build_sampled_contact
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant

PERIOD_S = 8e-4

PAYLOAD = Payload(
    mass_kg=16.0, com_S_m=(0.01, -0.02, 0.1), force_bias_S_n=(1.5, -0.25, 3.0), torque_bias_S_n_m=(0.1, 0.2, -0.3)
)
WALL = Plant(
    robot=RobotModel(numerator=np.array([20.0]), denominator=np.array([1.0, 20.0]), delay_s=2.4e-3),
    coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=120.0),
    payload=PayloadDynamics(mass_kg=16.0, drag_n_s_per_m=630.0),
    environment=Environment(stiffness_n_per_m=1e5),
)


# As if the first readings had been found at rest: the law moves from the first one on.
STARTED = START._replace(watch=START.watch._replace(resting=10**6))
# Those of no cell: what is fed to the law alone may be anything.
WIDE = Limits(
    force_n=1.7e308,
    torque_n_m=1.7e308,
    axes=dict.fromkeys(AXES, AxisLimits(speed=1e300, acceleration=1e300)),
    pose_speed_m_s=0.1 / PERIOD_S,
    pose_speed_rad_s=0.1 / PERIOD_S,
    stale_wrench_s=1e5,
    stale_pose_s=1e5,
    rest_samples=1,
    rest_force_n=1e150,
    rest_torque_n_m=1e150,
)


def make_axis(
    name: str, *, deadband: float = 0.0, is_subtractive: bool = False, compensation_mass_kg: float = 0.0
) -> AxisLaw:
    return AxisLaw(
        name=name,
        sample_time_s=PERIOD_S,
        mass=12.5,
        damping=1400.0,
        lead_s=0.0125,
        feedback_damping_s=2e-2,
        velocity_filter_rad_per_s=120.0,
        acceleration_filter_rad_per_s=200.0,
        compensation_mass_kg=compensation_mass_kg,
        deadband=deadband,
        is_subtractive=is_subtractive,
        payload_range=(14.0, 18.0),
    )


def make_runtime(
    *axes: AxisLaw,
    response: CollisionResponse = CollisionResponse.NONE,
    threshold_n: float = np.inf,
    payload: Payload = PAYLOAD,
    limits: Limits = WIDE,
) -> RuntimeController:
    return RuntimeController(
        checksum="ab" * 32,
        sample_time_s=PERIOD_S,
        axes=axes,
        response=response,
        threshold_n=threshold_n,
        payload=payload,
        limits=limits,
    )


def random_schedule(rng: np.random.Generator) -> VariableDampingSettings | None:
    """Any variable damping, or none; the random readings move at some 0.1 m/s."""
    if rng.random() < 0.4:
        return None
    lowest = float(rng.uniform(100.0, 1000.0))
    return VariableDampingSettings(
        highest=lowest * float(rng.uniform(1.0, 4.0)),
        lowest=lowest,
        decay_s_per_m=float(rng.uniform(0.0, 20.0)),
        update_periods=int(rng.integers(1, 20)),
        largest_change=float(rng.uniform(1.0, 200.0)),
    )


def random_runtime(rng: np.random.Generator, response: CollisionResponse, limits: Limits = WIDE) -> RuntimeController:
    """Any gains on any axes: the step does not ask whether a loop is stable."""
    names = [name for name in AXES if rng.random() < 0.7] or ["z"]
    turns = any(name.startswith("r") for name in names)
    axes = (
        AxisLaw(
            name=name,
            sample_time_s=PERIOD_S,
            mass=float(rng.uniform(1.0, 50.0)),
            damping=float(rng.uniform(100.0, 3000.0)),
            lead_s=float(rng.uniform(0.0, 0.03)),
            feedback_damping_s=float(rng.uniform(1e-3, 0.05)),
            velocity_filter_rad_per_s=float(rng.uniform(50.0, 300.0)),
            acceleration_filter_rad_per_s=200.0,
            compensation_mass_kg=0.0 if turns else 10.0,
            deadband=float(rng.choice([0.0, 5.0])),
            is_subtractive=bool(rng.random() < 0.5),
            payload_range=(14.0, 18.0),
            variable_damping=None if name.startswith("r") else random_schedule(rng),
        )
        for name in names
    )
    threshold = np.inf if response is CollisionResponse.NONE else 40.0
    return make_runtime(*axes, response=response, threshold_n=threshold, limits=limits)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What one step takes."""

    wrench_S: FloatArray
    position_W_m: FloatArray
    R_WS: FloatArray
    desired_S: FloatArray
    tick: int | None = None

    def arguments(self) -> dict[str, list[float] | list[list[float]] | int | None]:
        return {
            "wrench_S": self.wrench_S.tolist(),
            "position_W_m": self.position_W_m.tolist(),
            "R_WS": self.R_WS.tolist(),
            "desired_S": self.desired_S.tolist(),
            "tick": self.tick,
        }


def random_readings(rng: np.random.Generator, count: int) -> list[Reading]:
    """A tool that wanders and turns at up to some rad/s, under any wrench."""
    slow = np.cumsum(rng.standard_normal((count, 6)), axis=0)
    turned = Rotation.random(rng=rng) * Rotation.from_rotvec(2e-3 * slow[:, 3:])
    wrench = 10.0 * rng.standard_normal((count, 6)) + slow
    desired = np.where(rng.random((count, 6)) < 0.01, 30.0, 0.0)
    return [
        Reading(wrench_S=wrench[k], position_W_m=1e-4 * slow[k, :3], R_WS=matrix, desired_S=desired[k])
        for k, matrix in enumerate(turned.as_matrix())
    ]


def along(axis: int, rotation: Rotation, position: float, payload: Payload, wrench: FloatArray) -> Reading:
    """The reading of a tool `position` along, or turned about, its own axis, under a wrench beside its weight."""
    step = np.zeros(6)
    step[axis] = position
    turned = rotation * Rotation.from_rotvec(step[3:])
    weight = payload.mass_kg * turned.inv().apply(payload.gravity_W_m_s2)
    raw = np.concatenate(
        [weight + payload.force_bias_S_n, np.cross(payload.com_S_m, weight) + payload.torque_bias_S_n_m]
    )
    return Reading(
        wrench_S=raw + wrench,
        position_W_m=np.array([0.3, -1.0, 0.7]) + rotation.apply(step[:3]),
        R_WS=turned.as_matrix(),
        desired_S=np.zeros(6),
    )


@dataclass(frozen=True, kw_only=True)
class Contact:
    """What happened in a cell: the sensor's pressing force −F, the contact's F_e, and the command along the axis."""

    sensor_n: FloatArray
    contact_n: FloatArray
    command_m: FloatArray


def run_contact(
    increment: Callable[[Reading], FloatArray],
    axis: int,
    *,
    force_n: float,
    distance_m: float,
    duration_s: float,
    plant: Plant = WALL,
    payload: Payload = PAYLOAD,
) -> Contact:
    """Press with F^d on the simulated cell's wall, from rest: the exact plant, the runtime (or its twin) at the ticks.

    The tool is turned anyhow; weight and bias of the payload are in the raw wrench.
    """
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    (step, _, rows, _, (whole, chain, _), _) = pair.arguments
    n, count = step.shape[1], round(duration_s / PERIOD_S)
    state, surface, past = np.zeros(n), np.zeros(2), [-distance_m] * max(chain, 1)
    state[0] = state[n - 2] = -distance_m
    rotation, touching, command = Rotation.from_euler("xyz", [2.5, 0.3, -0.8]), False, -distance_m
    out = np.zeros((3, count))
    for k in range(count):
        held = past[chain - 1]
        position, sensed = float(rows[0, :n] @ state), float(rows[1, :n] @ state + rows[1, n] * held)
        wrench, desired = np.zeros(6), np.zeros(6)
        wrench[axis], desired[axis] = sensed, force_n
        reading = along(axis, rotation, position, payload, wrench)
        command += float(increment(Reading(**{**vars(reading), "desired_S": desired}))[axis])
        pressed = max(0.0, contact_force(state, rows, HeldInputs(held, 0.0))) if touching else 0.0
        out[:, k] = -sensed, pressed, command
        newer = command if whole == 0 else past[whole - 1]
        inputs = Inputs(held if chain > whole else newer, newer, 0.0)
        touching = _advance(pair.arguments, state, surface, inputs, touching)
        past = [command, *past[:-1]]
    return Contact(sensor_n=out[0], contact_n=out[1], command_m=out[2])
