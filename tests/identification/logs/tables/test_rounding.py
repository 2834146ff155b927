"""Time columns with too few digits, several tables of one recording, and their units."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.cell import check_cell_text
from identification.errors import LogError
from identification.logs.opened import open_logs
from identification.logs.read import read_recording, separate_runs
from identification.logs.tables.read import find_rounding
from problems.arrays import FloatArray

HEAD = "format: autotune/cell\nversion: 1\n"
ROLES = """\
wrench: {fields: {force: [fx, fy, fz], torque: [tx, ty, tz]}}
pose: {fields: {position: [px, py, pz], orientation: [qx, qy, qz, qw]}}
"""


def written(path: Path, names: str, time: list[str], values: FloatArray) -> Path:
    rows = [",".join([t, *(f"{value:.6f}" for value in row)]) for t, row in zip(time, values, strict=True)]
    path.write_text("\n".join([names, *rows, ""]), encoding="utf-8")
    return path


def wrenches(count: int) -> FloatArray:
    return np.asarray(np.random.default_rng(1).normal(size=(count, 6)) + 20.0)


def poses(count: int) -> FloatArray:
    rng, turn = np.random.default_rng(2), 0.3 * np.sin(0.01 * np.arange(count))
    places = np.cumsum(rng.normal(scale=1e-4, size=(count, 3)), axis=0)
    return np.column_stack([places, np.sin(turn), 0.0 * turn, 0.0 * turn, np.cos(turn)])


def codes(paths: list[Path], cell: str) -> list[str]:
    return [each.code for each in read_recording(paths, check_cell_text(HEAD + cell, Path("cell.yaml"))).findings]


@pytest.mark.parametrize("rate_hz", [98.0, 800.0, 1250.0, 3000.0])
@pytest.mark.parametrize("digits", [2, 3])
@pytest.mark.parametrize("cut", [False, True])
def test_an_even_clock_is_found_behind_its_rounded_readings(rate_hz: float, digits: int, cut: bool) -> None:
    """The steps are those that were; what all rows share is at most half a quantum, or a whole one of cut digits."""
    true = 1_700_000_000_000_000_000 + np.rint(1e9 * np.arange(5000) / rate_hz).astype(np.int64)
    quantum = 10 ** (9 - digits)
    found = find_rounding((true if cut else true + quantum // 2) // quantum * quantum)
    assert found is not None
    assert found.quantum_ns == quantum
    # The beat of both rates that is incomplete at the end tilts the line, by a part of a quantum over the whole.
    assert found.rate_hz == pytest.approx(rate_hz, rel=2e-5)
    off = found.even_ns - true
    assert np.max(np.abs(off)) < (1.05 if cut else 0.55) * quantum
    assert np.ptp(off) < 0.05 * quantum


def test_stamps_that_no_even_clock_explains_stay_as_they_are() -> None:
    ticks = np.rint(1e9 * np.arange(2000) / 800.0).astype(np.int64)
    rounded = (ticks + 500_000) // 1_000_000 * 1_000_000
    assert find_rounding(rounded) is not None
    assert find_rounding(np.delete(rounded, slice(700, 704))) is None, "rows were lost"
    assert find_rounding(np.concatenate([rounded[:900], rounded[900:] + 7_000_000])) is None, "a clock was set"
    assert find_rounding(ticks) is None, "nothing was rounded"
    assert find_rounding(rounded[::-1]) is None
    jitter = ticks + np.random.default_rng(1).integers(-300_000, 300_000, ticks.size)
    assert find_rounding(jitter) is None, "jitter of its own"


def test_a_table_with_three_digits_of_time_is_read_on_its_even_clock(tmp_path: Path) -> None:
    time = [f"{t:.2f}" for t in np.arange(1500) / 500.0]
    names = "t,fx,fy,fz,tx,ty,tz,px,py,pz,qx,qy,qz,qw"
    path = written(tmp_path / "run.csv", names, time, np.hstack([wrenches(1500), poses(1500)]))
    cell = check_cell_text(HEAD + ROLES + "table: {time: t}\n", Path("cell.yaml"))
    recording = read_recording(path, cell)
    assert np.max(np.abs(np.diff(recording.wrench.stamp_ns) - 2_000_000)) <= 1000
    assert {each.code: each.severity for each in recording.findings}["times-rounded"] == "info"
    assert not {"log-clock", "stamp-jitter", "duplicate-stamps"} & {each.code for each in recording.findings}


def test_rounded_times_with_lost_rows_are_the_tables_fault_and_not_the_drivers(tmp_path: Path) -> None:
    kept = np.delete(np.arange(1500), slice(700, 705))
    names = "t,fx,fy,fz,tx,ty,tz,px,py,pz,qx,qy,qz,qw"
    values = np.hstack([wrenches(1500), poses(1500)])[kept]
    path = written(tmp_path / "run.csv", names, [f"{t:.2f}" for t in kept / 500.0], values)
    with pytest.raises(
        LogError, match=r"times of table run\.csv repeat the one before.*Export the time with all its digi"
    ):
        codes([path], ROLES + "table: {time: t}\n")


def test_tables_of_other_rates_and_units_are_one_recording(tmp_path: Path) -> None:
    force_s, pose_s = np.arange(2000) / 1000.0, np.arange(250) / 125.0
    forces = written(tmp_path / "force.csv", "t,fx,fy,fz,tx,ty,tz", [f"{t:.6f}" for t in force_s], wrenches(2000))
    turned = written(tmp_path / "pose.csv", "ms,px,py,pz,qx,qy,qz,qw", [f"{1e3 * t:.3f}" for t in pose_s], poses(250))
    apart = "tables: {force.csv: {time: t}, pose.csv: {time: ms, time_unit: ms}}\n"
    cell = check_cell_text(HEAD + ROLES + apart, Path("cell.yaml"))
    assert separate_runs((forces, turned), cell) == ((forces, turned),)
    recording = read_recording([forces, turned], cell)
    assert (len(recording.wrench.stamp_ns), len(recording.pose.stamp_ns)) == (2000, 250)
    np.testing.assert_allclose(recording.pose.stamp_ns * 1e-9, pose_s, atol=1e-9)
    assert "tables-on-one-clock" in [each.code for each in recording.findings]
    # The unit forgotten: said as what it is, not as clocks of headers that nobody wrote.
    wrong = check_cell_text(HEAD + ROLES + apart.replace(", time_unit: ms", ""), Path("cell.yaml"))
    with pytest.raises(LogError, match=r"pose.csv span 1992 s, those of force.csv 1\.999 s, about 1000 times less"):
        read_recording([forces, turned], wrong)


def test_a_period_that_no_loop_has_is_questioned(tmp_path: Path) -> None:
    time = [f"{t:.1f}" for t in 2.0 * np.arange(300)]
    names = "t,fx,fy,fz,tx,ty,tz,px,py,pz,qx,qy,qz,qw"
    path = written(tmp_path / "run.csv", names, time, np.hstack([wrenches(300), poses(300)]))
    cell = check_cell_text(HEAD + ROLES + "table: {time: t}\n", Path("cell.yaml"))
    with open_logs((path,), cell, salvage=False) as logs:
        assert [each.code for each in logs.findings()] == ["crc-absent", "time-unit"]
    assert cell.table is not None
    with open_logs((path,), replace(cell, table=replace(cell.table, time_unit="ms")), salvage=False) as logs:
        assert [each.code for each in logs.findings()] == ["crc-absent"]
