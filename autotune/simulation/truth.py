"""What a simulated cell really is; identification has to find it again from the log."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from autotune.formats.units import AXES
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel


@dataclass(frozen=True, kw_only=True)
class SimulatedCell:
    """A robot with a six-axis sensor, a compliant gripper and a payload, in front of a wall.

    Vectors are in the sensor frame S, which is the flange's. `approach_axis` is the axis of S along which the robot
    moves and touches; the others are rigid and at rest. About rx, ry or rz the robot turns about the origin of S:
    coupling, drag, environment, robot, controller, deadband and `wall_distance_m` then hold rad, N·m and kg·m², and
    the moment of inertia about that axis takes the mass's place; see `turning`. `deadband_n` is the threshold deadband
    that the cell's present controller applies after gravity compensation.
    """

    payload_mass_kg: float = 16.2
    com_S_m: tuple[float, float, float] = (0.012, -0.008, 0.145)
    inertia_S_kg_m2: tuple[float, float, float] = (0.55, 0.52, 0.21)
    contact_point_S_m: tuple[float, float, float] = (0.03, 0.01, 0.28)
    coupling: Coupling = field(default_factory=lambda: Coupling(stiffness_n_per_m=3.1e5, damping_n_s_per_m=150.0))
    drag_n_s_per_m: float = 330.0
    environment: Environment = field(
        default_factory=lambda: Environment(stiffness_n_per_m=1.2e5, damping_n_s_per_m=40.0)
    )
    robot: RobotModel = field(
        default_factory=lambda: RobotModel(
            numerator=np.array([20.0]), denominator=np.array([1.0, 20.0]), delay_s=2.4e-3
        )
    )
    controller: AdmittanceController = field(
        default_factory=lambda: AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1400.0)
    )
    sample_time_s: float = 8e-4
    approach_axis: Literal["x", "y", "z", "rx", "ry", "rz"] = "x"
    deadband_n: float = 5.0
    force_bias_S_n: tuple[float, float, float] = (4.2, -7.5, 11.0)
    torque_bias_S_n_m: tuple[float, float, float] = (0.35, -0.22, 0.11)
    force_noise_rms_n: float = 0.14
    torque_noise_rms_n_m: float = 0.012
    position_noise_rms_m: float = 2e-6
    orientation_noise_rms_rad: float = 5e-6
    base_position_m: tuple[float, float, float] = (0.85, 0.10, 0.90)
    wall_distance_m: float = 0.025

    def __post_init__(self) -> None:
        if self.approach_axis not in AXES:
            raise ParameterError("approach_axis", self.approach_axis, f"one of {', '.join(AXES)}")
        if self.environment.is_free_space:
            raise ParameterError("environment", self.environment, "a surface to touch")
        for name in ("deadband_n", "force_noise_rms_n", "torque_noise_rms_n_m", "position_noise_rms_m"):
            if not getattr(self, name) >= 0.0:
                raise ParameterError(name, getattr(self, name), "not below 0")
        if not self.wall_distance_m > 0.0:
            raise ParameterError("wall_distance_m", self.wall_distance_m, "above 0")

    @classmethod
    def turning(cls, axis: Literal["rx", "ry", "rz"], **changes: Any) -> "SimulatedCell":
        """Return a cell that turns about an axis of S and presses 0.2 to 0.3 m off it; `changes` are fields."""
        usual: dict[str, Any] = {
            "approach_axis": axis,
            "contact_point_S_m": (0.16, 0.11, 0.28),
            "coupling": Coupling(stiffness_n_per_m=1.0e4, damping_n_s_per_m=5.0),
            "drag_n_s_per_m": 11.0,
            "environment": Environment(stiffness_n_per_m=4.0e3, damping_n_s_per_m=1.4),
            "controller": AdmittanceController(mass_kg=0.35, damping_n_s_per_m=48.0),
            "deadband_n": 1.0,
            "wall_distance_m": 0.13,
        }
        return cls(**{**usual, **changes})

    @classmethod
    def low_drag(cls, **changes: Any) -> "SimulatedCell":
        """Return a cell whose payload hardly loses any energy to ground, on a robot of second order.

        What damps the payload on its coupling is the controller alone, so little admittance can be had. `changes` are
        fields.
        """
        omega = 2.0 * np.pi * 10.83
        usual: dict[str, Any] = {
            "payload_mass_kg": 16.0,
            "coupling": Coupling(stiffness_n_per_m=3.0e5, damping_n_s_per_m=150.0),
            "drag_n_s_per_m": 20.0,
            # -3 dB at 6.97 Hz.
            "robot": RobotModel(
                numerator=np.array([omega**2]), denominator=np.array([1.0, 2.0 * omega, omega**2]), delay_s=2.6e-3
            ),
            "controller": AdmittanceController(mass_kg=60.0, damping_n_s_per_m=3000.0),
        }
        return cls(**{**usual, **changes})

    @property
    def axis_index(self) -> int:
        """0, 1 or 2 for the approach axis, along it or about it."""
        return AXES.index(self.approach_axis) % 3

    @property
    def is_turning(self) -> bool:
        """Whether the approach axis is a rotational one."""
        return self.approach_axis.startswith("r")

    @property
    def moved_mass_kg(self) -> float:
        """M_p of the approach axis: the mass, or the moment of inertia about it [kg·m²]."""
        return self.inertia_S_kg_m2[self.axis_index] if self.is_turning else self.payload_mass_kg

    def contact_plant(self) -> Plant:
        """Return the one-axis plant against the wall."""
        return Plant(
            robot=self.robot,
            coupling=self.coupling,
            payload=PayloadDynamics(mass_kg=self.moved_mass_kg, drag_n_s_per_m=self.drag_n_s_per_m),
            environment=self.environment,
        )
