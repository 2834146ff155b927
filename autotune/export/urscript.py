"""Export to the admittance script that Universal Robots publishes: a call of it with the certified numbers.

Its rule is `Discretization.TRAPEZOIDAL`, read in admittance-control/admittance_control.script of
UniversalRobots/URScript_Examples at commit a16766a; docs/targets.md says what differs before it.
"""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from autotune.formats.units import AXES

from .mdk import MdkExport, MdkProgram, mdk_target

if TYPE_CHECKING:
    from .mdk_axis import MdkForm

STEP_TIME_S = 0.002
"""The period of a script on an e-Series controller, 500 Hz."""
SCRIPT_ACCELERATION = {"straight": 5.0, "turning": 45.0}
"""What the script gives `speedl` as the largest acceleration (m/s², rad/s²)."""
# A mass for axes that no force moves.
_STILL_MASS, _STILL_DAMPING = 1.0, 100.0


def _form() -> "MdkForm":
    from problems.model.mass_damper_controllers import Discretization  # noqa: PLC0415

    from .mdk_axis import MdkForm  # noqa: PLC0415

    return MdkForm(discretization=Discretization.TRAPEZOIDAL, keeps_deadband=True)


def deadbands(made: MdkExport) -> tuple[float, float]:
    """Return the deadband of force and torque: the largest of the tuned axes, 0 where the peak force is limited.

    The script subtracts it, so a contact of F^d settles at F^d and the deadband more.
    """
    force, torque = 0.0, 0.0
    for kind in (AXES[:3], AXES[3:]):
        tuned = [axis for axis in kind if axis in made.controller.axes]
        asked = [made.controller.certificate.requirements_of(axis) or {} for axis in tuned]
        if not any("max_peak_force_n" in each for each in asked):
            widest = max((made.controller.axes[axis].deadband for axis in tuned), default=0.0)
            force, torque = (widest, torque) if kind == AXES[:3] else (force, widest)
    return force, torque


def script(made: MdkExport) -> str:
    """Return the script: the payload, the flange's orientation at the start, and the call."""
    payload, axes = made.controller.payload, made.axes
    numbers = {
        "mass_list": list(made.numbers("mass", _STILL_MASS).values()),
        "damping_list": list(made.numbers("damping", _STILL_DAMPING).values()),
        "dead_band": [*deadbands(made), 0.0, 0.0],
        "compliance_vector": [float(axis in axes) for axis in made.numbers("mass", 0.0)],
        "stiffness_params": list(made.numbers("stiffness", 0.0).values()),
        "target_wrench": [0.0] * 6,
    }
    arguments = ", ".join(
        (
            "mass_scaling = 1, damping_scaling = 1",
            *(f"{name} = {_listed(values)}" for name, values in numbers.items()),
            "base_to_compliance_frame = p[0, 0, 0, flange[3], flange[4], flange[5]]",
            "tool_flange_to_compliance_center = p[0, 0, 0, 0, 0, 0]",
        )
    )
    return "\n".join(
        (
            "def autotune_admittance():",
            f"  set_target_payload({payload.mass_kg:.9g}, {_listed(payload.com_m)})",
            "  local flange = pose_trans(get_target_tcp_pose(), pose_inv(get_tcp_offset()))",
            f"  admittance_control({arguments})",
            "end",
            "autotune_admittance()",
        )
    )


def _listed(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{each:.9g}' for each in values)}]"


def needed_accelerations(made: MdkExport) -> Mapping[str, float]:
    """Return by tuned axis the most that its speed changes per second in the certified contacts, from above.

    M a = F^d + F − D v, where D v is of the sign of F^d − |F| and never above F^d.
    """
    found = {}
    for axis, each in made.axes.items():
        assert each.certificate.worst is not None  # a certificate that holds has one
        found[axis] = each.certificate.worst.peak_sensor_force_n / each.written["mass"]
    return found


def notes(made: MdkExport) -> Iterator[str]:
    """Say what goes before this script, what must be set at the robot, and what the script does of itself."""
    yield (
        "This is the call alone. Put admittance_control.script of UniversalRobots/URScript_Examples (commit a16766a) "
        "in front of it, without the lines below '# Run the admittance control function' at its end, which start it "
        "with other numbers. Before that commit the argument target_wrench is called force_target."
    )
    for axis, needed in needed_accelerations(made).items():
        kind = "turning" if axis.startswith("r") else "straight"
        name, unit = ("aRot", "rad/s²") if kind == "turning" else ("a", "m/s²")
        if needed > SCRIPT_ACCELERATION[kind]:
            yield (
                f"axis {axis}: in the hardest certified contact the speed changes by up to {needed:.3g} {unit}, and "
                f"speedl allows {name} = {SCRIPT_ACCELERATION[kind]:g} there: RAISE {name} in the last line of that "
                f"script to at least {needed * 1.2:.2g}. Below that the robot lags what is certified."
            )
    force, torque = deadbands(made)
    if force or torque:
        yield (
            f"The deadband ({force:g} N, {torque:g} N·m) is subtracted, not a threshold: a contact settles that much "
            "above F^d, and each certified peak rises by the same share at most. Before commit a16766a the script "
            "subtracts the whole smooth band besides, which is 0 here."
        )
    yield (
        "The axes are those of the tool flange as it is turned when the script starts; after turning the tool, start "
        "it again. zero_ftsensor() at its start takes weight and bias off at that orientation, and set_target_payload "
        "the weight from then on: start with nothing touching the tool."
    )
    yield (
        "The command is a speed for one step of 2 ms. It is certified as a position that follows it within the step; "
        "identify the robot with speedl as well, where it answers later than to positions. target_wrench is −F^d. "
        "stiffness_params is 0; a spring there is not certified."
    )


URSCRIPT = mdk_target(
    MdkProgram(
        name="urscript",
        summary="a call of Universal Robots' admittance_control script.",
        software="admittance_control.script of UniversalRobots/URScript_Examples (commit a16766a), e-Series",
        form=_form,
        content=script,
        notes=notes,
        sample_time_s=STEP_TIME_S,
        suffix=".script",
        following=lambda request: f"cat admittance_control.script {shlex.quote(str(request.out))} > program.script",
    )
)
