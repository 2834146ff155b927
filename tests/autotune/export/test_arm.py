"""Exports on a real arm's kinematics: what is certified for one axis is what six axes do, and nothing drifts."""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.export.fzi_cartesian import KEYS_OF, FziOptions
from autotune.export.ros2_control import Ros2Options
from autotune.export.ros_yaml import INVERSE_DAMPING
from autotune.formats.controller import read_controller, write_controller
from problems.arrays import FloatArray
from problems.model.linear_controllers import LinearController
from problems.model.third_party_controllers import ForwardDynamics, SpringAdmittance
from tests.autotune.export.arm import POSES, UPRIGHT, UR10E, AdmittanceFile, chain, jacobian, play_forward_dynamics
from tests.autotune.export.peer_cases import PERIOD_S, PLAIN, load_as_ros, peer_controller, requirements, translated

PUSH_N, PUSH_S, WATCHED_S = 120.0, 4.0, 60.0
# The joints follow as the paper's robot does, at 20 rad/s: forward dynamics counts on their lag.
FOLLOWS = -math.expm1(-20.0 * PERIOD_S)
# How much a coordinate may drift in a minute after the push: 1 mm, and 1 mrad.
DRIFT = 1e-3


def on_its_own(law: LinearController, force: float, steps: int, follows: float = 1.0) -> FloatArray:
    """Return the positions of one axis whose robot goes the share `follows` of the way to the command in a period."""
    r, state, position, found = law.state_count, np.zeros(law.state_count), 0.0, np.empty(steps)
    for k in range(steps):
        seen = np.concatenate([state, [force, position]])
        state, command = law.matrix[:r] @ seen, float(law.matrix[r] @ seen)
        position += follows * (command - position)
        found[k] = position
    return found


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], AdmittanceFile]:
    """Return what the export writes for an axis, tuned alone; the same for the same axis."""

    @cache
    def export(axis: str) -> AdmittanceFile:
        path = tmp_path_factory.mktemp("arm") / "controller.yaml"
        write_controller(path, peer_controller({axis: PLAIN}, requirements(2.5e-4)))
        made = translated(read_controller(path), Ros2Options())
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


@pytest.fixture(scope="module")
def forward_dynamics(tmp_path_factory: pytest.TempPathFactory) -> tuple[FloatArray, float]:
    """Return p and d (2, 6) and the links' mass as an export along the base's axes writes them."""
    return exported_gains(tmp_path_factory.mktemp("fzi"), ("x", "y", "z"), FziOptions())


def exported_gains(folder: Path, axes: tuple[str, ...], options: FziOptions) -> tuple[FloatArray, float]:
    path = folder / "controller.yaml"
    write_controller(path, peer_controller(dict.fromkeys(axes, PLAIN), requirements(2.5e-4)))
    found = load_as_ros(translated(read_controller(path), options).text)["cartesian_force_controller"]
    rows = found["ros__parameters"]["pd_gains"]
    gains = np.array([[rows[key][gain] for key in KEYS_OF.values()] for gain in ("p", "d")])
    return gains, found["ros__parameters"]["solver/forward_dynamics/link_mass"]


@pytest.mark.parametrize("axis", ["x", "y"])
def test_gains_for_the_orientation_of_use_move_the_sensor_s_axis_and_no_other(tmp_path: Path, axis: str) -> None:
    """One tuned axis, the tool pointing down: the flange's x lies along the base's y, and its y along the base's x."""
    turn, index = chain(UR10E, UPRIGHT[0])[2], "xy".index(axis)
    x, y, z, w = (float(each) for each in Rotation.from_matrix(turn).as_quat())
    gains, link_mass = exported_gains(tmp_path, (axis,), FziOptions(orientation=(x, y, z, w)))
    assert gains[0, index] == 0.0
    assert gains[0, 1 - index] > 0.0
    wrench, steps = np.zeros(6), round(PUSH_S / PERIOD_S)
    wrench[:3] = PUSH_N * turn[:, index]
    way = play_forward_dynamics(UR10E, UPRIGHT[0], gains, link_mass, FOLLOWS, wrench, (steps, steps))
    law = ForwardDynamics(proportional=gains[0, 1 - index], derivative=gains[1, 1 - index]).law(PERIOD_S)
    found = way[-1, :3] @ turn
    assert found[index] == pytest.approx(on_its_own(law, PUSH_N, steps, FOLLOWS)[-2], rel=0.01)
    # The light links turn and shift the tool by less than 1 mm.
    assert np.max(np.abs(np.delete(found, index))) < 1e-3


def share(gains: FloatArray, link_mass: float, pose: FloatArray, axis: int) -> FloatArray:
    """Return the motion under 120 N over 4 s as a share of what the law of one axis does, period by period."""
    law = ForwardDynamics(proportional=gains[0, axis], derivative=gains[1, axis]).law(PERIOD_S)
    steps, wrench = round(PUSH_S / PERIOD_S), np.zeros(6)
    wrench[axis] = PUSH_N
    way = play_forward_dynamics(UR10E, pose, gains, link_mass, FOLLOWS, wrench, (steps, steps))[:, axis]
    # The first two poses are those before anything has moved.
    found: FloatArray = way[2:] / on_its_own(law, PUSH_N, steps, FOLLOWS)[1:-1]
    return found


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_forward_dynamics_in_six_axes_is_the_certified_law(
    forward_dynamics: tuple[FloatArray, float], axis: int
) -> None:
    gains, link_mass = forward_dynamics
    for pose in (*POSES, *UPRIGHT):
        assert np.max(np.abs(share(gains, link_mass, pose, axis) - 1.0)) < 0.01


@pytest.mark.parametrize(("link_mass", "least", "most"), [(0.1, 0.69, 0.72), (0.01, 0.955, 0.965)])
def test_heavier_links_take_a_part_of_the_motion(
    forward_dynamics: tuple[FloatArray, float], link_mass: float, least: float, most: float
) -> None:
    """Of 0.1 kg, the default, that part is what the compiled solver was seen to take: it moved 0.69 to 0.72."""
    for pose in UPRIGHT:
        found = share(forward_dynamics[0], link_mass, pose, 0)
        assert least < found[0] < most


def test_nothing_moves_after_a_push_of_forward_dynamics(forward_dynamics: tuple[FloatArray, float]) -> None:
    """Each period keeps 0.9 of the speed, so that a force that ends leaves 10 times its last step."""
    gains, link_mass = forward_dynamics
    for pose in POSES:
        push, rest = round(PUSH_S / PERIOD_S), round(60.0 / PERIOD_S)
        wrench = np.array([PUSH_N, 0.0, 0.0, 0.0, 0.0, 0.0])
        way = play_forward_dynamics(UR10E, pose, gains, link_mass, FOLLOWS, wrench, (push, push + rest))
        assert way[-1, 0] > 0.1
        # 0.9^200 of the speed is left after 200 periods: nothing.
        assert np.max(np.abs(way[-1] - way[push + 200])) < 1e-9
        # Turning, which no gain holds, and sideways it has gone by 1 mrad and 1 mm at most.
        assert np.max(np.abs(way[-1, 1:])) < 1e-3


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


@pytest.mark.parametrize("pose", [*POSES, *UPRIGHT])
def test_the_damped_inverse_takes_less_than_a_percent_of_any_motion(pose: FloatArray) -> None:
    """J (JᵀJ + αI)⁻¹ Jᵀ of what is asked: in the worst direction σ²/(σ² + α) of the least singular value."""
    axes, origins, _ = chain(UR10E, pose)
    seen = jacobian(axes, origins, origins[6], 6)
    moved = seen @ np.linalg.solve(seen.T @ seen + INVERSE_DAMPING * np.eye(6), seen.T)
    assert 0.99 < np.min(np.linalg.eigvalsh(0.5 * (moved + moved.T))) < 1.0
