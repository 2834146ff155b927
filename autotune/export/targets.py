"""The table of export targets; a new target is a module with a `ExportTarget`, and its import and entry here."""

from collections.abc import Mapping

from problems.frozen import FrozenDict

from .cartesian_vic import CARTESIAN_VIC
from .crisp import CRISP
from .fzi_cartesian import FZI_CARTESIAN
from .lbr_fri_ros2 import LBR_FRI_ROS2
from .matlab import MAT
from .own_formats import CELL, JSON, C
from .ros2_control import ROS2_CONTROL
from .ros2_package import ROS2_PACKAGE
from .ros2_params import ROS2_PARAMS
from .target import ExportTarget, TargetOption
from .urscript import URSCRIPT

TARGETS: Mapping[str, ExportTarget] = FrozenDict(
    {
        each.name: each
        for each in (
            CELL,
            JSON,
            C,
            MAT,
            ROS2_CONTROL,
            FZI_CARTESIAN,
            URSCRIPT,
            LBR_FRI_ROS2,
            CRISP,
            CARTESIAN_VIC,
            ROS2_PARAMS,
            ROS2_PACKAGE,
        )
    }
)


def target_options() -> Mapping[TargetOption, tuple[str, ...]]:
    """Return every option of the targets, each with the names of the targets that take it."""
    found = dict[TargetOption, tuple[str, ...]]()
    for target in TARGETS.values():
        for option in target.options:
            found[option] = (*found.get(option, ()), target.name)
    return found
