"""The public interface: what it holds, what it costs to import, and the chain from a plant to a validated file."""

import ast
import copy
import doctest
import importlib
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from hashlib import sha256
from html import escape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import autotune as at
from autotune.runtime.law import Payload
from autotune.runtime.load import load_controller
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.model.sampled import build_sampled_plant
from tests.autotune.formats.test_plant import WHOLE
from tests.autotune.simulation.runs import shorten_logs
from tests.autotune.tuning.cases import shorten_checks

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
PUBLIC = (
    *("AdmittanceTarget", "Approach", "AutotuneError", "Bumper", "Campaign", "CertificateError", "Check"),
    *(
        "ContactAtSpeed",
        "Design",
        "Estimate",
        "EstimateError",
        "Finding",
        "Identification",
        "InfeasibleError",
        "Log",
        "LogError",
    ),
    *("MultiplicativeError", "NoiseLimit"),
    *("ParameterError", "PassivityTarget", "Plant", "PredictedContact", "Problem", "Requirements", "Robot", "Status"),
    *("Uncertain", "UnstableLoopError", "UsageError", "Validation", "__version__", "from_control", "identify"),
    *("load", "optimize", "predict", "read_log", "run_campaign", "simulate_log"),
)


@pytest.fixture(autouse=True)
def _no_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")


def written_plant(**changes: Any) -> at.Plant:
    """The plant of the issue, with two ends that are near each other, so that the search is short."""
    values: dict[str, Any] = {
        "mass": 16,
        "coupling_stiffness": 3e5,
        "drag": 630,
        "robot": at.Robot(bandwidth=3.2, delay=2.4e-3),
        "environment_stiffness": (4e4, 8e4),
        "sample_time": 8e-4,
    }
    return at.Plant(**values | changes)


@pytest.fixture(scope="module")
def design() -> at.Design:
    return at.optimize(written_plant())


def test_the_public_names_are_these() -> None:
    assert tuple(at.__all__) == PUBLIC
    assert dir(at) == sorted(PUBLIC)
    for name in PUBLIC:
        assert getattr(at, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'optimise'"):
        _ = at.optimise  # type: ignore[attr-defined]


def test_what_types_see_is_what_there_is() -> None:
    """The imports under TYPE_CHECKING, which no interpreter runs, name every public name and no other."""
    tree = ast.parse(Path(at.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = [
        alias.asname or alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    ]
    assert sorted(seen) == sorted(PUBLIC)


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "autotune.api",
        "autotune.formats.plant",
        "autotune.log",
        "autotune.recording.first_log",
        "autotune.recording.recorder",
    ],
)
def test_the_examples_of_docstrings_run(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shorten_checks(monkeypatch)
    shorten_logs(monkeypatch)
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted > 0
    assert found.failed == 0


def test_importing_it_imports_nothing_else() -> None:
    code = "import sys; before = {*sys.modules}; import autotune; print(*({*sys.modules} - before))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"numpy", "scipy", "numba", "matplotlib", "casadi", "optuna", "control", "click", "rich", "pandas"}
    assert not heavy & {name.partition(".")[0] for name in found}
    assert {name for name in found if name.startswith(("autotune", "identification", "problems"))} == {"autotune"}


def test_a_plant_becomes_a_design_without_a_disk(design: at.Design) -> None:
    assert list(design.gains) == ["x"]
    assert design.controller.certificate.domain["x"].payload_mass_kg == (16.0, 16.0)
    assert design.controller.certificate.domain["x"].environment_stiffness_n_per_m == (4e4, 8e4)
    assert design.controller.provenance["identified"]["plant"]["mass"] == 16.0
    assert any("exact" in note and "robot.delay" in note for note in design.notes)


def test_every_result_shows_copies_and_pickles(design: at.Design, capsys: pytest.CaptureFixture[str]) -> None:
    prediction = at.predict(design, environment_stiffness=6e4)
    checked = design.validate(samples=0)
    for result in (design, prediction, checked, checked.checks[0]):
        assert len(repr(result).splitlines()) == 1
        assert repr(pickle.loads(pickle.dumps(result))) == repr(result)
        assert repr(copy.deepcopy(result)) == repr(result)
        assert {copy.deepcopy(result)} == {result}
        assert result._repr_html_().startswith("<p>")
        assert isinstance(result.to_dict(), dict)
    assert asdict(design.controller)["axes"]["x"]["mass"] == design.gains["x"]["mass"]
    design.summary()
    printed = capsys.readouterr().out
    assert "smallest margins" in printed
    # What it changes comes first, in a notebook too, and a straight axis has straight units only.
    (answer,) = design.before_after.values()
    assert printed.startswith(f"before → after, axis x: {answer}\n")
    assert design._repr_html_().startswith(f"<p>before → after, axis x: {escape(answer)}</p><p>Design, validated: ")
    assert "M_a [kg]  B_a [N·s/m]  " in printed


def test_the_summary_says_what_is_not_proved(design: at.Design) -> None:
    certificate = design.controller.certificate
    assert certificate.continuous is not None
    half = replace(certificate.continuous["x"][0], share=0.5, environment_stiffness_n_per_m=(4e4, 5e4))
    for continuous, said in (({"x": (half,)}, "50 %"), (None, "none")):
        changed = replace(design.controller, certificate=replace(certificate, continuous=continuous))
        text = str(at.Design(controller=changed))
        assert said in text.partition("modulus margin proved at all frequencies")[2]
        assert all(each.claim in text.partition("sampled, not proved")[2] for each in certificate.sampled)


def test_a_problem_shows_what_was_said_by_its_public_name() -> None:
    assert repr(at.Problem(bounds={"mass": (5, 20)})) == "Problem(bounds={'mass': (5, 20)})"


def test_what_is_asked_and_what_was_identified_are_keys() -> None:
    asked = at.Problem(uncertain={"drag": (300, 700)}, requirements=at.Requirements(min_damping_ratio=0.2))
    plant = written_plant()
    found = at.Identification(result=plant.file().result, provenance={"logs": [{"path": "run.mcap"}]})
    for result in (asked, asked.requirements, found, plant, plant.robot):
        assert {copy.deepcopy(result): 1}[result] == 1


def test_what_is_said_shows_itself_as_a_result_does() -> None:
    robot, mass = at.Robot(bandwidth=3.2, delay=2.4e-3), at.Uncertain(16, 0.2)
    asked = at.Problem(
        axes=("x",),
        uncertain={"drag": (300, 700)},
        requirements=at.Requirements(modulus_margin=None, min_damping_ratio=0.2, soft_n={"min_damping_ratio": 5}),
    )
    for said in (robot, mass, asked):
        assert said._repr_html_().startswith("<p>")
        assert json.loads(json.dumps(said.to_dict())) == said.to_dict()
        assert len(repr(said).splitlines()) == 1
    assert str(robot) == repr(robot) == "Robot(bandwidth=3.2, delay=0.0024)"
    assert robot.to_dict() == {"bandwidth": 3.2, "delay": 0.0024}
    assert f"{mass}" == "Uncertain(value=16.0, std=0.2)"
    assert mass.to_dict() == {"value": 16.0, "std": 0.2}
    tree = asked.to_dict()
    assert (tree["axes"], tree["objective"]) == (["x"], "contact_force")
    assert tree["uncertain"] == {"drag_n_s_per_m": [300, 700]}
    assert tree["requirements"]["min_damping_ratio"] == {"value": 0.2, "soft_n": 5}
    assert "modulus_margin" not in tree["requirements"]
    assert "uncertain.drag_n_s_per_m  " in str(asked)
    assert "None" not in str(asked)


def test_html_of_a_result_escapes_what_it_shows() -> None:
    check = at.Check(axis="x", name="<script>", passed=False, message="a & b")
    html = at.Validation(checks=(check,))._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_saved_design_is_loaded_and_holds(design: at.Design, tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    design.save(path)
    loaded = at.load(path)
    assert isinstance(loaded, at.Design)
    assert loaded.controller == design.controller
    assert loaded.notes == design.notes != ()
    checked = loaded.validate(samples=4)
    checked.require()
    assert checked.passed


def test_a_prediction_is_that_of_the_exact_transient(design: at.Design) -> None:
    found = at.predict(design, environment_stiffness=6e4, approach_speed=0.02)
    axis, plant = design._axis(None), found.plant
    assert plant is not None
    assert plant.environment.stiffness_n_per_m == 6e4
    pair = build_sampled_contact(build_sampled_plant(plant, 8e-4))
    again = simulate_contact(pair, axis.law, at.Approach(speed_m_s=0.02))
    assert np.array_equal(again.contact_force_n, found.contact.contact_force_n)
    assert found.peak_force == again.peak_contact_force_n
    assert not found.certified
    assert at.predict(design, environment_stiffness=6e4).certified
    assert not at.predict(design, environment_stiffness=1e6).certified


def test_plots_are_figures_and_take_axes(design: at.Design) -> None:
    from matplotlib import pyplot as plt
    from matplotlib.figure import Figure

    plots = (design.plot_contact, design.plot_nyquist, design.plot_bode, design.plot_map)
    for plot in (*plots, at.predict(design, environment_stiffness=6e4).plot):
        figure, axes = plt.subplots()
        assert plot(ax=axes) is figure
        assert axes.has_data()
        alone = plot()
        assert isinstance(alone, Figure)
        assert alone.number in plt.get_fignums()
        plt.close("all")
    with pytest.raises(at.UsageError, match="two different gains"):
        design.plot_map("damping", "stiffness")
    with pytest.raises(at.UsageError, match="two different gains"):
        design.plot_map("lead", "lead_s")
    for wrong in (3, [3, 4], [plt.figure().add_subplot(), 3]):
        with pytest.raises(at.UsageError, match="ax must be matplotlib axes"):
            design.plot_nyquist(ax=wrong)  # type: ignore[arg-type]
    design.plot_map("damping", "lead_s")
    plt.close("all")


def test_python_control_takes_the_loop_and_gives_the_robot(design: at.Design) -> None:
    """The poles of the closed loop lie inside of the unit circle, and r(s) comes back as it went."""
    loop = design.to_control()
    assert np.max(np.abs(loop.closed_loop.poles())) < 1.0
    assert len(repr(loop).splitlines()) == 1
    again = pickle.loads(pickle.dumps(loop))
    assert np.array_equal(again.closed_loop.A, loop.closed_loop.A)
    robot = at.from_control(loop.robot, delay=2.4e-3)
    # Coefficients pass through python-control as they are; its normalisation may round the last digits.
    assert robot.model().denominator == pytest.approx(written_plant().robot.model().denominator, rel=1e-12)


def test_the_runtime_refuses_a_payload_that_nobody_knows(design: at.Design, tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    design.save(path)
    with pytest.raises(at.CertificateError, match="give the payload that the cell carries"):
        load_controller(path, sample_time_s=8e-4, payload_mass_kg=16.0)
    payload = Payload(
        mass_kg=16.0, com_S_m=(0.0, 0.0, 0.1), force_bias_S_n=(1.0, 2.0, 3.0), torque_bias_S_n_m=(0.0, 0.0, 0.0)
    )
    ready = load_controller(path, sample_time_s=8e-4, payload_mass_kg=16.0, payload=payload)
    assert ready.payload == payload


@pytest.mark.parametrize(
    ("target", "code", "message"),
    [("c", 0, "cell_file_payload is empty"), ("ros2_control", 2, "no centre of mass"), ("json", 0, "checksum")],
)
def test_an_export_that_needs_the_payload_is_refused_or_leaves_it_to_the_cell(
    run_cli: RunCli, design: at.Design, tmp_path: Path, target: str, code: int, message: str
) -> None:
    design.save(tmp_path / "controller.yaml")
    out = tmp_path / {"c": "cell.c", "json": "cell.json"}.get(target, "cell.yaml")
    done = run_cli("export", "controller.yaml", "--target", target, "-o", out)
    assert done.returncode == code
    assert message in done.stdout + done.stderr
    assert out.exists() == (code == 0)


def test_a_known_payload_is_no_placeholder() -> None:
    none = (0.0, 0.0, 0.0)
    whole = written_plant(centre_of_mass=(0.0, 0.0, 0.1), force_bias=none, torque_bias=none)
    assert [finding.code for finding in whole.file().result.findings] == ["taken-as-exact"]
    assert "payload-unknown" in [finding.code for finding in written_plant().file().result.findings]


def test_pandas_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(at.UsageError, match=r"robot-autotune\[pandas\]"):
        at.Validation(checks=()).to_pandas()


def test_tables_go_to_pandas(design: at.Design, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in takes the columns: pandas is no dependency of the tests."""
    frame = SimpleNamespace(index=SimpleNamespace(name=None))
    taken: dict[str, Any] = {}

    def build(columns: dict[str, Any], index: Any = None) -> SimpleNamespace:
        taken.update(columns=columns, index=index)
        return frame

    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=build))
    assert design.to_pandas() is frame
    peaks = taken["columns"]["peak_contact_force_n"]
    assert max(peaks) == design.peak_force
    assert taken["columns"]["axis"] == ["x"] * len(peaks)
    contact = at.predict(design, environment_stiffness=6e4)
    contact.to_pandas()
    assert frame.index.name == "time [s]"
    assert len(taken["index"]) == len(taken["columns"]["contact_force"])
    robot = at.Robot(numerator=(20,), denominator=(1, 20), delay=(2e-3, 3e-3))
    written_plant(mass=at.Uncertain(16, 0.5), robot=robot, force_bias=(1, 2, 3)).to_pandas()
    columns = taken["columns"]
    rows = dict(zip(taken["index"], zip(*columns.values(), strict=True), strict=True))
    assert list(columns) == ["value", "std", "low", "high", "unit"]
    assert rows["mass"] == (16.0, 0.5, 14.5, 17.5, "kg")
    assert rows["force_bias.z"] == (3.0, 0.0, 3.0, 3.0, "N")
    assert rows["robot.denominator.1"] == (20.0, 0.0, 20.0, 20.0, "")
    assert np.isnan(rows["robot.delay"][:2]).all()
    assert rows["robot.delay"][2:] == (2e-3, 3e-3, "s")


def test_a_design_is_compared_with_one_in_memory_as_with_its_file(design: at.Design, tmp_path: Path) -> None:
    path = tmp_path / "before.yaml"
    checksum = design.save(path)
    kept = design.as_file()
    assert (kept.checksum, kept.controller) == (checksum, design.controller)
    found = at.optimize(written_plant(), compare=design)
    assert found.optimized is not None
    assert found.optimized.compared["x"].old.law.damping_n_s_per_m == design.gains["x"]["damping"]
    assert found.controller.provenance["options"]["compare"] == {"path": "(in memory)", "checksum": checksum}


def test_what_is_no_plant_or_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(at.UsageError, match="found int"):
        at.optimize(3)  # type: ignore[arg-type]
    (tmp_path / "other.yaml").write_text("a: 1\n", encoding="utf-8")
    with pytest.raises(at.UsageError, match="must be a controller"):
        at.load(tmp_path / "other.yaml")


def test_save_returns_the_digest_of_the_file(design: at.Design, tmp_path: Path) -> None:
    plant = written_plant(**WHOLE)
    for result in (plant, at.Identification(result=plant.file().result, provenance={"tool": "by hand"})):
        digest = result.save(tmp_path / "file.yaml")
        assert digest == sha256((tmp_path / "file.yaml").read_bytes()).hexdigest() == result.file().sha256
        (tmp_path / "file.yaml").unlink()
    assert design.save(tmp_path / "controller.yaml") == at.load(tmp_path / "controller.yaml").to_dict()["checksum"]


@pytest.mark.parametrize("kind", ["log", "plant", "controller"])
def test_save_replaces_no_file_of_another_kind(
    design: at.Design, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rule of the command line (docs/files.md, "What is replaced"), and again of the same kind it replaces."""
    shorten_logs(monkeypatch)
    path = tmp_path / "run7.mcap"
    if kind == "log":
        path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    else:
        (written_plant() if kind == "plant" else design).save(path)
    before = path.read_bytes()
    plant = at.Identification(result=written_plant().file().result, provenance={}, names=("a",))
    results: dict[str, Any] = {"controller": design, "plant": written_plant(), "identified": plant}
    for own, result in results.items():
        if own == kind:
            result.save(path)
            continue
        with pytest.raises(at.UsageError, match="not replaced"):
            result.save(path)
        assert path.read_bytes() == before
    with pytest.raises(at.UsageError, match="is not replaced"):
        at.simulate_log(path)
    assert path.read_bytes() == before


def test_a_log_is_not_simulated_into_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(at.UsageError, match="does not exist"):
        at.simulate_log(tmp_path / "none" / "run.mcap")


def test_a_prediction_names_the_payload_and_the_worst_of_the_certificate() -> None:
    """With a light and a heavy end, the default is the larger of the peaks, and never certified above the worst."""
    design = at.optimize(written_plant(), payload_mass=(14.0, 18.0))
    # A range for the design: the mass of the plant is not taken as exact any more.
    assert "mass" not in design.controller.provenance["identified"]["exact"]
    assert not any(": mass," in note for note in design.notes)
    found = at.predict(design, environment_stiffness=8e4)
    ends = [at.predict(design, environment_stiffness=8e4, payload_mass=mass).peak_force for mass in (14.0, 18.0)]
    assert found.peak_force >= max(ends)
    assert found.plant is not None
    assert f"payload of {found.plant.payload.mass_kg:.4g} kg" in repr(found)
    assert found.certified_peak == design.peak_force
    assert found.certified == (found.peak_force <= design.peak_force * (1.0 + 1e-9))
    assert f"predicts over its domain: {design.peak_force:.4g} N, computed on a grid and no proved bound" in str(found)
    refused: tuple[dict[str, Any], ...] = ({"approach_speed": 5.1}, {"approach_force": 1.1e4}, {"payload_mass": 1001.0})
    for wrong in refused:
        with pytest.raises(at.ParameterError):
            at.predict(design, environment_stiffness=8e4, **wrong)


def test_a_design_whose_gains_were_changed_is_not_saved(design: at.Design, tmp_path: Path) -> None:
    design.save(tmp_path / "first.yaml")
    loaded = at.load(tmp_path / "first.yaml")
    assert isinstance(loaded, at.Design)
    axes = {"x": replace(design.controller.axes["x"], mass=2.0 * design.gains["x"]["mass"])}
    for whole in (design, loaded):
        changed = replace(whole, controller=replace(whole.controller, axes=axes))
        with pytest.raises(at.CertificateError, match="changed after its certificate"):
            changed.save(tmp_path / "controller.yaml")
        assert not (tmp_path / "controller.yaml").exists()
