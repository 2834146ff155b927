"""Logged numbers become SI in our frames; what was turned, scaled or flipped on the way comes back."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.errors import LogError
from identification.logs.containers.channel import Channel
from identification.logs.messages.decode import Series
from identification.logs.recording import (
    build_frames,
    interpret_gains,
    interpret_pose,
    interpret_twist,
    interpret_wrench,
)
from identification.logs.roles.cell import (
    Cell,
    DeclaredDeadband,
    ExertedBy,
    Frame,
    Mounting,
    PoseSource,
    TwistSource,
    TwistUnits,
    WrenchSource,
    WrenchUnits,
)
from identification.logs.roles.cell import PoseUnits as Units
from identification.logs.roles.orientation import make_continuous, orientation_quaternion
from identification.signals.recording import AXES, PoseSignal, WrenchSignal
from problems.contact.nonlinearities import DeadbandType
from problems.errors import ParameterError

Array = NDArray[np.float64]
STAMPS = np.arange(1, 201, dtype=np.int64) * 5_000_000
ROUNDING = 1e-12
"""Sines of angles of a few radians, products of three rotations: some hundred times 2.2e-16."""
PLAIN = build_frames(Cell())


def columns(values: Array, has: tuple[bool, ...] | None = None, stamps: NDArray[np.int64] = STAMPS) -> Series:
    there = has or (True,) * values.shape[1]
    return Series(
        channel=Channel(topic="/t", type_name="", encoding="", schema_encoding="", schema=b""),
        fields=tuple("number" if is_there else None for is_there in there),
        log_ns=stamps[: len(values)],
        stamp_ns=stamps[: len(values)],
        frame_ids=("f",),
        values=values,
    )


def turning(seed: int = 0, turns: float = 3.0) -> Rotation:
    """Return 200 orientations that turn smoothly through more than a turn about a wandering axis."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi * turns, 200)
    axis = rng.standard_normal(3)
    return Rotation.random(rng=rng) * Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis))


def whole_pose(orientation: Rotation) -> PoseSignal:
    values = np.hstack([np.zeros((len(orientation), 3)), orientation.as_quat()])
    return interpret_pose(columns(values), PoseSource(), PLAIN, is_displacement=False)


def wrench_of(values: Array, source: WrenchSource, frames: Any = PLAIN, pose: PoseSignal | None = None) -> WrenchSignal:
    return interpret_wrench(
        columns(values),
        source,
        frames,
        pose or whole_pose(turning()),
        expressed_in=source.expressed_in or Frame.SENSOR,
        gravity_compensated=bool(source.gravity_compensated),
    )


def steps(quaternion: Array) -> Array:
    return np.asarray(np.linalg.norm(np.diff(quaternion, axis=0), axis=1))


@pytest.mark.parametrize(
    "kind",
    [
        "quaternion_xyzw",
        "quaternion_wxyz",
        "rotation_vector",
        "matrix_row_major",
        "matrix_column_major",
        "euler_ZYZ",
        "euler_xyz",
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_every_way_to_show_an_orientation_gives_the_same_continuous_quaternion(kind: str, seed: int) -> None:
    truth = turning(seed)
    numbers = {
        "quaternion_xyzw": lambda: truth.as_quat(canonical=True),
        "quaternion_wxyz": lambda: truth.as_quat(canonical=True)[:, [3, 0, 1, 2]],
        "rotation_vector": truth.as_rotvec,
        "matrix_row_major": lambda: np.array([matrix.ravel() for matrix in truth.as_matrix()]),
        "matrix_column_major": lambda: np.array([matrix.ravel(order="F") for matrix in truth.as_matrix()]),
        "euler_ZYZ": lambda: truth.as_euler("ZYZ"),
        "euler_xyz": lambda: truth.as_euler("xyz"),
    }[kind]()
    found = make_continuous(orientation_quaternion(kind, numbers))
    assert np.max((Rotation.from_quat(found).inv() * truth).magnitude()) < 1e-7  # arccos near 1
    # 3 turns in 199 steps: half of 0.095 rad each in the quaternion.
    assert np.max(steps(found)) < 0.05


def test_a_rotation_vector_that_flips_at_half_a_turn_is_made_continuous() -> None:
    # About one axis through 180 degrees: the vector jumps from +π to −π, the motion does not.
    angle = np.linspace(np.pi - 0.1, np.pi + 0.1, 50)
    axis = np.array([0.6, 0.0, 0.8])
    reported = np.where(angle > np.pi, angle - 2.0 * np.pi, angle)[:, None] * axis
    assert np.max(steps(reported)) > 6.0
    found = make_continuous(orientation_quaternion("rotation_vector", reported))
    assert np.max(steps(found)) < 0.003
    back = Rotation.from_quat(found[:1]).inv() * Rotation.from_quat(found)
    assert back.magnitude()[-1] == pytest.approx(0.2, abs=1e-7)


def test_degrees_are_radians_after_their_factor() -> None:
    truth = turning()
    found = orientation_quaternion("euler_ZYZ", truth.as_euler("ZYZ", degrees=True), np.pi / 180.0)
    assert np.max((Rotation.from_quat(found).inv() * truth).magnitude()) < 1e-7


@given(st.lists(st.booleans(), min_size=0, max_size=40))
@settings(deadline=None)
def test_signs_of_quaternions_never_matter(flips: list[bool]) -> None:
    smooth = make_continuous(turning(1).as_quat()[: len(flips)])
    signs = np.where(np.array(flips, dtype=bool), -1.0, 1.0)
    found = make_continuous(smooth * signs[:, None])
    assert len(found) == len(flips)
    assert not len(found) or np.array_equal(found * (found[0] @ smooth[0]).round(), smooth)


@given(
    st.sampled_from(["N", "kN", "lbf", "kgf"]),
    st.sampled_from(["N·m", "N·mm", "kN·m", "lbf·ft"]),
    st.lists(st.sampled_from([1.0, -1.0]), min_size=6, max_size=6),
    st.sampled_from(list(ExertedBy)),
    st.sampled_from(list(Frame)),
    st.integers(0, 10**6),
)
@settings(deadline=None)
def test_a_wrench_reported_in_any_unit_sign_and_frame_comes_back(
    force: str, torque: str, signs: list[float], by: ExertedBy, frame: Frame, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal((200, 6)) * [100, 100, 100, 10, 10, 10]
    mounted, orientation = Rotation.random(rng=rng), turning(seed)
    cell = Cell(sensor=Mounting(orientation=tuple(mounted.as_quat())), gravity_direction=tuple(rng.standard_normal(3)))
    frames = build_frames(cell)
    pose = interpret_pose(
        columns(np.hstack([np.zeros((200, 3)), orientation.as_quat()])), PoseSource(), frames, is_displacement=False
    )
    # Tell it as the log would: sensor to flange to base, in other units, signs flipped, or as the reaction.
    turn = {Frame.SENSOR: Rotation.identity(), Frame.FLANGE: mounted, Frame.BASE: orientation * mounted}[frame]
    reported = np.hstack([turn.apply(truth[:, :3]), turn.apply(truth[:, 3:])])
    in_si = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665}[force]
    in_n_m = {"N·m": 1.0, "N·mm": 1e-3, "kN·m": 1e3, "lbf·ft": 1.3558179483314004}[torque]
    reported = reported / np.repeat([in_si, in_n_m], 3) * signs * (-1.0 if by is ExertedBy.SENSOR else 1.0)
    source = WrenchSource(
        units=WrenchUnits(force=force, torque=torque), signs=tuple(signs), exerted_by=by, expressed_in=frame
    )
    found = wrench_of(reported, source, frames, pose)
    assert np.allclose(found.force_n, truth[:, :3], rtol=0, atol=1e-9)
    assert np.allclose(found.torque_n_m, truth[:, 3:], rtol=0, atol=1e-9)


def test_a_raw_wrench_keeps_every_bit() -> None:
    values = np.random.default_rng(0).standard_normal((200, 6))
    found = wrench_of(values, WrenchSource())
    assert np.array_equal(np.hstack([found.force_n, found.torque_n_m]), values)
    assert (found.gravity_compensated, found.deadband, found.measured_axes) == (False, None, AXES)


def test_what_was_done_before_recording_is_on_the_signal() -> None:
    deadband = DeclaredDeadband(type=DeadbandType.SUBTRACTIVE, force_n=2.0)
    found = wrench_of(np.ones((200, 6)), WrenchSource(gravity_compensated=True, deadband=deadband))
    assert found.gravity_compensated
    assert found.deadband is not None
    assert (found.deadband.type, found.deadband.force_n, found.deadband.torque_n_m) == ("subtractive", 2.0, None)


def test_gravity_points_down_in_our_base_wherever_it_points_in_theirs() -> None:
    orientation, rng = turning(), np.random.default_rng(5)
    for direction in [*rng.standard_normal((20, 3)), np.array([0, 0, 2.0]), np.array([0, 0, -1.0])]:
        frames = build_frames(Cell(gravity_direction=tuple(direction)))
        unit = direction / np.linalg.norm(direction)
        assert np.allclose(frames.R_WB.apply(unit), [0.0, 0.0, -1.0], rtol=0, atol=ROUNDING)
        values = np.hstack([np.tile(3.0 * unit, (200, 1)), orientation.as_quat()])
        pose = interpret_pose(columns(values), PoseSource(), frames, is_displacement=False)
        assert np.allclose(pose.position_m, [0.0, 0.0, -3.0], rtol=0, atol=ROUNDING)
        # What the sensor sees of gravity does not depend on how the base is called.
        seen = Rotation.from_quat(pose.quaternion_xyzw).inv().apply([0.0, 0.0, -1.0])
        assert np.allclose(seen, orientation.inv().apply(unit), rtol=0, atol=ROUNDING)


def test_the_pose_turns_with_the_sensor() -> None:
    mounting = Mounting(orientation=(0.0, 0.0, 90.0), orientation_as="euler_xyz", angle="deg")
    values = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    pose = interpret_pose(columns(values), PoseSource(), build_frames(Cell(sensor=mounting)), is_displacement=False)
    # The sensor's x axis lies along the flange's y axis.
    turned = Rotation.from_quat(pose.quaternion_xyzw).apply([1.0, 0.0, 0.0])
    assert np.allclose(turned, [0.0, 1.0, 0.0], rtol=0, atol=ROUNDING)
    with pytest.raises(ParameterError, match=r"unit quaternion \(its norm is 2\)"):
        Mounting(orientation=(0.0, 0.0, 0.0, 2.0))


def test_a_displacement_along_one_axis_has_that_axis_alone() -> None:
    values = np.full((3, 3), np.nan)
    values[:, 2] = [0.0, 1.0, 2.0]
    source = PoseSource(units=Units(position="mm"), signs=(1.0, 1.0, -1.0))
    found = interpret_pose(columns(values, (False, False, True)), source, PLAIN, is_displacement=True)
    assert found.is_displacement
    assert found.measured_axes == ("z",)
    assert found.position_m[:, 2].tolist() == [0.0, -0.001, -0.002]
    assert bool(np.all(np.isnan(found.position_m[:, :2])))
    assert bool(np.all(np.isnan(found.quaternion_xyzw)))


@pytest.mark.parametrize("frame", list(Frame))
def test_a_twist_is_reported_in_base_axes(frame: Frame) -> None:
    mounted, orientation = Rotation.from_rotvec([0.1, 0.7, -0.4]), turning(2)
    frames = build_frames(Cell(sensor=Mounting(orientation=tuple(mounted.as_quat()))))
    values = np.hstack([np.zeros((200, 3)), orientation.as_quat()])
    pose = interpret_pose(columns(values), PoseSource(), frames, is_displacement=False)
    truth = np.random.default_rng(1).standard_normal((200, 6))
    turn = {Frame.BASE: Rotation.identity(), Frame.FLANGE: orientation, Frame.SENSOR: orientation * mounted}[frame]
    reported = np.hstack([turn.inv().apply(truth[:, :3]) * 1e3, turn.inv().apply(truth[:, 3:]) * 180.0 / np.pi])
    source = TwistSource(units=TwistUnits(linear="mm", angular="deg"), expressed_in=frame)
    found = interpret_twist(columns(reported), source, frames, pose)
    assert np.allclose(found.linear_m_s, truth[:, :3], rtol=0, atol=1e-11)
    assert np.allclose(found.angular_rad_s, truth[:, 3:], rtol=0, atol=1e-11)


def test_a_wrench_in_base_axes_is_cut_to_the_time_of_the_pose() -> None:
    pose = whole_pose(turning())
    early = columns(np.ones((200, 6)), stamps=STAMPS - 50_000_000)
    found = interpret_wrench(early, WrenchSource(), PLAIN, pose, expressed_in=Frame.BASE, gravity_compensated=False)
    assert found.stamp_ns[0] >= pose.stamp_ns[0]
    assert len(found.stamp_ns) == 190
    with pytest.raises(LogError, match="same time"):
        interpret_wrench(
            columns(np.ones((200, 6)), stamps=STAMPS + 10**12),
            WrenchSource(),
            PLAIN,
            pose,
            expressed_in=Frame.BASE,
            gravity_compensated=False,
        )


def test_what_cannot_be_turned_is_refused() -> None:
    one_axis = columns(np.ones((200, 6)), (False, False, True, False, False, False))
    mounted = build_frames(Cell(sensor=Mounting(orientation=(0.0, 0.0, 1.0, 0.0))))
    pose = whole_pose(turning())
    with pytest.raises(LogError, match="all three components"):
        interpret_wrench(one_axis, WrenchSource(), mounted, pose, expressed_in=Frame.FLANGE, gravity_compensated=False)
    force_only = columns(np.ones((200, 6)), (True, True, True, False, False, False))
    found = interpret_wrench(
        force_only, WrenchSource(), mounted, pose, expressed_in=Frame.FLANGE, gravity_compensated=False
    )
    assert found.measured_axes == ("x", "y", "z")
    displacement = replace(pose, is_displacement=True)
    with pytest.raises(LogError, match="orientation of the sensor must be known"):
        interpret_wrench(
            force_only, WrenchSource(), PLAIN, displacement, expressed_in=Frame.BASE, gravity_compensated=False
        )


def test_gains_are_mass_then_damping() -> None:
    found = interpret_gains(columns(np.tile(np.arange(12.0), (3, 1))))
    assert found.mass[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert found.damping[0].tolist() == [6, 7, 8, 9, 10, 11]
