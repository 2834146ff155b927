"""Export to the force controller of FZI's cartesian_controllers: options, parameter file and notes.

Its rule is that of `fzi_axis`. Read in the sources of branch ros2 (cartesian_controller_base at commit 4e84f69,
cartesian_force_controller of the same time); docs/targets.md says what was read where.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .ros_yaml import (
    NAME_OPTIONS,
    ORIENTATION,
    UPRIGHT,
    OrientedNames,
    Tree,
    managed_parameters,
    spawner,
    update_rate_hz,
)
from .target import ExportTarget, begins_with, render_translation

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from autotune.formats.controller_record import AxisGains, Controller
    from autotune.validation.law import AxisTask

    from .retune import ControllerStructure
    from .third_party import ParameterFile, TranslatedAxis, Translation

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

# The mass (kg) of the inner links, which the law leaves out: at 1e-4 they take 0.04 % of the motion, at the default of
# 0.1 more than a quarter.
_LINK_MASS = 1e-4


@dataclass(frozen=True, kw_only=True)
class FziOptions(OrientedNames):
    """What the file needs beyond the controller; the axes of `orientation` are those that were tuned."""

    controller_name: str = "cartesian_force_controller"


def notes() -> Iterator[str]:
    """Say what the controller does of itself."""
    yield (
        "Every cycle moves a virtual mass of 1 by 0.02 s and keeps 0.9 of its speed, whatever the cycle's length: the "
        "file holds for its update_rate alone. The command starts from the measured position in every cycle."
    )
    yield (
        "That takes the robot's own lag out of the loop, and the predicted peaks rest on the robot model more than "
        "those of a controller that integrates by itself: measure one contact before relying on them."
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
    controller: "Controller", values: Mapping[str, Mapping[str, float]], options: FziOptions
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
    return managed_parameters(
        options.controller_name, "cartesian_force_controller/CartesianForceController", rate, parameters, KNOWN_KEYS
    ), rate


def translate(
    source: "ControllerFile", options: FziOptions, progress: Callable[[float], None] | None = None
) -> "Translation":
    """Return the controller as this program runs it, certified; raises as `third_party.translate_controller`."""
    from .base_axes import base_axes, check_kinds, orientation_notes  # noqa: PLC0415
    from .fzi_axis import FziAxis  # noqa: PLC0415
    from .third_party import ParameterFile, translate_controller  # noqa: PLC0415

    def build_axes(
        tasks: Mapping[str, "AxisTask"], gains: Mapping[str, "AxisGains"]
    ) -> tuple[list["ControllerStructure"], bool]:
        check_kinds(tasks, options.orientation)
        return [FziAxis(task, gains[name]) for name, task in tasks.items()], False

    def build_file(controller: "Controller", axes: Sequence["TranslatedAxis"]) -> "ParameterFile":
        written = {each.axis: each.written for each in axes}
        places = base_axes(written, options.orientation)
        tree, rate = parameter_tree(controller, {places[axis]: gains for axis, gains in written.items()}, options)
        return ParameterFile(
            content=tree,
            update_rate_hz=rate,
            software="cartesian_controllers (FZI), cartesian_force_controller, branch ros2",
            notes=(*orientation_notes(written, options.orientation, options.base_link), *notes()),
        )

    return translate_controller(source, options.joints, build_axes, build_file, progress)


FZI_CARTESIAN = ExportTarget(
    name="fzi_cartesian",
    summary="parameters of FZI's Cartesian force controller.",
    render=render_translation(translate, FziOptions),
    is_own=begins_with(rb"# Written by autotune \S+ for cartesian_controllers "),
    options=(
        *NAME_OPTIONS,
        ORIENTATION,
    ),
    runs_same_law=False,
    design_options=UPRIGHT,
    following=spawner("cartesian_force_controller"),
)
