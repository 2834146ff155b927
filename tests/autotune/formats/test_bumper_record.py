"""What `problem.yaml` says of a payload that is soft inside, and what it refuses."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import UsageError
from autotune.formats.bumper_record import BumperContacts, BumperRecord
from autotune.formats.problem import ProblemSpec, read_problem
from autotune.formats.records import record_tree
from problems.errors import ParameterError
from problems.model.plant import Bumper


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "problem.yaml"


def test_a_payload_that_is_soft_inside_is_read(path: Path) -> None:
    path.write_text("payload:\n  bumper: {mass_kg: 0.5, stiffness_n_per_m: 1e5, damping_n_s_per_m: 50}\n")
    assert read_problem(path).bumper == Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=50.0)
    path.write_text("payload: {contact_points_m: [[0, 0, 0]]}\n")
    assert read_problem(path).bumper is None


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{mass_kg: -1, stiffness_n_per_m: 1e5}", "payload.bumper.mass_kg must be greater than 0"),
        ("{mass_kg: 0, stiffness_n_per_m: 1e5}", "payload.bumper.mass_kg must be greater than 0"),
        ("{mass_kg: .nan, stiffness_n_per_m: 1e5}", "not a finite number"),
        ("{mass_kg: 1}", "payload.bumper.stiffness_n_per_m must be present"),
        ("{mass: 1, stiffness_n_per_m: 1e5}", "payload.bumper.mass must be one of"),
        ("{mass_kg: 1, stiffness_n_per_m: 1e5, damping_n_s_per_m: -1}", "damping_n_s_per_m must be at least 0"),
    ],
)
def test_what_is_no_bumper_is_refused_with_its_line(path: Path, entry: str, said: str) -> None:
    path.write_text(f"payload:\n  bumper: {entry}\n")
    with pytest.raises(UsageError) as refused:
        read_problem(path)
    assert str(refused.value).startswith(f"{path}, line 2: ")
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((0.5, 1e5), "bumper must be at.Bumper"),
        (Bumper(mass_kg=0.5, stiffness_n_per_m=100.0), r"30 N press this one 0\.3 m deep .* 100000"),
    ],
)
def test_what_is_no_value_of_a_problem_is_refused_where_it_is_made(given: Any, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        ProblemSpec(bumper=given)


def test_where_nothing_was_proved_nothing_is_written_of_a_proof() -> None:
    sampled = {"modulus": 0.5, "peak_contact_force_n": 60.0, "peak_sensor_force_n": 50.0, "plants": 9.0}
    contacts = BumperContacts(**sampled, hardest={"mass_kg": 16.0})
    proof = ("proved_modulus", "share", "cells", "arcs", "budget_s", "run_time_s")
    assert [getattr(contacts, name) for name in proof] == [0.0] * len(proof)
    assert record_tree(contacts) == {**sampled, "hardest": {"mass_kg": 16.0}}
    bumper = Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=50.0)
    axes = {"x": contacts, "y": replace(contacts, proved_modulus=0.4, share=0.7, cells=3.0)}
    record = BumperRecord(bumper=bumper, axes=axes, method="sampled", proof_method="proved")
    said = "with a bumper of 0.5 kg on 100 N/mm and 50 N·s/m"
    assert [each["claim"].partition(" |1 + L|")[0] for each in record.sampled()] == [
        f"axis x: {said}",
        f"axis y: {said}",
    ]
    assert [each["claim"] for each in record.proved()] == [f"axis y: stable with |1 + L| > 0.4 {said}"]
