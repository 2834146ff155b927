"""Export to the admittance rule of cartesian_vic_controller (cartesian_controllers_ros2): its parameter file.

Its rule is `Discretization.MEASURED_MOTION`, read in vanilla_cartesian_admittance_rule.cpp (commit 052b780) and
cartesian_vic_controller_parameters.yaml (commit 04dd1d4) of ICube-Robotics/cartesian_controllers_ros2.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from .mdk import MdkExport, MdkProgram, mdk_target
from .ros_yaml import CONTROL_FRAME, INVERSE_DAMPING, NAME_OPTIONS, SENSOR_NAME, Tree, managed_parameters

if TYPE_CHECKING:
    from .mdk_axis import MdkForm

STANDARD_GRAVITY = 9.80665
KNOWN_KEYS = frozenset(
    {
        *("joints", "command_interfaces", "state_interfaces", "enable_parameter_update_without_reactivation"),
        *(
            f"filters.{what}_cuttoff_freq"
            for what in ("state_position_filter", "state_velocity_filter", "command_filter", "ft_sensor_filter")
        ),
        *(f"dynamics.{what}" for what in ("plugin_name", "plugin_package", "base", "tip", "alpha")),
        *("ft_sensor.is_enabled", "ft_sensor.name", "ft_sensor.frame.id"),
        *("control.frame.id", "fixed_world_frame.frame.id", "gravity_compensation.frame.id"),
        *("gravity_compensation.CoG.pos", "gravity_compensation.CoG.force"),
        *("vic.frame.id", "vic.plugin_name", "vic.plugin_package", "vic.selected_axes"),
        *("vic.inertia", "vic.damping_ratio", "vic.stiffness"),
    }
)
"""What is written of the parameters that the controller declares."""
# The declared ranges of inertia, damping ratio and stiffness; what is not tuned gets the upper ends.
_INERTIA, _MOST_RATIO, _MOST_STIFFNESS = (1e-4, 1e6), 5.0, 1000.0
_NO_FILTER = -1.0


def _form() -> "MdkForm":
    from problems.model.mass_damper_controllers import Discretization  # noqa: PLC0415

    from .mdk_axis import MdkForm  # noqa: PLC0415

    return MdkForm(
        discretization=Discretization.MEASURED_MOTION,
        mass=_INERTIA,
        most_damping_ratio=_MOST_RATIO,
        most_stiffness=_MOST_STIFFNESS,
    )


def parameter_tree(made: MdkExport) -> Tree:
    """Return the whole file as a tree."""
    options, payload = made.options, made.controller.payload
    frame = options.sensor_frame
    parameters: Tree = {
        "joints": list(options.joints),
        "command_interfaces": ["position"],
        "state_interfaces": ["position", "velocity"],
        "filters": {
            f"{what}_cuttoff_freq": _NO_FILTER
            for what in ("state_position_filter", "state_velocity_filter", "command_filter", "ft_sensor_filter")
        },
        "dynamics": {
            "plugin_name": "dynamics_interface_kdl/DynamicsInterfaceKDL",
            "plugin_package": "dynamics_interface",
            "base": options.base_link,
            "tip": options.tip_link,
            "alpha": INVERSE_DAMPING,
        },
        "ft_sensor": {"is_enabled": True, "name": options.sensor_name, "frame": {"id": frame}},
        "control": {"frame": {"id": options.control_frame or frame}},
        "fixed_world_frame": {"frame": {"id": options.base_link}},
        "gravity_compensation": {
            "frame": {"id": frame},
            "CoG": {"pos": list(payload.com_m), "force": float(f"{payload.mass_kg * STANDARD_GRAVITY:.9g}")},
        },
        "vic": {
            "frame": {"id": options.control_frame or frame},
            "plugin_name": "cartesian_vic_controller/VanillaCartesianAdmittanceRule",
            "plugin_package": "cartesian_vic_controller",
            "selected_axes": [axis in made.axes for axis in made.numbers("mass", 0.0)],
            "inertia": list(made.numbers("mass", _INERTIA[1]).values()),
            "damping_ratio": list(made.numbers("damping_ratio", _MOST_RATIO).values()),
            "stiffness": list(made.numbers("stiffness", _MOST_STIFFNESS).values()),
        },
        "enable_parameter_update_without_reactivation": False,
    }
    return managed_parameters(
        options.controller_name,
        "cartesian_vic_controller/CartesianVicController",
        made.update_rate_hz,
        parameters,
        KNOWN_KEYS,
    )


def notes(made: MdkExport) -> Iterator[str]:
    """Say what the controller does of itself."""
    yield (
        "The damping there acts on the measured speed, the change of the measured position over one period in what is "
        "certified. A driver that filters its speeds is later than that: the delay margin must cover it. All filters "
        "of the controller are off (-1); its default of 100 Hz on position and speed is another law."
    )
    still = [axis for axis in ("x", "y", "z", "rx", "ry", "rz") if axis not in made.axes]
    if still:
        yield (
            f"{', '.join(still)} {'was' if len(still) == 1 else 'were'} not tuned. The rule that was read does not "
            "look at selected_axes, so they get the largest inertia, damping ratio and stiffness that it takes."
        )
    payload = made.controller.payload
    if any((*payload.force_bias_n, *payload.torque_bias_n_m)):
        yield "The controller takes the weight off the wrench, and no bias: take that off in the sensor's driver."
    yield (
        "Where the Jacobian's singular values are more than 30 apart, or no wrench arrives, the rule reports an error "
        "and the arm holds: keep the work away from singularities. vic.frame turns with the tool: gains are along it."
    )


CARTESIAN_VIC = mdk_target(
    MdkProgram(
        name="cartesian_vic",
        summary="parameters of the admittance rule of cartesian_vic_controller.",
        software="cartesian_controllers_ros2, cartesian_vic_controller (ICube, commit 04dd1d4)",
        form=_form,
        content=parameter_tree,
        notes=notes,
        options=(*NAME_OPTIONS, SENSOR_NAME, CONTROL_FRAME),
    )
)
