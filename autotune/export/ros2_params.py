"""Export to a ROS 2 parameter file with gains, limits, payload and checksum, for a node of one's own."""

import shlex
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from autotune.version import __version__

from .ros_yaml import check_names, dump_parameters
from .target import ExportRequest, ExportTarget, Rendered, TargetOption, begins_with

_ANY_NODE = "/**"
_PARTS = (
    *("sample_time_s", "delay_samples", "discretization", "axes", "filters", "compensation_mass_kg"),
    *("collision", "variable_damping", "payload", "limits"),
)
_COUNTS = ("rest_samples",)


def render(request: ExportRequest) -> Rendered:
    """Return the parameter file: the numbers that a step needs, under the names and in the units of controller.yaml."""
    from autotune.formats.canonical import short  # noqa: PLC0415
    from autotune.formats.controller import controller_tree  # noqa: PLC0415
    from autotune.runtime.load import read_law  # noqa: PLC0415

    node = request.options.get("node_name", _ANY_NODE)
    if node != _ANY_NODE:
        check_names("--node-name", (node,))
    source = request.source
    # Files of an earlier release have no limits; the runtime's are written for them.
    tree = {"limits": asdict(read_law(source.path).limits), **controller_tree(source.controller)}
    parameters = {
        "checksum": source.checksum,
        "tuned_axes": list(source.controller.axes),
        **{name: _parameter(name, tree[name]) for name in _PARTS if tree.get(name) is not None},
    }
    comments = (
        f"Written by autotune {__version__} as parameters of a node of your own.",
        f"Source: {source.path.name} with checksum {short(source.checksum)}.",
        "Units are SI; about rx, ry, rz rad and N·m.",
        (
            "Certified is the step of autotune.runtime (docs/runtime.md) with these limits, once per sample_time_s. A "
            "node that runs another one is not certified: compare its commands with those of the Python runtime or the "
            "C export on recorded readings before the first contact."
        ),
        "",
    )
    return Rendered(texts=(dump_parameters({node: {"ros__parameters": parameters}}, comments),))


def _parameter(name: str, value: Any) -> Any:
    """Return a value as ROS takes it: no reasons, no noise, nothing without a value; what is no count is a double."""
    if isinstance(value, Mapping):
        kept = {key: each for key, each in value.items() if each is not None and key not in ("noise", "reasons")}
        return {key: _parameter(key, each) for key, each in kept.items()}
    if isinstance(value, list | tuple):
        return [_parameter(name, each) for each in value]
    if isinstance(value, int | float) and name not in _COUNTS:
        return float(value)
    return value


def _load(request: ExportRequest) -> str:
    """Return the command that gives the parameters to the node that was named, or to one of any name."""
    return shlex.join(["ros2", "param", "load", request.options.get("node_name", "/my_node"), str(request.out)])


ROS2_PARAMS = ExportTarget(
    name="ros2_params",
    summary="gains, limits, payload and checksum as ROS 2 parameters of a node of your own.",
    render=render,
    is_own=begins_with(rb"# Written by autotune \S+ as parameters of a node of your own\."),
    options=(TargetOption(flag="--node-name", metavar="NAME", help="The node that reads the file (any node: /**)."),),
    following=_load,
)
