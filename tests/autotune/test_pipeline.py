"""Several recordings of one cell: identified side by side as one after the other, and told apart when one fails."""

from dataclasses import replace
from pathlib import Path

import pytest

from autotune.formats.cell import CellFile
from autotune.formats.identified import read_identified, write_identified
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.results import Identification
from autotune.simulation.phases import Program
from autotune.simulation.simulate import made_later, simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from identification.errors import EstimateError, LogError
from identification.given import Given
from identification.logs.roles.cell import Cell, GainsSource
from tests.autotune.simulation.runs import SHORT
from tests.identification.merging.test_axis import check_one_record

PARTIAL = IdentifyOptions(allow_partial=True)


def written(path: Path, program: Program, seed: int) -> Path:
    write_mcap(made_later(simulate_cell(SimulatedCell(), program, seed=seed).recording, seed), path)
    return path


@pytest.fixture(scope="module")
def two_logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("days")
    program = replace(SHORT, pose_count=5, pose_hold_s=1.0, jogging_s=2.0, sweep_s=2.0, contact_count=0)
    return [written(folder / f"{name}.mcap", program, seed) for seed, name in enumerate(("monday", "friday"), 1)]


@pytest.fixture(scope="module")
def one_orientation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = replace(SHORT, pose_count=1, jogging_s=2.0, sweep_s=1.0, contact_count=0)
    return written(tmp_path_factory.mktemp("rest") / "sunday.mcap", program, seed=0)


@pytest.fixture(scope="module")
def in_one_process(two_logs: list[Path]) -> Identification:
    return identify_log(two_logs, PARTIAL)


@pytest.mark.usefixtures("forked")
def test_recordings_side_by_side_show_what_they_show_one_after_the_other(
    two_logs: list[Path], in_one_process: Identification
) -> None:
    # The same code on the same numbers: nothing may differ, not by rounding.
    assert identify_log(two_logs, PARTIAL, processes=2) == in_one_process


def test_a_part_may_be_named_of_several_recordings(two_logs: list[Path]) -> None:
    """Seconds count in each; a recording that a stamp leaves outside is named and not used, and all are refused."""
    found = identify_log(two_logs, replace(PARTIAL, start=0.5, stop=14.0))
    spans = found.provenance["recordings"]
    assert [stop - start for start, stop in spans] == pytest.approx([13.5, 13.5], abs=0.01)
    begins = spans[1][0]
    alone = identify_log(two_logs, replace(PARTIAL, start=f"@{begins:.3f}"))
    assert len(alone.provenance["logs"]) == 1
    text = [each.message for each in alone.result.findings if each.code == "recording-outside"]
    assert [message[:8] for message in text] == ["Not used"]
    with pytest.raises(LogError, match="found none"):
        identify_log(two_logs, replace(PARTIAL, start="@4000000000"))


def test_options_come_back_from_the_provenance_and_an_older_file_has_defaults() -> None:
    given = {"mass_kg": Given(value=16.2, std=0.1)}
    asked = IdentifyOptions(wrench_topic="/ft", pose_topic="/pose", salvage=True, allow_partial=True, given=given)
    asked = replace(asked, gains={"mass": 10.0, "damping": 500.0})
    assert IdentifyOptions.from_tree(asked.tree(), None) == asked
    assert IdentifyOptions.from_tree({"salvage": True, "of_a_newer_version": 1}, None) == IdentifyOptions(salvage=True)
    wrench = asked.declared().wrench
    assert wrench is not None
    assert wrench.topic == "/ft"


def test_the_gains_that_ran_take_the_place_of_those_in_the_cell() -> None:
    own = GainsSource(mass=(20.0,) * 6, damping=(2e3,) * 6, lead=(0.01,) * 6)
    cell = CellFile(cell=Cell(gains=own), path=Path("cell.yaml"), sha256="")
    both = IdentifyOptions(cell=cell, gains={"mass": 10.0, "damping": 500.0}).declared().gains
    assert both == GainsSource(mass=(10.0,) * 6, damping=(500.0,) * 6, lead=(0.01,) * 6)
    assert IdentifyOptions(cell=cell, gains={"damping": 500.0}).declared().gains == replace(own, damping=(500.0,) * 6)
    assert IdentifyOptions(gains={"damping": 500.0}).declared().gains is None
    logged = Cell(gains=GainsSource(topic="/gains"))
    assert logged.with_gains({"mass": 10.0, "damping": 500.0}) == logged


def test_what_is_written_of_two_recordings_can_be_read_again(in_one_process: Identification, tmp_path: Path) -> None:
    """Reading refuses a table that is not what its covariance says."""
    check_one_record(in_one_process.result)
    write_identified(tmp_path / "identified.yaml", in_one_process.result, in_one_process.provenance)
    assert read_identified(tmp_path / "identified.yaml").result == in_one_process.result


def test_what_is_given_counts_once_beside_two_recordings(two_logs: list[Path], in_one_process: Identification) -> None:
    mass = in_one_process.result.payload.mass_kg
    assert mass.value is not None
    assert mass.std is not None
    prior = {"mass_kg": Given(value=mass.value, std=mass.std)}
    found = identify_log(two_logs, IdentifyOptions(allow_partial=True, given=prior)).result
    check_one_record(found)
    # As sharp as both logs together: 1/√2 of it, whatever each log alone knows.
    assert found.payload.mass_kg.std == pytest.approx(mass.std / 2.0**0.5, rel=1e-9)


def test_the_progress_comes_to_the_whole_in_small_parts(two_logs: list[Path]) -> None:
    reported: list[float] = []
    identify_log(two_logs[0], PARTIAL, progress=reported.append)
    assert sum(reported) == pytest.approx(1.0)
    assert min(reported) > 0.0
    assert max(reported) < 0.3


def test_the_provenance_names_both_recordings(two_logs: list[Path], in_one_process: Identification) -> None:
    provenance = in_one_process.provenance
    assert [entry["path"] for entry in provenance["logs"]] == [str(path) for path in two_logs]
    (first, second), gap_s = provenance["recordings"], 3600.0
    assert second[0] - first[0] == pytest.approx(gap_s, abs=1e-3)
    assert provenance["time_span_s"] == first


@pytest.mark.parametrize("processes", [1, 2])
def test_of_several_recordings_the_one_that_fails_is_named(
    two_logs: list[Path], one_orientation: Path, processes: int
) -> None:
    with pytest.raises(EstimateError, match=r"^sunday\.mcap: "):
        identify_log([one_orientation, two_logs[0]], processes=processes)


def test_an_only_recording_needs_no_name(one_orientation: Path) -> None:
    with pytest.raises(EstimateError) as refused:
        identify_log(one_orientation)
    assert "sunday" not in str(refused.value)
