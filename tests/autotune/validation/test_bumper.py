"""A file that was certified for a payload in one piece, held against one with a bumper."""

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.certificate.base_plant import point_polynomials
from autotune.certificate.certify import METHOD, prove
from autotune.certificate.family import Claim, Family, build_families
from autotune.certificate.multiplier_search import find_multiplier
from autotune.certificate.peaks import prove_peak
from autotune.errors import UsageError
from autotune.formats.bumper_record import BumperContacts, BumperRecord, describe_bumper
from autotune.formats.controller import controller_tree, parse_controller
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.yaml12 import dump_yaml
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.bumper import SAMPLED, check_bumper, check_stated_bumper, parse_bumper, prove_with_bumper
from autotune.validation.report import Check
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.hand import HandImpedance
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.plant import Bumper, Environment, WrenchFilter
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
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


@pytest.mark.parametrize("text", ["0.5", "0.5,1e5,1,1", "0.5kg,2mm", "0,1e5", "0.5,1e5,-1", "0.5,100"])
def test_what_is_no_bumper_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse_bumper(text)


def test_what_proves_of_one_mass_alone_refuses_a_bumper() -> None:
    controller = small_controller()
    domain, law = controller.certificate.domain["x"], admittance_controller(controller, "x")
    soft = replace(domain.plants.nominal, bumper=Bumper(mass_kg=0.1, stiffness_n_per_m=1e5))
    (family,) = build_families(soft, domain.plants.ranges, 8e-4)
    with pytest.raises(ParameterError, match="bumper"):
        prove_peak(family, law, domain.approach, 100.0, work=1)
    with pytest.raises(ParameterError, match="bumper"):
        find_multiplier([family], law)
    held = Claim(
        plants=replace(domain.plants, nominal=soft),
        law=law,
        sample_time_s=8e-4,
        modulus=0.1,
        work=1,
        hand=HandImpedance(),
    )
    with pytest.raises(ParameterError, match="bumper"):
        prove(held)
    bumper = Bumper(mass_kg=20.0, stiffness_n_per_m=1e5)
    heavy = replace(soft, payload=replace(soft.payload, mass_kg=30.0), bumper=bumper)
    with pytest.raises(ParameterError, match=r"bumper.mass_kg must be below the payload's 16 kg"):
        Family(nominal=heavy, ranges={"payload_mass_kg": (16.0, 30.0)}, sample_time_s=8e-4)


def stated() -> Controller:
    """The small controller with what it does with a bumper, as `optimize` writes it."""
    controller = small_controller()
    domain, law = controller.certificate.domain["x"], admittance_controller(controller, "x")
    bumper = Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=50.0)
    pairs = [
        build_sampled_contact(build_sampled_plant(replace(each.plant(domain.plants.nominal), bumper=bumper), 8e-4))
        for each in domain.plants.corners()
    ]
    contacts = [simulate_contact(pair, law, domain.approach) for pair in pairs]
    swept = BumperContacts(
        modulus=min(find_margins(side, law).modulus for pair in pairs for side in (pair.free, pair.contact)),
        peak_contact_force_n=max(each.peak_contact_force_n for each in contacts),
        peak_sensor_force_n=max(each.peak_sensor_force_n for each in contacts),
        hardest={"environment_stiffness_n_per_m": 1.2e5, "payload_mass_kg": 16.0},
        plants=4.0,
    )
    options = ProofOptions(budget_s=1.0)
    proved = prove_with_bumper(Prover(), domain.plants, law, 8e-4, bumper, swept, options)
    record = BumperRecord(bumper=bumper, axes={"x": proved}, method=SAMPLED, proof_method=METHOD)
    return replace(controller, certificate=replace(controller.certificate, bumper=record))


def changed(controller: Controller, **changes: Any) -> Controller:
    record = controller.certificate.bumper
    assert record is not None
    axes = {"x": replace(record.axes["x"], **changes)}
    return replace(controller, certificate=replace(controller.certificate, bumper=replace(record, axes=axes)))


def test_what_a_file_states_with_its_bumper_is_verified_from_the_file() -> None:
    controller = parse_controller(dump_yaml(controller_tree(stated())), "controller.yaml").controller
    assert controller == stated()
    sampled, proved = check_stated_bumper(controller, "x", Prover())
    assert sampled.passed, sampled.message
    assert proved.passed, proved.message
    assert "proved for 100 % of the set" in proved.message
    certificate = controller.certificate
    assert any("with a bumper of 0.5 kg on 100 N/mm" in each.claim for each in certificate.proved_further)
    assert any("with a bumper of 0.5 kg on 100 N/mm" in each.claim for each in certificate.sampled_further)
    assert not list(check_stated_bumper(small_controller(), "x", Prover()))


@pytest.mark.parametrize(
    ("share", "field"),
    [(1.02, "modulus"), (0.98, "peak_contact_force_n"), (0.98, "peak_sensor_force_n"), (1.06, "proved_modulus")],
)
def test_a_file_that_states_better_is_refused(share: float, field: str) -> None:
    controller = stated()
    assert controller.certificate.bumper is not None
    value = share * getattr(controller.certificate.bumper.axes["x"], field)
    found = list(check_stated_bumper(changed(controller, **{field: value}), "x", Prover()))
    assert [each for each in found if not each.passed], [each.message for each in found]


def test_a_file_whose_bumper_misses_what_was_asked_is_refused() -> None:
    controller = stated()
    certificate = controller.certificate
    for asked, said in (({"modulus_margin": 0.9}, "asked 0.9"), ({"max_peak_force_n": 31.0}, "asked at most 31")):
        other = replace(
            controller, certificate=replace(certificate, requirements={**certificate.requirements, **asked})
        )
        (found,) = check_stated_bumper(other, "x", Prover())
        assert not found.passed
        assert said in found.message


def test_claims_above_the_least_modulus_with_a_bumper_are_never_proved() -> None:
    """Half a per cent above what a sweep of the same two masses finds, on 24 drawn bumpers; 3 % below is proved."""
    controller, rng = small_controller(), np.random.default_rng(5)
    domain, law = controller.certificate.domain["x"], admittance_controller(controller, "x")
    proved = 0
    for _ in range(24):
        mass, stiffness = float(rng.uniform(0.2, 6.0)), float(np.exp(rng.uniform(math.log(1e4), math.log(5e5))))
        damping = float(rng.uniform(0.02, 0.7)) * 2.0 * math.sqrt(mass * stiffness)
        bumper = Bumper(mass_kg=mass, stiffness_n_per_m=stiffness, damping_n_s_per_m=damping)
        plants = replace(domain.plants, nominal=replace(domain.plants.nominal, bumper=bumper))
        least = min(
            find_margins(build_sampled_plant(plants.at(16.0, wall), 8e-4), law).modulus for wall in (0.0, 1e5, 1.2e5)
        )
        claim = Claim(plants=plants.only(), law=law, sample_time_s=8e-4, modulus=1.005 * least, work=100_000)
        assert not prove(claim).holds, bumper
        proved += prove(replace(claim, modulus=0.97 * least)).holds
    assert proved >= 20


@pytest.mark.parametrize("tau", [0.0, 1e-3])
def test_the_polynomials_of_a_proof_are_those_of_the_sampled_plant(tau: float) -> None:
    """At a point of the set: X and F per command, by `problems.model` and by the proof's own equations."""
    plants = small_controller().certificate.domain["x"].plants
    nominal = replace(
        plants.nominal,
        bumper=Bumper(mass_kg=2.0, stiffness_n_per_m=5e4, damping_n_s_per_m=70.0),
        wrench_filter=WrenchFilter(time_constant_s=tau),
        environment=Environment(stiffness_n_per_m=1e5, damping_n_s_per_m=40.0),
    )
    ranges = {"environment_stiffness_n_per_m": (8e4, 1.2e5), "payload_mass_kg": (12.0, 20.0)}
    (contact,) = build_families(nominal, ranges, 8e-4)
    for family in (contact, contact.in_free_space()):
        point = np.mean(family.box(), axis=1)
        sampled, z = build_sampled_plant(family.plant(point), 8e-4), np.exp(0.4j)
        moved = np.linalg.solve(z * np.eye(len(sampled.phi)) - sampled.phi, sampled.gamma)
        d, force, position = (
            np.polyval([complex(each) for each in part[::-1]], z - 1.0) for part in point_polynomials(family, point)
        )
        assert position / d == pytest.approx(sampled.c_position @ moved, rel=1e-9)
        assert force / d == pytest.approx(sampled.c_force @ moved + sampled.d_force, rel=1e-9)
