"""What `optimize` and `validate` tell of the limits that the runtime enforces."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller


def limit_lines(controller: "Controller") -> Iterator[str]:
    """Say in two lines what a reading and a command must stay within; nothing for a file without limits."""
    from autotune.formats.units import axis_units

    limits = controller.limits
    if limits is None:
        return
    commands = ", ".join(
        f"{name} {each.speed:g} {axis_units(name).speed} and {each.acceleration:g} {axis_units(name).speed}²"
        for name, each in limits.axes.items()
    )
    yield f"limits of the runtime: sensor ±{limits.force_n:g} N and ±{limits.torque_n_m:g} N·m; command {commands}"
    yield (
        f"  pose {limits.pose_speed_m_s:g} m/s and {limits.pose_speed_rad_s:g} rad/s; unchanged under a moving command "
        f"{limits.stale_wrench_s:g} s (wrench), {limits.stale_pose_s:g} s (pose); left over at the start "
        f"{limits.rest_force_n:g} N and {limits.rest_torque_n_m:g} N·m of {limits.rest_samples} readings"
    )
