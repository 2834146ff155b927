"""Before and after: replayed contacts against scipy's integrator, and the gains of today in every form."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import autotune as at
from autotune.errors import UsageError
from autotune.formats.cell import read_cell
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.prediction.as_run_by import with_target
from autotune.prediction.before_after import BeforeAndAfter, compare_before_after
from autotune.prediction.certified import predict_certified
from autotune.prediction.law import PresentGains, law_of_gains
from autotune.prediction.said_gains import present_gains
from autotune.validation.law import axis_task, check_targets, led_by_hand, of_own_law
from identification.result import Timeline, Touch, TouchCause
from problems.errors import ParameterError
from tests.autotune.formats.samples import make_identified
from tests.autotune.prediction.pressing import Cell, contact_peak
from tests.autotune.prediction.test_contact import plant_of
from tests.autotune.tuning.cases import small_controller
from tests.problems.axes import linear_controller

CELL, SPEED, FORCE = Cell(wall=1e5), 0.02, 30.0
NEW = {"mass": 8.0, "damping": 1200.0, "lead_s": 0.02, "feedback_damping_s": 0.0, "deadband": 0.0}
OLD = {"mass": 13.0, "damping": 1000.0, "lead": 0.02}
NJ60 = Path(__file__).parents[4] / "shared" / "data" / "nj60"


def controller(**changes: float) -> Controller:
    """Return a controller with the new gains, every 0.2 ms, since the integrator knows no sampling."""
    whole = small_controller()
    certificate = replace(whole.certificate, sample_time_s=2e-4)
    axes = {"x": replace(whole.axes["x"], **{**NEW, **changes})}  # type: ignore[arg-type]
    return replace(whole, axes=axes, sample_time_s=2e-4, certificate=certificate, limits=None)


def touch(peak: float, **changes: object) -> Touch:
    values: dict[str, object] = {
        "axis": "x", "sign": 1, "cause": TouchCause.WALL, "peak_s": 2.05, "onset_s": 2.0, "peak_force": peak,
        "approach_speed": SPEED, "held_force": FORCE, "surface": "x1",
    }  # fmt: skip
    return Touch(**{**values, **changes})  # type: ignore[arg-type]


def source(*touches: Touch) -> IdentifiedFile:
    file = plant_of(CELL).file()
    return replace(file, result=replace(file.result, timelines=(Timeline(phases=(), touches=touches),)))


def peak_of(mass: float, damping: float, lead: float) -> float:
    steady = SPEED * (damping + CELL.drag)
    return contact_peak(CELL, mass=mass, damping=damping, lead=lead, force=steady, speed=SPEED, after=FORCE)


def today(**gains: float) -> PresentGains:
    return PresentGains(laws={"x": law_of_gains({**OLD, **gains})}, label="gains")


@cache
def replayed(sign: int = 1) -> BeforeAndAfter:
    measured = peak_of(13.0, 1000.0, 0.02)
    touches = (touch(measured, sign=sign), touch(0.97 * measured, sign=sign, approach_speed=0.98 * SPEED))
    return compare_before_after(source(*touches), controller(), present=today())["x"]


@pytest.mark.parametrize("sign", [1, -1])
def test_the_hardest_contact_is_replayed_at_its_speed_as_another_integrator_does(sign: int) -> None:
    """The force that the log held acts after the impact; both peaks are those of the continuous law."""
    (surface,) = replayed(sign).surfaces
    assert surface.after.predicted.contact.contact_speed_m_s == SPEED
    assert surface.after.predicted.peak_sensor_force == pytest.approx(peak_of(8.0, 1200.0, 0.02), rel=0.01)
    assert surface.before_peak == pytest.approx(peak_of(13.0, 1000.0, 0.02), rel=0.01)


def test_the_sentence_says_both_peaks_and_by_how_much_free_motion_changes() -> None:
    found, measured = replayed(), peak_of(13.0, 1000.0, 0.02)
    # B_a + B_p: the certified plants of the controller have a drag of their own.
    drag = small_controller().certificate.domain["x"].plants.nominal.payload.drag_n_s_per_m
    heavier = 100.0 * ((1200.0 + drag) / (1000.0 + drag) - 1.0)
    after = found.surfaces[0].after.predicted.peak_sensor_force
    assert found.sentence().startswith(f"in your log {0.97 * measured:.1f}–{measured:.1f} N (2 contacts on surface, ")
    assert f"with this controller at the same speed {after:.1f} N [" in found.sentence()
    assert found.sentence().endswith(f"free motion {heavier:.0f} % heavier than with {found.label}")


def test_a_contact_that_is_harder_than_before_is_said_to_be() -> None:
    assert "HARDER" not in replayed().sentence()
    measured = 0.5 * peak_of(8.0, 1200.0, 0.02)
    found = compare_before_after(source(touch(measured)), controller())["x"]
    after = found.surfaces[0].after.predicted.peak_sensor_force
    assert f", {100.0 * (after / measured - 1.0):.0f} % HARDER than before" in found.sentence()
    # Without a contact in the log it is the certified one.
    worst = replace(found, surfaces=(), worst=(40.0, 50.0), label="gains", hand=(1.0, 1.0)).sentence()
    assert worst.startswith(
        "gains of today: up to 40.0 N on a certified plant; this controller: 50.0 N, 25 % HARDER than"
    )


def test_a_force_that_the_log_does_not_show_is_not_said_to_be_of_the_log() -> None:
    """Without F^d and without a hold what drives the approach under the new law goes on: (B_a + B_p) v."""
    measured = peak_of(13.0, 1000.0, 0.02)
    for held, words in (
        (FORCE, f"pressed on with {FORCE:.3g} N as in the log"),
        (None, "as that speed asks, since the log"),
    ):
        found = compare_before_after(source(touch(measured, held_force=held)), controller(), present=today())["x"]
        assert words in found.sentence()
    driving = found.surfaces[0].after.predicted.contact.driving_force_n
    assert driving == pytest.approx(SPEED * (1200.0 + CELL.drag), rel=0.01)


def as_target(made: Controller, *, peak: float = 56.9) -> Controller:
    """Return a file designed for a target that runs the same gains by the law of any linear controller."""
    law = linear_controller(admittance_controller(made, "x"), made.sample_time_s)
    said = {
        "parameters": {"mass": 8.0}, "peak_contact_force": peak, "peak_contact_force_before": 39.2,
        "hand_force": 1000.0, "least_admittance": 7e-4, "margins": {"modulus": 0.5},
    }  # fmt: skip
    led = {"x": led_by_hand(axis_task(made, "x"), law)}
    return with_target(made, "crisp", {"x": said}, {"x": law}, led)


def test_of_a_file_for_an_export_target_every_figure_is_of_the_law_that_the_target_runs() -> None:
    """The same gains as a law of another program have the same contact, in the replay and in a prediction."""
    file, made = source(touch(peak_of(13.0, 1000.0, 0.02))), controller()
    own = compare_before_after(file, made, present=today())["x"].surfaces[0].after.predicted
    compared = compare_before_after(file, as_target(made), present=today())["x"]
    found = compared.surfaces[0].after.predicted
    assert found.run_by == "crisp"
    assert found.peak_sensor_force == pytest.approx(own.peak_sensor_force, rel=1e-6)
    assert found.interval.sensor == pytest.approx(own.interval.sensor, rel=1e-6)
    assert "with this controller as crisp runs it at the same speed" in compared.sentence()
    assert (compared.hand[1], compared.worst[1]) == (1000.0, 56.9)
    predicted = predict_certified(as_target(made), "x", 1e5)
    assert predicted.peak_force == pytest.approx(predict_certified(made, "x", 1e5).peak_force, rel=1e-4)
    assert "on axis x as crisp runs it:" in str(predicted)
    chart = compared.chart()
    assert chart is not None
    assert "after as crisp runs it, predicted" in {each.label for each in chart.panels[0].elements}


def test_a_file_for_a_target_is_verified_for_its_law_and_not_taken_for_gains_that_ran() -> None:
    made = small_controller()
    false, *own = check_targets(as_target(made, peak=1.0))
    assert not own
    assert not false.passed
    assert false.name == "as crisp runs it"
    assert "its largest peak is" in false.message
    assert {each.name for each in of_own_law(as_target(made), [false])} == {"our own law, as crisp runs it"}
    file = ControllerFile(controller=as_target(made), checksum="0" * 64, path=Path("for.yaml"), sha256="")
    with pytest.raises(UsageError, match="was designed for crisp"):
        PresentGains.of_file(file)


def test_gains_of_today_that_are_unstable_are_named_where_the_log_says_its_own() -> None:
    log = source(touch(60.0, mass=13.0, damping=1000.0, lead_s=0.02))
    found = compare_before_after(log, controller(), present=today(), worst_before={"x": math.inf})["x"]
    assert "the gains of today (gains) are unstable on a certified plant" in found.sentence()


def test_the_figure_shows_what_the_sentence_says() -> None:
    chart = replayed().chart()
    assert chart is not None
    elements = {each.label: each for each in chart.panels[0].elements}
    assert list(elements) == ["after, interval", "before, predicted", "after, predicted", "before, measured peaks"]
    assert max(elements["before, measured peaks"].y) == peak_of(13.0, 1000.0, 0.02)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"cause": TouchCause.HAND}, "nothing to compare with"),
        ({"is_withdrawn": True}, "nothing to compare with"),
        ({}, "for free motion beside today's say the gains"),
    ],
)
def test_where_there_is_nothing_to_compare_it_says_how_to_get_it(changes: dict[str, object], part: str) -> None:
    found = compare_before_after(source(touch(60.0, **changes)), controller())["x"]
    assert part in found.sentence()
    assert found.is_empty == (part == "nothing to compare with")


def test_gains_of_the_log_count_where_it_holds_them() -> None:
    file = source(touch(60.0, mass=13.0, damping=1000.0, lead_s=0.02))
    present = present_gains(None, file)
    assert present is not None
    assert present.laws == today().laws
    several = source(touch(60.0, mass=13.0, damping=1000.0), touch(60.0, mass=13.0, damping=900.0))
    assert present_gains(None, several) is None
    with pytest.raises(UsageError, match="several gains on axis x"):
        present_gains("log", several)


@pytest.mark.parametrize(
    "said",
    ["mass=13,damping=1000,lead=20ms", "x.mass=13kg,x.damping=1kN·s/m,x.lead=0.02", OLD, {"x": OLD}],
)
def test_gains_in_numbers_are_read_with_their_units(said: object) -> None:
    found = present_gains(said, source())  # type: ignore[arg-type]
    assert found is not None
    assert found.laws == today().laws


def test_gains_of_several_axes_are_named_and_about_an_axis_they_turn() -> None:
    file = replace(source(), result=make_identified())
    axes = ("x", "rz")
    with pytest.raises(UsageError, match=r"say x\.mass=…,rz\.mass=…"):
        present_gains("mass=13,damping=1000", file, axes)
    found = present_gains("x.mass=13,x.damping=1000,rz.mass=0.35,rz.damping=48Nms/rad", file, axes)
    assert found is not None
    assert found.laws["rz"].controller.damping_n_s_per_m == 48.0
    with pytest.raises(UsageError, match="no unit of rotational damping"):
        present_gains("x.mass=13,x.damping=1000,rz.mass=0.35,rz.damping=48N·s/m", file, axes)
    with pytest.raises(UsageError, match="of an axis that is tuned"):
        present_gains("y.mass=13,y.damping=1000", file, axes)


def test_gains_of_a_cell_are_those_of_its_axes(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        "format: autotune/cell\nversion: 1\ngains: {mass: [1, 2, 3, 4, 5, 6], damping: [10, 20, 30, 40, 50, 60]}\n"
    )
    found = present_gains(path, replace(source(), result=make_identified()), ("z", "rx"))
    assert found is not None
    assert {axis: law.controller.mass_kg for axis, law in found.laws.items()} == {"z": 3.0, "rx": 4.0}


def test_gains_that_do_not_predict_the_log_are_doubted() -> None:
    """Peaks of the gains that ran are not doubted; half as much again is, and so is a loop that is unstable."""
    measured = peak_of(13.0, 1000.0, 0.02)
    assert "model misses" not in replayed().sentence()
    hard = source(touch(1.5 * measured), touch(1.49 * measured))
    found = compare_before_after(hard, controller(), present=today())["x"]
    shown = f"{1.49 * measured:.1f}–{1.5 * measured:.1f} N"
    said = f"these gains predict {found.surfaces[0].before_peak:.1f} N on surface, your log shows {shown}"
    assert f"{said}: they did not run there, or the model misses" in found.sentence()
    unstable = compare_before_after(hard, controller(), present=today(mass=0.001, damping=1.0, lead=0.0))["x"]
    assert f"before: unstable, no contact force on surface, where your log shows {shown}" in unstable.sentence()
    assert unstable.surfaces[0].before_peak is None


def test_what_are_no_gains_is_named_as_it_was_typed(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"The gain damping must be .*found -5"):
        present_gains("mass=13,damping=-5", source())
    with pytest.raises(UsageError, match="found an empty text"):
        present_gains("", source())
    log = tmp_path / "run7.mcap"
    log.write_bytes(b"\x89MCAP0\r\n" + bytes(2_000_000))
    with pytest.raises(UsageError, match=r"is a log, not a controller or a cell\.yaml"):
        present_gains(log, source())


def test_a_design_names_its_own_argument() -> None:
    design = at.Design(controller=controller())
    with pytest.raises(UsageError, match="plant must be what identify returns"):
        design.compare(None)  # type: ignore[arg-type]
    found = design.compare(plant_of(CELL))["x"]
    assert 'as in gains={"mass": 10, "damping": 1500}' in str(found)
    with pytest.raises(UsageError, match=r'as in gains=\{"mass": 10'):
        design.compare(plant_of(CELL), "log")


@pytest.mark.skipif(not NJ60.is_dir(), reason="needs the shared logs")
def test_a_real_contact_replayed_with_the_gains_that_ran_is_what_was_measured() -> None:
    """The soft surface of a real cell: its own gains, replayed, hold the measured peak; half of them are gentler."""
    cell = read_cell(Path(__file__).parents[3] / "examples" / "nj60" / "cell.yaml")
    plant = identify_log(NJ60 / "soft_low_1.bag", IdentifyOptions(cell=cell, allow_partial=True))
    file = plant.file()
    present = present_gains("log", file, ("z",))
    assert present is not None
    assert present.laws["z"].controller.damping_n_s_per_m == 500.0
    whole = small_controller()
    own = replace(whole.axes["x"], mass=7.0, damping=500.0, lead_s=0.0, feedback_damping_s=0.0, deadband=0.0)
    renamed = {"z": whole.certificate.domain["x"]}
    certificate = replace(
        whole.certificate, domain=renamed, margins={"z": whole.certificate.margins["x"]}, continuous=None
    )
    design = at.Design(
        controller=replace(
            whole, axes={"z": own}, certificate=certificate, predicted={"z": whole.predicted["x"]}, limits=None
        )
    )
    found = design.compare(plant)["z"]
    (surface,) = found.surfaces
    low, high = surface.after.predicted.interval.sensor
    assert low <= surface.after.touch.peak_force <= (high or float("inf"))
    assert surface.before_peak == pytest.approx(surface.after.predicted.peak_sensor_force, rel=1e-9)
    assert found.sentence().endswith("free motion as before")
