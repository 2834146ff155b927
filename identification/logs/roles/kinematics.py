"""The chain of joints from a robot's base to its tip, as a URDF has it, and the tip's pose from joint positions."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray

from ...errors import LogError, listed
from .cell import require_urdf_reader

_PRISMATIC, _FIXED = "prismatic", "fixed"
_LARGEST_BYTES = 2**24


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint: `T_PC` (4, 4) is its child frame at zero in that of its parent, `axis` (3,) that of its motion."""

    name: str
    kind: str
    T_PC: FloatArray
    axis: FloatArray


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The joints from `base` to `tip`, in this order."""

    base: str
    tip: str
    joints: tuple[Joint, ...]

    @property
    def moving(self) -> tuple[str, ...]:
        """The names of the joints that have a position."""
        return tuple(joint.name for joint in self.joints if joint.kind != _FIXED)

    def poses(self, positions: FloatArray, rad_per_unit: float = 1.0) -> FloatArray:
        """Return the poses of the tip in the base (n, 7), position [m] and quaternion xyzw.

        `positions` (n, k) are those of the moving joints: angles in a unit of `rad_per_unit`, lengths in m. A row with
        a number that is not finite gets no pose.
        """
        found = np.full((len(positions), 7), np.nan)
        good = np.isfinite(positions).all(axis=1)
        columns = iter(positions[good].T)
        place, turn = np.zeros((int(good.sum()), 3)), Rotation.identity(int(good.sum()))
        for joint in self.joints:
            place = place + turn.apply(joint.T_PC[:3, 3])
            turn = turn * Rotation.from_matrix(joint.T_PC[:3, :3])
            if joint.kind == _PRISMATIC:
                place = place + turn.apply(next(columns)[:, None] * joint.axis)
            elif joint.kind != _FIXED:
                turn = turn * Rotation.from_rotvec(rad_per_unit * next(columns)[:, None] * joint.axis)
        found[good, :3], found[good, 3:] = place, turn.as_quat(canonical=True)
        return found


def read_chain(path: Path, tip: str, base: str | None = None) -> Chain:
    """Read the chain that ends in the link `tip`, from the link `base` or the robot's root.

    Raises LogError where the file is no URDF or has no such chain, MissingExtraError without pytransform3d.
    """
    require_urdf_reader()
    from pytransform3d.urdf import UrdfException, parse_urdf  # noqa: PLC0415 - an extra, and slow to import

    text = _read(path)
    try:
        # Its own parser reads what is left of a truncated file.
        tree = ET.fromstring(text)
        _, links, joints = parse_urdf(text)
    except (ET.ParseError, UrdfException, ValueError) as error:
        raise LogError(
            f"{path.name} must be a URDF, found: {error}; of a xacro make one with `xacro robot.xacro > robot.urdf`."
        ) from error
    names = [link.name for link in links]
    for what, name in (("tip", tip), ("base", base)):
        if name is not None and name not in names:
            raise LogError(f"{path.name} has no link {name!r} to be the {what}; its links are: {listed(names)}.")
    mimicking = {each.get("name") for each in tree.iter("joint") if each.find("mimic") is not None}
    above = {joint.child: joint for joint in joints}
    chain: list[Joint] = []
    link = tip
    while link != base and link in above:
        joint = above.pop(link)
        axis = np.asarray(joint.joint_axis, dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if joint.joint_name in mimicking or (joint.joint_type != _FIXED and not (axis.shape == (3,) and length > 0.0)):
            what = "follows another (mimic)" if joint.joint_name in mimicking else "has no axis"
            raise LogError(f"The joint {joint.joint_name} of {path.name} {what}; name a tip before it.")
        T_PC = np.asarray(joint.child2parent, dtype=np.float64)
        chain.append(Joint(name=str(joint.joint_name), kind=joint.joint_type, T_PC=T_PC, axis=axis / (length or 1.0)))
        link = str(joint.parent)
    if base is not None and link != base:
        raise LogError(f"No chain of joints leads from {base} to {tip} in {path.name}; it begins at {link}.")
    found = Chain(base=link, tip=tip, joints=tuple(reversed(chain)))
    if not found.moving:
        raise LogError(f"No joint moves {tip} against {link} in {path.name}; name another tip.")
    return found


def _read(path: Path) -> str:
    try:
        data = path.read_bytes()
        return data[:_LARGEST_BYTES].decode()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}; name an existing URDF.") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path.name} must be a URDF, found a file that is no UTF-8 text.") from error
