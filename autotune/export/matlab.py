"""The `mat` target: plant and exact sampled loop of every axis as a MATLAB file."""

import shlex
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .target import ExportRequest, ExportTarget, Rendered

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller

_MARK = "MATLAB 5.0 MAT-file, written by autotune export --target mat"
_TEXT_BYTES = 116
"""The text at the head of a MATLAB file, in which scipy writes the time of day."""
_SAMPLED = ("at_force", "at_command", "closed_loop")


def _render(request: ExportRequest) -> Rendered:
    from scipy.io import savemat  # noqa: PLC0415

    controller = request.source.controller
    tree = {
        "checksum": request.source.checksum,
        "sample_time_s": controller.sample_time_s,
        **{f"axis_{name}": _axis(controller, name) for name in controller.axes},
    }
    stream = BytesIO()
    savemat(stream, tree, long_field_names=True)
    return Rendered(texts=(_MARK.encode().ljust(_TEXT_BYTES) + stream.getvalue()[_TEXT_BYTES:],))


def _axis(controller: "Controller", name: str) -> dict[str, Any]:
    """Return gains, and plant and loops in contact (stiff end of K_e, lightest payload) and in free space."""
    from autotune.formats.controller_record import admittance_controller  # noqa: PLC0415
    from problems.design.uncertainty import Scenario  # noqa: PLC0415
    from problems.model.plant import FREE_SPACE  # noqa: PLC0415

    law, domain = admittance_controller(controller, name), controller.certificate.domain[name]
    stiffest = Scenario(
        environment_stiffness_n_per_m=domain.environment_stiffness_n_per_m[1],
        payload_mass_kg=domain.payload_mass_kg[0],
    )
    contact = stiffest.plant(domain.plants.nominal)
    own = controller.axes[name]
    gains: dict[str, Any] = {
        "mass": own.mass,
        "damping": own.damping,
        "lead_s": own.lead_s,
        "feedback_damping_s": own.feedback_damping_s,
    }
    if own.biquad is not None:
        gains["biquad"] = asdict(own.biquad)
    plants = {"contact": contact, "free_space": contact.in_contact_with(FREE_SPACE)}
    return {
        "gains": gains,
        "environment_stiffness": stiffest.environment_stiffness_n_per_m,
        "payload_mass": stiffest.payload_mass_kg,
        **{key: _loop(plant, law, controller.sample_time_s) for key, plant in plants.items()},
    }


def _loop(plant: Any, law: Any, sample_time_s: float) -> dict[str, Any]:
    """Return the continuous blocks as `num` and `den`, the sampled loops as matrices, by the names of `to_control`."""
    from problems.model.python_control import BLOCKS, to_control  # noqa: PLC0415 - python-control takes seconds to import
    from problems.model.sampled import build_sampled_plant  # noqa: PLC0415

    objects = to_control(build_sampled_plant(plant, sample_time_s), law)
    blocks = {}
    for name in BLOCKS:
        system = getattr(objects, name)
        blocks[name] = {"num": system.num[0][0], "den": system.den[0][0]}
    sampled = {}
    for name in _SAMPLED:
        system = getattr(objects, name)
        sampled[name] = {
            **{matrix: getattr(system, matrix) for matrix in "ABCD"},
            "Ts": sample_time_s,
            "inputs": ",".join(system.input_labels),
            "outputs": ",".join(system.output_labels),
        }
    return {**blocks, "delay_s": objects.delay_s, "wrench_delay_s": objects.wrench_delay_s, **sampled}


def _is_own(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(_MARK)) == _MARK.encode()


MAT = ExportTarget(
    name="mat",
    summary="plant and exact sampled loop of every axis for MATLAB.",
    render=_render,
    is_own=_is_own,
    following=lambda request: shlex.join(["matlab", "-r", f"load -mat {request.out}"]),
)
