"""Exports on a real arm's kinematics: what is certified for one axis is what six axes do, and nothing drifts."""

from collections.abc import Callable

import numpy as np
import pytest

from autotune.exports.peers import make_peer
from autotune.exports.ros2_control import Ros2Options
from autotune.files.controller import read_controller, write_controller
from problems.laws import LinearLaw
from problems.peer_laws import SpringAdmittance
from tests.autotune.exports.arm import POSES, UR10E, AdmittanceFile, FloatArray, chain, jacobian
from tests.autotune.exports.peer_cases import PERIOD_S, PLAIN, load_as_ros, peer_controller, requirements

PUSH_N, PUSH_S, WATCHED_S = 120.0, 4.0, 60.0
# How much a coordinate may drift in a minute after the push: 1 mm, and 1 mrad.
DRIFT = 1e-3


def on_its_own(law: LinearLaw, force: float, steps: int) -> FloatArray:
    """Return the commands of one axis by itself whose robot is where the last command was."""
    r, state, position, found = law.state_count, np.zeros(law.state_count), 0.0, np.empty(steps)
    for k in range(steps):
        seen = np.concatenate([state, [force, position]])
        state, position = law.matrix[:r] @ seen, float(law.matrix[r] @ seen)
        found[k] = position
    return found


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], AdmittanceFile]:
    """Return what the export writes for an axis, tuned alone."""

    def export(axis: str) -> AdmittanceFile:
        path = tmp_path_factory.mktemp("arm") / "controller.yaml"
        write_controller(path, peer_controller({axis: PLAIN}, requirements(2.5e-4)))
        made = make_peer(read_controller(path), Ros2Options())
        return AdmittanceFile(**load_as_ros(made.text)["admittance_controller"]["ros__parameters"]["admittance"])

    return export


def pushed(rule: AdmittanceFile, pose: FloatArray, axis: int) -> FloatArray:
    """Return the way (samples, 6) every half second of a push of 4 s and of a minute and half a second after it."""
    wrench = np.zeros(6)
    wrench[axis] = PUSH_N
    return rule.after_a_push(pose, wrench, push_s=PUSH_S, total_s=PUSH_S + 0.5 + WATCHED_S, h=PERIOD_S, every_s=0.5)


def drift(way: FloatArray) -> float:
    """Return the largest change of a coordinate after the arm has come to rest, half a second after the push."""
    return float(np.max(np.abs(way[9:] - way[9])))


@pytest.mark.parametrize("pose", POSES, ids=["bent", "turned"])
@pytest.mark.parametrize("axis", ["x", "z"])
def test_nothing_drifts_after_a_push(file: Callable[[str], AdmittanceFile], axis: str, pose: FloatArray) -> None:
    rule, index = file(axis), "xyz".index(axis)
    way = pushed(rule, pose, index)
    assert way[9, index] > 0.1  # it was pushed, by 16 cm
    assert drift(way) < DRIFT


@pytest.mark.parametrize("axis", ["x", "z"])
def test_six_axes_do_what_is_certified_for_one(file: Callable[[str], AdmittanceFile], axis: str) -> None:
    rule, index = file(axis), "xyz".index(axis)
    law = SpringAdmittance(
        mass=rule.mass[index],
        damping_ratio=rule.damping_ratio[index],
        stiffness=rule.stiffness[index],
        joint_damping_per_s=rule.joint_damping,
        filter_coefficient=1.0,
    ).law(PERIOD_S)
    alone = on_its_own(law, PUSH_N, round(PUSH_S / PERIOD_S))[-1]
    for pose in POSES:
        way = pushed(rule, pose, index)[8]
        # The damped inverse of the Jacobian takes α/(σ² + α) off, less than 1 % of σ > 0.23.
        assert way[index] == pytest.approx(alone, rel=0.01)
        # What turning makes of the speed along the others dies out at once.
        assert np.max(np.abs(np.delete(way, index))) < 1e-3


@pytest.mark.parametrize("pose", POSES, ids=["bent", "turned"])
def test_without_damping_on_every_axis_the_arm_runs_away(pose: FloatArray) -> None:
    """The rule as it was exported once: nothing on the other axes, no joint damping; then with the latter."""
    ratio, mass = PLAIN.damping / (2.0 * np.sqrt(PLAIN.mass)), [PLAIN.mass] * 3 + [1.0] * 3
    selected, alone = [True] + [False] * 5, [1.0] + [0.0] * 5
    loose = AdmittanceFile(
        mass=mass,
        damping_ratio=[ratio] + [0.0] * 5,
        stiffness=alone,
        selected_axes=selected,
        joint_damping=0.0,
    )
    in_joints = AdmittanceFile(
        mass=mass,
        damping_ratio=[ratio] + [0.0] * 5,
        stiffness=alone,
        selected_axes=selected,
        joint_damping=5.0,
    )
    ways = [pushed(rule, pose, 0) for rule in (loose, in_joints)]
    # Half a metre and more, without a force.
    assert drift(ways[0]) > 0.5
    # Joint damping stops the others within seconds, millimetres away.
    sideways = np.abs(ways[1][:, 1:3])
    assert 1e-3 < sideways[-1].max() < 5e-3
    assert np.max(np.abs(ways[1][29:, 1:3] - ways[1][29, 1:3])) < 1e-4


def test_the_arm_s_jacobian_is_the_slope_of_its_pose() -> None:
    for pose in POSES:
        axes, origins, turn = chain(UR10E, pose)
        seen, step = jacobian(axes, origins, origins[6], 6), 1e-6
        assert np.linalg.svd(seen)[1][-1] > 0.23  # away from singularities
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        for joint in range(6):
            ends = [chain(UR10E, pose + side * step * np.eye(6)[joint]) for side in (1.0, -1.0)]
            np.testing.assert_allclose((ends[0][1][6] - ends[1][1][6]) / (2.0 * step), seen[:3, joint], atol=1e-8)
            spin = (ends[0][2] - ends[1][2]) / (2.0 * step) @ turn.T
            np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], seen[3:, joint], atol=1e-8)
    # Stretched out, as the maker draws it: a_2 + a_3 along −x, d_4 + d_6 along −y, d_1 − d_5 above the base.
    reach = chain(UR10E, np.zeros(6))[1][6]
    np.testing.assert_allclose(reach, [-1.18425, -0.2907, 0.06085], atol=1e-12)
