"""Robots for tests, as URDFs."""

from collections.abc import Sequence

JOINTS = ("shoulder", "lift", "slide", "elbow", "wrist_1", "wrist_2", "flange")
"""The moving joints of `ARM`, from base to tip."""


def joint(name: str, kind: str, parent: str, child: str, origin: str, axis: str = "", extra: str = "") -> str:
    axis_tag = f'<axis xyz="{axis}"/>' if axis else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"<origin {origin}/>{axis_tag}{extra}</joint>"
    )


def urdf(joints: Sequence[str], links: Sequence[str]) -> str:
    named = "".join(f'<link name="{link}"/>' for link in links)
    return f'<robot name="arm">{named}{"".join(joints)}</robot>'


ARM = urdf(
    [
        joint("mount", "fixed", "world", "base", 'xyz="0.1 -0.2 0.3" rpy="0.1 0.2 0.3"'),
        joint("shoulder", "revolute", "base", "l1", 'xyz="0 0 0.4"', "0 0 1"),
        joint("lift", "revolute", "l1", "l2", 'xyz="0.05 0.1 0" rpy="1.5707963 0 -0.4"', "0 2 0"),
        joint("slide", "prismatic", "l2", "l3", 'xyz="0.3 0 0" rpy="0 0.3 0"', "1 0 0"),
        joint("elbow", "continuous", "l3", "l4", 'xyz="0.2 0 0.1"', "0.6 0 0.8"),
        joint("wrist_1", "revolute", "l4", "l5", 'xyz="0 0.1 0" rpy="0.2 -1.1 2.9"', "0 0 -1"),
        joint("wrist_2", "revolute", "l5", "l6", 'xyz="0 0 0.1"', "1 0 0"),
        joint("flange", "revolute", "l6", "l7", 'rpy="-0.7 0.1 0"', "0 1 0"),
        joint("tool", "fixed", "l7", "tool0", 'xyz="0 0 0.25" rpy="0 3.1415926 0"'),
        joint("finger", "prismatic", "l7", "finger", 'xyz="0 0.02 0"', "0 1 0", '<mimic joint="slide"/>'),
    ],
    ["world", "base", *(f"l{i}" for i in range(1, 8)), "tool0", "finger", "apart"],
)
"""Seven joints that turn and move in every way, a fixed mount, a tool, and a finger that follows a joint."""

PLANAR = urdf(
    [
        joint("a", "revolute", "base", "upper", "", "0 0 1"),
        joint("b", "revolute", "upper", "lower", 'xyz="2 0 0"', "0 0 1"),
        joint("end", "fixed", "lower", "tip", 'xyz="1 0 0"'),
    ],
    ["base", "upper", "lower", "tip"],
)
"""Two links of 2 m and 1 m in a plane."""
