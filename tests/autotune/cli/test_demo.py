"""`autotune demo`: the whole chain, once as users run it."""

import contextlib
import hashlib
import io
import json
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import pytest

from autotune import demo as demo_module
from autotune.cli.demo import command
from autotune.cli.main import main
from autotune.demo import STEPS, DemoResult, MadeHere, run_demo
from autotune.formats.controller import read_controller
from autotune.formats.identified import read_identified
from autotune.formats.yaml12 import load_yaml
from autotune.report import page
from problems.model.plant import FREE_SPACE
from problems.model.robot import bandwidth_hz
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.progress import Progress
from tests.autotune.tuning.cases import shorten_checks

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
EARLIER = "from an earlier run\n"


@dataclass(frozen=True, kw_only=True)
class Whole:
    """What a demo found and printed, and the shares of the work that it reported."""

    folder: Path
    found: DemoResult
    printed: str
    notes: list[str]
    shares: list[float]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The demo with fewer impacts and plants (`make demo` is as users run it), over a file of an earlier run."""
    folder = tmp_path_factory.mktemp("demo") / "deep"
    folder.mkdir()
    (folder / "controller.yaml").write_text(EARLIER, encoding="utf-8")
    MadeHere(folder, []).add(folder / "controller.yaml")
    results, shares = list[DemoResult](), list[float]()

    def watched(*arguments: Any, progress: Progress, **options: Any) -> DemoResult:
        def report(share: float) -> None:
            shares.append(share)
            progress(share)

        results.append(run_demo(*arguments, progress=report, **options))
        return results[0]

    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        shorten_checks(patch)
        patch.setattr(demo_module, "run_demo", watched)
        assert main(["demo", str(folder), "--seed", "3", "--json"]) == 0
    notes = err.getvalue().splitlines()
    return Whole(folder=folder, found=results[0], printed=out.getvalue(), notes=notes, shares=shares)


@pytest.mark.slow
def test_the_demo_finds_the_truth_and_a_controller_that_is_certified_for_it(whole: Whole) -> None:
    tree = json.loads(whole.printed)
    *notes, replaced = whole.notes
    assert [line.removesuffix(" ...") for line in notes] == list(STEPS)
    earlier = hashlib.sha256(EARLIER.encode()).hexdigest()[:8]
    assert replaced == f"replaced {whole.folder / 'controller.yaml'} (sha256 {earlier}), of an earlier demo"
    by_name = {row["name"]: row for row in tree["identified"]}
    for name in ("payload mass M_p", "coupling stiffness K_s", "environment stiffness K_e"):
        assert by_name[name]["value"] == pytest.approx(by_name[name]["truth"], rel=0.05)
        assert abs(by_name[name]["value"] - by_name[name]["truth"]) < 5.0 * by_name[name]["std"]
    assert all(check["passed"] for check in tree["checks"])
    assert tree["active"]["x"]
    limit = tree["limit"]["x"]
    peak = max(each["peak_contact_force_n"] for each in tree["controller"]["predicted"]["x"]["scenarios"])
    # What the exact loop of the file says is where the picture begins.
    assert limit["design"]["peak_force_n"] == pytest.approx(peak, rel=1e-4)
    assert limit["lower_bound"]["force_n"] < limit["attained"]["peak_force_n"] < limit["design"]["peak_force_n"]
    assert "at this speed of approach no linear controller of this noise gets below" in (
        whole.folder / "report.html"
    ).read_text("utf-8")
    names = {"cell.mcap", "identified.yaml", "controller.yaml", "controller.json"}
    assert {path.name for path in whole.folder.iterdir()} == names | {"report.html", "demo.yaml"}
    assert Path(tree["report"]).name == "report.html"
    page = (whole.folder / "report.html").read_text(encoding="utf-8")
    assert page.index("controller.yaml: The controller and what it changes") < page.index("cell.mcap: The identified")
    assert {Path(path).name for path in tree["files"].values()} == names
    assert tree["controller"] == load_yaml(whole.folder / "controller.yaml")
    # The truth lies in the domain for which the controller is certified.
    domain = read_controller(whole.folder / "controller.yaml").controller.certificate.domain["x"]
    low, high = domain.environment_stiffness_n_per_m
    assert low < 1e3 * by_name["environment stiffness K_e"]["truth"] < high
    low, high = domain.payload_mass_kg
    assert low < by_name["payload mass M_p"]["truth"] < high


def test_how_far_it_is_is_reported_in_many_small_parts_that_make_the_whole(whole: Whole) -> None:
    assert sum(whole.shares) == pytest.approx(1.0, abs=1e-9)
    assert min(whole.shares) >= 0.0
    assert max(whole.shares) < 0.4
    assert len(whole.shares) > 20


def test_the_files_of_an_earlier_run_are_replaced(whole: Whole) -> None:
    found = whole.found
    assert found.report.passed
    written = read_controller(found.files.controller)
    assert written.checksum == found.checksum == read_controller(found.files.twin).checksum
    assert written.controller == found.optimized.controller
    assert written.controller.provenance["options"]["seed"] == 3
    source = read_identified(found.files.identified)
    assert written.controller.provenance["identified"]["sha256"] == source.sha256
    assert Path(source.provenance["logs"][0]["path"]) == found.files.log


def test_the_command_offers_the_cells_that_there_are() -> None:
    (option,) = (each for each in command.params if each.name == "cell")
    assert isinstance(option.type, click.Choice)
    assert tuple(option.type.choices) == tuple(demo_module.CELLS)
    build, spec = demo_module.CELLS["low-drag"]
    cell = build()
    assert cell.drag_n_s_per_m == 20.0
    assert bandwidth_hz(cell.robot) == pytest.approx(6.97, abs=0.005)
    assert (spec.payload_mass, spec.environment_stiffness) == ((12.0, 20.0), (2e4, 5e5))
    # The controller that drives it while the log is made is stable in free space and on the wall.
    plant = cell.contact_plant()
    for each in (plant, replace(plant, environment=FREE_SPACE)):
        assert spectral_radius(build_loop(build_sampled_plant(each, cell.sample_time_s), cell.controller)) < 1.0


def test_people_see_a_summary(
    whole: Whole, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = whole.found
    monkeypatch.setattr(demo_module, "run_demo", lambda *_args, **_options: found)
    monkeypatch.setattr("autotune.cli.demo.limits_of", lambda *_arguments: {})
    monkeypatch.setattr(page, "render_page", lambda *_arguments, **_options: "drawn once already")
    assert main(["demo", "anywhere"]) == 0
    output = capsys.readouterr().out
    for expected in (
        "beside the truth of the simulation",
        "payload mass M_p",
        "worst predicted peak",
        "holds the peak up",
        "stability in contact: proved for every M_p",
        str(found.files.log),
        str(found.files.log.parent / "report.html"),
        found.checksum[:8],
    ):
        assert expected in output
    (whole.folder / "report.html").unlink()  # what was written instead is no page, and would not be replaced
    assert main(["demo", "anywhere", "--quiet"]) == 0
    quiet = capsys.readouterr()
    assert (quiet.out, quiet.err) == ("", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["file.txt"], "is a file"), (["out", "--seed", "-1"], "seed"), (["a", "b"], "unexpected")],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "file.txt").write_text("", encoding="utf-8")
    done = run_cli("demo", *arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr


@pytest.mark.parametrize("name", ["cell.mcap", "identified.yaml", "controller.yaml", "controller.json", "report.html"])
def test_a_file_of_another_origin_is_not_replaced(run_cli: RunCli, tmp_path: Path, name: str) -> None:
    for list_is_there in (False, True):
        (tmp_path / "out").mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_text("mine\n", encoding="utf-8")
        if list_is_there:
            MadeHere(tmp_path / "out", []).add(tmp_path / "out" / name)
            (tmp_path / "out" / name).write_text("mine, and changed since\n", encoding="utf-8")
        before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
        run = run_cli("demo", "out")
        assert (run.returncode, run.stdout) == (2, "")
        assert f"{name} exists and is not what a demo made there, so it is not replaced" in run.stderr
        assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_a_list_that_is_none_is_refused(run_cli: RunCli, tmp_path: Path) -> None:
    (tmp_path / "demo.yaml").write_text("format: autotune/plan\n", encoding="utf-8")
    run = run_cli("demo", ".")
    assert run.returncode == 2
    assert "demo.yaml exists and is no list of a demo" in run.stderr
