"""Parameters for a node of one's own: what ROS reads is the controller, every double exactly."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import UsageError
from autotune.export.export import export_controller
from autotune.formats.controller import controller_tree, write_controller
from autotune.formats.controller_record import Controller
from autotune.runtime.load import read_law
from tests.autotune.export.peer_cases import load_as_ros
from tests.autotune.formats.samples import make_controller

pytestmark = pytest.mark.usefixtures("unchecked_law")


def exported(folder: Path, controller: Controller, **options: Any) -> dict[str, Any]:
    write_controller(folder / "controller.yaml", controller)
    export_controller(folder / "controller.yaml", "ros2_params", folder / "params.yaml", options=options)
    return load_as_ros((folder / "params.yaml").read_text(encoding="utf-8"))


def leaves(tree: Any, within: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {within: tree}
    return {name: leaf for key, each in tree.items() for name, leaf in leaves(each, f"{within}.{key}").items()}


@pytest.mark.parametrize("axes", [("x",), ("x", "rz")])
def test_what_ros_reads_is_the_controller(tmp_path: Path, axes: tuple[str, ...]) -> None:
    controller = make_controller(axes)
    (node,) = (tree := exported(tmp_path, controller))
    found, written = tree[node]["ros__parameters"], controller_tree(controller)
    assert node == "/**"
    assert found["checksum"] == written["checksum"]
    assert found["tuned_axes"] == list(axes)
    for name in ("sample_time_s", "delay_samples", "discretization", "axes", "filters", "payload"):
        assert found[name] == written[name]  # equal to the last bit


def test_limits_of_an_earlier_file_are_those_of_the_runtime(tmp_path: Path) -> None:
    found = exported(tmp_path, replace(make_controller(), limits=None))["/**"]["ros__parameters"]["limits"]
    limits = read_law(tmp_path / "controller.yaml").limits
    assert (found["force_n"], found["rest_samples"]) == (limits.force_n, limits.rest_samples)
    assert found["axes"]["x"] == {"speed": limits.axes["x"].speed, "acceleration": limits.axes["x"].acceleration}


def test_numbers_are_doubles_and_nothing_is_empty(tmp_path: Path) -> None:
    """ROS refuses an integer for a double parameter, and has no parameter without a value."""
    for name, value in leaves(exported(tmp_path, make_controller())).items():
        kind = int if name.endswith("rest_samples") else (float, str, list)
        assert isinstance(value, kind), name


def test_the_file_may_be_for_one_node(tmp_path: Path) -> None:
    assert set(exported(tmp_path, make_controller(), node_name="my_node")) == {"my_node"}
    with pytest.raises(UsageError, match="--node-name"):
        exported(tmp_path, make_controller(), node_name="my node")
