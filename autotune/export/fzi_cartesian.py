"""The force controller of FZI's cartesian_controllers: what it can be, and its parameter file.

Its rule is `problems.model.third_party_controllers.ForwardDynamics`. Read in the sources of branch ros2
(cartesian_controller_base at
commit 4e84f69, cartesian_force_controller of the same time); docs/targets.md tells what was read where.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from autotune.formats.controller_record import AxisGains, Controller
from autotune.formats.units import axis_units
from autotune.validation.law import AxisTask
from problems.contact.linear_controller_contact import force_per_speed
from problems.contact.transient import SampledContact, build_sampled_contact
from problems.design.problem import DEFAULT_BOUNDS
from problems.model.linear_controllers import LinearController
from problems.model.sampled import build_sampled_plant
from problems.model.third_party_controllers import VELOCITY_KEPT, ForwardDynamics

from .fzi_axes import Quaternion, check_orientation
from .ros_yaml import Tree, check_keys, check_names, update_rate_hz
from .structure import Values, Variable, lost_gains

LINK_MASS_KEY = "solver/forward_dynamics/link_mass"
"""One name with slashes, as it is declared; keys that are nested in the file are joined by points."""
KEYS_OF = {"x": "trans_x", "y": "trans_y", "z": "trans_z", "rx": "rot_x", "ry": "rot_y", "rz": "rot_z"}
KNOWN_KEYS = frozenset(
    {
        "end_effector_link",
        "robot_base_link",
        "ft_sensor_ref_link",
        "joints",
        "command_interfaces",
        "hand_frame_control",
        "ik_solver",
        "solver.error_scale",
        "solver.iterations",
        "solver.publish_state_feedback",
        LINK_MASS_KEY,
        *(f"pd_gains.{axis}.{gain}" for axis in KEYS_OF.values() for gain in ("p", "d")),
    }
)
"""Every parameter that the force controller declares with the solver forward_dynamics."""

# Gains that a search may choose, as ratios of the translated one; the lead stays where our own K_l does, for noise.
_GAIN_RATIO, _LONGEST_LEAD_S = (0.03, 10.0), DEFAULT_BOUNDS["lead_s"][1]
# The mass (kg) of the inner links, which the law leaves out: at 1e-4 they take 0.04 % of the motion, at the default of
# 0.1 more than a quarter.
_LINK_MASS = 1e-4


@dataclass(frozen=True, kw_only=True)
class FziOptions:
    """The names that the file needs beyond the controller, and how the sensor stands in the base where it is used.

    `orientation` is a quaternion (x, y, z, w) that takes vectors from the sensor's axes, those that were tuned, to the
    base's. Raises UsageError for a name or a quaternion that is none.
    """

    controller_name: str = "cartesian_force_controller"
    joints: tuple[str, ...] = tuple(f"joint_{i}" for i in range(1, 7))
    base_link: str = "base_link"
    tip_link: str = "tool0"
    sensor_frame: str = "ft_frame"
    orientation: Quaternion | None = None

    def __post_init__(self) -> None:
        check_names("--joints", self.joints)
        if self.orientation is not None:
            check_orientation(self.orientation)
        for what, name in (
            ("--controller-name", self.controller_name),
            ("--base-link", self.base_link),
            ("--tip-link", self.tip_link),
            ("--sensor-frame", self.sensor_frame),
        ):
            check_names(what, (name,))


@dataclass(frozen=True)
class FziAxis:
    """One axis: the gain p and the derivative's share of it (s), which leads as K_l does."""

    task: AxisTask
    gains: AxisGains
    options: FziOptions

    @cached_property
    def pair(self) -> SampledContact:
        """The nominal plant; how fast this controller moves depends on the robot's lag."""
        return build_sampled_contact(build_sampled_plant(self.task.domain.nominal_plant(), self.task.sample_time_s))

    @cached_property
    def translated(self) -> Values:
        """The gain that moves as fast per newton as B_a does, and K_l."""
        twice, once = (self._force_per_speed(ForwardDynamics(proportional=p, derivative=0.0)) for p in (1.0, 2.0))
        # What a speed takes is the drag, and what the gain is divided into.
        inverse = 2.0 * (twice - once)
        return inverse / (self.gains.damping + self.task.domain.drag_n_s_per_m - (twice - inverse)), self.gains.lead_s

    def _force_per_speed(self, rule: ForwardDynamics) -> float:
        return force_per_speed(self.pair, rule.law(self.task.sample_time_s))

    @property
    def variables(self) -> tuple[Variable, ...]:
        """p, and d/p (s)."""
        gain = self.translated[0]
        return (
            Variable(name="p", low=gain * _GAIN_RATIO[0], high=gain * _GAIN_RATIO[1]),
            Variable(name="lead", low=0.0, high=_LONGEST_LEAD_S, ratio=False),
        )

    def written(self, values: Values) -> Mapping[str, float]:
        """Return p and d with six digits, as the file holds them."""
        gain = float(f"{values[0]:.6g}")
        return {"p": gain, "d": float(f"{gain * values[1]:.6g}")}

    def law(self, values: Values) -> LinearController:
        """Return the law that runs with the numbers as they are written."""
        gains = self.written(values)
        return ForwardDynamics(proportional=gains["p"], derivative=gains["d"]).law(self.task.sample_time_s)

    def dropped(self) -> tuple[str, ...]:
        """Say what of the gains is left out."""
        units = axis_units(self.task.axis)
        mass = f"axis {self.task.axis}: mass M_a = {self.gains.mass:g} {units.mass} (it is not free)"
        return (mass, *lost_gains(self.task, self.gains, expressed=("lead_s",)))

    def told(self, values: Values) -> Iterator[str]:
        """Say what mass and damping the gains come to on this robot at this rate."""
        units, h = axis_units(self.task.axis), self.task.sample_time_s
        damping = force_per_speed(self.pair, self.law(values)) - self.task.domain.drag_n_s_per_m
        lag = -h / math.log(VELOCITY_KEPT)
        yield (
            f"axis {self.task.axis}: rendered damping {damping:.4g} {units.damping} and mass {lag * damping:.3g} "
            f"{units.mass}; the speed dies out within {lag * 1e3:.3g} ms at this update rate, whatever the gains."
        )


def notes() -> Iterator[str]:
    """Say what the controller does of itself."""
    yield (
        "Every cycle moves a virtual mass of 1 by 0.02 s and keeps 0.9 of its speed, whatever the cycle's length: the "
        "file holds for its update_rate alone. The command starts from the measured position in every cycle."
    )
    yield (
        "That takes the robot's own lag out of the loop, and the peaks told rest on the robot model more than those of "
        "a controller that integrates by itself: measure one contact before relying on them."
    )
    yield (
        "The wrench comes by a topic (~/ft_sensor_wrench), unfiltered and with gravity and bias already removed: its "
        "delay is not in the certificate and must stay well below the delay margin. solver.iterations does nothing."
    )
    yield (
        f"Keys that are misspelt are ignored in silence; gains that are not given are 0. {LINK_MASS_KEY} is one name: "
        f"ros2 param get must answer {_LINK_MASS:g} while the controller runs, since its default of 0.1 would take "
        "more than a quarter of the motion. With so light links the joints move fast near singularities: stay away."
    )


def parameter_tree(
    controller: Controller, values: Mapping[str, Mapping[str, float]], options: FziOptions
) -> tuple[Tree, int]:
    """Return the whole file as a tree, and the update rate [Hz] that it holds for; `values` by axis of the base."""
    rate = update_rate_hz(controller.sample_time_s)
    still: Mapping[str, float] = {"p": 0.0, "d": 0.0}
    parameters: Tree = {
        "end_effector_link": options.tip_link,
        "robot_base_link": options.base_link,
        "ft_sensor_ref_link": options.sensor_frame,
        "joints": list(options.joints),
        "command_interfaces": ["position"],
        "hand_frame_control": True,
        "ik_solver": "forward_dynamics",
        "solver": {"error_scale": 1.0, "iterations": 1},
        LINK_MASS_KEY: _LINK_MASS,
        "pd_gains": {key: dict(values.get(axis, still)) for axis, key in KEYS_OF.items()},
    }
    check_keys(parameters, KNOWN_KEYS)
    name = options.controller_name
    manager: Tree = {"update_rate": rate, name: {"type": "cartesian_force_controller/CartesianForceController"}}
    return {"controller_manager": {"ros__parameters": manager}, name: {"ros__parameters": parameters}}, rate
