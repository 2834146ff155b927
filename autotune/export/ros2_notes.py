"""What must be known of the admittance controller of ros2_controllers beside its parameters."""

from collections.abc import Iterator, Mapping

from autotune.formats.controller_record import RuntimePayload

from .ros2_control import AXES, FIRST_WITH_MASS_IN_CONTROL_FRAME, JOINT_DAMPING_PER_S, Ros2Options, parse_version

FIRST_WITH_WRENCH_REFERENCE = (4, 18, 0)
FIRST_WITHOUT_ROBOT_DESCRIPTION = (4, 3, 0)


def notes(payload: RuntimePayload, tuned: Mapping[str, object], options: Ros2Options) -> Iterator[str]:
    """Say what differs between versions, what the rule does when it fails, and how bias and drift are kept off."""
    version = parse_version(options.version)
    if version < FIRST_WITH_MASS_IN_CONTROL_FRAME:
        yield (
            "admittance.mass is read in the frame of kinematics.base before 6.4.0 (and in the control frame from then "
            "on); x, y, z have one mass here, and so have rx, ry, rz, which holds in any frame."
        )
    if version < FIRST_WITHOUT_ROBOT_DESCRIPTION:
        yield (
            "Before 4.3.0 the controller reads the URDF from its own parameter robot_description, which is not in this "
            "file: add it where the controller is launched."
        )
    yield from _bias_notes(payload, options, has_reference=version >= FIRST_WITH_WRENCH_REFERENCE)
    yield (
        "Where the kinematics plugin reports an error, at a singularity or beyond the reach, the rule commands its "
        "reference in that cycle: the arm jumps by the whole way that it was pushed. Keep the work away from there, "
        "limit the joints' speed below the controller, and reactivate it after a long push: it then starts from there."
    )
    still = [axis for axis in AXES if axis not in tuned]
    if still:
        yield (
            f"{', '.join(still)} {'was' if len(still) == 1 else 'were'} not tuned: no force moves them, and they are "
            "damped and sprung as the tuned ones. Without that the rule, which integrates the joints' speed, would "
            "make a drift of them that no force stops."
        )
    yield (
        f"joint_damping is {JOINT_DAMPING_PER_S:g} 1/s, the controller's default, and part of the damping that is "
        f"certified. filter_coefficient is {options.filter_coefficient:g} per cycle; its default of 0.05 would be a "
        "low-pass far below the loop."
    )


def _bias_notes(payload: RuntimePayload, options: Ros2Options, *, has_reference: bool) -> Iterator[str]:
    """Say how the sensor's bias is taken off."""
    bias = (*payload.force_bias_n, *payload.torque_bias_n_m)
    if not has_reference:
        yield "Before 4.18.0 there is no desired force (~/wrench_reference); the reference alone moves to a contact."
    if not any(bias):
        return
    if has_reference:
        numbers = ", ".join(f"{0.0 - each:g}" for each in bias)
        yield (
            "The controller takes no bias off the wrench, which is a force that moves the arm. What is published on "
            f"~/wrench_reference in the frame {options.sensor_frame} is added to the measured wrench: publish −bias "
            f"there before a contact, ({numbers}) N and N·m, and F^d − bias for a desired force. Until the first "
            "message the bias acts."
        )
    else:
        yield (
            "The controller takes no bias off the wrench, which is a force that moves the arm, and this version has no "
            "~/wrench_reference to add −bias on: take it off in the sensor's driver."
        )
