"""What is a vector of what by its names, and what is not."""

import pytest

from identification.logs.names import Meaning, read_names


def named(*paths: str) -> list[tuple[Meaning, tuple[str, ...]]]:
    return [(vector.kind, vector.paths) for vector in read_names(paths).vectors]


@pytest.mark.parametrize(
    ("paths", "kind"),
    [
        (("fx", "fy", "fz"), Meaning.FORCE),
        (("force_x", "force_y", "force_z"), Meaning.FORCE),
        (("ForceX", "ForceY", "ForceZ"), Meaning.FORCE),
        (("Fx [N]", "Fy [N]", "Fz [N]"), Meaning.FORCE),
        (("Lx_N", "Ly_N", "Lz_N"), Meaning.FORCE),
        (("Ux [Nmm]", "Uy [Nmm]", "Uz [Nmm]"), Meaning.TORQUE),
        (("wrench.force.x", "wrench.force.y", "wrench.force.z"), Meaning.FORCE),
        (("wrench.torque.x", "wrench.torque.y", "wrench.torque.z"), Meaning.TORQUE),
        (("Mx", "My", "Mz"), Meaning.TORQUE),
        (tuple(f"actual_TCP_force_{i}" for i in range(6)), Meaning.WRENCH),
        (tuple(f"K_F_ext_hat_K[{i}]" for i in range(6)), Meaning.WRENCH),
        (tuple(f"O_T_EE_{i}" for i in range(16)), Meaning.MATRIX),
        (tuple(f"actual_TCP_pose_{i}" for i in range(6)), Meaning.POSE),
        (tuple(f"pose[{i}]" for i in range(7)), Meaning.POSE),
        (("goal_pos_x", "goal_pos_y", "goal_pos_z"), Meaning.POSITION),
        (("x", "y", "z"), Meaning.POSITION),
        (("qx", "qy", "qz", "qw"), Meaning.TURN),
        (("pose.orientation.x", "pose.orientation.y", "pose.orientation.z", "pose.orientation.w"), Meaning.TURN),
        (("Roll", "Pitch", "Yaw"), Meaning.TURN),
        (tuple(f"R{row}{column}" for row in "123" for column in "123"), Meaning.MATRIX),
        (("TCP_x_ref", "TCP_y_ref", "TCP_z_ref"), Meaning.POSITION),
        (("qx_cmd", "qy_cmd", "qz_cmd", "qw_cmd"), Meaning.TURN),
        (("vx", "vy", "vz"), Meaning.LINEAR),
        (("twist.angular.x", "twist.angular.y", "twist.angular.z"), Meaning.ANGULAR),
    ],
)
def test_names_of_many_writers_are_known(paths: tuple[str, ...], kind: Meaning) -> None:
    assert named(*paths) == [(kind, paths)]


@pytest.mark.parametrize(
    "paths",
    [
        tuple(f"actual_q_{i}" for i in range(6)),
        tuple(f"joint_position[{i}]" for i in range(6)),
        tuple(f"tau_J[{i}]" for i in range(7)),
        tuple(f"data[{i}]" for i in range(6)),
        ("acc_x", "acc_y", "acc_z"),
        ("temperature_x", "temperature_y", "temperature_z"),
        ("fx", "fy"),
        ("index", "complex", "matrix"),
        ("R11", "R12", "R13", "R21"),
        ("f0", "f2", "f4"),
    ],
)
def test_what_is_no_vector_of_the_tool_is_left_alone(paths: tuple[str, ...]) -> None:
    assert named(*paths) == []


def test_t_is_a_torque_beside_a_force_and_a_translation_beside_a_turn() -> None:
    assert named("fx", "fy", "fz", "tx", "ty", "tz")[1] == (Meaning.TORQUE, ("tx", "ty", "tz"))
    assert named("tx", "ty", "tz", "qx", "qy", "qz", "qw")[0] == (Meaning.POSITION, ("tx", "ty", "tz"))


def test_words_say_what_is_commanded_measured_and_processed() -> None:
    paths = [f"{word}_pos_{axis}" for word in ("goal", "actual", "filtered") for axis in "xyz"]
    goal, actual, filtered = read_names(paths).vectors
    assert (goal.is_command, actual.is_command, filtered.is_command) == (True, False, False)
    assert (goal.is_measured, actual.is_measured, filtered.is_measured) == (False, True, False)
    assert (goal.is_processed, actual.is_processed, filtered.is_processed) == (False, False, True)


@pytest.mark.parametrize("names", ["{}_cmd", "{}set", "TCP_{}_ref", "{}_soll [mm]"])
def test_what_is_commanded_may_be_said_behind_the_axis(names: str) -> None:
    found = read_names([names.format(axis) for axis in "xyz"])
    assert [(vector.kind, vector.is_command) for vector in found.vectors] == [(Meaning.POSITION, True)]
    found = read_names(["x", "y", "z", *(names.format(axis) for axis in "xyz")])
    assert [vector.is_command for vector in found.vectors] == [False, True]
    assert read_names(["ms", "x_cmd"]).times == {"ms": "ms"}


@pytest.mark.parametrize(
    ("names", "unit", "is_command"),
    [
        ("{}_m", "m", False),
        ("pos_{}_m", "m", False),
        ("p{}_m", "m", False),
        ("{}_cmd_m", "m", True),
        ("tcp_{}_in", "in", False),
        ("target_{}_in", "in", True),
        ("F{}_lbf", "lbf", None),
        ("T{} [lbf*ft]", "lbf·ft", None),
        ("{}_in", "", None),
        ("f{}_m", "", None),
    ],
)
def test_a_unit_behind_the_axis(names: str, unit: str, is_command: bool | None) -> None:
    found = read_names([names.format(axis) for axis in "xyz"]).vectors
    if not unit:
        assert found == ()  # an input? a moment?
        return
    assert [vector.unit for vector in found] == [unit]
    if is_command is not None:
        assert [(vector.kind, vector.is_command) for vector in found] == [(Meaning.POSITION, is_command)]


def test_units_stand_beside_or_below_a_name() -> None:
    for found in (
        read_names(["x_mm", "y_mm", "z_mm", "time_ms"]),
        read_names(["X (mm)", "Y (mm)", "Z (mm)", "time [ms]"]),
        read_names(["x", "y", "z", "time"], ["mm", "mm", "mm", "ms"]),
    ):
        (vector,) = found.vectors
        assert vector.unit == "mm"
        assert list(found.times.values()) == ["ms"]
        assert found.others == ()


def test_what_a_kuka_sends_of_itself_is_measured_and_commanded() -> None:
    """RIst and RSol are where the robot is and where it is to be, IPOC counts milliseconds."""
    axes = "XYZABC"
    found = read_names(["IPOC", *(f"RIst_{axis}" for axis in axes), *(f"RSol_{axis}" for axis in axes)])
    assert found.times == {"IPOC": "ms"}
    assert [(v.kind, v.components, v.is_command) for v in found.vectors] == [
        (Meaning.POSITION, "xyz", False),
        (Meaning.TURN, "abc", False),
        (Meaning.POSITION, "xyz", True),
        (Meaning.TURN, "abc", True),
    ]


def test_german_names_are_read() -> None:
    found = read_names(
        [
            "Zeit [ms]",
            *(f"Kraft_{a} [kN]" for a in "xyz"),
            *(f"Weg_{a} [mm]" for a in "xyz"),
            "Sollkraft_z [N]",
            "qx_ist",
        ]
    )
    assert found.times == {"Zeit [ms]": "ms"}
    assert [(v.kind, v.unit) for v in found.vectors] == [(Meaning.FORCE, "kN"), (Meaning.POSITION, "mm")]
    (asked,) = found.asked
    assert (asked.kind, asked.components, asked.unit, asked.is_command) == (Meaning.FORCE, "z", "N", True)
    (command,) = read_names([f"Sollposition{a}" for a in "XYZ"]).vectors
    assert (command.kind, command.is_command) == (Meaning.POSITION, True)
    (moment,) = read_names([f"Drehmoment_{a}" for a in "xyz"]).vectors
    assert moment.kind is Meaning.TORQUE


def test_what_was_processed_may_be_said_behind_the_axis() -> None:
    (force,) = read_names([f"F{axis}_comp" for axis in "xyz"]).vectors
    assert (force.kind, force.is_processed) == (Meaning.FORCE, True)
