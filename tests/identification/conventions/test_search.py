"""Conventions told from the weight: logs are misdeclared on purpose, and rests written down in closed form."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.conventions.choice import ReadLog, read_by_weight
from identification.conventions.search import ConventionVerdict, SignOrigin, rank_conventions
from identification.conventions.weight_misfit import QUARTER_TURNS
from identification.errors import EstimateError
from identification.payload.gravity import identify_gravity
from identification.payload.static_poses import GRAVITY_B_M_S2, StaticPose
from identification.signals.aligned import align
from identification.signals.recording import Frames, PoseSignal, Recording
from identification.signals.segments import find_motion
from problems.arrays import FloatArray
from tests.identification.rests import PAYLOAD, Truth, poses_at, turned_about_the_vertical
from tests.identification.synthetic import tilted


def general(count: int = 9, seed: int = 4) -> Rotation:
    return turned_about_the_vertical(tilted(count, 1.1), np.random.default_rng(seed))


def misread(
    poses: tuple[StaticPose, ...],
    *,
    wxyz: bool = False,
    inverted: bool = False,
    turn: Rotation | None = None,
    sign: float = 1.0,
) -> tuple[StaticPose, ...]:
    """What a reader that declares everything plainly makes of a log that is otherwise."""
    found = []
    for pose in poses:
        logged = Rotation.from_quat(pose.quaternion_xyzw)
        if turn is not None:
            logged = logged * turn.inv()  # the flange, when `turn` is flange from sensor
        if inverted:
            logged = logged.inv()
        numbers = logged.as_quat()
        if wxyz:
            numbers = numbers[[3, 0, 1, 2]]
        found.append(
            replace(
                pose,
                quaternion_xyzw=numbers,
                gravity_S_m_s2=Rotation.from_quat(numbers).inv().apply(GRAVITY_B_M_S2),
                force_S_n=sign * pose.force_S_n,
                torque_S_n_m=sign * pose.torque_S_n_m,
            )
        )
    return tuple(found)


def noisy(orientation: Rotation, seed: int = 1, truth: Truth = PAYLOAD) -> tuple[StaticPose, ...]:
    return poses_at(orientation, np.random.default_rng(seed), truth=truth, noise_n=0.3, torque_noise_n_m=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_what_is_declared_rightly_stands(seed: int) -> None:
    ranking = rank_conventions(noisy(general(seed=seed), seed))
    assert ranking.verdict is ConventionVerdict.DECLARED
    chosen = ranking.chosen()
    assert chosen is not None
    assert chosen.entries() == ("as declared",)
    assert chosen.mass_kg == pytest.approx(PAYLOAD.mass_kg, rel=1e-3)  # 0.3 N / √1000 over 160 N, many times
    assert ranking.findings() == ()


@pytest.mark.parametrize("wxyz", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("turn", [0, 7, 16, 23])
def test_orders_inverses_and_quarter_turns_are_found(wxyz: bool, inverted: bool, turn: int) -> None:
    quarter = QUARTER_TURNS[turn]
    log = misread(noisy(general()), wxyz=wxyz, inverted=inverted, turn=quarter)
    ranking = rank_conventions(log)
    chosen = ranking.chosen()
    assert chosen is not None
    assert chosen.hypothesis.order == ("wxyz" if wxyz else "xyzw")
    assert chosen.hypothesis.inverted == inverted
    assert (chosen.hypothesis.quarter_turn * quarter.inv()).magnitude() < 1e-9
    assert chosen.sign_origin is SignOrigin.AS_DECLARED
    plain = not wxyz and not inverted and quarter.magnitude() < 0.1
    assert ranking.verdict is (ConventionVerdict.DECLARED if plain else ConventionVerdict.FOUND)
    assert len(ranking.findings()) == (0 if plain else 1)
    # The noise of a mean, 0.3 N / √1000, is what the right reading leaves: 27 numbers, 4 parameters; 3 deviations.
    assert chosen.residual_rms_n == pytest.approx(0.3 / np.sqrt(1000) * np.sqrt(23 / 27), rel=0.45)


def test_a_reversed_sign_is_a_question_with_both_answers() -> None:
    ranking = rank_conventions(misread(noisy(general()), sign=-1.0))
    assert ranking.verdict is ConventionVerdict.ASK
    assert {each.sign_origin for each in ranking.alike} == {SignOrigin.WRENCH, SignOrigin.GRAVITY}
    with pytest.raises(EstimateError, match=r"mass negative, and 2 others fit it alike.*cell\.yaml") as caught:
        ranking.chosen()
    assert "wrench: {exerted_by: sensor}" in str(caught.value)
    assert "gravity_direction: [0, 0, 1]" in str(caught.value)
    # These poses do turn about the vertical: more of them would show nothing new.
    assert "only you can say" in str(caught.value)
    assert "about the vertical" not in str(caught.value)


def test_readings_that_the_poses_cannot_distinguish_are_asked_with_their_residuals() -> None:
    # About horizontal axes from a tool that points down, turning back is tilting to the other side: an inverted pose
    # is a sensor turned about its axis with the sign reversed.
    log = misread(noisy(tilted(9, 1.1)), inverted=True)
    ranking = rank_conventions(log)
    assert ranking.verdict is ConventionVerdict.ASK
    assert [each.changes for each in ranking.alike] == [1, 2, 2]
    assert {each.hypothesis.inverted for each in ranking.alike} == {False, True}
    with pytest.raises(EstimateError, match=r"3 others fit it alike.*swapped.*N·m left.*turn about the vertical"):
        ranking.chosen()
    # The very same fault is found once the poses differ in their turn about the vertical too.
    found = rank_conventions(misread(noisy(general()), inverted=True))
    assert found.verdict is ConventionVerdict.FOUND
    # A matrix of the wrong order is the inverse, and a table has no frames that could be swapped.
    assert "orientation_as: matrix_row_major" in found.findings()[0].message


def test_euler_angles_that_are_taken_as_a_rotation_vector_are_suspected() -> None:
    def as_a_vector(pose: StaticPose) -> StaticPose:
        read = Rotation.from_rotvec(Rotation.from_quat(pose.quaternion_xyzw).as_euler("xyz"))
        return replace(pose, quaternion_xyzw=read.as_quat(), gravity_S_m_s2=read.inv().apply(GRAVITY_B_M_S2))

    with pytest.raises(EstimateError, match=r"declared `orientation_as` of the pose was tried: .*euler_xyz"):
        rank_conventions(tuple(map(as_a_vector, noisy(general(12))))).chosen()


def test_the_declared_one_wins_where_others_fit_alike() -> None:
    assert rank_conventions(noisy(tilted(9, 1.1))).verdict is ConventionVerdict.DECLARED
    assert len(rank_conventions(noisy(tilted(9, 1.1))).alike) > 1


def test_declared_frames_are_taken_into_account() -> None:
    frames = Frames(R_WB=Rotation.from_euler("x", 180, degrees=True), R_FS=Rotation.from_euler("z", 90, degrees=True))
    orientation = general()
    logged = [frames.R_WB.inv() * turn * frames.R_FS.inv() for turn in orientation]
    swapped = Rotation.from_quat([turn.as_quat()[[3, 0, 1, 2]] for turn in logged])
    read = frames.R_WB * swapped * frames.R_FS
    poses = tuple(
        replace(pose, quaternion_xyzw=turn.as_quat()) for pose, turn in zip(noisy(orientation), read, strict=True)
    )
    ranking = rank_conventions(poses, frames)
    chosen = ranking.chosen()
    assert chosen is not None
    assert chosen.entries(frames) == ("pose: {orientation_as: quaternion_wxyz}",)
    assert rank_conventions(poses).verdict is not ConventionVerdict.FOUND


def test_touched_rests_do_not_decide() -> None:
    log = list(misread(noisy(general(11)), wxyz=True))
    for i, push in ((2, 25.0), (7, -60.0)):
        log[i] = replace(log[i], force_S_n=log[i].force_S_n + np.array([push, 0.3 * push, 0.0]))
    chosen = rank_conventions(log).chosen()
    assert chosen is not None
    assert chosen.entries() == ("pose: {orientation_as: quaternion_wxyz}",)
    assert chosen.residual_rms_n < 0.03


@pytest.mark.parametrize("degrees", [20.0, 45.0, 130.0])
def test_a_sensor_at_an_angle_is_refused_with_the_entry_that_mends_it(degrees: float) -> None:
    angle = Rotation.from_euler("z", degrees, degrees=True)
    ranking = rank_conventions(misread(noisy(general()), turn=angle))
    assert ranking.verdict is ConventionVerdict.NONE
    assert ranking.mounting is not None
    assert (ranking.mounting * angle.inv()).magnitude() < np.radians(0.1)
    with pytest.raises(EstimateError, match=r"cell\.yaml") as caught:
        ranking.chosen()
    message = re.search(r"declare `sensor: \{orientation: \[(.+?)\]\}`", str(caught.value))
    assert message is not None
    numbers = np.array([float(number) for number in message.group(1).split(",")])
    np.testing.assert_allclose(numbers, angle.as_quat(), rtol=0.0, atol=1e-3)


def test_a_few_degrees_off_are_left_to_the_mounting() -> None:
    ranking = rank_conventions(misread(noisy(general()), turn=Rotation.from_euler("z", 4, degrees=True)))
    assert ranking.verdict is ConventionVerdict.DECLARED


def test_a_wrench_that_follows_nothing_fits_no_convention() -> None:
    poses = noisy(general())
    rng = np.random.default_rng(3)
    mixed = [replace(pose, force_S_n=100.0 * rng.standard_normal(3)) for pose in poses]
    ranking = rank_conventions(mixed)
    assert ranking.verdict is ConventionVerdict.NONE
    with pytest.raises(EstimateError, match="force must follow gravity"):
        ranking.chosen()


def test_too_few_or_weightless_rests_show_nothing() -> None:
    few = rank_conventions(noisy(tilted(3, 1.0)))
    assert few.verdict is ConventionVerdict.UNDECIDED
    assert few.chosen() is None
    assert [finding.code for finding in few.findings()] == ["conventions-unchecked"]
    removed = noisy(general(), truth=Truth(mass_kg=0.0))
    assert rank_conventions(removed).verdict is ConventionVerdict.UNDECIDED


def pose_read(pose: PoseSignal, change: Callable[[Rotation, FloatArray], tuple[Rotation, FloatArray]]) -> PoseSignal:
    turned, position = change(Rotation.from_quat(pose.quaternion_xyzw), np.array(pose.position_m))
    return replace(pose, quaternion_xyzw=turned.as_quat(), position_m=position)


def read(recording: Recording) -> ReadLog:
    log = align(recording)
    return read_by_weight(recording, log, find_motion(log))


def test_a_whole_log_is_kept_as_it_is(demo_recording: Recording) -> None:
    found = read(demo_recording)
    assert found.recording is demo_recording
    assert found.convention is None
    assert found.findings == ()


def test_an_inverted_pose_is_read_back_with_its_position(demo_recording: Recording) -> None:
    inverted = replace(
        demo_recording,
        pose=pose_read(demo_recording.pose, lambda turn, at: (turn.inv(), -turn.inv().apply(at))),
        command=None,
    )
    found = read(inverted)
    assert found.convention is not None
    assert found.convention.hypothesis.inverted
    # Turned there and back: rounding of numbers near 1.
    np.testing.assert_allclose(found.recording.pose.position_m, demo_recording.pose.position_m, rtol=0.0, atol=1e-12)
    back = Rotation.from_quat(found.recording.pose.quaternion_xyzw)
    assert float(np.max((back.inv() * Rotation.from_quat(demo_recording.pose.quaternion_xyzw)).magnitude())) < 1e-12
    assert identify_gravity(found.poses).mass_kg == pytest.approx(16.2, rel=5e-3)


def test_moves_show_a_wrench_of_the_other_body_from_gravity_reversed(demo_recording: Recording) -> None:
    wrench = demo_recording.wrench
    flipped = replace(demo_recording, wrench=replace(wrench, force_n=-wrench.force_n, torque_n_m=-wrench.torque_n_m))
    hanging = Rotation.from_rotvec([0.0, np.pi, 0.0])
    upside_down = replace(
        demo_recording,
        pose=pose_read(demo_recording.pose, lambda turn, at: (hanging * turn, hanging.apply(at))),
        command=None,
    )
    readings = {SignOrigin.WRENCH: read(flipped), SignOrigin.GRAVITY: read(upside_down)}
    for pull, found in readings.items():
        assert found.convention is not None
        assert found.convention.sign_origin is pull
        assert [finding.code for finding in found.findings] == ["convention-found"]
        assert identify_gravity(found.poses).mass_kg == pytest.approx(16.2, rel=5e-3)
    np.testing.assert_array_equal(readings[SignOrigin.WRENCH].recording.wrench.force_n, wrench.force_n)


@pytest.mark.parametrize("lean_deg", [15.0, 90.0])
def test_a_base_that_leans_is_reported_with_its_direction(lean_deg: float) -> None:
    down = Rotation.from_euler("xy", [0.6 * lean_deg, -0.8 * lean_deg], degrees=True).apply([0.0, 0.0, -1.0])
    rng = np.random.default_rng(7)
    poses = list(poses_at(general(12), rng, noise_n=0.3, torque_noise_n_m=0.02, down=down))
    # One rest in contact.
    poses[3] = replace(poses[3], force_S_n=poses[3].force_S_n + np.array([0.0, 0.0, 30.0]))
    ranking = rank_conventions(poses)
    assert ranking.verdict is ConventionVerdict.NONE
    with pytest.raises(EstimateError, match=r"declare `gravity_direction: \[") as caught:
        ranking.chosen()
    message = re.search(r"gravity_direction: \[(.*?)\]", str(caught.value))
    assert message is not None
    # 0.3 N / √1000 a rest over 160 N, many times.
    assert [float(each) for each in message[1].split(",")] == pytest.approx(down.tolist(), abs=1e-3)


@pytest.mark.parametrize("count", [4, 5, 8, 12])
@pytest.mark.parametrize("seed", range(6))
def test_a_wrench_without_weight_is_suspected_of_compensation_and_asked_for_no_mounting(count: int, seed: int) -> None:
    """What is left of an undeclared compensation, 1 N in any direction, is no weight however the sensor were turned."""
    rng = np.random.default_rng(seed)
    rests = tuple(
        replace(pose, force_S_n=rng.normal(size=3), torque_S_n_m=0.05 * rng.normal(size=3))
        for pose in poses_at(tilted(count, 1.0), rng, noise_n=0.3, torque_noise_n_m=0.03)
    )

    def weigh() -> None:
        rank_conventions(rests).chosen()
        identify_gravity(rests)

    with pytest.raises(EstimateError) as caught:
        weigh()
    assert "gravity_compensated: true" in str(caught.value)
    assert "seems mounted at an angle" not in str(caught.value)
