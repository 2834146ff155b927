"""What a terminal shows and a pipe does not."""

import io
import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli._common import Output, clock, remaining_s
from autotune.cli._terminal import detect_terminal, painted, print_message, set_apart, wrap_lines
from autotune.cli.main import main
from autotune.cli.optimize import print_optimized
from autotune.formats.controller import write_controller
from autotune.formats.controller_record import Controller
from autotune.report import from_files
from autotune.validation.report import ValidationReport
from tests.autotune.cli.terminals import SAID_BY_USERS, terminal
from tests.autotune.tuning.cases import fast_optimized, write_plant
from tests.next_step import is_next_alone

BLOCKS = set("▁▂▃▄▅▆▇█")
ESCAPE = "\x1b"


class Stream(io.StringIO):
    """A stream that says what it is."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


@pytest.fixture
def controller_file(tmp_path: Path) -> Path:
    path = tmp_path / "controller.yaml"
    write_controller(path, fast_optimized().controller)
    return path


@pytest.mark.parametrize(
    ("is_terminal", "environment", "coloured"),
    [
        (True, {"TERM": "xterm"}, True),
        (True, {}, True),
        (False, {"TERM": "xterm"}, False),
        (True, {"TERM": "dumb"}, False),
        (True, {"NO_COLOR": "1"}, False),
        (True, {"NO_COLOR": ""}, True),  # set and empty says nothing
        (True, {"CLICOLOR": "0"}, False),
        (False, {"FORCE_COLOR": "1"}, True),
        (False, {"CLICOLOR_FORCE": "1"}, True),
        (False, {"FORCE_COLOR": "0"}, False),
        (True, {"NO_COLOR": "1", "FORCE_COLOR": "1"}, False),
    ],
)
def test_who_says_whether_there_is_colour(is_terminal: bool, environment: Mapping[str, str], coloured: bool) -> None:
    screen = detect_terminal(Stream(is_terminal), environment)
    assert screen.has_colour == coloured
    assert screen.can_redraw == (is_terminal and environment.get("TERM") != "dumb")
    assert (screen.columns is None) == (not is_terminal)


def test_no_stream_and_a_closed_one_are_no_terminals() -> None:
    closed = io.StringIO()
    closed.close()
    assert [detect_terminal(stream, {}).is_terminal for stream in (None, closed)] == [False, False]


def test_only_words_that_judge_are_coloured() -> None:
    with terminal(environment={"FORCE_COLOR": "1"}):
        reported = {word: painted(word) for word in ("ok     ", "identified", "warning: ", "FAILED", "payload mass")}
    assert [word for word, text in reported.items() if ESCAPE not in text] == ["payload mass"]
    assert reported["warning: "].endswith("\x1b[0m: ")
    assert len({reported[word][:5] for word in ("identified", "warning: ", "FAILED")}) == 3


def test_a_terminal_shows_colour_and_a_pipe_the_same_words(
    controller_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in SAID_BY_USERS:
        monkeypatch.delenv(name, raising=False)
    arguments = ["validate", str(controller_file), "--samples", "0"]
    with terminal(columns=1000) as seen:
        assert main(arguments) == 0
    assert main(arguments) == 0
    piped = capsys.readouterr()
    assert is_next_alone(piped.err)
    assert ESCAPE not in piped.out
    assert seen.text == piped.out + piped.err
    assert "\x1b[32mok\x1b[0m" in seen.raw
    assert "\x1b[32mvalid\x1b[0m, checksum " in seen.raw
    # The bar showed how much is done, and was wiped.
    assert "validating controller.yaml" in seen.raw
    assert " %" in seen.raw
    assert "validating" not in seen.text


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {"TERM": "dumb"}, {"CLICOLOR": "0"}])
def test_without_colour_the_words_stay(controller_file: Path, environment: Mapping[str, str]) -> None:
    with terminal(environment=environment) as seen:
        assert main(["export", str(controller_file), "--target", "json", "-o", str(controller_file) + ".json"]) == 0
        assert main(["validate", "nowhere.yaml"]) == 2
    # A bar may be drawn and wiped where the terminal can redraw: that moves the cursor, and colours nothing.
    assert ESCAPE not in re.sub(r"\x1b\[(\?25[hl]|\d*[AK])", "", seen.raw)
    # Folded where the path of the file leaves no room.
    assert "json, checksum" in " ".join(seen.text.split())
    assert "autotune: nowhere.yaml" in seen.text


def test_an_error_stands_out_on_a_terminal() -> None:
    with terminal() as seen:
        assert main(["validate", "nowhere.yaml"]) == 2
    assert "\x1b[31m\x1b[1mautotune\x1b[0m: nowhere.yaml" in seen.raw


def test_json_is_the_same_object_on_a_terminal_and_under_force(
    controller_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["export", str(controller_file), "--target", "json", "-o", f"{controller_file}.json", "--json"]
    with terminal(columns=60) as seen:
        assert main(arguments) == 0
    # A second export would say that it replaces the first.
    Path(f"{controller_file}.json").unlink()
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert main(arguments) == 0
    piped = capsys.readouterr().out
    assert ESCAPE not in piped
    assert json.loads(piped) == json.loads(seen.text)


def test_lines_are_folded_for_the_width_of_the_terminal(controller_file: Path) -> None:
    with terminal(columns=60) as seen:
        assert main(["validate", str(controller_file), "--samples", "0"]) == 0
    # A path is not broken, and neither is the command to be pasted.
    kept = (str(controller_file.parent), "next: ")
    lines = [line for line in seen.text.splitlines() if not line.startswith(kept)]
    assert len(lines) > 10
    assert max(map(len, lines)) <= 60
    assert any(line.startswith("       ") for line in lines)


def test_a_log_fits_a_narrow_terminal_and_keeps_its_table_on_a_wide_one(good_log: Path) -> None:
    with terminal(columns=70) as narrow:
        assert main(["inspect", str(good_log)]) == 0
    with terminal(columns=300) as wide:
        assert main(["inspect", str(good_log)]) == 0
    # A command that is to be pasted is not folded.
    folded = [line for line in narrow.text.splitlines()[2:] if "next: autotune " not in line]
    assert max(map(len, folded)) <= 70
    assert "/ft_sensor/wrench\n  type" in narrow.text
    assert any(line.startswith("topic") and line.endswith("can serve as") for line in wide.text.splitlines())


@pytest.mark.parametrize(
    ("columns", "encoding", "drawn"), [(120, "utf-8", True), (120, "latin-1", False), (None, "", False)]
)
def test_the_predicted_contact_is_drawn_on_a_terminal_that_can(
    columns: int | None, encoding: str, drawn: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    found = fast_optimized()
    if columns is None:
        print_optimized(found, Path("controller.yaml"), "0123abcd")
        printed = capsys.readouterr().out
    else:
        with terminal(columns, encoding) as seen:
            print_optimized(found, Path("controller.yaml"), "0123abcd")
        printed = seen.text
    lines = [line for line in printed.splitlines() if BLOCKS & set(line)]
    assert len(lines) == int(drawn)
    peak = max(each.peak_contact_force_n for each in found.controller.predicted["x"].scenarios)
    assert all("█" in line and f"peak {peak:.3g} N" in line for line in lines)
    assert "checksum 0123abcd" in printed


def test_a_line_of_blocks_needs_no_wider_terminal() -> None:
    with terminal(60) as seen:
        print_optimized(fast_optimized(), Path("controller.yaml"), "0123abcd")
    assert max(len(line) for line in seen.text.splitlines() if BLOCKS & set(line)) <= 60


# --- progress -----------------------------------------------------------------------------------------------------


def test_the_time_left_is_that_of_the_part_done_and_counts_down() -> None:
    assert remaining_s(1.0, 1.0, 0.0) is None
    assert remaining_s(2.0, 2.0, 0.25) == pytest.approx(6.0)
    assert remaining_s(5.0, 2.0, 0.25) == pytest.approx(3.0)
    # A step that takes longer than all that was expected: nobody knows.
    assert remaining_s(9.0, 2.0, 0.25) is None
    assert [clock(seconds) for seconds in (0.4, 7.0, 65.2, 3725.0)] == ["0:00", "0:07", "1:05", "1:02:05"]


@pytest.mark.parametrize(("total", "message"), [(2.0, " left"), (None, None)])
def test_a_bar_shows_how_much_is_left_and_takes_names_as_they_are(total: float | None, message: str | None) -> None:
    with terminal() as seen, Output().progress("reading [/run] \x1b[31m.mcap", total) as advance:
        time.sleep(1.1)
        advance(1.0)
        time.sleep(0.6 if total else 0.0)
    assert "reading [/run] ?[31m.mcap" in seen.raw
    assert "0:01" in seen.raw
    assert ("50 %" in seen.raw) == (" left" in seen.raw) == (message is not None)


@pytest.mark.parametrize(("output", "environment"), [(Output(quiet=True), {}), (Output(), {"TERM": "dumb"})])
def test_no_bar_where_none_is_wanted_or_can_be_drawn(output: Output, environment: Mapping[str, str]) -> None:
    with terminal(environment=environment) as seen, output.progress("reading", 1.0) as advance:
        advance(1.0)
    assert seen.raw == ""


def test_what_is_printed_of_a_failed_check_is_red() -> None:
    found = fast_optimized()
    checks = (replace(found.report.checks[0], passed=False), *found.report.checks[1:])
    with terminal() as seen:
        print_optimized(
            replace(found, report=replace(found.report, checks=checks)), Path("controller.yaml"), "0123abcd"
        )
    assert seen.raw.count("\x1b[31m\x1b[1mFAILED\x1b[0m") == 1


def test_a_page_of_several_files_shows_how_far_it_is(controller_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = write_plant(controller_file.parent)
    shares: list[float] = []

    def passed(_controller: Controller, progress: Callable[[float], None]) -> ValidationReport:
        for _ in range(4):
            progress(0.25)
        return fast_optimized().report

    monkeypatch.setattr("autotune.validation.verify.validate_controller", passed)
    from_files.report_files([plant.path, controller_file], progress=shares.append)
    assert shares == pytest.approx([0.5, 0.125, 0.125, 0.125, 0.125])


def test_lines_to_be_pasted_stand_on_their_own_and_are_not_folded(capsys: pytest.CaptureFixture[str]) -> None:
    lines, commands = (
        "requirements: {modulus_margin: 0.4}",
        ("autotune optimize a.yaml -o b.yaml", "autotune export b.yaml"),
    )
    said = f"That controller cannot. Put into problem.yaml: {lines} and run {'; '.join(commands)}."
    apart = set_apart(said, (lines, *commands))
    assert apart.splitlines() == [
        "That controller cannot. Put into problem.yaml:",
        f"    {lines}",
        "and run",
        *(f"    {each}" for each in commands),
    ]
    # A line of YAML begins at the margin, as those of its file do.
    printed = [each.replace(f"    {lines}", lines) for each in apart.splitlines()]
    folded = wrap_lines(apart, verdict="autotune: ", columns=20)
    assert [each for each in folded if each in printed] == [lines, "and run", *(f"    {each}" for each in commands)]
    assert wrap_lines(apart) == printed
    print_message(apart)
    assert capsys.readouterr().out == "\n".join(printed) + "\n"
