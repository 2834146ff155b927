"""A plant that a person writes: what it is certified for, its file, and what is refused with line and key."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import autotune as at
from autotune.errors import UsageError
from autotune.explore.source import read_exploration
from autotune.formats.controller_record import RuntimePayload
from autotune.formats.plant import Plant, exact_within
from autotune.formats.plant_file import parse_plant, read_plant
from autotune.formats.problem import ProblemSpec
from autotune.formats.quantity import Uncertain
from autotune.formats.robot import Robot
from autotune.formats.yaml12 import load_document
from autotune.maps.source import read_source
from autotune.tuning.optimize import carried_payload
from autotune.tuning.problems import build_problems, within_domain
from identification.result import Status
from problems.errors import ParameterError
from problems.model.robot import bandwidth_hz

TEXT = """format: autotune/plant
version: 1
mass: 16
coupling_stiffness: [2.8e+5, 3.2e+5]
drag: 630
robot:
  bandwidth: 3.2
  delay: {value: 0.0024, std: 0.0001}
environment_stiffness: [2.0e+4, 5.0e+5]
sample_time: 0.0008
"""


def plant(**changes: Any) -> Plant:
    values: dict[str, Any] = {
        "mass": 16,
        "coupling_stiffness": (2.8e5, 3.2e5),
        "drag": 630,
        "robot": Robot(bandwidth=3.2, delay=Uncertain(0.0024, 0.0001)),
        "environment_stiffness": (2e4, 5e5),
        "sample_time": 8e-4,
    }
    return Plant(**values | changes)


def written(tmp_path: Path, text: str = TEXT) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"environment_stiffness": (2e4, 2e9)}, r"environment_stiffness must be at most 1e\+09 N/m"),
        ({"coupling_stiffness": 2e9}, r"coupling_stiffness must be at most 1e\+09 N/m"),
        ({"coupling_damping": 2e7}, r"coupling_damping must be at most 1e\+07 N·s/m"),
        ({"drag": 2e6}, r"drag must be at most 1e\+06 N·s/m"),
        ({"sample_time": 8e-10}, "sample_time must be at least 1e-05 s"),
        ({"mass": Uncertain(16, 6)}, r"mass must be greater than 0 three deviations .*-2, found Uncertain\(value=16"),
    ],
)
def test_the_limits_of_a_controller_file_hold_for_its_plant(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        plant(**changes)


def test_a_robot_without_any_number_is_refused_for_what_is_missing() -> None:
    with pytest.raises(
        ParameterError, match="bandwidth must be given, or numerator and denominator instead, found None"
    ):
        Robot()


def test_a_file_is_the_plant_that_it_says(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert parse_plant(load_document(path, error=UsageError)) == plant()
    again = tmp_path / "again.yaml"
    plant().save(again)
    assert parse_plant(load_document(again, error=UsageError)) == plant()


def test_a_plain_number_is_exact_and_a_range_is_the_domain() -> None:
    assert plant().exact() == ("mass", "coupling_damping", "drag", "robot.bandwidth")
    assert plant().domain() == {
        "payload_mass_kg": (16.0, 16.0),
        "environment_stiffness_n_per_m": (2e4, 5e5),
        "coupling_stiffness_n_per_m": (2.8e5, 3.2e5),
        # Three deviations to each side.
        "delay_s": pytest.approx((0.0021, 0.0027), rel=1e-12),
    }
    (message,) = (each.message for each in plant().file().result.findings if each.code == "taken-as-exact")
    assert message.endswith("mass, coupling_damping, drag, robot.bandwidth.")


def test_the_design_problem_holds_that_domain() -> None:
    source = plant().file()
    problems = build_problems(source.result, within_domain(ProblemSpec(), source.domain))
    (problem,) = problems.values()
    assert problem.plants.payload_mass_kg == (16.0, 16.0)
    assert problem.plants.environment_stiffness_n_per_m == (2e4, 5e5)
    assert set(problem.plants.further) == {"coupling_stiffness_n_per_m", "delay_s"}
    assert problem.plants.ellipsoid is None
    assert problem.plants.nominal.robot.delay_s == pytest.approx(0.0024, rel=1e-12)


def test_what_is_asked_wins_over_the_plant() -> None:
    asked = ProblemSpec(payload_mass=(10.0, 22.0), uncertain={"delay_s": (0.002, 0.003)})
    within = within_domain(asked, plant().domain())
    assert within.payload_mass == (10.0, 22.0)
    assert within.uncertain["delay_s"] == (0.002, 0.003)
    assert within.environment_stiffness == (2e4, 5e5)


@given(bandwidth=st.floats(0.5, 50.0), ratio=st.one_of(st.none(), st.floats(0.2, 2.0)))
def test_the_robot_has_the_bandwidth_that_was_said(bandwidth: float, ratio: float | None) -> None:
    found = Robot(bandwidth=bandwidth, damping_ratio=ratio).model()
    # Bisection over the whole range of doubles between 1e-2 and 1e4 Hz: as close as rounding of |r| lets it come.
    assert bandwidth_hz(found) == pytest.approx(bandwidth, rel=1e-9)


def test_every_parameter_is_given_and_the_payload_is_left_to_the_cell() -> None:
    result = plant().file().result
    assert result.payload.mass_kg.status is Status.GIVEN
    assert result.payload.com_m.value is None
    assert result.axes["x"].robot.delay_s.value == pytest.approx(0.0024, rel=1e-12)
    # The middle of a range that covers more than a factor of three is the geometric one.
    assert result.axes["x"].environments[0].stiffness_n_per_m.value == pytest.approx(math.sqrt(2e4 * 5e5), rel=1e-12)


def test_map_and_explore_take_the_file(tmp_path: Path) -> None:
    path = written(tmp_path)
    source = read_source(path, axis=None, controller=None)
    assert source.axis == "x"
    assert source.known["payload_mass"] == 16.0
    assert source.missing == {}
    with pytest.raises(UsageError, match="neither a plant nor a controller"):
        read_exploration(written(tmp_path, "a: 1\n"))


@pytest.mark.parametrize(
    "read",
    [read_plant, at.load, at.optimize, at.predict, read_exploration, partial(read_source, axis=None, controller=None)],
)
def test_a_plant_without_its_head_is_told_the_two_lines(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path = written(tmp_path, TEXT.removeprefix("format: autotune/plant\nversion: 1\n"))
    with pytest.raises(UsageError) as refused:
        read(path)
    assert str(refused.value).endswith(" begins with the lines `format: autotune/plant` and `version: 1`.")


@pytest.mark.parametrize(
    ("old", "new", "line", "what"),
    [
        ("mass: 16", "mass: -1", 3, "mass must be a number"),
        ("drag: 630", "drag: '630'", 5, "drag must be a number"),
        ("drag: 630", "drag: 630\ndrga: 1", 6, "drga must be one of"),
        ("std: 0.0001", "std: 0", 8, "robot.delay.std must be greater than 0"),
        ("std: 0.0001", "", 8, "robot.delay.std must be present"),
        ("sample_time: 0.0008", "sample_time: 1", 10, "sample_time must be at most 0.1"),
        ("bandwidth: 3.2", "bandwidth: [3.4, 3.0]", 7, "range from low to high"),
        ("bandwidth: 3.2", "damping_ratio: 0.7", 6, "bandwidth must be given"),
        ("sample_time: 0.0008", "", 1, "sample_time must be present"),
        ("drag: 630", "drga: 630", 5, "found the key drga; drag may be meant."),
        ("  bandwidth: 3.2", "  bandwith: 3.2", 7, "robot.bandwith must be one of bandwidth"),
        ("format: autotune/plant", "format: autotune/plan", 1, "autotune/identified or autotune/plant"),
        ("version: 1\n", "", 1, "begin the file with the lines `format: autotune/plant` and `version: 1`."),
    ],
)
def test_what_is_wrong_is_refused_with_file_line_and_key(
    tmp_path: Path, old: str, new: str, line: int, what: str
) -> None:
    path = written(tmp_path, TEXT.replace(old, new))
    with pytest.raises(UsageError) as refused:
        read_plant(path)
    assert str(refused.value).startswith(f"{path}, line {line}: ")
    assert what in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"mass": 0.0}, "mass"),
        ({"mass": (22.0, 10.0)}, "mass"),
        ({"mass": "16"}, "mass"),
        ({"mass": Uncertain(16.0, 6.0)}, "mass"),
        ({"drag": -1.0}, "drag"),
        ({"sample_time": 0.0}, "sample_time"),
        ({"axis": "rz"}, "axis"),
        ({"sample_time": (8e-4, 1e-3)}, "sample_time"),
        ({"sample_time": 0.8}, "sample_time"),
        ({"robot": 3.2}, "robot"),
        ({"centre_of_mass": (0.0, 0.0, 100.0)}, "centre_of_mass"),
        ({"force_bias": (0.0, math.nan, 0.0)}, "force_bias"),
        ({"force_bias": (1.0, 2.0)}, "force_bias"),
        ({"wrench_corner": 50.0, "wrench_delay": 0.001}, "wrench_delay"),
        ({"wrench_corner": (50.0, 60.0)}, "wrench_corner"),
        ({"wrench_delay": 0.2}, "wrench_delay"),
        ({"force_noise": [1.0, 2.0]}, "force_noise"),
        ({"force_noise": Uncertain(1.0, 0.1)}, "force_noise"),
        ({"force_bias": 3}, "force_bias"),
        ({"force_bias": ("a", 1, 2)}, "force_bias"),
        ({"force_bias": (301.0, 0.0, 0.0)}, "force_bias"),
        ({"torque_bias": (0.0, 51.0, 0.0)}, "torque_bias"),
        ({"mass": 1001.0}, "mass"),
        ({"mass": np.array([10.0, 20.0, 30.0])}, "mass"),
        ({"axis": ["x"]}, "axis"),
        # Meant in N/mm, kN/m or N/mm again.
        ({"coupling_stiffness": 300.0}, "coupling_stiffness"),
        ({"environment_stiffness": (20.0, 500.0)}, "environment_stiffness"),
        ({"environment_stiffness": 17.5}, "environment_stiffness"),
    ],
)
def test_a_number_out_of_range_is_refused_by_name(changes: dict[str, Any], name: str) -> None:
    with pytest.raises(ParameterError) as refused:
        plant(**changes)
    assert refused.value.name == name


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"bandwidth": 3.2, "delay": 0.1}, "delay"),
        ({"bandwidth": 3.2, "delay": (0.002, 0.2)}, "delay"),
        ({"bandwidth": "a"}, "bandwidth"),
        ({"bandwidth": 3200.0}, "bandwidth"),
        ({"bandwidth": (1e-3, 3.2)}, "bandwidth"),
        ({"numerator": (1e5,), "denominator": (1.0, 1e5)}, "denominator"),
        ({"numerator": 20, "denominator": (1.0, 20.0)}, "numerator"),
        ({"numerator": (20.0,), "denominator": "ab"}, "denominator"),
    ],
)
def test_a_robot_that_is_none_is_refused_by_name(arguments: dict[str, Any], name: str) -> None:
    with pytest.raises(ParameterError) as refused:
        Robot(**arguments)
    assert refused.value.name == name


@pytest.mark.parametrize("numbers", [(1, "b"), ("a", 1), (math.nan, 1), (None, 1), (16.0, 0.0), (16.0, True)])
def test_an_uncertain_number_is_two_finite_ones(numbers: tuple[Any, Any]) -> None:
    with pytest.raises(ParameterError, match="exact" if numbers == (16.0, 0.0) else "number"):
        Uncertain(*numbers)


def test_numbers_of_numpy_are_numbers() -> None:
    made = plant(
        mass=np.array([10, 20]), drag=np.float32(630.0), environment_stiffness=[2e4, 5e5], force_bias=np.zeros(3)
    )
    assert made == plant(mass=(10.0, 20.0), force_bias=(0.0, 0.0, 0.0))
    assert hash(made) == hash(plant(mass=(10.0, 20.0), force_bias=(0.0, 0.0, 0.0)))


def test_a_delay_that_was_left_out_is_noted_and_stays_left_out(tmp_path: Path) -> None:
    silent, said = plant(robot=Robot(bandwidth=6)), plant(robot=Robot(bandwidth=6, delay=0.0))
    assert silent.file().domain == said.file().domain
    assert silent.robot.model().delay_s == 0.0
    silent.save(tmp_path / "plant.yaml")
    assert read_plant(tmp_path / "plant.yaml").result == silent.file().result
    assert "delay was not given: 0 s was taken" in str(silent)
    assert "was not given" not in str(said)


def test_a_soft_surface_is_allowed_and_its_unit_asked() -> None:
    """250 to 500 N/m is foam, or a wall in kN/m: 30 N press 60 to 120 mm into the former."""
    (finding,) = (
        each for each in plant(environment_stiffness=(250, 500)).file().result.findings if "unit" in each.code
    )
    assert "60 to 120 mm" in finding.message
    assert "write 250000 to 500000" in finding.message
    assert "unit-suspected" not in [each.code for each in plant().file().result.findings]


def test_it_shows_itself_as_a_table() -> None:
    text = str(plant(mass=(10, 22)))
    assert "10 to 22" in text
    assert "0.0024 ± 0.0001" in text
    assert "taken as" in plant()._repr_html_()
    # Two coefficients are no range.
    assert "1, 20 " in str(plant(robot=Robot(numerator=(20,), denominator=(1, 20))))
    assert "force_bias" not in repr(plant())
    assert eval(repr(plant()), {"Plant": Plant, "Robot": Robot, "Uncertain": Uncertain}) == plant()


def test_what_a_design_takes_as_exact_follows_its_ranges() -> None:
    source = plant()
    asked = {"payload_mass_kg": (10.0, 22.0), "coupling_stiffness_n_per_m": (3e5, 3e5)}
    assert exact_within(source.exact(), asked) == ("coupling_stiffness", "coupling_damping", "drag", "robot.bandwidth")
    assert exact_within(source.exact(), {}) == source.exact()


WHOLE: dict[str, Any] = {
    "centre_of_mass": (0.0, 0.0, 0.1),
    "force_bias": (1.0, 2.0, 3.0),
    "torque_bias": (0.1, 0.2, 0.3),
}


def carried(source: Plant, **options: Any) -> RuntimePayload:
    identified = source.file()
    spec = within_domain(ProblemSpec().with_options(**options), identified.domain)
    return carried_payload(identified.result, build_problems(identified.result, spec), spec)


def test_the_value_of_an_uncertain_mass_is_what_is_compensated() -> None:
    """Three deviations reach from 4 to 28 kg, a factor of 7, and the value stays 16 kg."""
    source = plant(mass=Uncertain(16.0, 4.0), drag=Uncertain(630.0, 200.0), **WHOLE)
    payload = carried(source)
    assert payload.mass_kg == 16.0
    assert not payload.set_in_cell
    assert source.file().result.axes["x"].drag_n_s_per_m.value == 630.0


def test_of_a_range_of_mass_no_mass_is_compensated_until_the_cell_says_which() -> None:
    source = plant(mass=(5.0, 22.0), **WHOLE)
    assert carried(source).set_in_cell
    (finding,) = (each for each in source.file().result.findings if each.code == "payload-unknown")
    assert "mass is a range" in finding.message
    assert "set_in_cell" in finding.message
    assert "centre_of_mass, force_bias, torque_bias) is ignored" in finding.message
    # A narrower range without the middle of the wide one leaves the mass to the cell all the same.
    narrower = carried(source, payload_mass=(6.0, 7.0))
    assert (narrower.mass_kg, narrower.set_in_cell) == (7.0, True)
    chosen = carried(source, payload_mass=(12.0, 12.0))
    assert (chosen.mass_kg, chosen.set_in_cell) == (12.0, False)


def test_half_a_payload_is_said_to_be_ignored() -> None:
    source = plant(centre_of_mass=(0.0, 0.0, 0.1))
    assert carried(source).set_in_cell
    (finding,) = (each for each in source.file().result.findings if each.code == "payload-unknown")
    assert "force_bias, torque_bias" in finding.message
    assert "(centre_of_mass) is ignored" in finding.message


def test_coefficients_and_the_filter_of_the_wrench_are_exact_too() -> None:
    source = plant(robot=Robot(numerator=(20.0,), denominator=(1.0, 20.0)), wrench_corner=50.0)
    assert {"robot.numerator", "robot.denominator", "wrench_corner"} <= {*source.exact()}


def test_names_of_a_plant_and_of_gains_will_do() -> None:
    plain: dict[str, Any] = {"drag": (300.0, 400.0), "robot.delay": (2e-3, 3e-3), "coupling_stiffness": "identified"}
    spec = ProblemSpec(bounds={"lead": (0.0, 0.02)}, uncertain=plain)
    assert spec.bounds == {"lead_s": (0.0, 0.02)}
    assert list(spec.uncertain) == ["drag_n_s_per_m", "delay_s", "coupling_stiffness_n_per_m"]
    with pytest.raises(ParameterError, match="each parameter once"):
        ProblemSpec(uncertain={"drag": (1.0, 2.0), "drag_n_s_per_m": (1.0, 2.0)})
    unknown: tuple[tuple[Any, str], ...] = (
        ("wrench_corner", "; wrench_time_constant_s may be meant"),
        ("mass", ""),
        ("payload_mass", "; payload_mass= may be meant"),
        ("draag", "; drag may be meant"),
        (3, ""),
    )
    for name, hint in unknown:
        with pytest.raises(
            ParameterError, match=r"uncertain must be given for .*, drag, .*, robot\.delay, "
        ) as refused:
            ProblemSpec(uncertain={name: (1.0, 2.0)})
        assert str(refused.value).endswith(f"found {name!r}{hint}.")
