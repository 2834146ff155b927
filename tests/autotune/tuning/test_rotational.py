"""Rotational axes: the same loop through a lever has the same answer, and what is not known of it is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.errors import UsageError
from autotune.export.export import export_controller
from autotune.formats.controller import controller_tree, read_controller, write_controller
from autotune.formats.problem import ProblemSpec, RotationalSpec
from autotune.maps.source import read_source
from autotune.tuning.problems import build_problems, runtime_mass_kg, through_lever
from autotune.validation.domain import check_domain
from autotune.validation.validate import validate_controller
from identification.errors import EstimateError
from identification.result import AxisEstimate
from problems.contact.transient import Approach
from problems.design.evaluation import build_scenarios
from problems.design.problem import DEFAULT_BOUNDS, AdmittanceTarget, DesignProblem, NoiseLimit, Requirements
from tests.autotune.tuning.cases import absent, identified_plant, known, known_vector
from tests.autotune.tuning.turning import FAST_TURNING_SPEC, LEVER_M, SQUARE, both_optimized, turned_axis, two_axes
from tests.problems.axes import LAW

DEFAULT = ProblemSpec()
FORCE = Approach(force_n=30.0)


def turned(axis: AxisEstimate | None = None, spec: ProblemSpec = DEFAULT) -> DesignProblem:
    plant = replace(identified_plant(), axes={"ry": turned_axis() if axis is None else axis})
    return build_problems(plant, spec)["ry"]


# --- what is asked ------------------------------------------------------------------------------------------------


def test_the_defaults_are_those_of_a_straight_axis_at_the_lever_of_the_deadbands() -> None:
    problem = turned()
    assert dict(problem.bounds) == {
        "mass": (0.2, 4.0),
        "damping": (4.0, 400.0),
        "lead_s": DEFAULT_BOUNDS["lead_s"],
        "feedback_damping_s": DEFAULT_BOUNDS["feedback_damping_s"],
    }
    assert problem.approach == Approach(force_n=6.0)
    # The default band ends at a third of this robot's bandwidth, as on a straight axis.
    target = AdmittanceTarget(min_m_s_per_n=0.0175, band_hz=(0.1, 1.0))
    assert problem.requirements == Requirements(free_space_admittance=target)


@LAW
@given(
    mass=st.floats(1.0, 50.0),
    force_n=st.floats(1.0, 100.0),
    admittance=st.floats(1e-5, 1e-2),
    limit=st.none() | st.floats(1.0, 1e3),
)
def test_soft_limits_go_through_the_lever_as_forces_and_speeds_do(
    mass: float, force_n: float, admittance: float, limit: float | None
) -> None:
    asked = Requirements(max_peak_force_n=limit, free_space_admittance=AdmittanceTarget(min_m_s_per_n=admittance))
    spec = ProblemSpec(bounds={"mass": (mass, 2.0 * mass), "lead_s": (0.0, 0.01)}, requirements=asked)
    found = through_lever(spec, Approach(force_n=force_n))
    # A point mass at the end of a lever turns like m l²; power F v = (F l)(v / l) is the same. Nine digits are kept.
    close = 1e-8
    assert found.bounds["mass"] == pytest.approx((mass * SQUARE, 2.0 * mass * SQUARE), close)
    assert found.bounds["lead_s"] == (0.0, 0.01)
    assert found.approach is not None
    assert found.approach.force_n == pytest.approx(force_n * LEVER_M, close)
    assert found.requirements.free_space_admittance is not None
    assert found.requirements.free_space_admittance.min_m_s_per_n * SQUARE == pytest.approx(admittance, close)
    assert found.requirements.max_peak_force_n == (None if limit is None else pytest.approx(limit * LEVER_M, close))
    assert through_lever(spec, Approach(speed_m_s=0.05)).approach == Approach(speed_m_s=0.25)


def test_what_is_said_of_rotation_counts_as_it_stands() -> None:
    said = RotationalSpec(
        bounds={"mass": (0.3, 0.5), "lead_s": (0.0, 0.02)},
        approach=Approach(speed_m_s=0.1),
        environment_stiffness=(1e3, 2e3),
        payload_mass=(0.1, 0.2),
        requirements={"max_peak_force_n": 11.0, "free_space_admittance": None},
    )
    problem = turned(spec=ProblemSpec(rotational=said, requirements=Requirements(modulus_margin=0.4)))
    assert (problem.bounds["mass"], problem.bounds["lead_s"]) == ((0.3, 0.5), (0.0, 0.02))
    assert (problem.approach, problem.plants.payload_mass_kg) == (Approach(speed_m_s=0.1), (0.1, 0.2))
    assert problem.plants.environment_stiffness_n_per_m == (1e3, 2e3)
    asked = Requirements(modulus_margin=0.4, max_peak_force_n=11.0, free_space_admittance=None)
    assert problem.requirements == asked


def test_the_inertia_of_the_axis_is_what_it_moves() -> None:
    low, high = turned(replace(turned_axis(), mass_kg=known(0.5, 0.001))).plants.payload_mass_kg
    assert (low, high) == (0.49, 0.51)  # 2 %, more than three deviations
    low, high = turned(replace(turned_axis(), mass_kg=known(0.5, 0.01))).plants.payload_mass_kg
    assert (low, high) == pytest.approx((0.47, 0.53), abs=1.1e-3)  # three deviations, three digits rounded outwards


# --- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [None, absent("only turned at rest")])
def test_an_inertia_that_no_motion_shows_is_asked_back(mass: object) -> None:
    axis = replace(turned_axis(), mass_kg=mass)  # type: ignore[arg-type]  # None or an estimate
    with pytest.raises(EstimateError, match=r"axes\.ry\.inertia_kg_m2 is not identified"):
        turned(axis)
    given_range = ProblemSpec(rotational=RotationalSpec(payload_mass=(0.6, 0.7)))
    assert turned(axis, given_range).plants.payload_mass_kg == (0.6, 0.7)


def test_missing_parameters_are_named_as_the_file_names_them() -> None:
    with pytest.raises(EstimateError, match=r"axes\.ry\.drag_n_m_s_per_rad is not identified"):
        turned(replace(turned_axis(), drag_n_s_per_m=absent()))
    with pytest.raises(EstimateError, match=r"rotational\.environment_stiffness_n_m_per_rad"):
        turned(replace(turned_axis(), environments=()))


def test_another_payload_is_refused_unless_its_inertia_is_said() -> None:
    heavy = DEFAULT.with_options(payload_mass=(16.0, 22.0))
    with pytest.raises(UsageError, match=r"16 to 22 kg is not that of the plant .* rotational\.payload_inertia_kg_m2"):
        build_problems(two_axes(), heavy)
    said = replace(heavy, rotational=RotationalSpec(payload_mass=(0.6, 0.9)))
    problems = build_problems(two_axes(), said)
    assert (problems["x"].plants.payload_mass_kg, problems["ry"].plants.payload_mass_kg) == ((16.0, 22.0), (0.6, 0.9))
    assert build_problems(two_axes(), replace(heavy, axes=("x",)))["x"].plants.payload_mass_kg == (16.0, 22.0)
    # The identified mass itself is no other payload.
    assert (
        turned(spec=DEFAULT.with_options(payload_mass=(16.0, 16.0))).plants.payload_mass_kg
        == turned().plants.payload_mass_kg
    )


def test_ranges_that_no_axis_takes_are_refused() -> None:
    with pytest.raises(UsageError, match="says nothing of rotation"):
        turned(spec=DEFAULT.with_options(environment_stiffness=(1e4, 2e4)))
    with pytest.raises(UsageError, match="no rotational axis is tuned: x"):
        build_problems(identified_plant(), ProblemSpec(rotational=RotationalSpec(payload_mass=(0.6, 0.9))))


def test_the_runtime_compensates_the_identified_mass_when_only_rotation_is_tuned() -> None:
    assert runtime_mass_kg(identified_plant(), None) == 16.0


# --- the answer ---------------------------------------------------------------------------------------------------


def test_the_design_of_a_straight_axis_does_the_same_through_the_lever() -> None:
    """One loop, two sets of units: margins, times and shares are equal, forces go with the lever."""
    problems = build_problems(two_axes(), FAST_TURNING_SPEC)
    straight, about = problems["x"], problems["ry"]
    design = both_optimized().searches["x"].design
    through = design * np.array([SQUARE, SQUARE, 1.0, 1.0])
    one = build_scenarios(straight, straight.scenarios(3, 2)).evaluate(design, peaks_if_missed=True)
    other = build_scenarios(about, about.scenarios(3, 2)).evaluate(through, peaks_if_missed=True)
    # The matrices differ by factors that are no powers of two; margins are searched to 1e-9 or so.
    assert other.spectral_radius == pytest.approx(one.spectral_radius, rel=1e-9)
    assert dict(other.requirements) == pytest.approx(dict(one.requirements), rel=1e-6)
    assert other.cost == pytest.approx(one.cost * LEVER_M, rel=1e-6)


def test_both_axes_are_tuned_in_one_call_to_the_same_optimum() -> None:
    found = both_optimized()
    x, ry = found.searches["x"], found.searches["ry"]
    # Both stop within the search's own tolerance of the optimum, which is 1e-3 in the worst peak.
    assert ry.evaluation.cost == pytest.approx(x.evaluation.cost * LEVER_M, rel=2e-3)
    assert [name for name, gains in found.controller.axes.items() if gains.deadband == 1.0] == ["ry"]
    assert found.report.passed
    assert {check.name for check in found.report.checks if check.axis == "x"} - {
        check.name for check in found.report.checks if check.axis == "ry"
    } == {"payload", "axes together"}


def test_the_file_shows_rotational_units_and_survives_validate_export_and_map(tmp_path: Path) -> None:
    controller, path = both_optimized().controller, tmp_path / "controller.yaml"
    tree = controller_tree(controller)
    certificate = tree["certificate"]
    assert certificate["requirements"]["free_space_admittance"] == {"min_m_s_per_n": 6.5e-4, "band_hz": [1.0, 2.0]}
    assert certificate["rotational_requirements"]["free_space_admittance"] == {
        "min_rad_s_per_n_m": 0.01625,
        "band_hz": [1.0, 2.0],
    }
    assert certificate["domain"]["ry"]["payload_inertia_kg_m2"] == pytest.approx([0.64, 0.64])
    assert set(certificate["margins"]["ry"]["worst"]["modulus"]) == {
        "environment_stiffness_n_m_per_rad",
        "payload_inertia_kg_m2",
    }
    reported = [tree["predicted"]["ry"]["scenarios"][0]["name"], *(p["over"] for p in certificate["proved"][2:])]
    assert all("kg·m²" in text for text in reported)
    write_controller(path, controller)
    assert read_controller(path).controller == controller
    export_controller(path, "json", tmp_path / "controller.json")
    assert read_controller(tmp_path / "controller.json").controller == controller
    source = read_source(path, axis="ry", controller=None)
    assert (source.is_rotational, source.known["payload_mass"]) == (
        True,
        controller.certificate.domain["ry"].payload_mass_kg[0],
    )


def test_an_identified_plant_is_compared_by_its_inertia() -> None:
    controller, plant = both_optimized().controller, two_axes()
    assert [check.passed for check in check_domain(controller, plant)] == [True, True, True]
    for inertia, reported in ((known(0.7, 0.01), "is 0.7, certified for [0.64, 0.64]"), (None, "is not identified")):
        other = replace(plant, axes={**plant.axes, "ry": replace(plant.axes["ry"], mass_kg=inertia)})
        straight, about, _ = check_domain(controller, other)
        assert (straight.passed, about.passed, about.message) == (True, False, f"payload inertia [kg·m²] {reported}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotational_requirements": None}, "does not say what was asked of rotational axes"),
        ({"rotational_requirements": {"modulus_margin": 0.6}}, "modulus_margin must be at least 0.6"),
        (
            {
                "rotational_requirements": {
                    "free_space_admittance": AdmittanceTarget(min_m_s_per_n=0.02, band_hz=(1.0, 2.0))
                }
            },
            "|G| must be at least 0.02 rad/s/(N·m), found 0.016",
        ),
        ({"rotational_requirements": {"max_peak_force_n": 6.5}}, "the peak torque must be at most 6.5 N·m"),
    ],
)
def test_validation_asks_rotational_axes_for_their_own_requirements(change: dict[str, object], message: str) -> None:
    controller = both_optimized().controller
    only = replace(
        controller,
        axes={"ry": controller.axes["ry"]},
        predicted={"ry": controller.predicted["ry"]},
        # Chosen for both axes.
        limits=None,
        certificate=replace(
            controller.certificate,
            **change,  # type: ignore[arg-type]  # named in the table above
            domain={"ry": controller.certificate.domain["ry"]},
            margins={"ry": controller.certificate.margins["ry"]},
            coupled=None,
            continuous={"ry": (controller.certificate.continuous or {})["ry"]},
            proved=tuple(each for each in controller.certificate.proved if each.claim.startswith("axis ry:")),
            sampled=tuple(each for each in controller.certificate.sampled if each.claim.startswith("axis ry:")),
        ),
    )
    failed = [check for check in validate_controller(only).checks if not check.passed]
    assert len(failed) == 1
    assert message in failed[0].message


def test_prices_and_speeds_go_through_the_lever_and_the_noise_does_not() -> None:
    asked = Requirements(
        command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.2),
        soft_n={"modulus_margin": 20.0, "command_noise": 5.0},
    )
    plant = two_axes()
    loud = replace(plant, sensor=replace(plant.sensor, torque_noise_rms_n_m=known_vector(0.01, 0.03, 0.02)))
    spec = ProblemSpec(axes=("ry",), requirements=asked)
    with pytest.raises(EstimateError, match=r"sensor\.torque_noise_rms_n_m is not identified"):
        build_problems(plant, spec)
    found = build_problems(loud, spec)["ry"].requirements
    assert found.command_noise == NoiseLimit(max_speed_rms_m_s=5e-3, force_noise_rms_n=0.03)
    assert dict(found.soft_n) == {"modulus_margin": 4.0, "command_noise": 1.0}
    # What is said of rotation counts as it stands: there the noise is a limit, and the price is gone.
    said = RotationalSpec(requirements={"command_noise": NoiseLimit(max_speed_rms_m_s=0.02, force_noise_rms_n=0.05)})
    own = build_problems(plant, replace(spec, rotational=said))["ry"].requirements
    assert own.command_noise == NoiseLimit(max_speed_rms_m_s=0.02, force_noise_rms_n=0.05)
    assert dict(own.soft_n) == {"modulus_margin": 4.0}
