"""The exported ROS 2 package against stubs of the interfaces that it uses: it compiles, and drives as Python does."""

import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from autotune.errors import UsageError
from autotune.export.export import LIST, export_controller
from autotune.formats.controller import write_controller
from autotune.runtime import START, Fault, RuntimeController, step
from autotune.runtime.load import read_law
from tests.autotune.export.peer_cases import load_as_ros
from tests.autotune.export.ros2_driver import VERSIONS, Compiler, Driven, Numbers, exported, payload_of
from tests.autotune.formats.samples import make_controller

pytestmark = pytest.mark.usefixtures("unchecked_law")

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")

SUCCESS, ERROR = 0, 2


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "controller.yaml"
    write_controller(path, make_controller(("x", "y", "rz")))
    return path


@pytest.fixture(scope="module")
def compiler(source: Path, tmp_path_factory: pytest.TempPathFactory) -> "Compiler":
    return Compiler(source, tmp_path_factory.mktemp("compiled"))


@pytest.fixture(scope="module")
def law(source: Path) -> RuntimeController:
    return read_law(source)


def driver_of(compiler: Compiler, law: RuntimeController, version: str = "jazzy", **given: Any) -> Path:
    (axis,) = (each for each in law.axes if each.turns)
    payload = payload_of(compiler.package) | {"inertia_kg_m2": [0.0, 0.0, axis.payload_range[0]]}
    return compiler.driver(version, payload=payload | given.pop("payload", {}), **given)


def ready(driver: Path, law: RuntimeController, joints: Numbers) -> Driven:
    """Bring the controller up at rest."""
    driven = Driven(driver, round(1.0 / law.sample_time_s))
    assert driven.does("init") == SUCCESS
    assert driven.does("configure") == SUCCESS
    assert driven.does("activate", *map(float, joints), *map(float, at_rest(law, joints))) == SUCCESS
    return driven


def turn(joints: Numbers) -> NDArray[np.float64]:
    """Return R_WS of the arm: Rz Ry Rx."""
    return np.asarray(Rotation.from_euler("xyz", joints[3:]).as_matrix())


def at_rest(law: RuntimeController, joints: Numbers) -> NDArray[np.float64]:
    """Return what the sensor shows of weight and bias."""
    payload = law.payload
    weight = payload.mass_kg * turn(joints).T @ np.array(payload.gravity_W_m_s2)
    moment = np.cross(payload.com_S_m, weight)
    return np.concatenate([weight + payload.force_bias_S_n, moment + payload.torque_bias_S_n_m])


def joint_change(joints: Numbers, increment: Numbers) -> NDArray[np.float64]:
    """Return the change of the commanded joints, by a linear solution of its own."""
    at = turn(joints)
    z = Rotation.from_euler("z", joints[5]).as_matrix()
    zy = z @ Rotation.from_euler("y", joints[4]).as_matrix()
    axes = np.column_stack([zy[:, 0], z[:, 1], [0.0, 0.0, 1.0]])
    return np.concatenate([increment[:3], np.linalg.solve(axes, increment[3:])]) if at.size else np.zeros(6)


@needs_compiler
@pytest.mark.parametrize("version", VERSIONS)
def test_the_controller_commands_what_the_runtime_commands(
    compiler: Compiler, law: RuntimeController, version: str
) -> None:
    """Start check, pushes, a desired force and a wall, the measured arm lagging behind, to the last digits."""
    rng = np.random.default_rng(11)
    joints = np.array([0.4, -0.2, 0.6, 0.1, -0.15, 0.3])
    driven = ready(driver_of(compiler, law, version), law, joints)
    if version == "later":
        assert driven.does("chain") == 0
    state, commanded, faults, started = START, joints.copy(), set(), False
    for k in range(900):
        rest = at_rest(law, joints)
        push = np.zeros(6)
        if k > law.limits.rest_samples + 10:
            push = np.array([9.0 * np.sin(0.02 * k), 6.0, 0.0, 0.0, 0.0, 0.4 * np.sin(0.03 * k)])
        desired = np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]) if 500 < k < 700 else np.zeros(6)
        wrench = rest + push + rng.normal(0.0, 0.01, 6)
        answer = driven.update(law.sample_time_s, joints, wrench, desired)
        state, command = step(
            law,
            state,
            wrench_S=wrench.tolist(),
            position_W_m=joints[:3].tolist(),
            R_WS=turn(joints).tolist(),
            desired_S=desired.tolist(),
            tick=k,
        )
        world = np.concatenate([turn(joints) @ command.increment_S[:3], turn(joints) @ command.increment_S[3:]])
        commanded = commanded + joint_change(commanded, world)
        # The sines of the arm are computed twice, in another order.
        np.testing.assert_allclose(answer.commands, commanded, rtol=0.0, atol=1e-11)
        assert (answer.returned, answer.allocations) == (0, 0)
        faults.add(answer.fault)
        started = started or command.is_started
        joints = joints + 0.05 * (commanded - joints)
    assert faults == {0}
    assert started
    assert np.max(np.abs(commanded - [0.4, -0.2, 0.6, 0.1, -0.15, 0.3])) > 1e-3
    driven.close()


@needs_compiler
def test_velocities_are_the_changes_per_second_and_end_with_the_controller(
    compiler: Compiler, law: RuntimeController
) -> None:
    joints = np.zeros(6)
    driven = ready(driver_of(compiler, law, command_interface="velocity"), law, joints)
    state, seen = START, 0.0
    for k in range(law.limits.rest_samples + 200):
        wrench = at_rest(law, joints) + np.array([8.0 if k > law.limits.rest_samples else 0.0, 0, 0, 0, 0, 0])
        wrench[5] += 1e-6 * k
        answer = driven.update(law.sample_time_s, joints, wrench)
        state, command = step(
            law, state, wrench_S=wrench.tolist(), position_W_m=[0.0] * 3, R_WS=np.eye(3).tolist(),
            desired_S=[0.0] * 6, tick=k,
        )  # fmt: skip
        np.testing.assert_allclose(answer.commands, command.twist_S, rtol=0.0, atol=1e-9)
        seen = max(seen, float(np.max(np.abs(answer.commands))))
    assert seen > 1e-4
    assert driven.does("deactivate") == SUCCESS
    driven.close()


@dataclass(frozen=True)
class Broken:
    """One period that is not as it should be: its length in periods, and what stands in place of a reading."""

    fault: int
    periods: float = 1.0
    joint: float | None = None
    force: float | None = None


FAULTS = {
    "a wrench that is not a number": Broken(Fault.NOT_FINITE, force=np.nan),
    "a joint that is not a number": Broken(Fault.NOT_FINITE, joint=np.nan),
    "a late update": Broken(Fault.MISSED_TICK, periods=2.0),
    "an update too soon": Broken(Fault.REPEATED_TICK, periods=0.2),
    "a pose that jumps": Broken(Fault.JUMP, joint=5.0),
    "kinematics out of reach": Broken(100, joint=200.0),
}


@needs_compiler
def test_a_fault_holds_the_command_is_published_and_ends_with_a_new_activation(
    compiler: Compiler, law: RuntimeController
) -> None:
    driver, joints = driver_of(compiler, law), np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0])
    wrench = at_rest(law, joints)
    driven = ready(driver, law, joints)
    for what, case in FAULTS.items():
        for _ in range(law.limits.rest_samples + 5):
            answer = driven.update(law.sample_time_s, joints, wrench)
            assert (answer.fault, answer.level) == (0, 0), what
        held = answer.commands
        broken, felt = joints.copy(), wrench.copy()
        broken[0] = joints[0] if case.joint is None else case.joint
        felt[2] = wrench[2] if case.force is None else case.force
        for answer in (
            driven.update(law.sample_time_s * case.periods, broken, felt),
            driven.update(law.sample_time_s, joints, wrench + 5.0),
        ):
            assert (answer.fault, answer.level, answer.allocations) == (int(case.fault), 2, 0), what
            np.testing.assert_array_equal(answer.commands, held)
        assert driven.does("deactivate") == SUCCESS
        assert driven.does("activate", *map(float, joints), *map(float, wrench)) == SUCCESS
    driven.close()


@needs_compiler
def test_another_payload_at_the_start_is_a_fault(compiler: Compiler, law: RuntimeController) -> None:
    joints = np.zeros(6)
    driven = ready(driver_of(compiler, law), law, joints)
    wrench = at_rest(law, joints) + np.array([0.0, 0.0, -30.0, 0.0, 0.0, 0.0])
    found = {driven.update(law.sample_time_s, joints, wrench).fault for _ in range(law.limits.rest_samples + 2)}
    assert found == {0, int(Fault.RESIDUAL_WRENCH)}
    driven.close()


@needs_compiler
@pytest.mark.parametrize(
    ("rate_share", "payload", "message"),
    [
        (0.5, {}, "update rate must be"),
        (1.0, {"mass_kg": 99.0}, "payload's mass is outside"),
        (1.0, {"inertia_kg_m2": [0.0, 0.0, 0.0]}, "payload's inertia is outside"),
        (1.0, {"com_m": [0.0, 0.0]}, "must hold 3 numbers"),
    ],
)
def test_a_cell_outside_of_the_certificate_is_not_configured(
    compiler: Compiler, law: RuntimeController, rate_share: float, payload: dict[str, Any], message: str
) -> None:
    driven = Driven(driver_of(compiler, law, payload=payload), round(rate_share / law.sample_time_s))
    assert driven.does("init") == SUCCESS
    assert driven.does("configure") == ERROR
    assert message in driven.close()


def test_every_parameter_of_the_config_is_declared_and_typed(source: Path, tmp_path: Path) -> None:
    package = exported(source, tmp_path, command_interface="velocity", joints=("a", "b", "c", "d", "e", "f"))
    declared = YAML(typ="safe").load((package / "src" / "cell_admittance_parameters.yaml").read_text(encoding="utf-8"))
    config = load_as_ros((package / "config" / "controller.yaml").read_text(encoding="utf-8"))
    given = dict(config["admittance_controller"]["ros__parameters"])
    assert given.pop("type") == config["controller_manager"]["ros__parameters"]["admittance_controller"]["type"]

    def compare(tree: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        assert set(values) <= set(tree)
        for key, each in tree.items():
            if "type" in each:
                kinds = {"string": str, "double": float, "string_array": list, "double_array": list}
                assert isinstance(values.get(key, each.get("default_value")), kinds[each["type"]]), key
            else:
                compare(each, values[key])

    compare(declared["cell_admittance"], given)
    assert given["command_interface"] == "velocity"


def test_the_package_names_itself_alike_everywhere(source: Path, tmp_path: Path) -> None:
    package = exported(source, tmp_path)
    plugin = ET.parse(package / "cell_admittance_plugin.xml").getroot()
    (each,) = plugin.findall("class")
    assert each.get("type") == "cell_admittance::AdmittanceController"
    assert each.get("base_class_type") == "controller_interface::ChainableControllerInterface"
    manifest = ET.parse(package / "package.xml").getroot()
    assert manifest.findtext("name") == "cell_admittance"
    cmake = (package / "CMakeLists.txt").read_text(encoding="utf-8")
    depends = {each.text for each in manifest.iter() if each.tag in {"depend", "build_depend"}} - {"eigen"}
    assert depends == set(re.findall(r"find_package\((\w+) REQUIRED\)", cmake)) - {"ament_cmake"}
    for name in re.findall(r"src/\S+\.(?:c|cpp|yaml)\b", cmake):
        assert (package / name).is_file()
    compile((package / "launch" / "controller.launch.py").read_text(encoding="utf-8"), "launch", "exec")
    assert "has **not** been built with colcon" in (package / "README.md").read_text(encoding="utf-8")
    assert not re.search(r"\$\{?[a-z]", (package / "src" / "admittance_controller.cpp").read_text(encoding="utf-8"))


def test_a_folder_with_anything_else_is_left_alone(source: Path, tmp_path: Path) -> None:
    package = exported(source, tmp_path)
    assert exported(source, tmp_path) == package  # an unaltered one is replaced
    extra = package / "src" / "mine.cpp"
    extra.write_text("int mine;\n", encoding="ascii")
    with pytest.raises(UsageError, match=r"holds src/mine\.cpp beside an earlier export"):
        exported(source, tmp_path)
    extra.unlink()
    config = package / "config" / "controller.yaml"
    config.write_text(config.read_text(encoding="utf-8").replace("joint_1", "elbow"), encoding="utf-8")
    with pytest.raises(UsageError, match=r"controller\.yaml was changed since it was exported"):
        exported(source, tmp_path)
    assert "elbow" in config.read_text(encoding="utf-8")
    (package / LIST).unlink()
    with pytest.raises(UsageError, match="is no earlier export"):
        exported(source, tmp_path)


@pytest.mark.parametrize("name", ["Cell", "9cell", "a__b", "cell-1", "c"])
def test_a_name_that_is_none_of_a_package_is_refused(source: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="must be named as a ROS package"):
        export_controller(source, "ros2_package", tmp_path / name)
    assert not (tmp_path / name).exists()


def test_what_a_failed_export_leaves_is_what_was_there(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = exported(source, tmp_path)
    before = {each: each.read_bytes() for each in package.rglob("*") if each.is_file()}
    other = tmp_path / "other.yaml"
    write_controller(other, replace(make_controller(("x",)), delay_samples=4.0))

    def fail(*_: Path) -> bool:
        raise OSError(28, "no space")

    monkeypatch.setattr("autotune.formats.atomic.exchange", fail)
    with pytest.raises(UsageError, match="cannot be written"):
        export_controller(other, "ros2_package", package)
    assert {each: each.read_bytes() for each in package.rglob("*") if each.is_file()} == before
    assert [each.name for each in tmp_path.iterdir() if each.is_dir()] == ["cell_admittance"]
