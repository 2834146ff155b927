"""What a log cannot say of itself: topics, layouts, units, signs, frames and what was done before recording."""

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

import numpy as np

from problems.contact.nonlinearities import DeadbandType
from problems.errors import ParameterError, require_extra
from problems.frozen import NO_ENTRY, Rule, freeze

from ...signals.recording import AXES
from ..tables.layout import TableLayout
from .orientation import NORM_TOLERANCE, is_rotation, of_pose_matrix, orientation_width

# Units in which logs are written, each as so much of its SI unit.
FORCE_N: Mapping[str, float] = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665}
_METRIC_N_M = {"N·m": 1.0, "Nm": 1.0, "N·mm": 1e-3, "Nmm": 1e-3, "kN·m": 1e3, "kNm": 1e3}
_LBF_N_M = {"lbf·in": 4.4482216152605 * 0.0254, "lbf·ft": 4.4482216152605 * 0.3048}
TORQUE_N_M: Mapping[str, float] = _METRIC_N_M | _LBF_N_M
LENGTH_M: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
ANGLE_RAD: Mapping[str, float] = {"rad": 1.0, "deg": 0.017453292519943295}
_SLICE = re.compile(r"(.*)\[(\d{1,4}):(\d{1,4})\]")
_Text = Annotated[str, Rule(minLength=1)]
_A_PATH = Rule(description="a path such as effort[0], or null for an axis that is not logged", minLength=1)
Paths = tuple[Annotated[str | None, _A_PATH], ...]
"""Paths of the numbers of a vector in a message; None for an axis that the log does not have."""
_THREE, _SIX, _SOME = Rule(minItems=1, maxItems=3), Rule(minItems=1, maxItems=6), Rule(minItems=1)
_OF_FILES = Rule(description="the same for single files, by their names")
_OF_3, _OF_6 = Rule(minItems=3, maxItems=3), Rule(minItems=6, maxItems=6)
_Above0 = Annotated[float, Rule(exclusiveMinimum=0)]
_Sign = Annotated[float, Rule(description="1 or -1", enum=[1, -1])]
_Force = Annotated[str, Rule(enum=[*FORCE_N])]
_Torque = Annotated[str, Rule(enum=[*TORQUE_N_M])]
_Length = Annotated[str, Rule(enum=[*LENGTH_M])]
_Angle = Annotated[str, Rule(enum=[*ANGLE_RAD])]
_Coordinate = Annotated[float, Rule(minimum=-5, maximum=5)]


def check_unit(name: str, unit: str, known: Collection[str]) -> None:
    """Raise ParameterError for a unit that is not known."""
    if unit not in known:
        raise ParameterError(name, unit, f"one of {', '.join(known)}")


class _Units:
    """Units of a channel, each of those that its type names."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            check_unit(name, getattr(self, name), get_args(hint)[1]["enum"])


def _expand(vectors: object, **widths: int) -> None:
    """Write slices such as `effort[0:3]` in the vectors of a record out, and check how many paths each then has."""
    for name, width in widths.items():
        paths: list[str | None] = []
        for path in getattr(vectors, name):
            found = None if path is None else _SLICE.fullmatch(path)
            entries = () if found is None else range(int(found[2]), int(found[3]))
            paths += [path] if found is None else [f"{found[1]}[{index}]" for index in entries]
        if width and len(paths) != width:
            raise ParameterError(name, f"{len(paths)} paths", f"{width} paths (a slice such as effort[0:3] is three)")
        object.__setattr__(vectors, name, tuple(paths))


class Clock(StrEnum):
    """Which clock stamps a channel: that of the sender's header or that of the recorder."""

    HEADER = "header"
    LOG = "log"


class Frame(StrEnum):
    """In whose axes a vector is written."""

    SENSOR = "sensor"
    FLANGE = "flange"
    BASE = "base"


class ExertedBy(StrEnum):
    """Whose force a wrench is: the payload's on the sensor, or the sensor's on the payload."""

    PAYLOAD = "payload"
    SENSOR = "sensor"


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which channel serves a role; None where it is to be found.

    `frame` is the frame that the headers must name; `header` the path of the header in a message; `clock_offset_s` is
    added to the stamps to bring them to the wrench's clock.
    """

    topic: _Text | None = None
    frame: _Text | None = None
    header: str | None = None
    clock: Clock | None = None
    clock_offset_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class WrenchFields:
    """Paths of force and torque, three each."""

    force: Annotated[Paths, _THREE]
    torque: Annotated[Paths, _THREE] = (None, None, None)

    def __post_init__(self) -> None:
        _expand(self, force=3, torque=3)


@dataclass(frozen=True, kw_only=True)
class WrenchUnits(_Units):
    """Units of a wrench."""

    force: _Force = "N"
    torque: _Torque = "N·m"


@dataclass(frozen=True, kw_only=True)
class DeclaredDeadband:
    """A deadband applied before recording; a width is None where it is not known."""

    type: DeadbandType
    force_n: _Above0 | None = None
    torque_n_m: _Above0 | None = None


@dataclass(frozen=True, kw_only=True)
class Saturation:
    """The sensor's range: the largest magnitude per axis that it measures."""

    force_n: tuple[_Above0, _Above0, _Above0] | None = None
    torque_n_m: tuple[_Above0, _Above0, _Above0] | None = None


@dataclass(frozen=True, kw_only=True)
class WrenchSource(Source):
    """The wrench: its channel, and how its numbers become the payload's wrench on the sensor in the sensor frame.

    `expressed_in` None is the sensor frame, `exerted_by` None the payload and `gravity_compensated` None is False,
    unless the message type says else. `left_out` are axes (x to rz) that the sensor does not measure.
    """

    fields: WrenchFields | None = None
    units: WrenchUnits = field(default_factory=WrenchUnits)
    signs: Annotated[tuple[_Sign, ...], _OF_6] = (1.0,) * 6
    expressed_in: Frame | None = None
    exerted_by: ExertedBy | None = None
    gravity_compensated: bool | None = None
    left_out: Annotated[tuple[Annotated[str, Rule(enum=[*AXES])], ...], Rule(maxItems=6, uniqueItems=True)] = ()
    deadband: DeclaredDeadband | None = None
    saturation: Saturation = field(default_factory=Saturation)

    def __post_init__(self) -> None:
        unknown = [axis for axis in self.left_out if axis not in AXES]
        if unknown:
            raise ParameterError("left_out", unknown[0], f"one of {', '.join(AXES)}")


@dataclass(frozen=True, kw_only=True)
class DesiredForceSource(WrenchSource):
    """F^d: where it is logged, or its constant value in `units`, a torque too where there is one."""

    left_out: Annotated[tuple[str, ...], NO_ENTRY] = ()
    saturation: Annotated[Saturation, NO_ENTRY] = field(default_factory=Saturation)
    force: tuple[float, float, float] | None = None
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_known(self) -> bool:
        """Whether the value is declared, and no channel is looked for."""
        return self.force is not None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.is_known and (self.topic is not None or self.fields is not None):
            raise ParameterError("force", "a known force", "left out where topic or fields say where it is logged")


@dataclass(frozen=True, kw_only=True)
class PoseFields:
    """Paths of position (three) and orientation (3, 4 or 9, or the 16 of a pose that is written as one matrix).

    Without position all that is known of a pose is its orientation.
    """

    RULE: ClassVar = Rule(minProperties=1)

    position: Annotated[Paths, _THREE] = ()
    orientation: Annotated[tuple[_Text, ...], Rule(minItems=1, maxItems=16)] = ()

    def __post_init__(self) -> None:
        _expand(self, position=3 if self.position else 0, orientation=0)
        if not (self.position or self.orientation):
            raise ParameterError("position", "nothing", "named, or `orientation` where no position was logged")
        if not self.position and len(self.orientation) != 16:
            object.__setattr__(self, "position", (None,) * 3)


@dataclass(frozen=True, kw_only=True)
class PoseUnits(_Units):
    """Units of a pose; `angle` is that of Euler angles and rotation vectors."""

    position: _Length = "m"
    angle: _Angle = "rad"


@dataclass(frozen=True, kw_only=True)
class PoseSource(Source):
    """A pose: its channel or its pair of transform frames (`child` in `parent`), and how its numbers are meant.

    `signs` are those of the position.
    """

    parent: _Text | None = None
    child: _Text | None = None
    fields: PoseFields | None = None
    units: PoseUnits = field(default_factory=PoseUnits)
    signs: Annotated[tuple[_Sign, ...], _OF_3] = (1.0,) * 3
    orientation_as: _Text = "quaternion_xyzw"

    def __post_init__(self) -> None:
        width = orientation_width(self.orientation_as)
        fields = self.fields
        if fields is not None and len(fields.orientation) == 16 and width == 9:
            position, turn = of_pose_matrix(fields.orientation, self.orientation_as)
            object.__setattr__(self, "fields", PoseFields(position=fields.position or position, orientation=turn))
        count = 0 if self.fields is None else len(self.fields.orientation)
        if count not in (0, width):
            raise ParameterError(
                "orientation_as", self.orientation_as, f"of {count} numbers, as fields.orientation has"
            )
        if (self.parent is None) != (self.child is None):
            missing = "parent" if self.parent is None else "child"
            raise ParameterError(missing, "nothing", "named too: a transform needs parent and child")


@dataclass(frozen=True, kw_only=True)
class TwistFields:
    """Paths of linear and angular velocity, three each."""

    linear: Annotated[Paths, _THREE]
    angular: Annotated[Paths, _THREE] = (None, None, None)

    def __post_init__(self) -> None:
        _expand(self, linear=3, angular=3)


@dataclass(frozen=True, kw_only=True)
class TwistUnits(_Units):
    """Units of a twist, per second: of the lengths and of the angles."""

    linear: _Length = "m"
    angular: _Angle = "rad"


@dataclass(frozen=True, kw_only=True)
class TwistSource(Source):
    """The flange's twist."""

    fields: TwistFields | None = None
    units: TwistUnits = field(default_factory=TwistUnits)
    signs: Annotated[tuple[_Sign, ...], _OF_6] = (1.0,) * 6
    expressed_in: Frame = Frame.BASE


@dataclass(frozen=True, kw_only=True)
class GainsFields:
    """Paths of M_a and B_a, six each."""

    mass: Annotated[Paths, _SIX]
    damping: Annotated[Paths, _SIX]

    def __post_init__(self) -> None:
        _expand(self, mass=6, damping=6)


@dataclass(frozen=True, kw_only=True)
class GainsSource(Source):
    """The controller's gains: where they are logged, or their constant values in SI of each axis.

    `lead` is K_l [s] of each axis, None where it is not known; `deadband` what the controller takes off the logged
    force before it acts on it.
    """

    fields: GainsFields | None = None
    mass: Annotated[tuple[_Above0, ...] | None, _OF_6] = None
    damping: Annotated[tuple[_Above0, ...] | None, _OF_6] = None
    lead: Annotated[tuple[Annotated[float, Rule(minimum=0)], ...] | None, _OF_6] = None
    deadband: DeclaredDeadband | None = None

    @property
    def is_known(self) -> bool:
        """Whether the values are declared, and no channel is looked for."""
        return self.mass is not None

    def __post_init__(self) -> None:
        if (self.mass is None) != (self.damping is None):
            missing = "mass" if self.mass is None else "damping"
            raise ParameterError(missing, None, "given: known gains are mass and damping")
        if self.mass is not None and (self.topic is not None or self.fields is not None):
            raise ParameterError("mass", "known gains", "left out where topic or fields say where they are logged")


@dataclass(frozen=True, kw_only=True)
class JointsSource(Source):
    """Joint positions [rad, m], and the URDF through which they are a pose: that of the link `tip` in `base`.

    `positions` are their paths in the order from base to tip; of a JointState they are found by the joints' names.
    `base` None is the robot's root, `angle` the unit of what turns. `command_topic` and `command_positions` are those
    of the commanded joints.
    """

    frame: Annotated[str | None, NO_ENTRY] = None
    urdf: Annotated[Path, Rule(minLength=1)]
    tip: _Text
    base: _Text | None = None
    positions: Annotated[tuple[_Text, ...], _SOME] = ()
    angle: _Angle = "rad"
    command_topic: _Text | None = None
    command_positions: Annotated[tuple[_Text, ...], _SOME] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "urdf", Path(self.urdf))
        check_unit("angle", self.angle, ANGLE_RAD)
        _expand(self, positions=0, command_positions=0)


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """How the sensor sits on the flange: flange from sensor, written as `orientation_as`; () for no turn."""

    orientation: Annotated[tuple[float, ...], Rule(minItems=3, maxItems=9)] = ()
    orientation_as: _Text = "quaternion_xyzw"
    angle: _Angle = "rad"

    def __post_init__(self) -> None:
        width = orientation_width(self.orientation_as)
        if len(self.orientation) not in (0, width):
            raise ParameterError(
                "orientation", list(self.orientation), f"{width} numbers, as {self.orientation_as} has"
            )
        norm = math.hypot(*self.orientation)
        if len(self.orientation) == 4 and abs(norm - 1.0) > NORM_TOLERANCE:
            raise ParameterError("orientation", list(self.orientation), f"a unit quaternion (its norm is {norm:.6g})")
        if len(self.orientation) == 9 and not bool(is_rotation(np.array([self.orientation]))[0]):
            raise ParameterError("orientation", list(self.orientation), "a rotation matrix (orthonormal, no mirror)")
        check_unit("angle", self.angle, ANGLE_RAD)


@dataclass(frozen=True, kw_only=True)
class DeclaredPayload:
    """Where the payload may touch: points [m] in the sensor frame; () for the box that has its inertia."""

    contact_points_m: Annotated[tuple[tuple[_Coordinate, _Coordinate, _Coordinate], ...], Rule(maxItems=64)] = ()


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Everything that may be declared of a cell's logs; every entry may be left out.

    `gravity_direction` is in the base frame; `sample_time_s` is the period of the controller, which holds each command
    until the next one, whether or not the log shows them all. A measured `pose` and a `displacement` (a pose relative
    to one that is not known) exclude each other; `joints` give the pose where there is no other. `table` says how CSV
    and Parquet files are timed, `tables` the same of single files by their names; `fields` name their columns.
    """

    gravity_direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    sample_time_s: _Above0 | None = None
    sensor: Mounting = field(default_factory=Mounting)
    payload: DeclaredPayload = field(default_factory=DeclaredPayload)
    wrench: WrenchSource | None = None
    pose: PoseSource | None = None
    displacement: PoseSource | None = None
    command: PoseSource | None = None
    joints: JointsSource | None = None
    twist: TwistSource | None = None
    gains: GainsSource | None = None
    desired_force: DesiredForceSource | None = None
    table: TableLayout | None = None
    tables: Annotated[Mapping[str, TableLayout], _OF_FILES] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "tables")
        kinds = {layout.rows for layout in self._layouts}
        if len(kinds) > 1:
            raise ParameterError("tables", "samples beside poses", "of one kind: rows with a time, or means of rests")
        if self.pose is not None and self.displacement is not None:
            raise ParameterError("displacement", "both pose and displacement", "the only one of the two")
        if not any(self.gravity_direction):
            raise ParameterError("gravity_direction", list(self.gravity_direction), "a direction, not zero")

    @property
    def rows_are_poses(self) -> bool:
        """Whether the rows of tables are declared as means of rests."""
        return any(layout.are_poses for layout in self._layouts)

    @property
    def _layouts(self) -> tuple[TableLayout, ...]:
        return (*(() if self.table is None else (self.table,)), *self.tables.values())

    def table_of(self, name: str) -> TableLayout | None:
        """Return how the table of this file name is to be read, None where nothing is declared."""
        return self.tables.get(name, self.table)

    def with_topics(self, *, wrench: str | None, pose: str | None, command: str | None) -> "Cell":
        """Return the cell with these topics instead of its own where they are not None."""
        cell = self
        if wrench is not None:
            cell = replace(cell, wrench=replace(cell.wrench or WrenchSource(), topic=wrench))
        if command is not None:
            cell = replace(cell, command=replace(cell.command or PoseSource(), topic=command))
        if pose is not None and cell.displacement is not None:
            cell = replace(cell, displacement=replace(cell.displacement, topic=pose))
        elif pose is not None:
            cell = replace(cell, pose=replace(cell.pose or PoseSource(), topic=pose))
        return cell

    def with_gains(self, said: Mapping[str, float]) -> "Cell":
        """Return the cell with these gains on every axis in the place of its own numbers; those of a log stay."""
        if self.gains is None or not self.gains.is_known:
            return self
        values: dict[str, Any] = {name: (value,) * 6 for name, value in said.items()}
        return replace(self, gains=replace(self.gains, **values))

    def with_urdf(self, urdf: Path | str | None, tip: str | None) -> "Cell":
        """Return the cell with joints that are read through this URDF up to this link.

        Raises ParameterError where one of the two is missing, MissingExtraError without pytransform3d.
        """
        if urdf is None and tip is None:
            return self
        require_extra("A URDF", "pytransform3d", "urdf")
        if self.joints is None and (urdf is None or tip is None):
            missing = "urdf" if urdf is None else "tip"
            raise ParameterError(missing, "nothing", "named too: a pose from joints needs a URDF and its tip")
        if self.joints is None:
            return replace(self, joints=JointsSource(urdf=Path(str(urdf)), tip=str(tip)))
        known = self.joints
        return replace(self, joints=replace(known, urdf=Path(urdf or known.urdf), tip=tip or known.tip))
