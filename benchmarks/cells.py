"""Cells drawn at random: plant, sensor, program, and how their logs are written."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from autotune.formats.units import AXES
from autotune.simulation.phases import Program
from autotune.simulation.simulate import WORKING_ORIENTATION, simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Coupling, Environment
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

Draw = np.random.Generator

_ADMITTANCE_MASS_KG = 10.0
_LEAST_TILT_SHARE = 0.45  # of the largest
_DAMPINGS = np.geomspace(400.0, 4e4, 24)
_LEAST_MODULUS_MARGIN = 0.55
_SLOWEST_APPROACH_M_S = 2e-3
_SURFACES_APART = 2.0


@dataclass(frozen=True, kw_only=True)
class Writing:
    """How a log is written.

    `pose_every` and `wrench_every` keep one sample of so many; `lost_share` of each channel's messages is missing, and
    once `gap_periods` in a row; the wrench's stamps are `wrench_late_s` late; `reversed_wrench` is the sensor's on the
    payload; `turned_sensor` by 90 degrees about the flange's z, declared in cell.yaml. With `names_period`
    cell.yaml names the controller's period, as the one that `autotune.recording` writes beside a log.
    """

    container: Literal["mcap", "sqlite", "bag", "csv"] = "mcap"
    pose_type: Literal["PoseStamped", "TransformStamped"] = "PoseStamped"
    topics: tuple[str, str, str] = ("/ft_sensor/wrench", "/flange/pose", "/flange/command")
    pose_every: int = 1
    wrench_every: int = 1
    lost_share: float = 0.0
    gap_periods: int = 0
    wrench_late_s: float = 0.0
    reversed_wrench: bool = False
    turned_sensor: bool = False
    names_period: bool = False


@dataclass(frozen=True, kw_only=True)
class DrawnCell:
    """A cell, the surfaces that it touches one after the other, what it does, and how that is logged."""

    seed: int
    cell: SimulatedCell
    surfaces: tuple[Environment, ...]
    program: Program
    writing: Writing


def draw_cell(seed: int) -> DrawnCell:
    """Draw a cell whose loop is stable with a margin and not too slow to touch anything; the seed decides all of it."""
    rng = np.random.default_rng([seed, 5])
    while True:
        cell, surfaces = _plant(rng)
        controller = _controller(cell, surfaces)
        force_n = float(rng.uniform(25.0, 60.0))
        program = _program(rng)
        writing = _writing(rng, cell.sample_time_s)
        if controller is None:
            continue
        cell, program = _spaced(replace(cell, controller=controller), surfaces, program, force_n)
        if force_n / _resistance(cell) > _SLOWEST_APPROACH_M_S:
            names_period = bool(np.random.default_rng([seed, 9]).random() < 0.5)
            writing = replace(writing, names_period=names_period)
            return DrawnCell(seed=seed, cell=cell, surfaces=surfaces, program=program, writing=writing)


def _log_uniform(rng: Draw, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _plant(rng: Draw) -> tuple[SimulatedCell, tuple[Environment, ...]]:
    mass, stiffness = _log_uniform(rng, 2.0, 60.0), _log_uniform(rng, 5e4, 1e6)
    critical = 2.0 * np.sqrt(stiffness * mass)
    period = _log_uniform(rng, 8e-4, 4e-3)
    reach = 0.03 + 0.12 * mass / 60.0
    com = (*rng.uniform(-reach, reach, 2).tolist(), float(rng.uniform(0.03, 0.25)))
    radius = _log_uniform(rng, 0.08, 0.2)
    noise, surfaces = _log_uniform(rng, 0.05, 0.5), _surfaces(rng)
    cell = SimulatedCell(
        payload_mass_kg=mass,
        com_S_m=com,
        inertia_S_kg_m2=tuple(_inertia_about_sensor(mass, radius, com)),
        contact_point_S_m=(com[0] + 0.02, com[1] - 0.01, com[2] + 0.1),
        coupling=Coupling(stiffness_n_per_m=stiffness, damping_n_s_per_m=_log_uniform(rng, 0.01, 0.1) * critical),
        drag_n_s_per_m=_log_uniform(rng, 60.0, 600.0),
        environment=surfaces[0],
        robot=_robot(rng, period),
        sample_time_s=period,
        approach_axis=AXES[int(rng.integers(3))],  # type: ignore[arg-type]  # one of the three names
        deadband_n=float(rng.uniform(2.0, 8.0)),
        force_bias_S_n=tuple(rng.uniform(-15.0, 15.0, 3).tolist()),
        torque_bias_S_n_m=tuple(rng.uniform(-1.0, 1.0, 3).tolist()),
        force_noise_rms_n=noise,
        torque_noise_rms_n_m=noise * float(rng.uniform(0.05, 0.12)),
        position_noise_rms_m=_log_uniform(rng, 5e-7, 1e-5),
        orientation_noise_rms_rad=_log_uniform(rng, 1e-6, 5e-5),
    )
    return cell, surfaces


def _inertia_about_sensor(mass: float, radius: float, com: tuple[float, ...]) -> FloatArray:
    """Return the diagonal of a ball's tensor about the sensor's origin; the simulator knows no products of inertia."""
    square = np.square(com)
    return np.asarray(mass * (radius**2 + np.sum(square) - square))


def _surfaces(rng: Draw) -> tuple[Environment, ...]:
    """Draw one to three surfaces that differ by a factor of 2 or more in stiffness; one in four moves."""
    count = int(rng.choice([1, 2, 3], p=[0.6, 0.25, 0.15]))
    while True:
        stiffness = np.exp(rng.uniform(np.log(5e3), np.log(3e5), count))
        if count == 1 or np.min(np.diff(np.sort(np.log(stiffness)))) > np.log(_SURFACES_APART):
            break
    masses = [_log_uniform(rng, 0.3, 5.0) if rng.random() < 0.25 else 0.0 for _ in range(count)]
    return tuple(
        Environment(stiffness_n_per_m=float(k), damping_n_s_per_m=_log_uniform(rng, 10.0, 500.0), mass_kg=m)
        for k, m in zip(stiffness, masses, strict=True)
    )


def _robot(rng: Draw, period_s: float) -> RobotModel:
    omega, delay = 2.0 * np.pi * _log_uniform(rng, 1.0, 8.0), float(rng.uniform(0.5, 6.0)) * period_s
    if rng.random() < 0.5:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=omega, delay_s=delay)
    damping = float(rng.uniform(0.6, 1.2))
    return RobotModel(
        numerator=np.array([omega**2]), denominator=np.array([1.0, 2.0 * damping * omega, omega**2]), delay_s=delay
    )


def _controller(cell: SimulatedCell, surfaces: tuple[Environment, ...]) -> AdmittanceController | None:
    """Return the fastest controller that touches every surface, and moves freely, with a margin."""
    plants = [
        build_sampled_plant(cell.contact_plant().in_contact_with(each), cell.sample_time_s)
        for each in (FREE_SPACE, *surfaces)
    ]
    for damping in _DAMPINGS.tolist():
        controller = AdmittanceController(mass_kg=_ADMITTANCE_MASS_KG, damping_n_s_per_m=damping)
        try:
            if all(find_margins(plant, controller).modulus > _LEAST_MODULUS_MARGIN for plant in plants):
                return controller
        except UnstableLoopError:
            continue
    return None


def _resistance(cell: SimulatedCell) -> float:
    return cell.controller.damping_n_s_per_m + cell.drag_n_s_per_m


def _program(rng: Draw) -> Program:
    count, hold, tilt = int(rng.integers(6, 13)), float(rng.uniform(0.8, 1.3)), float(rng.uniform(0.6, 1.3))
    return Program(
        pose_count=count,
        pose_hold_s=hold,
        tilts_rad=(_LEAST_TILT_SHARE * tilt, tilt),
        jogging_s=float(rng.choice([0.0, 8.0])),
        sweep_s=float(rng.uniform(9.0, 14.0)),
        sweep_hz=(float(rng.uniform(0.4, 0.7)), float(rng.uniform(35.0, 55.0))),
        sweep_speed_m_s=float(rng.uniform(0.007, 0.015)),
        contact_count=int(rng.integers(3, 6)),
    )


def _spaced(
    cell: SimulatedCell, surfaces: tuple[Environment, ...], program: Program, force_n: float
) -> tuple[SimulatedCell, Program]:
    """Put the wall beyond sweep and jogging; give contacts, retreats and rests the time that this loop needs."""
    distance, resistance = max(0.010, 42.0 / _resistance(cell)), _resistance(cell)
    slowest_hz = float(np.min(np.abs(np.roots(cell.robot.denominator)))) / (2.0 * np.pi)
    softest = min(each.stiffness_n_per_m for each in surfaces)
    settling = 4.0 * cell.controller.damping_n_s_per_m / softest + 0.5 / slowest_hz
    hold = 0.9 + settling + max(0.0, distance * resistance / force_n - 1.5)
    rest = max(0.8, 1.5 / slowest_hz)
    # Retreating takes F/K_e at the speed 0.55 F/(B_a + B_p), and then as far again as from an unyielding wall.
    retract = 0.9 + 2.0 * resistance / softest
    program = replace(program, contact_force_n=force_n, contact_hold_s=hold, rest_s=rest, retract_s=retract)
    return replace(cell, wall_distance_m=distance), program


def _writing(rng: Draw, period_s: float) -> Writing:
    container = str(rng.choice(["mcap", "sqlite", "bag", "csv"], p=[0.4, 0.15, 0.25, 0.2]))
    topics = [
        ("/ft_sensor/wrench", "/flange/pose", "/flange/command"),
        ("/wrist/ft_raw", "/ur/tcp_pose", "/ur/tcp_pose_target"),
        ("/netft_data", "/arm/state/cartesian", "/arm/setpoint/cartesian"),
    ][int(rng.integers(3))]
    pose_every = int(rng.choice([1, 2, 3], p=[0.6, 0.25, 0.15]))
    wrench_every = int(rng.choice([1, 2], p=[0.8, 0.2]))
    lost = float(rng.uniform(0.0, 0.01)) if rng.random() < 0.4 else 0.0
    late = float(rng.uniform(-1.5, 1.5)) * period_s if rng.random() < 0.3 else 0.0
    gap = int(rng.integers(3, 11)) if rng.random() < 0.2 else 0
    table, slow = container == "csv", period_s > 2.5e-3
    return Writing(
        container=container,  # type: ignore[arg-type]  # one of the four names
        pose_type="TransformStamped" if rng.random() < 0.3 else "PoseStamped",
        topics=topics,
        pose_every=1 if table else min(pose_every, 2 if slow else 3),
        wrench_every=1 if table or slow else wrench_every,
        lost_share=lost,
        gap_periods=gap,
        wrench_late_s=0.0 if table else late,
        reversed_wrench=bool(rng.random() < 0.3),
        turned_sensor=bool(rng.random() < 0.2),
    )


def simulate(drawn: DrawnCell) -> Recording:
    """Run the whole program at the first surface, and only its contacts at each further one, from where it stopped."""
    parts = [simulate_cell(drawn.cell, drawn.program, seed=drawn.seed).recording]
    touching = replace(drawn.program, pose_count=1, pose_hold_s=0.1, pose_move_s=0.1, jogging_s=0.0, sweep_s=0.0)
    for number, surface in enumerate(drawn.surfaces[1:], 1):
        cell = replace(drawn.cell, environment=surface)
        parts.append(simulate_cell(cell, touching, seed=drawn.seed + 1000 * number).recording)
    whole = parts[0]
    for part in parts[1:]:
        whole = _followed(whole, part, drawn.cell)
    return whole


def _followed(first: Recording, second: Recording, cell: SimulatedCell) -> Recording:
    """Join two runs that begin and end at rest in the working orientation; the second begins where the first ended."""
    assert first.command is not None
    assert second.command is not None
    direction_B = WORKING_ORIENTATION.apply(np.eye(3)[cell.axis_index])
    travel = float((first.command.position_m[-1] - second.command.position_m[0]) @ direction_B)
    period_ns = int(np.median(np.diff(first.wrench.stamp_ns)))
    later_ns = int(first.wrench.stamp_ns[-1]) + period_ns - int(second.wrench.stamp_ns[0])

    def joined_pose(a: PoseSignal, b: PoseSignal) -> PoseSignal:
        return replace(
            a,
            stamp_ns=np.concatenate([a.stamp_ns, b.stamp_ns + later_ns]),
            position_m=np.concatenate([a.position_m, b.position_m + travel * direction_B]),
            quaternion_xyzw=np.concatenate([a.quaternion_xyzw, b.quaternion_xyzw]),
        )

    wrench: WrenchSignal = replace(
        first.wrench,
        stamp_ns=np.concatenate([first.wrench.stamp_ns, second.wrench.stamp_ns + later_ns]),
        force_n=np.concatenate([first.wrench.force_n, second.wrench.force_n]),
        torque_n_m=np.concatenate([first.wrench.torque_n_m, second.wrench.torque_n_m]),
    )
    return replace(
        first,
        wrench=wrench,
        pose=joined_pose(first.pose, second.pose),
        command=joined_pose(first.command, second.command),
    )
