"""A file that was certified for a payload in one piece, held against one with a bumper."""

import re
from dataclasses import replace

import pytest

from autotune.certificate.family import Family
from autotune.errors import UsageError
from autotune.formats.controller_record import admittance_controller
from autotune.validation.bumper import check_bumper, describe_bumper, parse_bumper
from autotune.validation.report import Check
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.plant import Bumper
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import small_controller


def check(bumper: Bumper) -> Check:
    (found,) = check_bumper(small_controller(), bumper)
    return found


def test_a_light_bumper_changes_nothing_that_is_certified() -> None:
    found = check(Bumper(mass_kg=0.1, stiffness_n_per_m=1e6, damping_n_s_per_m=100.0))
    assert found.passed, found.message
    assert "0.1 kg on 1000 N/mm and 100 N·s/m" in found.message
    assert not check_bumper(small_controller(), None)


def test_one_that_nothing_damps_swings_on_the_surface_for_ever() -> None:
    found = check(Bumper(mass_kg=6.0, stiffness_n_per_m=2e4))
    assert not found.passed
    assert found.message.endswith("K_e 100 N/mm, M_p 16 kg: the contact does not come to rest")


def test_peaks_are_held_against_those_that_the_file_states() -> None:
    """The hardest corner by itself, and a file that states half of it."""
    bumper, controller = Bumper(mass_kg=3.0, stiffness_n_per_m=2e4), small_controller()
    domain, law = controller.certificate.domain["x"], admittance_controller(controller, "x")
    corner = Scenario(
        environment_stiffness_n_per_m=domain.environment_stiffness_n_per_m[1], payload_mass_kg=domain.payload_mass_kg[1]
    )
    plant = replace(corner.plant(domain.plants.nominal), bumper=bumper)
    pair = build_sampled_contact(build_sampled_plant(plant, controller.sample_time_s))
    struck = simulate_contact(pair, law, domain.approach).peak_contact_force_n
    low = [
        replace(each, peak_contact_force_n=0.5 * struck, peak_sensor_force_n=0.5 * struck)
        for each in controller.predicted["x"].scenarios
    ]
    forged = replace(controller, predicted={"x": replace(controller.predicted["x"], scenarios=tuple(low))})
    (found,) = check_bumper(forged, bumper)
    assert not found.passed
    said = re.search(r"peak at the contact ([\d.]+) N, stated ([\d.]+)", found.message)
    assert said is not None
    assert float(said[1]) == pytest.approx(struck, rel=0.01)


def test_one_that_is_heavier_than_the_payload_is_no_verdict_on_the_file() -> None:
    for mass in (50.0, 16.0):
        with pytest.raises(UsageError, match=f"--bumper has {mass:g} kg .* below the certified 16 kg"):
            check(Bumper(mass_kg=mass, stiffness_n_per_m=2e4))


@pytest.mark.parametrize(
    ("text", "bumper"),
    [
        ("0.5,1e5", Bumper(mass_kg=0.5, stiffness_n_per_m=1e5)),
        ("500g,100N/mm,20Ns/m", Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=20.0)),
    ],
)
def test_it_is_typed_as_mass_stiffness_and_damping(text: str, bumper: Bumper) -> None:
    assert parse_bumper(text) == bumper
    assert describe_bumper(bumper).startswith("a bumper of 0.5 kg on 100 N/mm")


@pytest.mark.parametrize("text", ["0.5", "0.5,1e5,1,1", "0.5kg,2mm", "0,1e5", "0.5,1e5,-1"])
def test_what_is_no_bumper_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse_bumper(text)


def test_a_proof_knows_no_bumper() -> None:
    domain = small_controller().certificate.domain["x"]
    soft = replace(domain.plants.nominal, bumper=Bumper(mass_kg=0.1, stiffness_n_per_m=1e5))
    with pytest.raises(ParameterError, match="bumper"):
        Family(nominal=soft, ranges={}, sample_time_s=8e-4)
