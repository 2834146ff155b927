"""`problem.yaml`: what it may say, and the refusal with file and line of everything else."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from autotune.errors import UsageError
from autotune.formats.limits import LimitsSpec
from autotune.formats.problem import ComplianceSpec, ProblemSpec, RotationalSpec, read_problem
from autotune.formats.schema import load_schema
from problems.contact.transient import Approach
from problems.design.objectives import BUILT_IN, SensorForce
from problems.design.problem import (
    FURTHER_VARIABLES,
    VARIABLES,
    AdmittanceTarget,
    NoiseLimit,
    PassivityTarget,
    Requirements,
)
from problems.errors import ParameterError
from tests.problems.axes import LAW

WHOLE = """\
format: autotune/problem
version: 1
axis: z
bounds:
  mass: [5, 20]
  damping: [550.0, 2.0e3]
  lead_s: [0, 0.025]
  feedback_damping_s: [0, 0.0075]
approach: {speed_m_s: 0.02}
environment_stiffness_n_per_m: [2e4, 5e5]
payload_mass_kg: [10, 22]
requirements:
  modulus_margin: 0.45
  gain_margin_db: 5
  phase_margin_deg: null
  delay_margin_s: 2e-5
  decay_rate_per_s: 3
  max_peak_force_n: 120
  free_space_admittance: {min_m_s_per_n: 5e-4, band_hz: [0.2, 3]}
objective: sensor_force
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "problem.yaml"


def read(path: Path, text: str) -> ProblemSpec:
    path.write_text(text, encoding="utf-8")
    return read_problem(path)


def refusal(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError) as caught:
        read_problem(path)
    return str(caught.value)


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(load_schema("problem"))
    assert set(load_schema("problem")["$defs"]["bounds"]["properties"]) == set(VARIABLES)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"requirements": {"modulus_margin": 0.6}}, "requirements must be at.Requirements"),
        ({"approach": 30}, "approach must be at.Approach"),
        ({"environment_stiffness": 3}, "environment_stiffness must be a range"),
        ({"payload_mass": (0.0, 5.0)}, "payload_mass must be greater than 0"),
        ({"bounds": {"mass": "5"}}, r"bounds\['mass'\] must be a range"),
        ({"bounds": {"mas": (1.0, 2.0)}}, "bounds must be given for mass, .*, lead, .* found 'mas'; mass may be meant"),
        ({"uncertain": {"delay_s": "identfied"}}, r"uncertain\['delay_s'\] must be a range"),
        ({"axes": "q"}, "axes must be names among x, y"),
    ],
)
def test_what_is_no_value_of_a_problem_is_refused_where_it_is_made(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        ProblemSpec(**wrong)


def test_everything_can_be_said(path: Path) -> None:
    spec = read(path, WHOLE)
    assert spec == ProblemSpec(
        axes=("z",),
        bounds={
            "mass": (5.0, 20.0),
            "damping": (550.0, 2000.0),
            "lead_s": (0.0, 0.025),
            "feedback_damping_s": (0.0, 0.0075),
        },
        approach=Approach(speed_m_s=0.02),
        environment_stiffness=(2e4, 5e5),
        payload_mass=(10.0, 22.0),
        requirements=Requirements(
            modulus_margin=0.45,
            gain_margin_db=5.0,
            phase_margin_deg=None,
            delay_margin_s=2e-5,
            decay_rate_per_s=3.0,
            max_peak_force_n=120.0,
            free_space_admittance=AdmittanceTarget(min_m_s_per_n=5e-4, band_hz=(0.2, 3.0)),
        ),
        objective=SensorForce(),
    )


def test_rotational_axes_have_their_own_units_and_keep_what_is_not_said(path: Path) -> None:
    spec = read(
        path,
        """\
axis: [x, ry]
requirements: {modulus_margin: 0.4, max_peak_force_n: 90}
rotational:
  bounds: {mass: [0.2, 0.8]}
  approach: {torque_n_m: 4}
  environment_stiffness_n_m_per_rad: [1e3, 5e3]
  payload_inertia_kg_m2: [0.4, 0.6]
  requirements:
    max_peak_torque_n_m: null
    free_space_admittance: {min_rad_s_per_n_m: 0.01, band_hz: [0.2, 3]}
""",
    )
    assert spec.axes == ("x", "ry")
    assert spec.requirements == Requirements(modulus_margin=0.4, max_peak_force_n=90.0)
    assert spec.rotational == RotationalSpec(
        bounds={"mass": (0.2, 0.8)},
        approach=Approach(force_n=4.0),
        environment_stiffness=(1e3, 5e3),
        payload_mass=(0.4, 0.6),
        requirements={
            "max_peak_force_n": None,
            "free_space_admittance": AdmittanceTarget(min_m_s_per_n=0.01, band_hz=(0.2, 3.0)),
        },
    )


def test_json_is_yaml(path: Path) -> None:
    assert read(path, '{"payload_mass_kg": [10, 22]}') == ProblemSpec(payload_mass=(10.0, 22.0))


@pytest.mark.parametrize("text", ["{}", "format: autotune/problem\n", "requirements: {}\nbounds: {}\n"])
def test_everything_has_a_default(path: Path, text: str) -> None:
    assert read(path, text) == ProblemSpec()


@pytest.mark.parametrize("name", BUILT_IN)
def test_an_objective_may_be_given_by_its_name(name: str) -> None:
    given: Any = name
    assert ProblemSpec(objective=given) == ProblemSpec(objective=BUILT_IN[name])


@pytest.mark.parametrize("given", ["nope", ["admittance"], None])
def test_an_objective_that_is_none_is_refused_with_the_names(given: Any) -> None:
    with pytest.raises(ParameterError, match=r"objective must be one of contact_force, .*admittance.*, found "):
        ProblemSpec(objective=given)


def test_null_asks_for_nothing_and_absence_for_the_default(path: Path) -> None:
    asked = read(path, "requirements: {modulus_margin: null, free_space_admittance: null}\n").requirements
    assert (asked.modulus_margin, asked.free_space_admittance) == (None, None)
    assert asked.gain_margin_db == Requirements().gain_margin_db


@pytest.mark.parametrize(
    ("text", "line", "output"),
    [
        ("axis: w\n", 1, "axis must be one of x, y, z"),
        ("axis: [x, x]\n", 1, "a list of different ones"),
        ("axis: x\nobjective: [admittance]\n", 2, "objective must be one of contact_force"),
        ("objective: {name: admittance}\n", 1, "found a mapping"),
        ("axis: []\n", 1, "a list of different ones"),
        ("rotational: {payload_mass_kg: [1, 2]}\n", 1, "rotational.payload_mass_kg must be one of bounds, approach"),
        ("payload_inertia_kg_m2: [1, 2]\n", 1, "payload_inertia_kg_m2 must be one of"),
        ("rotational:\n  payload_inertia_kg_m2: [2, 1]\n", 2, "rotational.payload_inertia_kg_m2 must be [low, high]"),
        ("rotational:\n  bounds:\n    mass: [2, 1]\n", 3, "rotational.bounds.mass must be [low, high]"),
        ("rotational: {approach: {force_n: 3}}\n", 1, "rotational.approach.force_n must be one of torque_n_m"),
        (
            "rotational: {requirements: {modulus_margin: 0.4}}\n",
            1,
            "one of max_peak_torque_n_m, contact_at_speed, held_by_hand, free_space_admittance",
        ),
        (
            "rotational:\n  requirements:\n    free_space_admittance: {min_rad_s_per_n_m: 1, band_hz: [2, 1]}\n",
            3,
            "rotational.requirements.free_space_admittance.band_hz must be [low, high]",
        ),
        ("bounds:\n  mass: [5, 20]\n  stiffness: [1, 2]\n", 3, "bounds.stiffness must be one of mass"),
        ("bounds:\n  mass: [20, 5]\n", 2, "bounds.mass must be [low, high], found 20 above 5"),
        ("payload_mass_kg: [22, 10]\n", 1, "payload_mass_kg must be [low, high]"),
        ("payload_mass_kg: 16\n", 1, "payload_mass_kg must be a list"),
        ("payload_mass_kg: [10, 12, 14]\n", 1, "at most 2 entries"),
        ("payload_mass_kg: [0, 10]\n", 1, "greater than 0"),
        ("environment_stiffness_n_per_m: [2e4, .inf]\n", 1, "finite"),
        ("requirements:\n  modulus_margin: 1\n", 2, "less than 1"),
        ("requirements:\n  modulus_margin: 0,5\n", 2, "comma"),
        ("requirements:\n  modulus: 0.5\n", 2, "found the key modulus; modulus_margin may be meant."),
        ("requirements:\n  free_space_admittance: {min_m_s_per_n: 1e-3}\n", 2, "band_hz"),
        (
            "requirements:\n  free_space_admittance:\n    min_m_s_per_n: 1e-3\n    band_hz: [2, 1]\n",
            4,
            "requirements.free_space_admittance.band_hz must be [low, high]",
        ),
        ("approach: {force_n: 30, speed_m_s: 0.02}\n", 1, "approach"),
        ("approach: {}\n", 1, "approach"),
        ("objective: speed\n", 1, "one of contact_force, sensor_force"),
        ("format: autotune/controller\n", 1, "autotune/problem"),
        ("version: 2\n", 1, "version must be 1"),
        ("axis: x\naxis: z\n", 2, "axis"),
        ("axis: [x\n", None, ""),
        ("- axis\n", 1, "mapping"),
    ],
)
def test_what_is_wrong_is_reported_with_its_line(path: Path, text: str, line: int | None, output: str) -> None:
    message = refusal(path, text)
    assert message.startswith(f"{path}, line {line}: " if line is not None else f"{path}, line ")
    assert output in message


def test_a_file_that_is_not_there_is_a_wrong_request(path: Path) -> None:
    with pytest.raises(UsageError, match=r"problem\.yaml cannot be read"):
        read_problem(path)


@LAW
@given(low=st.floats(1e-3, 1e6), ratio=st.floats(1.0, 1e3))
def test_ranges_are_read_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, low: float, ratio: float) -> None:
    path = tmp_path_factory.mktemp("problem") / "problem.yaml"
    high = low * ratio
    spec = read(path, f"payload_mass_kg: [{low!r}, {high!r}]\n")
    assert spec.payload_mass == (low, high)


def test_a_spec_cannot_be_changed(path: Path) -> None:
    spec = read(path, WHOLE)
    with pytest.raises(TypeError):
        spec.bounds["mass"] = (1.0, 2.0)  # type: ignore[index]  # that it is refused is the point


def test_what_is_uncertain_is_a_range_or_has_an_origin(path: Path) -> None:
    spec = read(
        path,
        "coupling_stiffness_n_per_m: [2.9e5, 3.1e5]\n"
        "coupling_damping_n_s_per_m: [0, 200]\n"
        "delay_s: {from: identified}\n"
        "robot_bandwidth_hz: {from: nominal}\n"
        "rotational:\n"
        "  drag_n_m_s_per_rad: [1, 2]\n"
        "  environment_damping_n_m_s_per_rad: {from: identified}\n",
    )
    assert dict(spec.uncertain) == {
        "coupling_stiffness_n_per_m": (2.9e5, 3.1e5),
        "coupling_damping_n_s_per_m": (0.0, 200.0),
        "delay_s": "identified",
        "robot_bandwidth_hz": "nominal",
    }
    assert dict(spec.rotational.uncertain) == {
        "drag_n_s_per_m": (1.0, 2.0),
        "environment_damping_n_s_per_m": "identified",
    }


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("delay_s: [2e-3, 1e-3]\n", r"delay_s must be [low, high], found 0.002 above 0.001"),
        ("coupling_stiffness_n_per_m: [0, 3e5]\n", "coupling_stiffness_n_per_m"),
        ("delay_s: {from: guess}\n", "delay_s"),
        ("delay_s: identified\n", "delay_s"),
        ("rotational:\n  drag_n_s_per_m: [1, 2]\n", "drag_n_s_per_m"),
    ],
)
def test_an_uncertainty_that_cannot_be_read_is_refused(path: Path, text: str, output: str) -> None:
    assert output in refusal(path, text)


def test_soft_limits_have_a_price_and_the_command_its_limits(path: Path) -> None:
    spec = read(
        path,
        """\
requirements:
  modulus_margin: {value: 0.5, soft_n: 20.0}
  free_space_admittance: {min_m_s_per_n: 5e-4, band_hz: [0.2, 3], soft_n: 10}
  command_noise: {max_speed_rms_m_s: 1e-3, force_noise_rms_n: 0.2}
  passivity: {passive_below_hz: 20, soft_n: 2}
rotational:
  requirements:
    max_peak_torque_n_m: {value: 12, soft_n_m: 3}
    command_noise: {max_speed_rms_rad_s: 0.01, torque_noise_rms_n_m: 0.02, soft_n_m: 1}
free:
  velocity_filter_rad_per_s: [60, 300]
  compensation_mass_kg: [0, 16]
""",
    )
    assert spec.requirements == Requirements(
        modulus_margin=0.5,
        free_space_admittance=AdmittanceTarget(min_m_s_per_n=5e-4, band_hz=(0.2, 3.0)),
        command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.2),
        passivity=PassivityTarget(passive_below_hz=20.0),
        soft_n={"modulus_margin": 20.0, "free_space_admittance": 10.0, "passivity": 2.0},
    )
    assert dict(spec.rotational.requirements) == {
        "max_peak_force_n": 12.0,
        "command_noise": NoiseLimit(max_speed_rms_m_s=0.01, force_noise_rms_n=0.02),
    }
    assert dict(spec.rotational.soft_n) == {"max_peak_force_n": 3.0, "command_noise": 1.0}
    assert dict(spec.free) == {"velocity_filter_rad_per_s": (60.0, 300.0), "compensation_mass_kg": (0.0, 16.0)}


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("[2e4, 5e5]", ComplianceSpec(bounds=(2e4, 5e5), tolerance=0.2)),
        ("{bounds: [2e4, 5e5]}", ComplianceSpec(bounds=(2e4, 5e5), tolerance=0.2)),
        ("{bounds: [3e4, 3e4], tolerance: 0}", ComplianceSpec(bounds=(3e4, 3e4), tolerance=0.0)),
    ],
)
def test_a_compliance_is_no_variable_of_the_controller(path: Path, said: str, expected: ComplianceSpec) -> None:
    spec = read(path, f"free:\n  environment_stiffness_n_per_m: {said}\n  velocity_filter_rad_per_s: [60, 300]\n")
    assert spec.compliance == expected
    assert dict(spec.free) == {"velocity_filter_rad_per_s": (60.0, 300.0)}
    assert spec.environment_stiffness is None


def test_the_schema_knows_every_further_variable() -> None:
    known = load_schema("problem")["properties"]["free"]["properties"]
    assert set(FURTHER_VARIABLES) < set(known)


@pytest.mark.parametrize(
    ("text", "line", "output"),
    [
        ("requirements:\n  modulus_margin: {value: 0.5}\n", 2, "requirements.modulus_margin.soft_n must be present"),
        ("requirements:\n  modulus_margin: {value: 1, soft_n: 1}\n", 2, "less than 1"),
        ("requirements:\n  gain_margin_db: {value: 6, soft_n: 0}\n", 2, "greater than 0"),
        ("requirements:\n  modulus_margin: {value: 0.5, soft_n_m: 1}\n", 2, "soft_n"),
        ("requirements:\n  passivity: true\n", 2, "requirements.passivity must be a mapping or null"),
        ("requirements:\n  passivity: {}\n", 2, "passive_below_hz must be present"),
        ("requirements:\n  command_noise: {force_noise_rms_n: 1}\n", 2, "max_speed_rms_m_s must be present"),
        ("free:\n  velocity_filter_rad_per_s: [300, 60]\n", 2, "free.velocity_filter_rad_per_s must be [low, high]"),
        ("bounds:\n  lead_s: [0.0, 1.2]\n", 2, "bounds.lead_s[1] must be at most 1"),
        ("free:\n  mass: [5, 20]\n", 2, "free.mass must be one of velocity_filter_rad_per_s"),
        ("free:\n  collision_threshold_n: [50, 20]\n", 2, "free.collision_threshold_n must be [low, high]"),
        ("free:\n  collision_threshold_n: [0, 20]\n", 2, "greater than 0"),
        ("free:\n  collision_threshold_n: 20\n", 2, "free.collision_threshold_n"),
        ("free:\n  collision_threshold_n: [10, .inf]\n", 2, "finite"),
        (
            "free:\n  environment_stiffness_n_per_m: [1e5, 1e4]\n",
            2,
            "free.environment_stiffness_n_per_m must be [low, high]",
        ),
        (
            "free:\n  environment_stiffness_n_per_m:\n    tolerance: 0.1\n    bounds: [1e5, 1e4]\n",
            4,
            "free.environment_stiffness_n_per_m.bounds must be [low, high]",
        ),
        (
            "free:\n  environment_stiffness_n_per_m: {bounds: [1e4, 1e5], tolerance: 1}\n",
            2,
            "free.environment_stiffness_n_per_m.tolerance must be less than 1",
        ),
        ("free:\n  environment_stiffness_n_per_m: {tolerance: 0.1}\n", 2, "m.bounds must be present"),
        ("free:\n  environment_stiffness_n_per_m: [0, 1e5]\n", 2, "must be bounds [low, high]"),
        (
            "free: {environment_stiffness_n_per_m: [1e4, 1e5]}\nenvironment_stiffness_n_per_m: [2e4, 3e4]\n",
            2,
            "environment_stiffness_n_per_m is free, and a range of it is given too",
        ),
    ],
)
def test_a_wish_or_variable_that_cannot_be_is_reported_with_its_line(
    path: Path, text: str, line: int, output: str
) -> None:
    message = refusal(path, text)
    assert message.startswith(f"{path}, line {line}: ")
    assert output in message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bounds: {feedback_damping_s: [2e-5, 5e-5]}", "bounds.feedback_damping_s must hold 0 or at least 0.0001 s"),
        ("bounds: {feedback_damping_s: [0, 7.5e-6]}", "prints B_fb in another unit"),
        ("bounds: {feedback_damping_s: [2e-5, 0.05]}", "found 2e-05"),
        (
            "rotational: {bounds: {feedback_damping_s: [0, 2e-5]}}",
            "rotational.bounds.feedback_damping_s must hold 0 or",
        ),
        ("approach: {speed_m_s: 50}", "approach.speed_m_s must be at most 5, "),
        ("approach: {force_n: 1.1e4}", "approach.force_n must be at most 10000, "),
        ("rotational: {approach: {torque_n_m: 2.1e3}}", "rotational.approach.torque_n_m must be at most 2000, "),
        ("rotational: {approach: {speed_rad_s: 26}}", "found 26; mind its unit"),
    ],
)
def test_numbers_in_another_unit_are_refused_where_they_stand(path: Path, text: str, said: str) -> None:
    reported = refusal(path, "axis: x\n" + text)
    assert said in reported
    assert "line 2" in reported


def test_bounds_and_approaches_at_the_limits_are_taken(path: Path) -> None:
    spec = read(path, "bounds: {feedback_damping_s: [0, 1e-4]}\napproach: {speed_m_s: 5}")
    assert spec.bounds["feedback_damping_s"] == (0.0, 1e-4)
    assert spec.approach == Approach(speed_m_s=5.0)


def test_limits_are_said_by_name_and_by_axis(path: Path) -> None:
    spec = read(path, "limits: {force_n: 660, rest_samples: 250, axes: {x: {speed: 0.1}}}\n")
    assert spec.limits == LimitsSpec(values={"force_n": 660.0, "rest_samples": 250}, axes={"x": {"speed": 0.1}})
    assert read(path, "axis: x\n").limits == LimitsSpec()


@pytest.mark.parametrize("said", ["{force_n: 0}", "{rest_samples: 0.5}", "{speed: 1}", "{axes: {x: {}}}"])
def test_a_limit_that_cannot_be_is_refused_with_its_line(path: Path, said: str) -> None:
    assert "line 1: limits." in refusal(path, f"limits: {said}\n")


def test_requirements_of_the_registry_and_of_other_packages_are_read(path: Path) -> None:
    said = "min_damping_ratio: {value: 0.2, soft_n: 3}\n  passive_band: true\n"
    spec = read(path, f"requirements:\n  {said}rotational: {{requirements: {{min_damping_ratio: 0.3}}}}\n")
    assert dict(spec.requirements.further) == {"min_damping_ratio": 0.2, "passive_band": 1.0}
    assert [each.name for each in spec.requirements.plugins] == ["passive_band"]
    assert dict(spec.requirements.soft_n) == {"min_damping_ratio": 3.0}
    assert dict(spec.rotational.requirements) == {"min_damping_ratio": 0.3}
    none = read(path, "requirements: {min_damping_ratio: null, passive_band: false}\n")
    assert none.requirements == Requirements()


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("{min_damping_ratio: 1.0}", "less than 1"),
        ("{min_damping_ratio: true}", "a number or null or a mapping"),
        ("{passive_bands: true}", "one of modulus_margin"),
    ],
)
def test_what_the_registry_does_not_take_is_refused_with_its_line(path: Path, text: str, output: str) -> None:
    message = refusal(path, f"requirements: {text}\n")
    assert "line 1" in message
    assert output in message
