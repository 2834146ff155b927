"""`autotune map` through the real entry point."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.cli.main import main
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.identified import write_identified
from autotune.formats.limits import CollisionResponse
from tests.autotune.formats.samples import make_controller, make_identified
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
COARSE = ("--x", "damping=100:5000:9:log", "--y", "lead_s=0:0.06:7")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of the command, with a controller and an identified plant."""
    made = make_controller(("x",))
    alone = replace(made, collision=replace(made.collision, response=CollisionResponse.NONE, threshold_n=None))
    write_controller(tmp_path / "controller.yaml", alone)
    found = make_identified()
    write_identified(tmp_path / "identified.yaml", replace(found, axes={"x": found.axes["x"]}), {})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_people_see_the_share_the_extremes_and_the_design(run_cli: RunCli, folder: Path) -> None:
    done = run_cli("map", "controller.yaml", "--show", "modulus", *COARSE)
    assert done.returncode == 0
    assert is_next_alone(done.stderr)
    lines = done.stdout.splitlines()
    assert lines[0].startswith("63 points, ")
    assert lines[0].endswith("% stable in contact and in free space")
    reported = ["smallest modulus", "largest modulus", "design", "controller.yaml", "written"]
    assert [line.split(":")[0] for line in lines[1:]] == reported
    assert lines[3].endswith(" at B_a 913 N·s/m, K_l 12.5 ms")
    assert lines[5] == "written: map.svg, map.csv"
    assert (folder / "map.csv").read_text(encoding="utf-8").count("\n") >= 63


def test_json_is_one_object_and_a_second_run_gives_the_same_bytes(run_cli: RunCli, folder: Path) -> None:
    arguments = ("map", "controller.yaml", "--show", "disk", *COARSE, "--json", "-o", "a.svg", "--data", "a.json")
    done = run_cli(*arguments)
    assert (done.returncode, done.stderr) == (0, "")
    tree = json.loads(done.stdout)
    assert (tree["picture"], tree["data"], tree["points"]) == ("a.svg", "a.json", 63)
    assert tree["design"]["value"] > 0.0
    assert tree["fixed"]["payload_mass"] == 16.0
    before = {name: (folder / name).read_bytes() for name in ("a.svg", "a.json")}
    again = run_cli(*arguments)
    assert again.stdout == done.stdout
    assert {name: (folder / name).read_bytes() for name in before} == before


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_intervals_are_reported_and_drawn_the_same_twice(
    folder: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    picture = folder / f"lead{suffix}"
    arguments = ["map", "controller.yaml", "--show", "stable-lead", "--where", "free_space", "-o", picture.name]
    arguments += ["--x", "drag=60:700:6", "--y", "damping=400:1200:2", "--set", "coupling_damping=0"]
    seen = []
    for _ in range(2):
        assert main(arguments) == 0
        seen.append((capsys.readouterr(), picture.read_bytes(), picture.with_suffix(".csv").read_bytes()))
    assert seen[0][1:] == seen[1][1:]
    assert seen[0][0].out == seen[1][0].out
    assert is_next_alone(seen[0][0].err)
    *reported, following = seen[1][0].err.splitlines()
    assert following == "next: autotune explore controller.yaml"
    assert [line.rpartition(" of sha256 ")[0] for line in reported] == [
        f"{picture.name}: replaced the picture of a map",
        "lead.csv: replaced the table of a map",
    ]
    lines = seen[0][0].out.splitlines()
    assert lines[0] == "K_l searched in 0 to 100 ms, in free space"
    assert lines[1].startswith("  B_a = 400 N·s/m: smallest stable value ")
    assert "none at " in lines[1]
    checksum = read_controller(folder / "controller.yaml").checksum
    assert lines[-2:] == [f"controller.yaml: checksum {checksum[:8]}", f"written: {picture.name}, lead.csv"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("q.svg", b"<?xml version='1.0'?><svg><dc:title>a drawing</dc:title></svg>"),
        ("q.png", b"\x89PNG\r\n\x1a\n of a camera"),
        ("q.csv", b"day,hours\n1,8\n"),
    ],
)
def test_a_file_that_no_map_made_is_not_replaced(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes
) -> None:
    (folder / name).write_bytes(content)
    picture = name if name != "q.csv" else "q.svg"
    before = sorted(folder.iterdir())
    assert main(["map", "controller.yaml", *COARSE, "-o", picture]) == 2
    output = capsys.readouterr().err
    assert (output.count("\n"), f"{name} exists and is no file of this tool" in output) == (1, True)
    assert ((folder / name).read_bytes(), sorted(folder.iterdir())) == (content, before)


def test_the_smallest_damping_is_reported_for_each_controller(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["map", "controller.yaml", "--show", "stable-damping", "--where", "contact", "--x", "K_e=1e5:1e6:5"]
    assert main([*arguments, "--search", "10:1e5:200:log", "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert list(tree["cases"]) == ["standard", "lead", "feedback damping", "lead + feedback damping"]
    assert tree["cases"]["lead"]["smallest"][1] < tree["cases"]["standard"]["smallest"][1]
    assert (folder / "map.svg").is_file()


def test_an_identified_plant_takes_its_gains_from_settings(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains = ["--set", "mass=13", "--set", "damping=1000", "--set", "lead_s=0.02", "--set", "drag=630"]
    assert main(["map", "identified.yaml", *gains, *COARSE, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert "# fixed: drag (B_p) = 630.0 N·s/m" in (folder / "map.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("controller.yaml", "--x", "speed=1:2"), 2, "parameter must be one of mass, damping"),
        (("controller.yaml", "--x", "mass=20:5"), 2, "LOW:HIGH with LOW below HIGH"),
        (("controller.yaml", "--x", "mass=5:5"), 2, "LOW:HIGH with LOW below HIGH"),
        (("controller.yaml", "--x", "mass=5:20:5000"), 2, "between 2 and 2000"),
        (("controller.yaml", "--x", "mass=5:20:1200", "--y", "lead_s=0:1:1200"), 2, "at most 1000000"),
        (("controller.yaml", "--y", "lead_s=0:0.05:log"), 2, "above 0 for logarithmic spacing"),
        (("controller.yaml", "--set", "mass=-1"), 2, "finite and above 0"),
        (("controller.yaml", "--axis", "y"), 2, "does not hold axis y; it holds x"),
        (("controller.yaml", "--show", "speed"), 2, "'speed' is not one of"),
        (("controller.yaml", "-o", "map.pdf"), 2, ".png or .svg"),
        (("controller.yaml", "-o", "nowhere/map.png"), 2, "does not exist"),
        (("controller.yaml", "--data", "controller.yaml"), 2, ".csv or .json"),
        (("absent.yaml",), 2, "cannot be read"),
        (("identified.yaml",), 2, "say --set mass=VALUE, or --controller FILE"),
        (("identified.yaml", "--set", "mass=13"), 4, "drag of axis x is not identified"),
        (("altered.yaml",), 6, "altered"),
        (("identified.yaml", "--controller", "altered.yaml"), 6, "altered"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence_a_code_and_no_file(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, message: str
) -> None:
    altered = (folder / "controller.yaml").read_text(encoding="utf-8").replace("12.5", "12.6")
    (folder / "altered.yaml").write_text(altered, encoding="utf-8")
    before = sorted(path.name for path in folder.iterdir())
    assert main(["map", *arguments]) == code
    out, aside = capsys.readouterr()
    assert (out, aside.count("\n")) == ("", 1)
    assert aside.startswith("autotune: ")
    assert message in aside
    assert sorted(path.name for path in folder.iterdir()) == before
