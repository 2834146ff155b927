import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from autotune.cli.main import main
from autotune.formats.canonical import checksum, short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.problem import read_problem
from autotune.formats.signature import fingerprint
from autotune.formats.yaml12 import dump_yaml, load_yaml
from tests.autotune.export.peer_cases import PLAIN, peer_controller, requirements
from tests.autotune.tuning.cases import small_controller
from tests.next_step import is_next_alone

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_controller(tmp_path / "controller.yaml", small_controller())
    return tmp_path / "controller.yaml"


@pytest.mark.parametrize("target", ["cell", "json"])
def test_a_controller_is_exported_and_its_short_checksum_reported(run_cli: RunCli, source: Path, target: str) -> None:
    run = run_cli("export", source, "--target", target, "-o", "out")
    assert run.returncode == 0
    assert is_next_alone(run.stderr)
    exported = read_controller(source.with_name("out"))
    assert exported.controller == small_controller()
    assert run.stdout == f"out: {target}, checksum {short(exported.checksum)}\n"


def test_c_is_a_source_and_its_header(run_cli: RunCli, source: Path) -> None:
    run = run_cli("export", source, "--target", "c", "-o", "cell.c")
    assert run.returncode == 0
    assert is_next_alone(run.stderr)
    assert run.stdout == f"cell.c: c, checksum {short(read_controller(source).checksum)}\n"
    assert source.with_name("cell.c").exists()
    assert source.with_name("cell.h").exists()


def test_json_is_one_object_and_quiet_is_silent(run_cli: RunCli, source: Path) -> None:
    digest = read_controller(source).checksum
    output = run_cli("export", source, "--target", "json", "-o", "out", "--json")
    expected = {"target": "json", "path": "out", "checksum": digest, "short_checksum": digest[:8]}
    assert json.loads(output.stdout) == {**expected, "replaced": False}
    quiet = run_cli("export", source, "--target", "json", "-o", "out", "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.mark.parametrize(("old", "new"), [("mass: 6.0", "mass: 6.1"), ("status: validated\n", ""), ("\n", "\n\t")])
def test_an_altered_file_is_exit_6_with_one_line(run_cli: RunCli, source: Path, old: str, new: str) -> None:
    source.write_text(source.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    run = run_cli("export", source, "--target", "cell", "-o", "out")
    assert run.returncode == 6
    assert run.stdout == ""
    assert run.stderr.count("\n") == 1
    assert f"{source}, line " in run.stderr
    assert not source.with_name("out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["controller.yaml", "--target", "fzi", "-o", "out"], "'cell', 'json'"),
        (["controller.yaml", "--target", "cell"], "--output"),
        (["missing.yaml", "--target", "cell", "-o", "out"], "missing.yaml cannot be read"),
        (["controller.yaml", "--target", "cell", "-o", "no/such/folder/out"], "cannot be written"),
    ],
)
def test_a_wrong_request_is_exit_2(run_cli: RunCli, source: Path, arguments: list[str], message: str) -> None:
    run = run_cli("export", *arguments)
    assert run.returncode == 2
    assert message in run.stderr
    assert [path.name for path in source.parent.iterdir()] == ["controller.yaml"]


@pytest.mark.parametrize("target", ["cell", "json", "c"])
def test_an_earlier_export_is_replaced_and_reported_and_another_file_is_exit_2(
    run_cli: RunCli, source: Path, target: str
) -> None:
    arguments = ("export", source, "--target", target, "-o", "out.c")
    assert run_cli(*arguments).returncode == 0
    again = run_cli(*arguments)
    assert again.returncode == 0
    assert f"out.c: an earlier export --target {target} was replaced\n" in again.stdout
    assert json.loads(run_cli(*arguments, "--json").stdout)["replaced"] is True
    source.with_name("out.c").write_text("notes\n", encoding="utf-8")
    refused = run_cli(*arguments)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
    assert "out.c exists and is no export to" in refused.stderr
    assert source.with_name("out.c").read_text(encoding="utf-8") == "notes\n"


def test_the_help_has_an_example(run_cli: RunCli) -> None:
    run = run_cli("export", "--help")
    assert run.returncode == 0
    assert "Examples:\n    autotune export controller.yaml --target json -o controller.json\n" in run.stdout


def test_another_controller_is_certified_and_its_price_reported(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "easy.yaml", peer_controller({"x": PLAIN}, requirements(2.5e-4)))
    run = run_cli("export", "easy.yaml", "--target", "ros2_control", "-o", "out.yaml", "--joints", "j1, j2")
    assert run.returncode == 0
    assert is_next_alone(run.stderr)
    lines = run.stdout.splitlines()
    assert lines[0].startswith("out.yaml: ros2_control, from the file with checksum ")
    assert lines[1].startswith("axis x: mass 8 kg, damping_ratio ")
    assert " N with the law of the file itself: " in lines[2]
    assert any(line.startswith("axis x: the spring that the damping needs pulls back") for line in lines)
    for note in ("rule commands its reference", "publish −bias", "y, z, rx, ry, rz were not tuned"):
        assert any(line.startswith("note: ") and note in line for line in lines)
    assert 'joints: ["j1", "j2"]' in (tmp_path / "out.yaml").read_text(encoding="utf-8")


def test_the_json_of_another_controller_shows_parameters_and_price(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "easy.yaml", tmp_path / "out.yaml"
    digest = write_controller(source, peer_controller({"x": PLAIN}, requirements(2.5e-4)))
    assert (
        main(["export", str(source), "--target", "fzi_cartesian", "-o", str(out), "--json", "--orientation", "0,0,0,1"])
        == 0
    )
    tree = json.loads(capsys.readouterr().out)
    axis = tree["axes"]["x"]
    assert set(axis["parameters"]) == {"p", "d"}
    assert {"tuned", "reason", "peak_contact_force", "peak_contact_force_before", "margins"} <= set(axis)
    assert (tree["checksum"], tree["target"]) == (digest, "fzi_cartesian")
    assert out.exists()


def test_gains_along_the_base_ask_for_the_orientation_of_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "easy.yaml", tmp_path / "out.yaml"
    write_controller(source, peer_controller({"x": PLAIN}, requirements(2.5e-4)))
    asked = ["export", str(source), "--target", "fzi_cartesian", "-o", str(out)]
    assert main(asked) == 2
    output = capsys.readouterr()
    assert output.out == ""
    said, *lines = output.err.splitlines()
    assert "x must move and y, z must not" in said
    # What is to be pasted stands on lines of its own.
    *commands, said = (line for line in lines if line.startswith("    autotune "))
    assert [line for line in lines if not line.startswith("    ")] == [
        "where this law is beyond that controller, design in the law that it runs:"
    ]
    assert (len(commands), "--orientation 1,0,0,0" in said) == (2, True)
    assert not out.exists()
    assert main([*asked, "--orientation", "0,0,-0.70711,0.70711"]) == 0
    assert "x along its y" in capsys.readouterr().out
    assert "trans_y:\n        p: 0.00" in out.read_text(encoding="utf-8")


def test_what_another_controller_cannot_do_is_exit_5_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "hard.yaml", tmp_path / "out.yaml"
    write_controller(source, peer_controller({"x": PLAIN}, requirements(5e-3)))
    assert main(["export", str(source), "--target", "ros2_control", "-o", str(out)]) == 5
    output = capsys.readouterr()
    assert output.out == ""
    said, *lines = output.err.splitlines()
    assert "cannot do what was asked" in said
    # A line of YAML begins where its file does, commands are indented.
    pasted, *others = (line for line in lines if not line.startswith("    autotune "))
    assert others == ["and run"]
    (tmp_path / "problem.yaml").write_text(f"{pasted}\n", encoding="utf-8")
    assert read_problem(tmp_path / "problem.yaml").requirements.free_space_admittance is not None
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "cell", "--joints", "a"], "The target cell has no option --joints; it takes no options"),
        (
            ["--target", "fzi_cartesian", "--ros2-version", "jazzy"],
            "fzi_cartesian has no option --ros2-version; its",
        ),
        (["--target", "fzi_cartesian", "--orientation", "1,0,0"], "must be four numbers QX,QY,QZ,QW"),
        (["--target", "ros2_control", "--orientation", "0,0,0,1"], "ros2_control has no option --orientation"),
        (["--target", "ros2_control", "--ros2-version", "3.1.0"], "4.0.0 to 6.x"),
        (["--target", "ros2_control", "--return-stiffness", "0"], "above 0"),
    ],
)
def test_an_option_that_does_not_fit_is_exit_2(
    source: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = source.with_name("out")
    assert main(["export", str(source), "-o", str(out), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_a_law_that_is_not_stable_is_exit_6_whatever_its_checksum_says(run_cli: RunCli, source: Path) -> None:
    tree = load_yaml(source)
    tree["axes"]["x"]["damping"] /= 10.0
    tree["checksum"] = checksum(tree)
    source.write_text(dump_yaml(tree), encoding="utf-8")
    for target in ("json", "cell", "c"):
        run = run_cli("export", source, "--target", target, "-o", "out.c")
        assert (run.returncode, run.stdout) == (6, "")
        assert "controller.yaml is false, so nothing is exported from it: Axis x, stability" in run.stderr
    assert [path.name for path in source.parent.iterdir()] == ["controller.yaml"]


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("rest_force_n", 20.0, "with_residual_weight"),
        ("speed", 0.02, "limits.axes.x.speed is 0.02 m/s, and certified"),
        ("speed", 2.0, "limits.axes.x.speed is 2, and what the file holds makes it"),
    ],
)
def test_limits_that_validate_refuses_are_not_exported(
    source: Path, capsys: pytest.CaptureFixture[str], entry: str, value: float, message: str
) -> None:
    tree = load_yaml(source)
    (tree["limits"]["axes"]["x"] if entry == "speed" else tree["limits"])[entry] = value
    tree["checksum"] = checksum(tree)
    source.write_text(dump_yaml(tree), encoding="utf-8")
    for target in ("json", "c"):
        assert main(["export", str(source), "--target", target, "-o", str(source.with_name("out.c"))]) == 6
        refusal = capsys.readouterr().err
        assert "controller.yaml is false, so nothing is exported from it: Axis x, limits" in refusal
        assert message in refusal
    assert [path.name for path in source.parent.iterdir()] == ["controller.yaml"]


def test_c_of_a_payload_that_is_set_in_the_cell_holds_none(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No mass of 0 is certified, so the check of the exported code refuses the payload of the file."""
    tree = load_yaml(source)
    none = [0.0, 0.0, 0.0]
    tree["payload"] |= {"com_m": none, "force_bias_n": none, "torque_bias_n_m": none, "set_in_cell": True}
    # Those of the file hold the payload that it had.
    del tree["limits"]
    tree["checksum"] = checksum(tree)
    source.write_text(dump_yaml(tree), encoding="utf-8")
    assert main(["export", str(source), "--target", "c", "-o", str(source.with_name("cell.c"))]) == 0
    assert "cell_file_payload is empty" in capsys.readouterr().out
    after = source.with_name("cell.c").read_text("utf-8").partition("cell_file_payload = {")[2]
    assert float.fromhex(after.split(",")[0].strip()) == 0.0


def test_margins_that_are_better_than_those_of_the_law_are_exit_6(run_cli: RunCli, source: Path) -> None:
    tree = load_yaml(source)
    tree["certificate"]["margins"]["x"]["modulus"] *= 1.1
    tree["checksum"] = checksum(tree)
    source.write_text(dump_yaml(tree), encoding="utf-8")
    run = run_cli("export", source, "--target", "json", "-o", "out.json")
    assert (run.returncode, run.stdout) == (6, "")
    assert "modulus is claimed as" in run.stderr


def test_where_a_key_or_a_checksum_is_asked_for_it_is_verified(run_cli: RunCli, source: Path) -> None:
    key, beside = Ed25519PrivateKey.generate(), source.with_name("controller.yaml.sig")
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    source.with_name("pub.pem").write_bytes(public)
    arguments = ("export", source, "--target", "c", "-o", "cell.c")
    for signature in (None, bytes(64)):
        if signature is not None:
            beside.write_bytes(signature)
        assert run_cli(*arguments, "--public-key", "pub.pem").returncode == 6
    assert not source.with_name("cell.c").exists()
    unasked = run_cli(*arguments)
    assert unasked.returncode == 0
    assert "controller.yaml.sig was not verified, since no key was given" in unasked.stderr
    assert 'signed_by[17] = "";' in source.with_name("cell.c").read_text(encoding="utf-8")
    beside.write_bytes(key.sign(source.read_bytes()))
    assert run_cli(*arguments, "--public-key", "pub.pem").returncode == 0
    reported = fingerprint(key.public_key())
    assert f'signed_by[17] = "{reported}";' in source.with_name("cell.c").read_text(encoding="utf-8")
    assert f"signature verified, key {reported}" in source.with_name("cell.h").read_text(encoding="utf-8")
    digest = read_controller(source).checksum
    for expected, code in ((digest, 0), ("0" * 64, 6), (digest[:8], 2)):
        assert run_cli(*arguments, "--expected-checksum", expected).returncode == code
