import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from autotune.errors import CertificateError, UsageError
from autotune.export.export import export_controller
from autotune.formats.canonical import checksum
from autotune.formats.controller import controller_tree, read_controller, write_controller
from autotune.formats.controller_record import CollisionSettings, Controller, ControllerStatus
from autotune.formats.limits import CollisionResponse as FileResponse
from autotune.formats.signature import signature_path
from autotune.formats.yaml12 import dump_yaml
from autotune.runtime import CollisionResponse, Payload, load_controller
from problems.errors import ParameterError
from problems.model.controller import controller_blocks
from tests.autotune.formats.samples import make_controller
from tests.autotune.runtime.cases import PAYLOAD, make_axis

CELL: dict[str, Any] = {"sample_time_s": 1.0 / 1250.0, "payload_mass_kg": 16.0, "payload_inertia_kg_m2": {"rz": 16.0}}


def written(folder: Path, controller: Controller) -> Path:
    write_controller(folder / "controller.yaml", controller)
    return folder / "controller.yaml"


def resealed(folder: Path, change: dict[str, Any]) -> Path:
    """A file as a program would write it that knows how to make the checksum but not what may stand in the file."""
    tree = controller_tree(make_controller()) | change
    tree["checksum"] = checksum(tree)
    (folder / "controller.yaml").write_text(dump_yaml(tree), encoding="utf-8")
    return folder / "controller.yaml"


def test_a_good_file_says_what_it_says_to_the_rest_of_the_tool(tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    law = load_controller(path, **CELL)
    whole = read_controller(path)
    assert law.checksum == whole.checksum
    assert [axis.name for axis in law.axes] == ["x", "rz"]
    assert (law.response, law.threshold_n) == (CollisionResponse.RESET, 150.0)
    assert law.payload == Payload(
        mass_kg=16.0,
        com_S_m=(0.01, -0.02, 0.1),
        force_bias_S_n=(1.5, -0.25, 3.0),
        torque_bias_S_n_m=(0.1, 0.2, -0.0),
    )
    from autotune.formats.controller_record import admittance_controller

    for axis in law.axes:
        blocks = controller_blocks(admittance_controller(whole.controller, axis.name), law.sample_time_s)
        assert [[axis.blocks[row, i] for i in range(3)] for row in range(8)] == blocks.tolist()
        assert axis.payload_range == (14.0, 18.0)
        assert (axis.deadband, axis.is_subtractive) == (5.0, False)


@pytest.mark.usefixtures("unchecked_law")
def test_the_json_twin_is_the_same_controller(tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    export_controller(path, "json", tmp_path / "controller.json")
    assert load_controller(tmp_path / "controller.json", **CELL) == load_controller(path, **CELL)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass: 12.5", "mass: 12.4", "altered"),
        ("status: validated\n", "", "status must be present"),
        ("feedback_damping_s: 0.02", "feedback_damping_s: 2.0e-05", "feedback_damping_s must be 0 or at least 1e-4"),
        ("checksum:", "more: 1\nchecksum:", "found the key more"),
        ("format: autotune/controller", "format: autotune/identified", "format must be autotune/controller"),
        ("version: 1\n", "version: 2\n", "version must be 1"),
        ("lead_s: 0.0125", "lead_s: .nan", "not a finite number"),
        ("threshold_n: 150.0", "threshold_n: null", "threshold_n must be a number"),
    ],
)
def test_a_damaged_file_is_refused_with_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, make_controller())
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CertificateError, match=rf"controller\.yaml, line \d+: .*{message}"):
        load_controller(path, **CELL)


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    text = path.read_text(encoding="utf-8")
    for length in range(1, len(text), 97):
        path.write_text(text[:length], encoding="utf-8")
        with pytest.raises(CertificateError):
            load_controller(path, **CELL)
    with pytest.raises(UsageError, match="cannot be read"):
        load_controller(tmp_path / "none.yaml", **CELL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"status": "unvalidated"}, "not validated"),
        ({"compensation_mass_kg": 8.0}, "says nothing of axis rz"),
        ({"sample_time_s": 1e-3}, "certificate is for 0.0008 s, but the controller runs every 0.001 s"),
    ],
)
def test_a_sealed_file_that_claims_nothing_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(CertificateError, match=message):
        load_controller(resealed(tmp_path, change), **CELL)


@pytest.mark.parametrize(("key", "message"), [("domain", "does not speak of axis x"), ("proved", "proves nothing")])
def test_a_certificate_that_leaves_something_out_is_refused(tmp_path: Path, key: str, message: str) -> None:
    certificate = controller_tree(make_controller())["certificate"]
    empty: Any = {"domain": {"rz": certificate["domain"]["rz"]}, "proved": []}[key]
    with pytest.raises(CertificateError, match=message):
        load_controller(resealed(tmp_path, {"certificate": certificate | {key: empty}}), **CELL)


def test_gains_whose_equation_overflows_are_refused(tmp_path: Path) -> None:
    axes = controller_tree(make_controller(("x",)))["axes"]
    with pytest.raises(CertificateError, match=r"axes\.x\.mass must be at most 10000"):
        load_controller(resealed(tmp_path, {"axes": {"x": axes["x"] | {"mass": 1e300, "damping": 1e-300}}}), **CELL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sample_time_s": 1e-3}, r"runs every 0\.001 s, but .* for 0\.0008 s"),
        ({"sample_time_s": float("nan")}, "runs every nan s"),
        ({"payload_mass_kg": 13.9}, r"mass of 13\.9 kg is outside .* axis x .*, 14 to 18 kg"),
        ({"payload_mass_kg": float("nan")}, "mass of nan kg is outside"),
        ({"payload_mass_kg": 17.0}, r"would leave 9\.81 N of the cell's 17 kg, more than the 5 N"),
        ({"payload_inertia_kg_m2": {"rz": 18.1}}, r"inertia of 18\.1 kg·m² is outside .* axis rz"),
        ({"payload_inertia_kg_m2": None}, r"Axis rz is certified for an inertia from 14 to 18 kg·m²; give"),
    ],
)
def test_a_cell_outside_of_the_certificate_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = written(tmp_path, make_controller())
    with pytest.raises(CertificateError, match=rf"controller\.yaml: .*{message}"):
        load_controller(path, **CELL | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"payload_mass_kg": "16.2"}, r"payload_mass_kg must be a number, found '16\.2'"),
        ({"payload_mass_kg": True}, "payload_mass_kg must be a number, found True"),
        ({"sample_time_s": None}, "sample_time_s must be a number, found None"),
        ({"payload_inertia_kg_m2": {"rz": "16"}}, r"payload_inertia_kg_m2\['rz'\] must be a number, found '16'"),
        ({"payload_inertia_kg_m2": {"rz": 16.0, "q": 0.4}}, "by axis, rx, ry or rz; found 'q'"),
        ({"payload_inertia_kg_m2": {"rz": 16.0, "x": 0.4}}, "by axis, rx, ry or rz; found 'x'"),
        ({"payload_inertia_kg_m2": 0.4}, r"must hold inertias by axis, .*; found 0\.4"),
    ],
)
def test_a_cell_that_is_reported_wrongly_is_a_usage_error(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_controller(written(tmp_path, make_controller()), **CELL | change)


def test_the_ends_of_the_certified_range_are_in_it(tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    for mass in (14.0, 18.0):
        payload = dataclasses.replace(PAYLOAD, mass_kg=mass)
        law = load_controller(path, **CELL | {"payload_mass_kg": mass}, payload=payload)
        assert law.payload == payload


def test_the_expected_checksum_is_compared_in_all_of_its_digits(tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    digest = read_controller(path).checksum
    for expected in (digest, digest.upper()):
        assert load_controller(path, **CELL, expected_checksum=expected).checksum == digest
    with pytest.raises(CertificateError, match=f"its checksum is {digest}, not {'0' * 64}"):
        load_controller(path, **CELL, expected_checksum="0" * 64)
    with pytest.raises(CertificateError, match="another file"):
        load_controller(path, **CELL, expected_checksum=digest[:8] + "0" * 56)
    # 32 bits: another file of the same first 8 digits is found within minutes.
    for short in ("", digest[:8], digest[:63], digest + "0", "g" * 64):
        with pytest.raises(UsageError, match="must be all 64 hexadecimal digits"):
            load_controller(path, **CELL, expected_checksum=short)


def test_where_a_key_is_given_only_what_it_signed_is_loaded(tmp_path: Path) -> None:
    path, key, other = written(tmp_path, make_controller()), new_key(tmp_path / "pub.pem"), tmp_path / "other.pem"
    new_key(other)
    for signature in (None, bytes(64), b"", key.sign(b"another file")):
        if signature is not None:
            signature_path(path).write_bytes(signature)
        with pytest.raises(CertificateError, match=r"must be signed|is not a signature of"):
            load_controller(path, **CELL, public_key=tmp_path / "pub.pem")
    signature_path(path).write_bytes(key.sign(path.read_bytes()))
    assert load_controller(path, **CELL, public_key=str(tmp_path / "pub.pem")) == load_controller(path, **CELL)
    with pytest.raises(CertificateError, match="is not a signature of"):
        load_controller(path, **CELL, public_key=other)
    with pytest.raises(UsageError, match=r"none\.pem cannot be read"):
        load_controller(path, **CELL, public_key=tmp_path / "none.pem")
    # A file with another number and its checksum made anew is whole, but it is not what was signed.
    resealed(tmp_path, {"delay_samples": 3.5})
    load_controller(path, **CELL)
    with pytest.raises(CertificateError, match="is not a signature of"):
        load_controller(path, **CELL, public_key=tmp_path / "pub.pem")


def new_key(public: Path) -> Ed25519PrivateKey:
    key = Ed25519PrivateKey.generate()
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return key


def test_no_response_has_no_threshold(tmp_path: Path) -> None:
    calm = dataclasses.replace(
        make_controller(), collision=CollisionSettings(response=FileResponse.NONE, threshold_n=None)
    )
    law = load_controller(written(tmp_path, calm), **CELL)
    assert (law.response, law.threshold_n) == (CollisionResponse.NONE, float("inf"))


def test_an_unvalidated_file_is_refused_whatever_else_it_says(tmp_path: Path) -> None:
    path = written(tmp_path, dataclasses.replace(make_controller(), status=ControllerStatus.UNVALIDATED))
    with pytest.raises(CertificateError, match="not validated"):
        load_controller(path, **CELL)


@pytest.mark.parametrize(
    "change",
    [
        {"mass_kg": -1.0},
        {"mass_kg": float("nan")},
        {"mass_kg": "16"},
        {"com_S_m": (0.0, float("inf"), 0.0)},
        {"com_S_m": (0.0, "up", 0.0)},
        {"force_bias_S_n": 1.5},
    ],
)
def test_a_payload_that_cannot_be_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ParameterError, match=next(iter(change))):
        dataclasses.replace(PAYLOAD, **change)


ALONE = """
import json, sys, time

class Nothing:
    # What a machine without these libraries does: not even numpy is asked for.
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in {*sys.stdlib_module_names, "autotune", "problems", "ruamel"}:
            raise ModuleNotFoundError(name)

sys.path[:0] = [sys.argv[1]]
sys.meta_path.insert(0, Nothing())
begin = time.process_time()
import autotune.runtime as runtime
took = time.process_time() - begin
law = runtime.load_controller(sys.argv[2], sample_time_s=8e-4, payload_mass_kg=16.0, payload_inertia_kg_m2={"rz": 16.0})
rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
from autotune.runtime.frames import external_wrench
resting = [-each for each in external_wrench(law.payload, (0.0,) * 6, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))]
state = runtime.START
for _ in range(law.limits.rest_samples):
    state, command = runtime.step(law, state, wrench_S=resting, position_W_m=[0.0] * 3, R_WS=rows)
pushed = [each + 10.0 for each in resting]
state, command = runtime.step(law, state, wrench_S=pushed, position_W_m=[0.0] * 3, R_WS=rows)
print(json.dumps([took, command.increment_S]))
"""


def test_a_machine_with_nothing_but_the_yaml_parser_runs_a_controller(repository: Path, tmp_path: Path) -> None:
    path = written(tmp_path, make_controller())
    runs = []
    for _ in range(3):
        command = [sys.executable, "-c", ALONE, str(repository), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        runs.append(json.loads(done.stdout))
    assert all(increment[0] > 0.0 and increment[5] > 0.0 and increment[1] == 0.0 for _, increment in runs)
    # Of this process's own time: other processes do not make it longer.
    assert min(took for took, _ in runs) < 0.2


def test_the_axis_knows_its_place() -> None:
    assert [make_axis(name).index for name in ("x", "z", "rx", "rz")] == [0, 2, 3, 5]
    assert [make_axis(name).turns for name in ("z", "rx")] == [False, True]
