"""The command line as a whole: exit codes, what goes to which stream, and what is imported when."""

import importlib.util
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import numpy as np
import pytest

from autotune import __version__
from autotune.cli._common import Output, output_options
from autotune.cli.main import COMMANDS, CommandEntry, ExitCode, exit_code_of, main
from autotune.errors import CertificateError, InfeasibleError, UsageError
from identification.errors import EstimateError, LogError
from problems.errors import AutotuneError, ParameterError
from problems.frozen import FrozenDict

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
RunTiny = Callable[..., int]
HEAVY = {"numpy", "scipy", "numba", "rich", "mcap", "rosbags", "ruamel"}

TINY = """
import sys, time
import click
from autotune.cli._common import output_options
from autotune.cli.main import CommandEntry, main

@click.command()
@click.option("--wait", type=float, default=0.0)
@click.option("--lines", type=int, default=1)
@output_options
def command(output, wait, lines):
    with output.progress("Waiting", 3) as advance:
        advance(1)
        print("ready", file=sys.stderr, flush=True)
        time.sleep(wait)
    output.result({"lines": ["x" * 79] * lines}, lambda: print(*["x" * 79] * lines, sep="\\n"))
    return 6

sys.modules["tiny"] = sys.modules["__main__"]
sys.exit(main(entries={"tiny": CommandEntry(module="tiny", help="Do little.")}))
"""


@pytest.fixture
def run_tiny(monkeypatch: pytest.MonkeyPatch) -> RunTiny:
    """Run `autotune tiny ARGUMENTS` in this process, where the command does `body(output)`."""

    def run(body: Callable[[Output], int | None], *arguments: str) -> int:
        @click.command()
        @click.option("--mass", type=float)
        @output_options
        def tiny(output: Output, mass: float | None) -> int | None:
            del mass
            return body(output)

        module = ModuleType("tiny_command")
        module.__dict__["command"] = tiny
        monkeypatch.setitem(sys.modules, "tiny_command", module)
        entries = {"tiny": CommandEntry(module="tiny_command", help="Do little.")}
        return main(["tiny", *arguments], entries=entries)

    return run


def raising(error: BaseException) -> Callable[[Output], None]:
    def body(_output: Output) -> None:
        raise error

    return body


# --- through the real entry point ---------------------------------------------------------------------------------


def test_help_lists_every_command_in_the_order_of_the_work(run_process: RunCli) -> None:
    done = run_process("--help")
    assert (done.returncode, done.stderr) == (0, "")
    listed = [line.split()[0] for line in done.stdout.partition("Commands:")[2].splitlines() if line.startswith("  ")]
    assert listed[: len(COMMANDS)] == list(COMMANDS)
    assert list(COMMANDS)[:6] == ["inspect", "identify", "optimize", "validate", "export", "demo"]


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; from autotune.cli.main import main; code = main(['--help'])\n"
        "print(*sorted({name.split('.')[0] for name in sys.modules}), file=sys.stderr); sys.exit(code)"
    )
    done = _python(script)
    assert done.returncode == 0
    loaded = set(done.stderr.split())
    assert {"click", "autotune", "identification", "problems"} <= loaded
    assert not loaded & HEAVY


def test_help_answers_at_once(run_process: RunCli) -> None:
    """0.3 s is promised; processor time is asked, of the best of three runs: other work does not count in it."""
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run_process("--help").returncode == 0
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(spent) < 0.3


def test_version(run_process: RunCli) -> None:
    done = run_process("--version")
    assert (done.returncode, done.stdout) == (0, f"autotune {__version__}\n")


def test_no_arguments_show_the_help_as_a_usage_error(run_process: RunCli) -> None:
    done = run_process()
    assert (done.returncode, done.stdout) == (2, "")
    assert "Commands:" in done.stderr


@pytest.mark.parametrize("arguments", [("no-such-command",), ("--no-such-option",), ("completion", "tcsh")])
def test_usage_errors_are_one_line_and_exit_2(run_process: RunCli, arguments: tuple[str, ...]) -> None:
    done = run_process(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("autotune: ")
    assert done.stderr.count("\n") == 1
    assert "--help" in done.stderr


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_helps_with_an_example(run_cli: RunCli, name: str) -> None:
    done = run_cli(name, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    _usage, _, rest = done.stdout.partition("\n")
    assert f"autotune {name}" in rest


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "completion"])
def test_every_command_speaks_json_and_can_be_quiet(run_cli: RunCli, name: str) -> None:
    printed = run_cli(name, "--help").stdout
    assert [option for option in ("--json", "--quiet", "--debug") if option not in printed] == []


def test_importing_commands_imports_nothing_heavy() -> None:
    """One after the other in one process: what the first of them would load stands in its line."""
    modules = [entry.module for entry in COMMANDS.values()]
    script = (
        "import importlib, sys\n"
        f"for module in {modules}:\n"
        "    importlib.import_module(module)\n"
        "    print(module, *{name.split('.')[0] for name in sys.modules})"
    )
    done = _python(script)
    assert done.returncode == 0, done.stderr
    loaded = {line.split()[0]: set(line.split()[1:]) & HEAVY for line in done.stdout.splitlines()}
    assert loaded == {module: set[str]() for module in modules}


@pytest.mark.parametrize(("shell", "mark"), [("bash", "complete -o"), ("zsh", "compdef"), ("fish", "complete --")])
def test_completion_script(run_process: RunCli, shell: str, mark: str) -> None:
    done = run_process("completion", shell)
    assert done.returncode == 0
    assert mark in done.stdout
    assert "_AUTOTUNE_COMPLETE" in done.stdout


def test_completion_answers_the_shell() -> None:
    words = {"COMP_WORDS": "autotune i", "COMP_CWORD": "1", "_AUTOTUNE_COMPLETE": "bash_complete"}
    done = _python("import sys; from autotune.cli.main import main; sys.exit(main([]))", **words)
    assert done.stdout.split() == ["plain,inspect", "plain,identify"]


def test_a_reader_that_leaves_early_changes_nothing(tmp_path: Path) -> None:
    """100 000 lines do not fit into a pipe, so the writer meets the closed end for certain."""
    script = _tiny_script(tmp_path)
    for option in ([], ["--json"]):
        process = subprocess.Popen(
            [sys.executable, script, "tiny", "--lines", "100000", *option],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=_environment(),
        )
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        printed = process.stderr.read().decode()
        process.stderr.close()
        assert (process.wait(timeout=60), printed) == (ExitCode.CERTIFICATE, "ready\n")


def test_ctrl_c_exits_130(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, _tiny_script(tmp_path), "tiny", "--wait", "60"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=_environment(),
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    out, reported = process.communicate(timeout=60)
    assert (process.returncode, out, reported) == (130, "", "autotune: Interrupted.\n")


@pytest.mark.parametrize(("option", "shown"), [((), True), (("--quiet",), False)])
def test_progress_is_shown_on_a_terminal_only_and_never_when_quiet(
    tmp_path: Path, option: tuple[str, ...], shown: bool
) -> None:
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, _tiny_script(tmp_path), "tiny", *option],
        stdout=subprocess.PIPE,
        stderr=theirs,
        env=_environment(TERM="xterm"),
        timeout=60,
        check=False,
    )
    os.close(theirs)
    seen = os.read(ours, 65536).decode()
    os.close(ours)
    assert done.returncode == ExitCode.CERTIFICATE
    assert "ready" in seen
    assert ("Waiting" in seen) == shown


# --- in this process, with a command made for the purpose ---------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (click.UsageError("Two logs, one cell."), 2),
        (UsageError("Both masses are given."), 2),
        (ParameterError("mass_kg", -1.0, "positive"), 2),
        (LogError("run.mcap ends in the middle of a chunk."), 3),
        (EstimateError("The log holds no contact."), 4),
        (InfeasibleError("No controller keeps the peak below 100 N."), 5),
        (CertificateError("controller.yaml was altered."), 6),
        (KeyboardInterrupt(), 130),
        (click.Abort(), 130),
        (AutotuneError("An error of a branch that has no code."), 1),
        (ZeroDivisionError("division by zero"), 1),
        (SystemExit(0), 1),
    ],
)
def test_every_error_is_one_line_and_has_its_code(
    run_tiny: RunTiny, capsys: pytest.CaptureFixture[str], error: BaseException, code: int
) -> None:
    assert run_tiny(raising(error), "--json") == code
    out, printed = capsys.readouterr()
    assert printed.startswith("autotune: ")
    assert printed.count("\n") == 1
    tree = json.loads(out)
    assert tree["error"]["kind"] == type(error).__name__
    assert tree["error"]["exit_code"] == code
    assert tree["error"]["message"] in printed
    assert exit_code_of(error) == code


def test_without_json_an_error_leaves_standard_output_alone(
    run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_tiny(raising(LogError("Two\nlines."))) == 3
    assert capsys.readouterr() == ("", "autotune: Two lines.\n")


def test_debug_shows_the_traceback_and_nothing_else_does(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_tiny(raising(ZeroDivisionError("no")), "--debug") == 1
    assert "Traceback" in capsys.readouterr().err
    assert run_tiny(raising(ZeroDivisionError("no"))) == 1
    printed = capsys.readouterr().err
    assert "Traceback" not in printed
    assert "--debug" in printed


def test_a_usage_error_in_the_arguments_is_json_too(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_tiny(lambda _output: None, "--mass", "heavy", "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["kind"] == "BadParameter"


def test_a_page_is_named_behind_a_line_to_paste(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(output: Output) -> None:
        output.delivery.remark = "The page r.html says so."
        raise InfeasibleError("Nothing meets it; say structure: biquad", suggestion={"structure": "biquad"})

    assert run_tiny(refuse) == ExitCode.INFEASIBLE
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["autotune: Nothing meets it; say", "structure: biquad", "The page r.html says so."]


def test_a_result_then_an_error_is_still_one_object(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    def body(output: Output) -> None:
        output.result({"holds": False}, lambda: None)
        raise CertificateError("The modulus margin does not hold.")

    assert run_tiny(body, "--json") == 6
    out, printed = capsys.readouterr()
    assert json.loads(out) == {"holds": False}
    assert printed == "autotune: The modulus margin does not hold.\n"


@pytest.mark.parametrize(
    ("arguments", "out", "message"),
    [
        ((), "text\n", "note\n"),
        (("--quiet",), "", ""),
        (("--json",), '{\n  "mass_kg": 16.0\n}\n', "note\n"),
        (("--json", "--quiet"), '{\n  "mass_kg": 16.0\n}\n', ""),
    ],
)
def test_what_goes_to_which_stream(
    run_tiny: RunTiny, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], out: str, message: str
) -> None:
    def body(output: Output) -> None:
        output.note("note")
        with output.progress("Working", 2) as advance:
            advance(1)
            advance(1)
        output.result({"mass_kg": 16.0}, lambda: print("text"))

    assert run_tiny(body, *arguments) == 0
    assert capsys.readouterr() == (out, message)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), np.float64("nan"), np.array([-np.inf])])
def test_json_refuses_numbers_that_are_none(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str], bad: object) -> None:
    assert run_tiny(lambda output: output.result({"mass_kg": bad}, lambda: None), "--json") == 1
    out, _ = capsys.readouterr()
    assert json.loads(out)["error"]["kind"] == "ValueError"


def test_json_takes_the_values_that_the_project_uses(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    tree: Mapping[str, Any] = FrozenDict(
        {"code": ExitCode.LOG, "axes": FrozenDict({"z": np.arange(2.0)}), "n": np.int64(3), "log": Path("a.mcap")}
    )
    assert run_tiny(lambda output: output.result(tree, lambda: None), "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"code": 3, "axes": {"z": [0.0, 1.0]}, "n": 3, "log": "a.mcap"}


@pytest.mark.parametrize("code", [0, 5])
def test_an_integer_result_is_the_exit_code(run_tiny: RunTiny, code: int) -> None:
    assert run_tiny(lambda _output: code) == code


def test_linear_algebra_has_one_thread_whatever_the_environment_says(
    run_tiny: RunTiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums in another order round differently: the same input would give another file."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4")
    assert run_tiny(lambda _output: int(os.environ["OPENBLAS_NUM_THREADS"])) == 1


def test_the_table_names_modules_that_exist() -> None:
    missing = [entry.module for entry in COMMANDS.values() if importlib.util.find_spec(entry.module) is None]
    assert missing == []


def _environment(**more: str) -> dict[str, str]:
    root = Path(__file__).resolve().parents[3]
    return {**os.environ, "PYTHONPATH": str(root), **more}


def _python(script: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        env=_environment(**environment),
        timeout=60,
        check=False,
    )


def _tiny_script(folder: Path) -> str:
    path = folder / "tiny_cli.py"
    path.write_text(TINY, encoding="utf-8")
    return str(path)


def test_an_interrupt_inside_of_code_from_text_ends_with_our_code() -> None:
    lines = (
        "import sys, types, click",
        "from autotune.cli.main import CommandEntry, main",
        "command = click.Command('tiny', callback=lambda: exec('raise KeyboardInterrupt'))",
        "sys.modules['tiny'] = types.SimpleNamespace(command=command)",
        "code = main(['tiny'], entries={'tiny': CommandEntry(module='tiny', help='Interrupt.')})",
        "sys.exit(code)",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (130, "autotune: Interrupted.\n")


def test_a_warning_of_a_library_is_one_line_and_no_code(run_tiny: RunTiny, capsys: pytest.CaptureFixture[str]) -> None:
    """A library divides by zero: two lines of Python would mean nothing to a user, silence would hide it."""

    def body(output: Output) -> None:
        with np.errstate(divide="warn"), warnings.catch_warnings():
            warnings.simplefilter("always")
            np.log(np.zeros(1))
            np.ones(1) / np.zeros(1)
        output.result({}, lambda: print("done"))

    assert run_tiny(body) == 0
    printed = capsys.readouterr()
    assert printed.out == "done\n"
    (line,) = printed.err.splitlines()
    assert line.startswith("autotune: 2 warning(s) of the numerical libraries inside, the first RuntimeWarning: divide")


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("optimize", "a.yaml", "--compare", "mass=10,damping=1500", "--compare", "log"), "--compare is given 2 times"),
        (("predict", "a.yaml", "--axis", "x", "--axis=y", "--axis", "z"), "--axis is given 3 times"),
        (("export", "a.yaml", "-o", "b.c", "--output", "c.c"), "--output is given 2 times"),
    ],
)
def test_an_option_of_one_value_that_is_given_two_is_refused(
    words: tuple[str, ...], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(list(words)) == ExitCode.USAGE
    assert f"{option} and takes one value; leave one, or run the command once for each" in capsys.readouterr().err


def test_a_log_that_says_too_little_is_named_in_the_command_that_helps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "my cell.csv"
    table.write_text("a,b,c\n0,1,2\n0.01,2,3\n0.02,2,4\n", encoding="utf-8")
    assert main(["identify", str(table)]) == ExitCode.LOG
    assert f"`autotune inspect '{table}' --write-cell cell.yaml`" in capsys.readouterr().err


def test_a_search_starts_without_libraries_that_it_rarely_needs() -> None:
    """Half a second of the start of `optimize`: axes that share a payload and biquads take them, and nothing else."""
    done = _python("import sys, autotune.tuning.optimize, autotune.export.designing; print(*sys.modules)")
    assert "scipy.optimize" in done.stdout.split()
    assert not {"scipy.signal", "scipy.stats", "scipy.ndimage", "matplotlib", "casadi"} & set(done.stdout.split())
