"""The table of what the runtime notices, and the bits of Python and C over random readings with faults among them."""

import shutil
from pathlib import Path

import pytest

from autotune.formats.controller import write_controller
from autotune.runtime import Fault, RuntimeController
from autotune.runtime.load import read_law
from benchmarks.abuse_cases import CASES, Case
from benchmarks.bench_abuse import compare_random, compiled, run_case
from tests.autotune.export.c_twin import Twin
from tests.autotune.tuning.cases import small_controller

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> RuntimeController:
    """What `optimize` makes of a small cell, with the limits that it chose."""
    path = tmp_path_factory.mktemp("abuse") / "controller.yaml"
    write_controller(path, small_controller())
    return read_law(path)


@pytest.fixture(scope="module")
def twin(controller: RuntimeController, tmp_path_factory: pytest.TempPathFactory) -> Twin | None:
    """The same law in C, where there is a compiler."""
    return compiled(controller, tmp_path_factory.mktemp("twin")) if shutil.which("gcc") else None


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.fed)
def test_every_row_of_the_table_is_noticed_by_c_with_the_same_bits(
    controller: RuntimeController, twin: Twin | None, case: Case
) -> None:
    row = run_case(controller, case, twin)
    assert row.is_noticed, (row.fed.fault, case.fault)
    assert row.same
    assert twin is None or row.c_fault is row.fed.fault
    # Nothing faster than the limit is ever sent, and at once after a fault nothing at all.
    assert row.fed.largest_speed_m_s <= controller.limits.axes["x"].speed
    if case.fault in (Fault.FORCE_RANGE, Fault.SPEED, Fault.JUMP, Fault.NOT_FINITE, Fault.RESIDUAL_WRENCH):
        assert row.fed.largest_speed_m_s == 0.0


@pytest.mark.parametrize(("share", "missing_kg"), [(1.2, 3.2), (1.05, 0.8), (0.0, -16.0)])
def test_the_fault_at_the_start_carries_the_missing_mass(
    controller: RuntimeController, share: float, missing_kg: float
) -> None:
    (case,) = [each for each in CASES if each.load == share]
    # Noise of 0.14 N over 125 readings is 0.0013 kg of deviation.
    assert run_case(controller, case, None).fed.missing_mass_kg == pytest.approx(missing_kg, abs=0.008)


@needs_gcc
def test_c_is_python_to_the_bit_over_random_readings_with_every_fault_among_them(tmp_path: Path) -> None:
    """A short one of `bench_abuse.py --ticks 1000000`."""
    found = compare_random(20_000, 3, tmp_path)
    assert found.differs_at is None
    assert found.ticks >= 20_000
    assert set(found.faults) == set(Fault) - {Fault.NONE}
