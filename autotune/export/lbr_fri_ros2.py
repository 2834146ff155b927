"""Export to the admittance controller of lbr_fri_ros2_stack: its parameter file.

Its rule is `Discretization.FROM_MEASURED`, read in admittance_controller.cpp (commit 00ed924), control.cpp and
filters.hpp of lbr-stack/lbr_fri_ros2_stack at that time.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from autotune.errors import UsageError

from .mdk import MdkExport, MdkOptions, MdkProgram, mdk_target
from .ros_yaml import NAME_OPTIONS, ORIENTATION, SENSOR_NAME, Tree, managed_parameters
from .target import ALL_GAINS, TargetOption

if TYPE_CHECKING:
    from autotune.formats.controller_record import AxisGains

    from .mdk_axis import MdkForm

JOINTS = 7
FILTER_TIME_S = 0.4
"""The least time constant that the controller takes for the filter of the joints' speed."""
KNOWN_KEYS = frozenset(
    {
        *("robot_name", "ft_sensor_name", "admittance.mass", "admittance.damping", "admittance.stiffness"),
        *(
            f"inv_jac_ctrl.{what}"
            for what in (
                *("chain_root", "chain_tip", "damping", "max_linear_velocity", "max_angular_velocity"),
                *("joint_gains", "cartesian_gains"),
            )
        ),
        *("filter.joint_velocity_tau", "on_activate.max_external_force", "on_activate.max_external_torque"),
    }
)
"""Every parameter that the controller declares."""
ROBOT_NAME = TargetOption(
    flag="--robot-name", metavar="NAME", help="The robot's name, which begins its joints' (lbr: lbr_A1 to lbr_A7)."
)
# The pseudo-inverse is damped by this, which takes motion away; the controller's default of 0.2 takes much of it.
_DAMPING = 0.01
_SPEED_M_S, _SPEED_RAD_S = 0.25, 1.25
_STILL = {"mass": 1.0, "damping": 0.0, "stiffness": 0.0}
# How far R may be from its transpose: about a degree.
_SYMMETRIC = 0.02


def _form() -> "MdkForm":
    from problems.model.mass_damper_controllers import Discretization  # noqa: PLC0415

    from .mdk_axis import MdkForm  # noqa: PLC0415

    return MdkForm(discretization=Discretization.FROM_MEASURED, filter_time_s=FILTER_TIME_S)


def _check(gains: Mapping[str, "AxisGains"], options: MdkOptions) -> None:
    """Raise UsageError for turning axes, and for an orientation in which the wrench is turned the wrong way."""
    from .base_axes import MissingOrientationError, right_angles, rotation  # noqa: PLC0415

    turning = [axis for axis in gains if axis.startswith("r")]
    if turning:
        raise UsageError(
            f"That controller divides the turn of a period by no time, so no turning axis ({', '.join(turning)}) can "
            "be certified; name the straight axes with axis in problem.yaml and optimize again."
        )
    must = (
        "That controller turns the wrench by the transpose of the tip's orientation and acts along the base's axes, "
        "which is right only where the two are the same: no turn, or a half turn, such as 1,0,0,0 for a tool that "
        "points down."
    )
    if options.orientation is None:
        raise MissingOrientationError(
            f"{must} Give the sensor's orientation in the base with --orientation QX,QY,QZ,QW."
        )
    right_angles(options.orientation)
    turn = rotation(options.orientation)
    if float(abs(turn - turn.T).max()) > _SYMMETRIC:
        found = ",".join(f"{each:g}" for each in options.orientation)
        raise UsageError(f"{must} The orientation {found} is neither; hold the tool otherwise.")


def parameter_tree(made: MdkExport) -> Tree:
    """Return the whole file as a tree."""
    from .base_axes import base_axes  # noqa: PLC0415

    options, limits = made.options, made.controller.limits
    written = {axis: each.written for axis, each in made.axes.items()}
    places = base_axes(written, options.orientation)
    of_base = {places[axis]: numbers for axis, numbers in written.items()}
    rows = {
        what: [of_base[axis][what] if axis in of_base else still for axis in ("x", "y", "z", "rx", "ry", "rz")]
        for what, still in _STILL.items()
    }
    speeds = [] if limits is None else [each.speed for axis, each in limits.axes.items() if axis in made.axes]
    parameters: Tree = {
        "robot_name": options.robot_name,
        "ft_sensor_name": options.sensor_name,
        "admittance": rows,
        "inv_jac_ctrl": {
            "chain_root": options.base_link,
            "chain_tip": options.tip_link,
            "damping": _DAMPING,
            "max_linear_velocity": max(speeds, default=_SPEED_M_S),
            "max_angular_velocity": _SPEED_RAD_S,
            "joint_gains": [1.0] * JOINTS,
            "cartesian_gains": [1.0 if axis in of_base else 0.0 for axis in ("x", "y", "z", "rx", "ry", "rz")],
        },
        "filter": {"joint_velocity_tau": FILTER_TIME_S},
        "on_activate": {
            "max_external_force": 5.0 if limits is None else limits.rest_force_n,
            "max_external_torque": 1.0 if limits is None else limits.rest_torque_n_m,
        },
    }
    return managed_parameters(
        options.controller_name, "lbr_ros2_control/AdmittanceController", made.update_rate_hz, parameters, KNOWN_KEYS
    )


def notes(made: MdkExport) -> Iterator[str]:
    """Say what the controller does of itself."""
    from .base_axes import orientation_notes  # noqa: PLC0415

    written = {axis: each.written for axis, each in made.axes.items()}
    yield from orientation_notes(written, made.options.orientation, made.options.base_link)
    yield (
        f"The joints' speed passes a low-pass of {FILTER_TIME_S:g} s, the least that this controller takes; it "
        "is part of what is certified, and its default."
    )
    yield (
        "cartesian_gains of 0 keep the axes that were not tuned where they are; max_linear_velocity cuts the speed "
        "and is not certified where it does."
    )
    yield (
        "The wrench must be that of the sensor that was identified, with weight and bias taken off, along the axes of "
        "the tip; the controller's own estimated_wrench_interface is another sensor."
    )


LBR_FRI_ROS2 = mdk_target(
    MdkProgram(
        name="lbr_fri_ros2",
        summary="parameters of the admittance controller of lbr_fri_ros2_stack.",
        software="lbr_fri_ros2_stack, lbr_ros2_control AdmittanceController (commit 00ed924)",
        form=_form,
        content=parameter_tree,
        notes=notes,
        options=(*(each for each in NAME_OPTIONS if each.flag != "--joints"), SENSOR_NAME, ROBOT_NAME, ORIENTATION),
        check=_check,
        expresses=ALL_GAINS,
        joints=lambda options: tuple(f"{options.robot_name}_A{i}" for i in range(1, JOINTS + 1)),
    )
)
