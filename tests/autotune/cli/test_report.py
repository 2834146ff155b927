"""`--report` and `autotune report`, through the real entry point."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from autotune.cli.main import main
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.canonical import checksum
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.schedule import FORMAT
from autotune.formats.yaml12 import parse_document
from autotune.report.page import Table
from autotune.report.refused_page import refused_search_page
from tests.autotune.report.page_law import check_page
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, small_controller, write_plant
from tests.autotune.validation.test_validate import FALSE_CLAIMS


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], code: int) -> str:
    assert main(arguments) == code
    output = capsys.readouterr()
    assert output.err.count("\n") == 1
    return output.err


def test_the_page_of_identify_is_that_of_its_file_and_log(
    folder: Path, good_log: Path, identified_page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert json.loads((identified_page / "printed.json").read_text(encoding="utf-8"))["report"] == "page.html"
    shutil.copy(identified_page / "identified.yaml", folder)
    assert main(["report", "identified.yaml", str(good_log), "-o", "again.html", "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree == {"report": "again.html", "files": {"identified.yaml": "identified", str(good_log): "log"}}
    text = (identified_page / "page.html").read_text(encoding="utf-8")
    # The numbers of the file are read to the last bit, so the page is the same to the last byte.
    assert text == (folder / "again.html").read_text(encoding="utf-8")
    check_page(text)
    for output in (
        "Health of cell.mcap",
        'id="wrench-1"',
        'id="torque-1"',
        'id="x-residual"',
        'id="x-white"',
        'id="noise"',
    ):
        assert output in text
    # A picture comes before the long table, what is not known is named, and nothing is said twice.
    assert text.index("<figure") < text.index("Every parameter with one standard deviation")
    assert re.search(r"unidentifiable \([^)]*inertia", text)
    shown_text = re.sub(r'="[^"]*"', "", text)
    assert shown_text.count("The clocks of") == 1
    assert "`" not in re.sub(r"<script.*?</script>", "", shown_text, flags=re.DOTALL)
    assert text.count("Every contact along x") == 2  # the caption, and the name of its region
    other = folder / "other.mcap"
    shutil.copy(good_log, other)
    with other.open("ab") as stream:
        stream.write(b"\0")
    output = refused(capsys, ["report", "identified.yaml", "other.mcap"], 3)
    assert "other.mcap is not a log that identified.yaml was identified from" in output
    assert main(["report", "identified.yaml", "-o", "short.html", "--quiet"]) == 0
    assert 'id="wrench-1"' not in (folder / "short.html").read_text(encoding="utf-8")


def test_optimize_writes_its_page_and_json_shows_where(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_plant(folder)
    (folder / "problem.yaml").write_text(FAST_PROBLEM_YAML, encoding="utf-8")
    arguments = ["optimize", "identified.yaml", "--problem", "problem.yaml"]
    assert "name must end in .html" in refused(capsys, [*arguments, "--report", "controller.yaml"], 2)
    (folder / "mine.html").write_text("<p>mine</p>", encoding="utf-8")
    assert "name another one with --report" in refused(capsys, [*arguments, "--report", "mine.html"], 2)
    assert "--schedule tunes many" in capsys_first_line(
        capsys, [*arguments, "--schedule", "payload=16", "--report", "r.html"]
    )
    assert main([*arguments, "--report", "r.html"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "report: r.html"
    text = (folder / "r.html").read_text(encoding="utf-8")
    check_page(text)
    assert read_controller("controller.yaml").checksum in text
    assert 'id="x-convergence"' in text
    assert "1 % less would save" in text


def capsys_first_line(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    assert main(arguments) == 2
    return capsys.readouterr().err.splitlines()[0]


def test_validate_and_report_show_a_controller_and_replace_their_own_page(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_controller("controller.yaml", small_controller())
    assert main(["validate", "controller.yaml", "--samples", "4", "--report", "r.html", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == "r.html"
    check_page((folder / "r.html").read_text(encoding="utf-8"))
    arguments = ["report", "controller.yaml", "--samples", "4", "-o", "r.html", "--compare", "controller.yaml"]
    assert main(arguments) == 0
    text = (folder / "r.html").read_text(encoding="utf-8")
    check_page(text)
    arguments = ["report", "controller.yaml", "--samples", "0", "-o", "r.html", "--compare"]
    assert main([*arguments, "mass=30,damping=2000"]) == 0
    assert "mass=30,damping=2000" in (folder / "r.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert "--compare log needs the identified.yaml" in refused(capsys, [*arguments, "log"], 2)
    for reported in ('id="verdict"', 'id="x-band"', 'id="x-map"', 'id="x-nyquist"', "before"):
        assert reported in text


def test_a_claim_that_does_not_hold_is_exit_6_and_the_page_says_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, check, _ = FALSE_CLAIMS["damping too low"]
    write_controller("controller.yaml", change(small_controller()))
    for arguments in (
        ["report", "controller.yaml", "-o", "r.html"],
        ["validate", "controller.yaml", "--report", "r.html"],
    ):
        assert check in refused(capsys, arguments, 6)
        text = (folder / "r.html").read_text(encoding="utf-8")
        assert "NOT valid" in text
        assert "FAILED" in text
        (folder / "r.html").unlink()


def test_files_that_have_no_report_are_refused_in_a_sentence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_controller("controller.yaml", small_controller())
    altered = (
        (folder / "controller.yaml").read_text(encoding="utf-8").replace("status: validated", "status: unvalidated")
    )
    (folder / "altered.yaml").write_text(altered, encoding="utf-8")
    (folder / "plan.yaml").write_text("format: autotune/plan\nversion: 1\n", encoding="utf-8")
    (folder / "notes.txt").write_text("nothing", encoding="utf-8")
    (folder / "schedule.yaml").write_text(f"format: {FORMAT}\nversion: 1\n", encoding="utf-8")
    known = "not an identified plant, a controller, a Pareto front, a schedule or a log."
    (folder / "page.html").write_text('<meta name="generator" content="autotune report">', encoding="utf-8")
    for name, kind in (("plan.yaml", "a plan"), ("page.html", "a report")):
        assert f"{name} is {kind}, {known}" in refused(capsys, ["report", name], 2)
    assert "notes.txt is no file that autotune wrote; if it is a log, give the identified.yaml" in refused(
        capsys, ["report", "notes.txt"], 2
    )
    (folder / "broken.yaml").write_text("payload: [1, 2\naxes: {}\n", encoding="utf-8")
    assert "broken.yaml, line 2: not readable as YAML" in refused(capsys, ["report", "broken.yaml"], 2)
    (folder / "bag").mkdir()
    assert "bag is no file that autotune wrote; if it is a log" in refused(capsys, ["report", "bag"], 2)
    assert "none.yaml cannot be read" in refused(capsys, ["report", "none.yaml"], 2)
    assert not (folder / "report.html").exists()
    assert "schedule.yaml" in refused(capsys, ["report", "schedule.yaml", "altered.yaml"], 6)
    # Each has its part on a page of its own kind, which says it.
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert text.count("<dd>NOT valid") == 2
    stated = str(read_tree(altered)["checksum"])
    assert stated in text
    assert checksum(read_tree(altered)) in text
    assert "controller.html is the page of an earlier run and stays as it is." in refused_beside_a_page(folder, capsys)


def read_tree(text: str) -> dict[str, Any]:
    return parse_document(text.encode(), Path("altered.yaml"), error=UsageError, exact=False).tree


def refused_beside_a_page(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    page = folder / "controller.html"
    shutil.copy(folder / "report.html", page)
    before = page.read_bytes()
    output = refused(capsys, ["validate", "none.yaml", "--report", "controller.html"], 2)
    assert page.read_bytes() == before
    return output


def test_an_altered_controller_takes_the_place_of_the_page_that_called_it_valid(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_controller("controller.yaml", small_controller())
    assert main(["validate", "controller.yaml", "--samples", "0", "--report", "r.html", "--quiet"]) == 0
    valid = (folder / "r.html").read_text(encoding="utf-8")
    assert "Valid: all" in valid
    text = (folder / "controller.yaml").read_text(encoding="utf-8")
    (folder / "controller.yaml").write_text(text.replace("damping: ", "damping: 1", 1), encoding="utf-8")
    output = refused(capsys, ["validate", "controller.yaml", "--report", "r.html"], 6)
    assert output.endswith("The page r.html says so.\n")
    now = (folder / "r.html").read_text(encoding="utf-8")
    check_page(now, has_pictures=False)
    assert "Valid: all" not in now
    assert '<div class="bad large"><dt>outcome</dt><dd>NOT valid' in now
    assert main(["validate", "controller.yaml", "--report", "r.html", "--json"]) == 6
    assert json.loads(capsys.readouterr().out)["report"] == "r.html"


@pytest.mark.parametrize(
    ("log", "code", "shown"),
    [
        ("no_contact", 4, ("NOT identified", 'id="wrench-1"', "Phases of the log", "--allow-partial")),
        ("one_pose", 4, ("NOT identified", 'id="wrench-1"', "Health of one_pose.mcap")),
        ("no_command", 4, ("NOT identified", 'id="wrench-1"', "Health of no_command.mcap")),
        ("truncated", 3, ("NOT identified", "truncated.mcap")),
    ],
)
def test_a_refused_log_has_a_page_of_what_can_be_seen(
    folder: Path, unusable_logs: Path, capsys: pytest.CaptureFixture[str], log: str, code: int, shown: tuple[str, ...]
) -> None:
    output = refused(capsys, ["identify", str(unusable_logs / f"{log}.mcap"), "--report", "r.html"], code)
    assert output.endswith("The page r.html says so.\n")
    text = (folder / "r.html").read_text(encoding="utf-8")
    check_page(text, has_pictures=log != "truncated")
    for each in shown:
        assert each in text, each
    assert not (folder / "identified.yaml").exists()


def test_a_search_without_a_controller_has_a_page_of_what_could_be_eased(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = InfeasibleError("Axis x: none.", (("modulus_margin", 0.9, 0.5),))
    page = refused_search_page(error, None)
    table = next(block for block in page.sections[0].blocks if isinstance(block, Table))
    assert [cell.text for cell in table.rows[0]] == ["modulus_margin", "0.9", "0.5"]
    write_plant(folder)
    write_controller("old.yaml", small_controller())
    text = (folder / "old.yaml").read_text(encoding="utf-8")
    (folder / "old.yaml").write_text(text.replace("damping: ", "damping: 1", 1), encoding="utf-8")
    output = refused(capsys, ["optimize", "identified.yaml", "--compare", "old.yaml", "--report", "r.html"], 6)
    assert output.endswith("The page r.html says so.\n")
    shown = (folder / "r.html").read_text(encoding="utf-8")
    assert "NO controller" in shown
    assert "identified.yaml" in shown
    assert not (folder / "controller.yaml").exists()
