"""The exported ROS 2 package, compiled against stubs of the interfaces that it uses, and driven from here."""

import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from autotune.export.export import export_controller
from tests.autotune.export.peer_cases import load_as_ros

STUBS = Path(__file__).parent / "ros2_stubs"


FLAGS = ("-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off")


VERSIONS = {"humble": 16, "jazzy": 28, "later": 29}


# Every header of ROS 2 and Eigen that the package may include; `realtime_tools` changed the ending.
HEADERS = (
    "controller_interface/chainable_controller_interface.hpp",
    "diagnostic_msgs/msg/diagnostic_array.hpp",
    "geometry_msgs/msg/wrench_stamped.hpp",
    "hardware_interface/types/hardware_interface_type_values.hpp",
    "kinematics_interface/kinematics_interface.hpp",
    "pluginlib/class_list_macros.hpp",
    "pluginlib/class_loader.hpp",
    "rclcpp/logging.hpp",
    "rclcpp/rclcpp.hpp",
    "rclcpp/version.h",
    "rclcpp_lifecycle/state.hpp",
    "semantic_components/force_torque_sensor.hpp",
)


_TYPES = {
    "string": "std::string",
    "double": "double",
    "string_array": "std::vector<std::string>",
    "double_array": "std::vector<double>",
}


Numbers = Sequence[float] | NDArray[np.float64]


def exported(source: Path, folder: Path, **options: Any) -> Path:
    package = folder / "cell_admittance"
    export_controller(source, "ros2_package", package, options=options)
    return package


def literal(value: Any) -> str:
    if isinstance(value, list):
        return f"{{{', '.join(map(literal, value))}}}"
    return f'"{value}"' if isinstance(value, str) else repr(float(value))


def struct(tree: Mapping[str, Any], name: str) -> Iterator[str]:
    """Return the lines of what generate_parameter_library makes of a declaration."""
    yield f"struct {name} {{"
    for key, each in tree.items():
        if "type" in each:
            yield f"{_TYPES[each['type']]} {key}{{}};"
        else:
            yield from struct(each, key.capitalize())
            yield f"{key.capitalize()} {key};"
    yield "};"


def assignments(tree: Mapping[str, Any], values: Mapping[str, Any], path: str) -> Iterator[str]:
    """Return the lines that give every parameter its value or its default."""
    for key, each in tree.items():
        if "type" in each:
            yield f"{path}.{key} = {literal(values.get(key, each.get('default_value')))};"
        else:
            yield from assignments(each, values[key], f"{path}.{key}")


def declared_parameters(package: Path) -> Mapping[str, Any]:
    declared = YAML(typ="safe").load((package / "src" / "cell_admittance_parameters.yaml").read_text(encoding="utf-8"))
    found: Mapping[str, Any] = declared["cell_admittance"]
    return found


def parameters_struct(package: Path) -> str:
    lines = struct(declared_parameters(package), "Params")
    return "\n".join(
        ("#pragma once\n#include <string>\n#include <vector>", "namespace cell_admittance {", *lines, "}\n")
    )


def parameters_values(package: Path, given: Mapping[str, Any]) -> str:
    """Return the definition of what a listener answers; the package is compiled without it."""
    config = load_as_ros((package / "config" / "controller.yaml").read_text(encoding="utf-8"))
    values = config["admittance_controller"]["ros__parameters"] | given
    lines = assignments(declared_parameters(package), values, "given")
    return "\n".join(
        (
            '#include "cell_admittance_params.hpp"',
            "namespace cell_admittance {",
            "Params given_params();",
            "Params given_params() {",
            "Params given;",
            *lines,
            "return given;",
            "}",
            "}\n",
        )
    )


LISTENER = """#pragma once
#include <memory>
#include <rclcpp/rclcpp.hpp>
#include "cell_admittance_params.hpp"
namespace cell_admittance {
Params given_params();
class ParamListener {
public:
explicit ParamListener(std::shared_ptr<rclcpp_lifecycle::LifecycleNode>) {}
Params get_params() const { return given_params(); }
};
}
"""


@dataclass(frozen=True)
class Compiler:
    """Compiles the package of a controller once for each version, and its drivers once for each set of parameters."""

    source: Path
    folder: Path
    built: dict[str, Path] = field(default_factory=dict)

    @cached_property
    def package(self) -> Path:
        return exported(self.source, self.folder)

    def driver(self, version: str = "jazzy", **given: Any) -> Path:
        """Return the driver of a package with parameters in place of those of its own file."""
        key = repr((version, sorted(given.items())))
        if key not in self.built:
            folder = self.folder / str(len(self.built))
            folder.mkdir()
            self.built[key] = self._compiled(folder, version, given)
        return self.built[key]

    def _compiled(self, folder: Path, version: str, given: Mapping[str, Any]) -> Path:
        """Compile the values of the parameters and link them to the rest; every warning is an error."""
        parts = self._package(version)
        (folder / "values.cpp").write_text(parameters_values(self.package, given), "ascii")
        include = [self.folder / version / "include"]
        run(cpp_compiler(include, version), folder / "values.cpp", *parts, "-o", folder / "driver")
        return folder / "driver"

    def _package(self, version: str) -> tuple[Path, ...]:
        """Return the package's own C and C++ for a version and what drives it, compiled once."""
        folder, package = self.folder / version, self.package
        parts = tuple(folder / name for name in ("c.o", "controller.o", "driver.o"))
        if not folder.exists():
            include = headers(folder, version)
            header = include / ("" if version == "humble" else "cell_admittance")
            header.mkdir(exist_ok=True)
            (include / "cell_admittance_params.hpp").write_text(parameters_struct(package), "ascii")
            (header / "cell_admittance_parameters.hpp").write_text(LISTENER, "ascii")
            paths = [include, STUBS, package / "include", package / "include" / "cell_admittance"]
            run(c_compiler(paths), "-c", package / "src" / "cell_admittance.c", "-o", parts[0])
            run(cpp_compiler(paths, version), "-c", package / "src" / "admittance_controller.cpp", "-o", parts[1])
            run(cpp_compiler([include, STUBS], version), "-c", STUBS / "driver.cpp", "-o", parts[2])
        return parts


def headers(folder: Path, version: str) -> Path:
    """Write every header that a package includes, which lead to the stubs, and return their folder."""
    include = folder / "include"
    ending = "h" if version == "humble" else "hpp"
    for name in (*HEADERS, f"realtime_tools/realtime_buffer.{ending}", f"realtime_tools/realtime_publisher.{ending}"):
        (include / name).parent.mkdir(parents=True, exist_ok=True)
        (include / name).write_text('#include "stubs.hpp"\n', encoding="ascii")
    return include


def c_compiler(paths: Sequence[Path]) -> tuple[str, ...]:
    return ("gcc", "-std=c99", *FLAGS, *(f"-I{each}" for each in paths))


def cpp_compiler(paths: Sequence[Path], version: str) -> tuple[str, ...]:
    define = f"-DSTUB_RCLCPP_MAJOR={VERSIONS[version]}"
    return ("g++", "-std=c++17", *FLAGS, define, *(f"-I{each}" for each in paths))


def run(compiler: Sequence[str], *arguments: str | Path) -> None:
    done = subprocess.run([*compiler, *map(str, arguments)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@dataclass(frozen=True)
class Answer:
    returned: int
    allocations: int
    level: int
    fault: int
    commands: NDArray[np.float64]


class Driven:
    """The compiled controller, as a controller manager drives it."""

    def __init__(self, driver: Path, rate_hz: int) -> None:
        self.process = subprocess.Popen(
            [str(driver), str(rate_hz)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def ask(self, *words: object) -> list[str]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(
            " ".join(f"{each!r}" if isinstance(each, float) else str(each) for each in words) + "\n"
        )
        self.process.stdin.flush()
        return self.process.stdout.readline().split()

    def does(self, *words: object) -> int:
        return int(self.ask(*words)[0])

    def update(self, period_s: float, joints: Numbers, wrench: Numbers, desired: Numbers = (0.0,) * 6) -> Answer:
        found = self.ask("update", period_s, *map(float, joints), *map(float, wrench), *map(float, desired))
        returned, allocations, level, fault = (int(each) for each in found[:4])
        commands = np.array([float(each) for each in found[4:]])
        return Answer(returned, allocations, level, fault, commands)

    def close(self) -> str:
        _, said = self.process.communicate()
        return said


def payload_of(package: Path) -> dict[str, Any]:
    config = load_as_ros((package / "config" / "controller.yaml").read_text(encoding="utf-8"))
    found: dict[str, Any] = config["admittance_controller"]["ros__parameters"]["payload"]
    return found
