"""A table of controllers: classes and their names, what each is worth against one for all, and what is refused."""

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.schedule import Schedule, ScheduleClass, covered, read_schedule, write_schedule
from autotune.tuning import schedule as schedule_module
from autotune.tuning.optimize import optimize
from autotune.tuning.problems import build_problems
from autotune.tuning.schedule import build_classes, hull, of_class, tune_schedule
from autotune.validation import dwell
from autotune.validation.dwell import dwell_time_s, proved_share
from identification.errors import EstimateError
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.uncertainty import Scenario
from problems.model.sampled import build_sampled_plant
from tests.autotune.formats.samples import make_controller
from tests.autotune.tuning.cases import BARE_SPEC, identified_plant

# What is made in other processes is made anew there.
pytestmark = pytest.mark.usefixtures("shared_results")

PLANT = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
SPEC = BARE_SPEC.with_options(environment_stiffness=(1e5, 1.2e5))
CLASSES = build_classes([(8.0, 8.0), (22.0, 22.0)], [])
POSITIVE = st.floats(min_value=1e-3, max_value=1e12)


@cache
def small_schedule() -> Schedule:
    """A light and a heavy payload, far enough apart that one controller for both costs something."""
    return tune_schedule(PLANT, SPEC, CLASSES, seed=1)


def peak_n(controller: Controller, mass_kg: float) -> float:
    """Return the largest peak at the contact over the ends of the surface's range, from the plant alone."""
    (problem,) = build_problems(PLANT.result, of_class(CLASSES[0], SPEC)).values()
    law = admittance_controller(controller, "x")
    peaks = []
    for stiffness in problem.plants.environment_stiffness_n_per_m:
        plant = problem.plant(Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass_kg))
        contact = build_sampled_contact(build_sampled_plant(plant, 8e-4))
        peaks.append(simulate_contact(contact, law, problem.approach).peak_contact_force_n)
    return max(peaks)


# --- classes ---


def test_the_table_is_every_combination_in_order_with_readable_names() -> None:
    classes = build_classes([(8.0, 12.0), (16.2, 16.2)], [(2e4, 1e5), (1.25e5, 5e5)])
    assert [each.name for each in classes] == [
        "m8-12_k2e4-1e5",
        "m8-12_k1.25e5-5e5",
        "m16.2_k2e4-1e5",
        "m16.2_k1.25e5-5e5",
    ]
    assert [each.name for each in build_classes([(8.0, 12.0)], [])] == ["m8-12"]
    assert [each.name for each in build_classes([], [(500.0, 500.0)])] == ["k5e2"]


@given(POSITIVE, POSITIVE)
def test_a_name_shows_every_digit(first: float, second: float) -> None:
    low, high = min(first, second), max(first, second)
    name = ScheduleClass(payload_mass_kg=(low, high), environment_stiffness_n_per_m=(low, high)).name
    mass, stiffness = name.split("_")
    for reported, letter in ((mass, "m"), (stiffness, "k")):
        assert reported[0] == letter
        numbers = [float(part) for part in re.split(r"(?<!e)-", reported[1:])]
        assert (numbers[0], numbers[-1]) == (low, high)


@given(st.lists(st.tuples(POSITIVE, POSITIVE).map(lambda p: (min(p), max(p))), min_size=1), POSITIVE)
def test_what_is_covered_is_the_union_and_the_hull_its_span(intervals: list[tuple[float, float]], at: float) -> None:
    union = covered(intervals)
    for probe in (at, *(end for interval in intervals for end in interval)):
        inside = any(low <= probe <= high for low, high in intervals)
        assert inside == any(low <= probe <= high for low, high in union)
    assert all(before[1] < after[0] for before, after in pairwise(union))
    whole = hull(ScheduleClass(payload_mass_kg=each) for each in intervals)
    assert whole == ScheduleClass(payload_mass_kg=(union[0][0], union[-1][1]))


@pytest.mark.parametrize(
    ("masses", "stiffnesses", "message"),
    [
        ([(8.0, 8.0), (8.0, 8.0)], [], "8 to 8 is named twice"),
        ([], [(1e4, 2e4), (3e4, 4e4), (1e4, 2e4)], "10000 to 20000 is named twice"),
        ([], [], "at least one class"),
    ],
)
def test_classes_that_say_nothing_new_are_refused(
    masses: list[tuple[float, float]], stiffnesses: list[tuple[float, float]], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        build_classes(masses, stiffnesses)


# --- the controllers ---


def test_a_class_has_the_controller_of_an_ordinary_call() -> None:
    spec = BARE_SPEC.with_options(payload_mass=(8.0, 8.0), environment_stiffness=(1e5, 1.2e5))
    assert small_schedule().tuned[0].controller == optimize(PLANT, spec, seed=1).controller


def test_classes_have_the_structure_that_an_ordinary_call_has_and_a_biquad_no_dwell_time() -> None:
    # Room for the biquad: a robot of which little is asked.
    spec = replace(SPEC, structure="biquad")
    found = tune_schedule(PLANT, spec, CLASSES[:1], seed=1)
    alone = optimize(PLANT, of_class(CLASSES[0], spec), seed=1).controller
    assert found.tuned[0].controller == alone
    assert alone.axes["x"].biquad is not None
    assert found.dwell_time_s is None


def test_peaks_and_cost_are_those_of_the_exact_transient() -> None:
    schedule = small_schedule()
    assert schedule.common is not None
    assert schedule.hull == ScheduleClass(payload_mass_kg=(8.0, 22.0))
    for each, mass in zip(schedule.tuned, (8.0, 22.0), strict=True):
        assert each.peaks_with_common is not None
        own, common = peak_n(each.controller, mass), peak_n(schedule.common, mass)
        # The worst surface is an end of the range, or one between them that differs little.
        assert each.peaks["x"] == pytest.approx(own, rel=1e-3)
        assert each.peaks_with_common["x"] == pytest.approx(common, rel=1e-3)
        cost = each.cost_n("x")
        assert cost is not None
        assert cost >= 0.0
        assert cost == pytest.approx(common - own, abs=2e-3 * own)
    light, heavy = (each.cost_n("x") or 0.0 for each in schedule.tuned)
    # The heavy payload holds the lead down, which only the light one could use.
    assert light > 1.0
    assert heavy < 0.1 * light


@pytest.mark.slow
def test_the_dwell_time_is_that_of_the_classes_and_the_common_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule = small_schedule()
    own = [each.controller for each in schedule.tuned]
    assert schedule.common is not None
    assert schedule.dwell_time_s == dwell_time_s([*own, schedule.common])
    # One class alone waits for nobody, and with more of them none waits less.
    assert dwell_time_s(own[:1]) == 0.0
    assert 0.0 < (dwell_time_s(own) or 0.0) <= (schedule.dwell_time_s or 0.0) < 5.0
    write_schedule(tmp_path / "cell", schedule)
    tree = read_schedule(tmp_path / "cell" / "schedule.yaml").tree
    assert (tree["dwell_time_s"], tree["dwell_proved_share"]) == (schedule.dwell_time_s, 1.0)
    # A change in every period is proved of no plant, with more cells than the proof above takes (309).
    monkeypatch.setattr(dwell, "_MOST_CELLS", 350)
    assert proved_share([*own, schedule.common], own[0].sample_time_s) == 0.0
    # Controllers of other axes are no schedule that changes while it runs.
    assert dwell_time_s([make_controller(("x",)), make_controller(("y",))]) is None


@pytest.mark.usefixtures("forked")
def test_processes_do_not_change_the_bytes(tmp_path: Path) -> None:
    side_by_side = tune_schedule(PLANT, SPEC, CLASSES, seed=1, processes=2)
    assert side_by_side == small_schedule()
    write_schedule(tmp_path / "a", small_schedule())
    write_schedule(tmp_path / "b", side_by_side)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["all.yaml", "m22.yaml", "m8.yaml", "schedule.yaml"]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.slow
def test_a_class_that_the_common_controller_beats_is_searched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first search that stopped early must not make one controller for all look better than one for the class."""
    honest, calls = optimize, list[str]()

    def lazy(identified: Any, spec: Any, **further: Any) -> Any:
        first = spec.payload_mass == (8.0, 8.0) and further.get("present") is None
        calls.append("lazy" if first else "honest")
        short = replace(spec, bounds={**spec.bounds, "lead_s": (0.01, 0.012)}) if first else spec
        return honest(identified, short, **further)

    monkeypatch.setattr(schedule_module, "optimize", lazy)
    found = tune_schedule(PLANT, SPEC, CLASSES, seed=1).tuned[0]
    assert calls[:4] == ["honest", "lazy", "honest", "honest"]
    assert found.peaks["x"] == pytest.approx(small_schedule().tuned[0].peaks["x"], rel=1e-3)
    assert found.controller.provenance["options"]["compare"]["path"] == "all.yaml"


# --- refusals ---


@pytest.mark.slow
def test_all_infeasible_classes_are_named() -> None:
    limit = 0.5 * sum(each.peaks["x"] for each in small_schedule().tuned)
    # Freer structures, before anything is refused, have tests of their own.
    asked = replace(BARE_SPEC, structure="gains", requirements=replace(BARE_SPEC.requirements, max_peak_force_n=limit))
    classes = build_classes([(16.0, 16.0)], [(4e4, 5e4), (1e5, 1.2e5), (1.1e5, 1.2e5)])
    with pytest.raises(
        InfeasibleError, match=r"^2 of 3 classes have no controller\. m16_k1e5-1\.2e5: Axis x: .*"
    ) as at:
        tune_schedule(PLANT, asked, classes, seed=1)
    assert "m16_k1.1e5-1.2e5: Axis x: " in str(at.value)
    assert "m16_k4e4-5e4" not in str(at.value)


def test_a_hull_that_no_controller_serves_is_reported_and_is_no_error(tmp_path: Path) -> None:
    # Either mass alone is compensated; nobody can say which weight a range without the identified one would need.
    classes = build_classes([(16.5, 16.5), (16.6, 16.6)], [])
    schedule = tune_schedule(PLANT, BARE_SPEC.with_options(environment_stiffness=(1e5, 1.1e5)), classes, seed=1)
    assert schedule.common is None
    assert "leaves out the identified payload of 16 kg" in schedule.common_refusal
    assert [each.controller.payload.mass_kg for each in schedule.tuned] == [16.5, 16.6]
    assert [each.cost_n("x") for each in schedule.tuned] == [None, None]
    tree = write_schedule(tmp_path / "s", schedule)
    assert tree["common"] == {
        "payload_mass_kg": [16.5, 16.6],
        "file": None,
        "checksum": None,
        "refusal": schedule.common_refusal,
    }
    assert tree["provenance"]["options"]["environment_stiffness_n_per_m"] == [1e5, 1.1e5]
    assert set(read_schedule(tmp_path / "s" / "schedule.yaml").controllers) == {"m16.5", "m16.6"}


def test_a_range_without_the_identified_mass_names_its_class_before_any_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule_module, "optimize", lambda *_, **__: pytest.fail("searched"))
    classes = build_classes([(16.0, 16.0), (8.0, 12.0)], [])
    with pytest.raises(UsageError, match=r"^Class m8-12: The payload range 8 to 12 kg leaves out"):
        tune_schedule(PLANT, BARE_SPEC, classes)
    nothing = replace(PLANT.result, axes={"x": replace(PLANT.result.axes["x"], environments=())})
    with pytest.raises(EstimateError, match=r"^Class m16: Axis x has no identified environment"):
        tune_schedule(replace(PLANT, result=nothing), BARE_SPEC, classes)


def test_another_failure_keeps_its_kind_and_names_the_class(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = optimize

    def doubtful(identified: Any, spec: Any, **further: Any) -> Any:
        if spec.payload_mass == (8.0, 8.0):
            raise CertificateError("Axis x: not proved.")
        return honest(identified, spec, **further)

    monkeypatch.setattr(schedule_module, "optimize", doubtful)
    with pytest.raises(CertificateError, match=r"^Class m8: Axis x: not proved"):
        tune_schedule(PLANT, SPEC, CLASSES, seed=1)
