"""A surface that moves with a mass: proved as part of the payload's, replayed and simulated by other roads."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from autotune.certificate.certify import prove
from autotune.certificate.family import Claim, build_families
from autotune.errors import UsageError
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import read_problem
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.problems import build_problems
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.monte_carlo import run_monte_carlo
from autotune.validation.peak_proof import prove_peaks
from autotune.validation.replay import replay_contact
from autotune.validation.validate import validate_controller
from identification.errors import EstimateError
from problems.contact.nonlinear_simulation import Operator, needed_substeps, simulate_nonlinear, simulate_operator
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.uncertainty import PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, Plant
from problems.model.plant_parameters import with_values
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.tuning.cases import FAST_SPEC, ROOM, absent, identified_axis, identified_plant, known, with_axis

H = 8e-4
LAW = AdmittanceController(mass_kg=5.0, damping_n_s_per_m=1190.0, lead_s=0.0213, feedback_damping_s=0.007)
MOVED = (2.0, 4.0)


def plants(moved: tuple[float, float], mass: tuple[float, float] = (15.0, 18.0)) -> PlantSet:
    return PlantSet.of(
        RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling_stiffness_n_per_m=3e5,
        coupling_damping_n_s_per_m=150.0,
        drag_n_s_per_m=330.0,
        environment_stiffness_n_per_m=(8e4, 1.6e5),
        payload_mass_kg=mass,
        environment_mass_kg=moved[0],
        further={"environment_mass_kg": moved},
    )


def surface(stiffness: float, mass: float) -> Plant:
    found = plants(MOVED).at(16.0, stiffness)
    return found.in_contact_with(Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=20.0, mass_kg=mass))


def modulus(mass: float, stiffness: float, moved: float) -> float:
    values = {"payload_mass_kg": mass, "environment_stiffness_n_per_m": stiffness, "environment_mass_kg": moved}
    return find_margins(build_sampled_plant(with_values(plants(MOVED).nominal, values), H), LAW).modulus


@cache
def designed() -> Optimized:
    file = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    spec = replace(FAST_SPEC, bounds=ROOM, uncertain={"environment_mass_kg": MOVED})
    return optimize(file, spec, seed=1, replays=False, proof=ProofOptions(further_s=5.0))


def test_a_mass_on_the_surface_is_one_on_the_payload_while_they_touch() -> None:
    assert modulus(16.0, 5e5, 12.0) == pytest.approx(modulus(28.0, 5e5, 0.0), rel=1e-9)
    assert modulus(16.0, 5e5, 12.0) != pytest.approx(modulus(16.0, 5e5, 0.0), rel=1e-3)
    (contact,) = build_families(plants(MOVED).nominal, plants(MOVED).ranges, H)
    assert contact.range_of("payload_mass_kg") == pytest.approx((17.0, 22.0), rel=1e-12)
    free = contact.in_free_space()
    assert free.range_of("payload_mass_kg") == (15.0, 18.0)
    lightest, heaviest = (contact.scenario(np.array([8e4, 1.0 / total])) for total in (17.0, 22.0))
    assert (lightest.payload_mass_kg, lightest.environment_mass_kg) == pytest.approx((15.0, 2.0))
    assert (heaviest.payload_mass_kg, heaviest.environment_mass_kg) == pytest.approx((18.0, 4.0))


def test_what_is_proved_holds_on_every_drawn_plant_and_no_false_claim_is_proved() -> None:
    """Claims half a percent above the least modulus of a dense search are refuted, those below are proved."""
    rng = np.random.default_rng(5)
    for low in (0.0, 1.0, 6.0):
        moved = (low, low + 2.0)
        free = [find_margins(build_sampled_plant(plants(moved).at(m, 0.0), H), LAW).modulus for m in (15.0, 16.5, 18.0)]
        touching = [
            modulus(mass, stiffness, extra)
            for mass in (15.0, 16.5, 18.0)
            for extra in (moved[0], low + 1.0, moved[1])
            for stiffness in np.geomspace(8e4, 1.6e5, 9).tolist()
        ]
        least = min(*free, *touching)
        drawn = [
            modulus(float(rng.uniform(15.0, 18.0)), float(rng.uniform(8e4, 1.6e5)), float(rng.uniform(*moved)))
            for _ in range(20)
        ]
        assert min(drawn) > 0.999 * least
        of = Claim(plants=plants(moved), law=LAW, sample_time_s=H, modulus=0.97 * least, work=10**7)
        assert prove(of).holds
        false = prove(replace(of, modulus=1.005 * least)).false
        assert false is not None


@pytest.mark.parametrize("mass", [0.0, 0.5, 2.0, 8.0])
@pytest.mark.parametrize("stiffness", [2e4, 1.6e5, 5e5])
def test_three_roads_lead_to_the_same_contact(mass: float, stiffness: float) -> None:
    """The exact transient, the paper's difference equation with fine steps, and Runge–Kutta steps."""
    plant = surface(stiffness, mass)
    pair = build_sampled_contact(build_sampled_plant(plant, H))
    exact, played = simulate_contact(pair, LAW, Approach(force_n=30.0)), replay_contact(plant, LAW, H, 30.0)
    assert played.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=5e-3)
    assert played.peak_sensor_force_n == pytest.approx(exact.peak_sensor_force_n, rel=5e-3)
    # Fast, and led by little afterwards: the payload leaves and comes back, to a mass that swings meanwhile.
    fast = Approach(speed_m_s=0.08, after_impact_n=3.0)
    other = simulate_contact(pair, LAW, fast)
    stepped = simulate_nonlinear(plant, LAW, fast, sample_time_s=H, duration_s=1.0, substeps=needed_substeps(plant, H))
    assert stepped.peak_contact_force_n == pytest.approx(other.peak_contact_force_n, rel=2e-3)
    assert stepped.peak_sensor_force_n == pytest.approx(other.peak_sensor_force_n, rel=2e-3)


def test_a_mass_takes_its_share_of_the_speed_at_once() -> None:
    """M_p v = (M_p + M_e) v': the impulse in closed form, and the speed of a simulated payload one tick later."""
    plant, speed, mass = surface(1e3, 8.0), 0.1, 8.0
    exact = simulate_contact(build_sampled_contact(build_sampled_plant(plant, H)), LAW, Approach(speed_m_s=speed))
    # The approach that both begin from is steady to a hundred-thousandth.
    assert exact.impulse_n_s == pytest.approx(16.0 * mass / (16.0 + mass) * speed, rel=1e-4)
    run = simulate_nonlinear(plant, LAW, Approach(speed_m_s=speed), sample_time_s=H, duration_s=2.0 * H, substeps=40)
    assert run.payload_velocity_m_s[0] == pytest.approx(16.0 / 24.0 * speed, rel=1e-4)


def test_a_design_is_certified_with_the_mass_and_validated_from_its_file(tmp_path: Path) -> None:
    found = designed()
    certificate = found.controller.certificate
    assert certificate.continuous is not None
    widest = certificate.continuous["x"][-1]
    assert "environment_mass_kg" in widest.over
    assert widest.share == 1.0
    # Neither of these is proved of a wall with a mass, and neither is claimed.
    assert certificate.peaks is None
    assert certificate.bouncing is not None
    assert certificate.bouncing["x"].multiplier is None
    assert certificate.bouncing["x"].impacts > 0.0
    assert found.unchecked_together.startswith("not known") or "mass" in found.unchecked_together
    write_controller(tmp_path / "controller.yaml", found.controller)
    read = read_controller(tmp_path / "controller.yaml").controller
    assert read.certificate.domain["x"].plants.range_of("environment_mass_kg") == MOVED
    report = validate_controller(read)
    assert report.passed, [each.message for each in report.checks if not each.passed]
    lighter = replace(read.certificate.domain["x"], uncertain={"environment_mass_kg": (2.0, 60.0)})
    forged = replace(read, certificate=replace(read.certificate, domain={"x": lighter}))
    assert not validate_controller(forged).passed


def test_drawn_plants_are_simulated_one_by_one() -> None:
    (found,) = run_monte_carlo(designed().controller, count=6, seed=2)
    assert found.refusal == ""
    assert found.contact is not None
    assert found.unstable is None
    largest = max(each.peak_contact_force_n for each in designed().controller.predicted["x"].scenarios)
    assert found.worst[0].contact < 1.3 * largest
    assert all(each.plant.environment_mass_kg is not None for each in found.worst)


def test_peaks_and_rest_are_not_proved_with_a_mass() -> None:
    options = ProofOptions(further_s=1.0)
    assert prove_peaks(Prover(), plants(MOVED), LAW, H, "x", Approach(force_n=30.0), 60.0, options) is None


def test_a_person_who_holds_the_payload_is_not_simulated_against_a_mass() -> None:
    hand = Operator(mass_kg=1.0, damping_n_s_per_m=10.0, stiffness_n_per_m=300.0, path_m=np.linspace(-0.01, 0.01, 9))
    with pytest.raises(ParameterError, match=r"environment\.mass_kg"):
        simulate_operator(surface(1e5, 1.0), LAW, hand, sample_time_s=H)


def test_the_mass_is_read_from_problem_or_plant(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("environment_mass_kg: [1, 3]\n", encoding="utf-8")
    spec = read_problem(path)
    assert build_problems(identified_plant(), spec)["x"].plants.range_of("environment_mass_kg") == (1.0, 3.0)
    path.write_text("environment_mass_kg: {from: identified}\n", encoding="utf-8")
    asked = read_problem(path)
    with pytest.raises(EstimateError, match="no surface of axis x has a mass"):
        build_problems(identified_plant(), asked)
    axis = identified_axis()
    heavy = replace(axis.environments[0], mass_kg=known(2.0, 0.1))
    of = with_axis(replace(axis, environments=(heavy,)))
    assert build_problems(of, asked)["x"].plants.range_of("environment_mass_kg") == pytest.approx((1.8, 2.2))
    massless = replace(axis.environments[0], name="x2", mass_kg=absent())
    both = with_axis(replace(axis, environments=(heavy, massless)))
    assert build_problems(both, asked)["x"].plants.range_of("environment_mass_kg") == pytest.approx((0.0, 2.2))
    # Nobody asked: the surface is taken as one without mass.
    assert build_problems(of, FAST_SPEC)["x"].plants.range_of("environment_mass_kg") == (0.0, 0.0)
    path.write_text("environment_mass_kg: [-1, 3]\n", encoding="utf-8")
    with pytest.raises(UsageError):
        read_problem(path)
    with pytest.raises(ParameterError, match="environment_mass_kg"):
        plants((-1.0, 2.0))
