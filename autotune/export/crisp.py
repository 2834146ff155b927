"""Export to the Cartesian admittance controller of crisp_controllers: its parameter file.

Its rule is `Discretization.EULER`, read in cartesian_admittance_controller.cpp and .yaml of utiasDSL/crisp_controllers
at commit 089d95c.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from .mdk import MdkExport, MdkOptions, MdkProgram, mdk_target
from .ros_yaml import NAME_OPTIONS, ORIENTATION, Tree, managed_parameters

if TYPE_CHECKING:
    from autotune.formats.controller_record import AxisGains

    from .mdk_axis import MdkForm

KNOWN_KEYS = frozenset(
    {
        *("joints", "end_effector_frame", "base_frame", "coupled_se3_integration"),
        *("ft_sensor.topic", "ft_sensor.frame", "variable_admittance_stiffness.enabled"),
        *(
            f"admittance.{what}_{axis}"
            for what in ("mass", "damping", "stiffness")
            for axis in ("x", "y", "z", "rx", "ry", "rz")
        ),
    }
)
"""What is written of the parameters that the controller declares."""
# The declared ranges: what is not tuned gets the upper ends, and the stiffness to which it is clamped by default.
_MASS, _DAMPING, _CLAMPED = (0.001, 100.0), (0.0, 5000.0), {False: 900.0, True: 60.0}


def _form() -> "MdkForm":
    from problems.model.mass_damper_controllers import Discretization  # noqa: PLC0415

    from .mdk_axis import MdkForm  # noqa: PLC0415

    return MdkForm(discretization=Discretization.EULER, mass=_MASS, damping=_DAMPING)


def _check(gains: Mapping[str, "AxisGains"], options: MdkOptions) -> None:
    from .base_axes import check_kinds  # noqa: PLC0415

    check_kinds(gains, options.orientation)


def parameter_tree(made: MdkExport) -> Tree:
    """Return the whole file as a tree."""
    from autotune.formats.units import AXES  # noqa: PLC0415

    from .base_axes import base_axes  # noqa: PLC0415

    written = {axis: each.written for axis, each in made.axes.items()}
    places = base_axes(written, made.options.orientation)
    of_base = {places[axis]: numbers for axis, numbers in written.items()}
    rows: dict[str, float] = {}
    for axis in AXES:
        still = {"mass": _MASS[1], "damping": _DAMPING[1], "stiffness": _CLAMPED[axis.startswith("r")]}
        rows |= {f"{what}_{axis}": value for what, value in dict(of_base.get(axis, still)).items()}
    parameters: Tree = {
        "joints": list(made.options.joints),
        "end_effector_frame": made.options.tip_link,
        "base_frame": made.options.base_link,
        "coupled_se3_integration": False,
        "ft_sensor": {"topic": "ft_sensor_wrench", "frame": made.options.sensor_frame},
        "variable_admittance_stiffness": {"enabled": False},
        "admittance": rows,
    }
    return managed_parameters(
        made.options.controller_name,
        "crisp_controllers/CartesianAdmittanceController",
        made.update_rate_hz,
        parameters,
        KNOWN_KEYS,
    )


def notes(made: MdkExport) -> Iterator[str]:
    """Say what the controller does of itself."""
    from .base_axes import orientation_notes  # noqa: PLC0415

    written = {axis: each.written for axis, each in made.axes.items()}
    yield from orientation_notes(written, made.options.orientation, made.options.base_link)
    yield (
        "The admittance moves a target that this controller's own impedance loop (task.k_pos_*, task.d_pos_*, "
        "filter.*) then follows with torques. That loop is the robot of this certificate: identify with it, as it is "
        "tuned, as the follower of positions. Another stiffness there is another robot."
    )
    still = [axis for axis in ("x", "y", "z", "rx", "ry", "rz") if axis not in written]
    if still:
        yield (
            f"{', '.join(still)} {'was' if len(still) == 1 else 'were'} not tuned; no axis can be left out there, so "
            f"they get the largest mass and damping and a spring of {_CLAMPED[False]:g} N/m ({_CLAMPED[True]:g} "
            "N·m/rad): a push moves them by force over stiffness, and they come back."
        )
    yield (
        "The wrench comes by the topic ft_sensor_wrench, without gravity and bias taken off: do that before it. The "
        "law has no F^d: target_wrench is added to the torques, not to the admittance; press by moving the target."
    )
    yield "limit_error and max_delta_tau cut what the impedance loop does; reaching them is not certified."


CRISP = mdk_target(
    MdkProgram(
        name="crisp",
        summary="parameters of the Cartesian admittance controller of crisp_controllers.",
        software="crisp_controllers, CartesianAdmittanceController (commit 089d95c)",
        form=_form,
        content=parameter_tree,
        notes=notes,
        options=(*NAME_OPTIONS, ORIENTATION),
        check=_check,
    )
)
