"""Wrong arguments of the public functions end in one sentence, which speaks of arguments."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import autotune as at
from autotune.arguments import count, in_arguments, priors, truth
from autotune.formats.cell import cell_text
from autotune.text import si_parameters
from identification.given import Given
from tests.autotune.formats.test_plant import WHOLE, plant
from tests.autotune.simulation.runs import shorten_logs

WRONG: dict[str, Callable[[], Any]] = {
    "axes must be names": lambda: at.optimize(plant(), axes=[]),
    "axes must be": lambda: at.optimize(plant(), axes=3),  # type: ignore[arg-type]
    "seed must be a whole number of at least 0, found 'a'": lambda: at.optimize(plant(), seed="a"),  # type: ignore[arg-type]
    "seed must be a whole number of at least 0, found -1": lambda: at.optimize(plant(), seed=-1),
    "problem must be the path": lambda: at.optimize(plant(), problem=3),  # type: ignore[arg-type]
    "compare must be the path": lambda: at.optimize(plant(), compare=3),  # type: ignore[arg-type]
    "progress must be": lambda: at.optimize(plant(), progress=3),  # type: ignore[arg-type]
    "log must be the path": lambda: at.identify(None),  # type: ignore[arg-type]
    "paths must be the path": lambda: at.read_log(None),  # type: ignore[arg-type]
    "each of paths must be the path": lambda: at.read_log([3]),  # type: ignore[list-item]
    "cell must be the path": lambda: at.read_log("run.mcap", cell=3),  # type: ignore[arg-type]
    "wrench_topic must be the name": lambda: at.read_log("run.mcap", wrench_topic=3),  # type: ignore[arg-type]
    "path must be the path": lambda: at.load(None),  # type: ignore[arg-type]
    "path must be the path of a file, found a Plant.": lambda: at.load(plant()),  # type: ignore[arg-type]
    "log must be the path of a file or several in a list, found a Plant.": lambda: at.identify(plant()),  # type: ignore[arg-type]
    "path must be the path of a file, found 3": lambda: plant().save(3),  # type: ignore[arg-type]
    "given must be a dictionary": lambda: at.identify("run.mcap", given=3),  # type: ignore[arg-type]
    "must be a finite number": lambda: at.identify("run.mcap", given={"mass_kg": math.nan}),
    "mass_kg must be at least 0": lambda: at.identify("run.mcap", given={"mass_kg": -1.0}),
    "jobs must be a whole number of at least 1, found 0": lambda: at.run_campaign("logs", "out", jobs=0),
    "seed must be a whole number of at least 0, found -2": lambda: at.run_campaign("logs", "out", seed=-2),
    "executor must be one of concurrent.futures, found 3": lambda: at.run_campaign("logs", "out", executor=3),  # type: ignore[arg-type]
    "optimize must be True or False, found 'no'": lambda: at.run_campaign("logs", "out", optimize="no"),  # type: ignore[arg-type]
    "allow_partial must be True or False, found 1": lambda: at.run_campaign("logs", "out", allow_partial=1),  # type: ignore[arg-type]
    "salvage must be True or False, found 'yes'": lambda: at.run_campaign("logs", "out", salvage="yes"),  # type: ignore[arg-type]
    "allow_partial must be True or False, found 'no'": lambda: at.identify("run.mcap", allow_partial="no"),  # type: ignore[arg-type]
    "keep_signals must be True or False, found None": lambda: at.identify("run.mcap", keep_signals=None),  # type: ignore[arg-type]
    "salvage must be True or False, found 'no'": lambda: at.read_log("run.mcap", salvage="no"),  # type: ignore[arg-type]
    "folder must be the path": lambda: at.run_campaign("logs", 3),  # type: ignore[arg-type]
    "Nothing called massx": lambda: at.identify("run.mcap", given={"massx": 1.0}),
}


def test_more_than_enough_is_refused_with_the_range() -> None:
    assert count("samples", 10, most=10) == 10
    with pytest.raises(at.UsageError, match="samples must be a whole number from 0 to 10, found 11"):
        count("samples", 11, most=10)


NO_KIND = " must be a controller.yaml, identified.yaml or plant.yaml, found no format entry."


@pytest.mark.parametrize("sentence", WRONG)
def test_a_wrong_argument_is_refused_in_one_sentence(sentence: str) -> None:
    with pytest.raises(at.UsageError) as refused:
        WRONG[sentence]()
    assert sentence in str(refused.value)
    assert "--" not in str(refused.value)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ((22.0, 10.0), "payload_mass must be a range from low to high, found (22.0, 10.0)."),
        ((0.0, 10.0), "payload_mass must be greater than 0, found (0.0, 10.0)."),
        (-10.0, "payload_mass must be greater than 0, found -10.0."),
        (plant(), "payload_mass must be a number, a range (low, high) or Uncertain(value, std), found a Plant."),
    ],
)
def test_a_range_that_is_none_is_refused_for_one_thing(given: Any, sentence: str) -> None:
    with pytest.raises(at.ParameterError) as refused:
        at.optimize(plant(), payload_mass=given)
    assert str(refused.value) == sentence


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [1, 2\nb: 3\n", ", line 2: not readable as YAML: expected ',' or ']', but got ':'."),
        ("mass: 16\n\tdrag: 1\n", ", line 2: a tab; use spaces."),
        ("only words\n", ", line 1: must hold a mapping (key: value), found the text 'only words'."),
        ("mass: 16\n", f"{NO_KIND} A plant.yaml begins with the lines `format: autotune/plant` and `version: 1`."),
    ],
)
def test_a_file_that_is_no_yaml_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(at.UsageError) as refused:
        at.load(path)
    assert str(refused.value) == f"{path}{said}"


@pytest.mark.parametrize("call", [at.optimize, at.predict, at.load])
def test_a_log_in_the_place_of_a_plant_is_refused_with_the_call_that_helps(
    tmp_path: Path, call: Callable[[Any], Any]
) -> None:
    path = tmp_path / "a run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(2**20))
    with pytest.raises(at.UsageError) as refused:
        call(path)
    first = f"at.identify('{path}'), or run `autotune identify '{path}'`."
    assert str(refused.value) == f"{path} is a log, which must be identified first: with {first}"


def test_a_log_that_was_read_is_to_be_identified_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_logs(monkeypatch)
    log = at.read_log(at.simulate_log(tmp_path / "run.mcap"))
    for call in (at.optimize, at.predict):
        with pytest.raises(at.UsageError) as refused:
            call(log)  # type: ignore[arg-type]
        assert str(refused.value) == "A log must be identified first: say at.identify(log) in its place."


def test_a_system_without_coefficients_is_no_robot() -> None:
    import control

    for system in (control.frd([1, 2, 3], [1, 2, 3]), 3):
        with pytest.raises(at.ParameterError, match="system must be"):
            at.from_control(system)


def test_whole_numbers_of_numpy_are_whole_and_its_truths_true() -> None:
    assert truth("salvage", np.bool_(True)) is True
    assert count("seed", np.int64(3)) == 3
    for wrong in (True, 1.5, None, "1"):
        with pytest.raises(at.UsageError):
            count("seed", wrong)


def test_the_folder_in_which_one_is_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_logs(monkeypatch)
    folder = tmp_path / "run 7"
    folder.mkdir()
    at.simulate_log(folder / "part.mcap")
    monkeypatch.chdir(folder)
    log = at.read_log(".")
    assert repr(log).startswith("<Log run 7: ")
    assert repr(at.identify(log, allow_partial=True)).startswith("<Identification of run 7: ")
    assert "from run 7. Lines without #" in cell_text(log.summary)


def test_priors_are_exact_or_have_a_deviation() -> None:
    assert priors({"mass_kg": 16, "x.delay_s": at.Uncertain(2e-3, 1e-4)}) == {
        "mass_kg": Given(value=16.0, std=0.0),
        "x.delay_s": Given(value=2e-3, std=1e-4),
    }


@pytest.mark.parametrize(
    ("option", "argument"),
    [
        ("record contacts, or say --environment-stiffness LO:HI.", "or say environment_stiffness=(low, high)."),
        ("or name it with --command-topic.", "or name it with command_topic."),
        ("With --allow-partial what was found", "With allow_partial=True what was found"),
        ("read what is left with `--salvage`.", "read what is left with salvage=True (an argument of read_log)."),
        ("did you mean 2e4:5e5? If it is meant, say its unit: --payload-mass 16N/m.", "did you mean 2e4:5e5?"),
        ("elsewhere, `--given x.delay_s=SECONDS`", 'elsewhere, `given={"x.delay_s": SECONDS}`'),
        (
            "`autotune inspect LOG --write-cell cell.yaml` begins",
            "`autotune inspect LOG --write-cell cell.yaml` begins",
        ),
    ],
)
def test_options_are_arguments(option: str, argument: str) -> None:
    assert in_arguments(option).endswith(argument) or in_arguments(option).startswith(argument)


def test_an_error_speaks_of_arguments() -> None:
    with pytest.raises(at.UsageError) as refused:
        at.optimize(plant(mass=16.0), environment_stiffness=(2.0, 5.0))
    assert str(refused.value).startswith("environment_stiffness asks for 2:5 N/m")
    assert "--" not in str(refused.value)


def test_parameters_are_si_numbers_with_their_units() -> None:
    found = at.Identification(result=plant(mass=16.0, **WHOLE).file().result, provenance={}, names=("a plant",))
    rows = {row.name: row for row in si_parameters(found.to_dict())}
    mass = rows["payload.mass_kg"]
    assert (mass.value, mass.std, mass.status, mass.unit) == (16.0, 0.0, "given", "kg")
    assert rows["axes.x.coupling.stiffness_n_per_m"].unit == "N/m"
    assert rows["axes.x.environments.surface.stiffness_n_per_m"].value == pytest.approx(math.sqrt(2e4 * 5e5))
    # One pole at ω: r(s) = ω/(s + ω).
    assert rows["axes.x.robot.denominator.1"].value == pytest.approx(2.0 * math.pi * 3.2)
    assert math.isnan(rows["sensor.deadband_n"].value)
    assert rows["sensor.deadband_n"].unit == "N"


def test_a_log_is_simulated_again_and_replaces_nothing_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_logs(monkeypatch)
    path = tmp_path / "run.mcap"
    assert at.simulate_log(path) == path
    first = path.read_bytes()
    assert at.simulate_log(path) == path
    assert path.read_bytes() == first
    path.write_bytes(b"mine")
    with pytest.raises(at.UsageError, match="overwrite=True"):
        at.simulate_log(path)
    assert path.read_bytes() == b"mine"
    at.simulate_log(path, overwrite=True)
    assert path.read_bytes() == first
