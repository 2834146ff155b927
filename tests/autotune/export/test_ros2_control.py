"""The admittance controller of ros2_controllers: what is written of springs, damping, masses and versions."""

import itertools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.export.ros2_axis import Ros2Axis, with_common_masses
from autotune.export.ros2_control import Ros2Options, parse_version
from autotune.export.third_party import Translation
from autotune.validation.law import certify_law
from problems.model.third_party_controllers import alternates
from tests.autotune.export.peer_cases import EASY, PERIOD_S, PLAIN, exported, parameters, peer_controller, task_of


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Translation:
    return exported(tmp_path_factory.mktemp("plain"), peer_controller({"x": PLAIN}, EASY), Ros2Options())


def test_the_joints_damping_is_kept_the_filter_switched_off_and_the_weight_in_newtons(plain: Translation) -> None:
    found = parameters(plain)
    assert found["admittance"]["joint_damping"] == 5.0
    assert found["ft_sensor"]["filter_coefficient"] == 1.0
    assert found["gravity_compensation"]["CoG"] == {"pos": [0.01, -0.02, 0.1], "force": 156.9064}
    assert found["enable_parameter_update_without_reactivation"] is False


def test_the_return_spring_is_reported_and_axes_that_were_not_tuned_are_damped_alike(plain: Translation) -> None:
    found = parameters(plain)["admittance"]
    assert found["selected_axes"] == [True, False, False, False, False, False]
    assert found["mass"] == [PLAIN.mass] * 3 + [1.0] * 3
    mass, stiffness = np.array(found["mass"]), np.array(found["stiffness"])
    # B_a over ten hours, and D/M and S/M the same on all axes, to the six digits that are written.
    assert stiffness[0] == pytest.approx(PLAIN.damping / 36e3, rel=1e-5)
    damping = 2.0 * np.array(found["damping_ratio"]) * np.sqrt(mass * stiffness)
    np.testing.assert_allclose(damping / mass, PLAIN.damping / PLAIN.mass - 5.0, rtol=1e-5)
    np.testing.assert_allclose(stiffness / mass, stiffness[0] / mass[0], rtol=1e-5)
    text = re.sub(r"\n#\s*", " ", plain.text)
    assert "0.00833 N per 100 mm, with a time constant of 36000 s: what was pushed away comes back by 0.17 %" in text
    assert "y, z, rx, ry, rz were not tuned" in text
    assert plain.axes[0].certificate.spring_share is not None


def test_a_spring_of_one_s_own_is_written_as_it_is_and_reported(tmp_path: Path) -> None:
    made = exported(tmp_path, peer_controller({"x": PLAIN}, EASY), Ros2Options(return_stiffness=1.0))
    assert parameters(made)["admittance"]["stiffness"][:3] == [1.0] * 3
    # 1 − exp(−60/3000).
    assert "a time constant of 3000 s: what was pushed away comes back by 2 % in a minute" in made.axes[0].notes[0]


def test_much_mass_beside_little_damping_keeps_a_tenth_of_its_damping_out_of_the_joints() -> None:
    """5 M of a mass of 30 kg is more than the damping that was asked for."""
    heavy = replace(PLAIN, mass=30.0, damping=120.0)
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    for fixed in (None, 30.0):
        axis = Ros2Axis(task=task, gains=heavy, fixed_mass=fixed)
        for values in (axis.translated, *itertools.product(*((each.low, each.high) for each in axis.variables))):
            rule = axis.rule(values)
            # Six digits are written.
            assert rule.damping >= 0.1 * rule.total_damping * (1.0 - 1e-4)
        assert axis.written(axis.translated)["mass"] == pytest.approx(30.0, rel=1e-6)


@pytest.mark.parametrize("version", ["humble", "2.60.1", "lyrical"])
def test_older_and_newer_releases_run_the_same_rule(tmp_path: Path, plain: Translation, version: str) -> None:
    made = exported(tmp_path, peer_controller({"x": PLAIN}, EASY), Ros2Options(ros2_version=version))
    assert parameters(made) == parameters(plain)
    text = re.sub(r"\n#\s*", " ", made.text)
    is_old = version != "lyrical"
    assert ("own parameter robot_description" in text) == is_old
    assert ("no ~/wrench_reference to add −bias on" in text) == is_old
    # The bias of the sample controller, with its sign turned.
    assert ("publish −bias there before a contact, (-1.5, 0.25, -3, -0.1, -0.2, 0)" in text) == (not is_old)
    assert "the arm jumps by the whole way that it was pushed" in text


def test_a_strong_filter_is_certified_as_it_is() -> None:
    """The default coefficient delays the force so much that the translated gains no longer hold."""
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    filtered = Ros2Axis(task=task, gains=PLAIN, filter_coefficient=0.05)
    open_ = Ros2Axis(task=task, gains=PLAIN)
    late, plain = (certify_law(task, axis.law(axis.translated)) for axis in (filtered, open_))
    assert plain.margins is not None
    assert late.margins is None or late.margins.values["modulus"] < 0.95 * plain.margins.values["modulus"]


@pytest.mark.parametrize(
    ("version", "common"), [("6.3.0", True), ("6.4.0", False), ("jazzy", True), ("rolling", False)]
)
def test_masses_are_common_where_they_are_read_in_the_base_frame(tmp_path: Path, version: str, common: bool) -> None:
    axes = {"x": PLAIN, "z": replace(PLAIN, mass=9.0)}
    made = exported(tmp_path, peer_controller(axes, EASY), Ros2Options(ros2_version=version))
    assert parameters(made)["admittance"]["mass"][:3] == ([9.0, 9.0, 9.0] if common else [8.0, 9.0, 9.0])
    assert ("in the frame of kinematics.base" in re.sub(r"\n#\s*", " ", made.text)) == common
    # What is written was certified with its common mass.
    assert made.axes[0].written["mass"] == (9.0 if common else 8.0)
    assert made.axes[0].tuned_because is None


def test_a_common_mass_is_kept_by_a_search_and_is_enough_for_every_damping() -> None:
    """Equal masses would part if each axis were tuned by itself; the most damped axis needs the most mass."""
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    for mass, common in ((PLAIN.mass, PLAIN.mass), (1.0, PERIOD_S * PLAIN.damping)):
        gains = {"x": replace(PLAIN, mass=mass, damping=500.0), "z": replace(PLAIN, mass=mass)}
        axes = {name: Ros2Axis(task=task, gains=each) for name, each in gains.items()}
        for axis in with_common_masses(axes).values():
            assert axis.written(tuple(each.high for each in axis.variables))["mass"] == pytest.approx(common, rel=1e-4)
            assert not alternates(axis.law(axis.translated))


@pytest.mark.parametrize(
    ("text", "known"),
    [
        *((text, True) for text in ("2.54.0", "2.99.0", "4.0.0", "6.99.9")),
        *((text, False) for text in ("2.53.9", "3.0.0", "3.9.9", "7.0.0", "2.54", "foxy")),
    ],
)
def test_a_version_is_known_from_the_first_that_runs_the_rule_to_the_last(text: str, known: bool) -> None:
    if known:
        assert parse_version(text) == tuple(int(each) for each in text.split("."))
        return
    with pytest.raises(UsageError, match=rf"--ros2-version must be humble, .* from 4\.0\.0 to 6\.x, found {text}\."):
        parse_version(text)
