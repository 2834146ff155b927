"""Programs whose law is mass, damping and spring: what is written is what was certified, and what is theirs is told."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.export.cartesian_vic import CARTESIAN_VIC
from autotune.export.crisp import CRISP
from autotune.export.export import export_controller
from autotune.export.lbr_fri_ros2 import LBR_FRI_ROS2, _check
from autotune.export.mdk import MdkOptions
from autotune.export.target import ExportTarget
from autotune.export.urscript import STEP_TIME_S, URSCRIPT
from autotune.formats.controller import write_controller
from autotune.formats.controller_record import Controller
from autotune.validation.law import certify_law
from problems.model.mass_damper_controllers import Discretization, MassDamper
from tests.autotune.export.peer_cases import (
    EASY,
    PLAIN,
    SLOW,
    at_500_hz,
    load_as_ros,
    peer_controller,
    requirements,
    task_of,
)

UPRIGHT = {"orientation": (0.0, 0.0, 0.0, 1.0)}


def exported(folder: Path, target: ExportTarget, controller: Controller, **options: object) -> str:
    write_controller(folder / "controller.yaml", controller)
    export_controller(folder / "controller.yaml", target.name, folder / "out.txt", options=options)
    return (folder / "out.txt").read_text(encoding="utf-8")


def flat(text: str) -> str:
    return re.sub(r"\n#\s*", " ", text)


def arguments(text: str) -> Mapping[str, list[float]]:
    """Return the lists that the script is called with."""
    (call,) = re.findall(r"^  admittance_control\((.*)\)$", text, re.MULTILINE)
    found = re.findall(r"(\w+) = \[([^\]]*)\]", call)
    return {name: [float(each) for each in numbers.split(",")] for name, numbers in found}


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("urscript")
    return exported(folder, URSCRIPT, at_500_hz(peer_controller({"x": replace(PLAIN, deadband=4.0)}, EASY)))


def test_the_script_calls_with_what_was_certified(script: str) -> None:
    called = arguments(script)
    rule = MassDamper(
        discretization=Discretization.TRAPEZOIDAL,
        mass=called["mass_list"][0],
        damping=called["damping_list"][0],
    )
    assert certify_law(task_of(at_500_hz(peer_controller({"x": PLAIN}, EASY))), rule.law(STEP_TIME_S)).holds
    assert called["compliance_vector"] == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert called["stiffness_params"] == called["target_wrench"] == [0.0] * 6
    assert all(len(called[name]) == 6 for name in ("mass_list", "damping_list"))


def test_the_script_s_subtracted_deadband_is_kept_unless_a_peak_is_limited(script: str, tmp_path: Path) -> None:
    assert arguments(script)["dead_band"] == [4.0, 0.0, 0.0, 0.0]
    assert "deadband (4 N, 0 N·m) is subtracted" in flat(script)
    limited = at_500_hz(peer_controller({"x": replace(PLAIN, deadband=4.0)}, EASY | {"max_peak_force_n": 400.0}))
    assert arguments(exported(tmp_path, URSCRIPT, limited))["dead_band"] == [0.0] * 4


def test_an_acceleration_that_the_script_would_cut_is_reported(script: str) -> None:
    """The peak in the sensor over the mass, beside the 5 m/s² of its last line."""
    found = re.search(r"speed changes by up to (\S+) m/s²", flat(script))
    (mass,) = {arguments(script)["mass_list"][0]}
    peak = re.search(r"largest contact force (\S+) N", flat(script))
    if found is None:
        assert peak is not None
        assert float(peak.group(1)) / mass < 5.0
    else:
        assert float(found.group(1)) > 5.0


def test_a_script_has_a_period_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"urscript runs every 2 ms .* is for 0\.8 ms; .*optimize \S+ --for urscript"):
        exported(tmp_path, URSCRIPT, peer_controller({"x": PLAIN}, EASY))


def test_the_admittance_of_crisp_is_that_of_the_file_and_axes_that_do_not_move_are_held(tmp_path: Path) -> None:
    text = exported(tmp_path, CRISP, peer_controller({"x": PLAIN}, EASY), **UPRIGHT)
    found = load_as_ros(text)["admittance_controller"]["ros__parameters"]["admittance"]
    assert (found["mass_x"], found["damping_x"], found["stiffness_x"]) == (PLAIN.mass, PLAIN.damping, 0.0)
    assert (found["mass_y"], found["damping_y"], found["stiffness_y"]) == (100.0, 5000.0, 900.0)
    assert found["stiffness_rz"] == 60.0
    assert "no axis can be left out there" in flat(text)
    with pytest.raises(UsageError, match="Give that of the sensor in the base"):
        exported(tmp_path, CRISP, peer_controller({"x": PLAIN}, EASY))


def test_gains_beyond_what_crisp_declares_are_tuned_within_it(tmp_path: Path) -> None:
    heavy = peer_controller({"x": replace(PLAIN, damping=6000.0, mass=20.0)}, requirements(1e-4))
    text = exported(tmp_path, CRISP, heavy, **UPRIGHT)
    assert "since the translated gains fail: damping must be from 0 to 5000" in flat(text)
    found = load_as_ros(text)["admittance_controller"]["ros__parameters"]["admittance"]
    assert found["damping_x"] <= 5000.0


def test_the_rule_that_damps_measured_motion_gets_its_damping_from_a_spring_within_declared_ranges(
    tmp_path: Path,
) -> None:
    controller = peer_controller({"x": PLAIN}, SLOW)
    text = exported(tmp_path, CARTESIAN_VIC, controller)
    found = load_as_ros(text)["admittance_controller"]["ros__parameters"]["vic"]
    mass, ratio, stiffness = found["inertia"][0], found["damping_ratio"][0], found["stiffness"][0]
    assert 0.0 < ratio <= 5.0
    assert 0.0 < stiffness <= 1000.0
    rule = MassDamper(
        discretization=Discretization.MEASURED_MOTION,
        mass=mass,
        damping=2.0 * ratio * (mass * stiffness) ** 0.5,
        stiffness=stiffness,
    )
    certificate = certify_law(task_of(controller), rule.law(controller.sample_time_s))
    assert certificate.holds
    assert certificate.spring_share is not None
    assert found["selected_axes"] == [True, False, False, False, False, False]
    assert found["inertia"][1:] == [1e6] * 5
    assert "pulls back with" in flat(text)


def test_the_lbr_s_filter_is_part_of_what_is_certified(tmp_path: Path) -> None:
    controller = peer_controller({"x": PLAIN}, SLOW)
    text = exported(tmp_path, LBR_FRI_ROS2, controller, **UPRIGHT)
    found = load_as_ros(text)["admittance_controller"]["ros__parameters"]
    rule = MassDamper(
        discretization=Discretization.FROM_MEASURED,
        mass=found["admittance"]["mass"][0],
        damping=found["admittance"]["damping"][0],
        filter_time_s=found["filter"]["joint_velocity_tau"],
    )
    assert certify_law(task_of(controller), rule.law(controller.sample_time_s)).holds
    assert found["inv_jac_ctrl"]["cartesian_gains"] == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("orientation", "message"),
    [
        (None, "Give the sensor's orientation"),
        ((0.0, 0.0, 0.70710678, 0.70710678), "neither; hold the tool otherwise"),
        ((0.0, 0.0, 0.38268343, 0.92387953), "turn by right angles"),
    ],
)
def test_the_lbr_s_turned_wrench_holds_in_half_turns_only(
    tmp_path: Path, orientation: tuple[float, ...] | None, message: str
) -> None:
    options = {} if orientation is None else {"orientation": orientation}
    with pytest.raises(UsageError, match=message):
        exported(tmp_path, LBR_FRI_ROS2, peer_controller({"x": PLAIN}, SLOW), **options)


@pytest.mark.parametrize("half_turns", [0.0, 180.0])
@pytest.mark.parametrize("axis", range(3))
def test_the_lbr_s_tip_may_be_turned_by_half_a_degree_beside_a_half_turn(axis: int, half_turns: float) -> None:
    """R - Rᵀ of a turn by an angle has ±2 sin of it beside its diagonal, of which 0.02 are let through."""

    def check(degrees: float) -> None:
        half = math.radians(degrees) / 2.0
        turned = [math.sin(half) if i == axis else 0.0 for i in range(3)]
        options = MdkOptions(orientation=(turned[0], turned[1], turned[2], math.cos(half)))
        _check({"x": PLAIN}, options)

    for degrees in (half_turns, half_turns + 0.57, half_turns - 0.57):
        check(degrees)
    for degrees in (half_turns + 0.58, half_turns - 0.58, half_turns + 90.0, half_turns - 90.0):
        with pytest.raises(UsageError, match=r"only where the two are the same.* The orientation .* is neither;"):
            check(degrees)


def test_the_lbr_s_turning_axes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no turning axis"):
        exported(tmp_path, LBR_FRI_ROS2, peer_controller({"rz": PLAIN}, SLOW), **UPRIGHT)
