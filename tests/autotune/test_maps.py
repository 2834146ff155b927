"""What lies between the command and the ground floor: sources, ranges, plans, data files and pictures."""

import csv
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from autotune.errors import CertificateError, UsageError
from autotune.files.controller import controller_tree, write_controller
from autotune.files.controller_record import CollisionResponse, Controller
from autotune.files.identified import write_identified
from autotune.maps.ask import MapAsk, check_targets, parse_range, parse_search, parse_settings
from autotune.maps.draw import draw_map
from autotune.maps.draw_intervals import _pieces, has_lower_limits_only
from autotune.maps.make import make_map, summary_tree
from autotune.maps.plan import MapPlan, build_plan, controller_family
from autotune.maps.source import MapSource, read_source
from autotune.maps.style import render
from autotune.maps.table import table_text
from autotune.maps.text import number
from identification.errors import EstimateError
from identification.result import Estimate, Identified, Status
from problems.contact import Approach
from problems.controller import AdmittanceController
from problems.errors import ParameterError
from problems.map_parameters import MapQuantity, value_of
from problems.map_search import IntervalRequest, IntervalResult, StableInterval, find_stable_intervals
from problems.maps import MapAxis, MapRequest, MapResult, compute_map
from tests.autotune.files.samples import make_controller, make_identified

FloatArray = NDArray[np.float64]


def controller_file() -> Controller:
    """A controller whose collision response is none, so that everything in it is part of the loop."""
    made = make_controller(("x",))
    return replace(made, collision=replace(made.collision, response=CollisionResponse.NONE, threshold_n=None))


def identified() -> Identified:
    """The sample plant with its drag known."""
    found = make_identified()
    drag = Estimate(value=630.0, std=1.0, status=Status.IDENTIFIED)
    return replace(found, axes={"x": replace(found.axes["x"], drag_n_s_per_m=drag)})


@pytest.fixture(scope="module")
def written_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sources")
    write_controller(path / "controller.yaml", controller_file())
    write_controller(path / "two.yaml", make_controller(("x", "rz")))
    write_identified(path / "identified.yaml", identified(), {})
    write_identified(path / "sample.yaml", make_identified(), {})
    return path


@pytest.fixture
def folder(tmp_path: Path, written_once: Path) -> Path:
    """A folder of one's own with the files that are read."""
    shutil.copytree(written_once, tmp_path, dirs_exist_ok=True)
    return tmp_path


def read(path: Path, axis: str | None = None, controller: Path | None = None) -> MapSource:
    return read_source(path, axis=axis, controller=controller)


def plan_of(folder: Path, source: str = "controller.yaml", **asked: Any) -> MapPlan:
    axis = asked.pop("axis", None)
    ask = MapAsk(source=folder / source, picture=folder / "map.svg", axis=axis, **asked)
    return build_plan(ask, read(ask.source, axis, ask.controller))


# --- sources ------------------------------------------------------------------------------------------------------


def test_a_certificate_gives_the_middle_of_its_ranges_and_the_payload_that_is_compensated(folder: Path) -> None:
    source = read(folder / "controller.yaml")
    assert source.known["environment_stiffness"] == pytest.approx(math.sqrt(2e4 * 5e5))
    assert source.known["payload_mass"] == 16.0
    assert (source.known["drag"], source.known["coupling_damping"]) == (630.0, 120.0)
    assert source.controller is not None
    assert (source.controller.mass_kg, source.controller.feedback_damping_s) == (12.5, 2e-2)
    assert source.approach == Approach(force_n=30.0)
    assert not source.is_rotational


def test_a_rotational_axis_takes_the_middle_of_the_inertia_and_its_own_units(folder: Path) -> None:
    source = read(folder / "two.yaml", "rz")
    assert (source.is_rotational, source.known["payload_mass"]) == (True, 16.0)
    plan = plan_of(folder, "two.yaml", axis="rz")
    assert isinstance(plan.request, MapRequest)
    assert plan.unit(plan.request.x.parameter) == "N·m·s/rad"


def test_the_compensation_of_a_file_is_in_the_loop(folder: Path) -> None:
    write_controller(folder / "compensated.yaml", replace(controller_file(), compensation_mass_kg=12.0))
    controller = read(folder / "compensated.yaml").controller
    assert controller is not None
    assert controller.compensation_mass_kg == 12.0


def test_the_json_twin_is_read_as_well(folder: Path) -> None:
    (folder / "twin.json").write_text(json.dumps(controller_tree(controller_file()), indent=1) + "\n", "utf-8")
    assert read(folder / "twin.json").known == read(folder / "controller.yaml").known


def test_an_identified_plant_has_no_controller_unless_one_is_given(folder: Path) -> None:
    source = read(folder / "identified.yaml")
    assert source.controller is None
    assert source.known["environment_stiffness"] == 5e5
    given = read(folder / "identified.yaml", controller=folder / "controller.yaml")
    assert given.controller == read(folder / "controller.yaml").controller
    assert given.known == source.known


@pytest.mark.parametrize(
    ("name", "axis", "error", "told"),
    [
        ("two.yaml", None, UsageError, "holds the axes x, rz; say which one with --axis"),
        ("two.yaml", "y", UsageError, "does not hold axis y; it holds x, rz"),
        ("absent.yaml", None, UsageError, "cannot be read"),
        ("other.yaml", None, UsageError, "neither an identified plant nor a controller"),
        ("altered.yaml", None, CertificateError, "the file is altered"),
    ],
)
def test_a_source_that_cannot_be_used_is_refused(
    folder: Path, name: str, axis: str | None, error: type[Exception], told: str
) -> None:
    (folder / "other.yaml").write_text("bounds: {mass: [6, 6]}\n", encoding="utf-8")
    altered = (folder / "controller.yaml").read_text(encoding="utf-8").replace("12.5", "12.6")
    (folder / "altered.yaml").write_text(altered, encoding="utf-8")
    with pytest.raises(error, match=told):
        read(folder / name, axis)


def test_what_the_log_does_not_tell_must_be_set(folder: Path) -> None:
    gains = ["mass=13", "damping=1000"]
    with pytest.raises(EstimateError, match=r"drag of axis x is not identified \(no free motion\); say --set drag="):
        plan_of(folder, "sample.yaml", axis="x", settings=gains)
    plan = plan_of(folder, "sample.yaml", axis="x", settings=[*gains, "drag=300"])
    assert plan.fixed["drag"] == 300.0
    # Varied, or determined by what varies, is as good as set.
    plan_of(folder, "sample.yaml", axis="x", settings=gains, x="drag=100:700")
    plan_of(folder, "sample.yaml", axis="x", settings=gains, x="payload_damping_ratio=0.01:0.3")
    with pytest.raises(EstimateError, match="payload_mass of axis rz"):
        plan_of(folder, "sample.yaml", axis="rz", settings=[*gains, "drag=300"])
    plan_of(folder, "sample.yaml", axis="rz", settings=[*gains, "drag=300", "payload_frequency_rad_per_s=100"])


def test_free_space_needs_no_environment(folder: Path) -> None:
    found = identified()
    bare = replace(found, axes={"x": replace(found.axes["x"], environments=())})
    write_identified(folder / "bare.yaml", bare, {})
    gains = ["mass=13", "damping=1000"]
    with pytest.raises(EstimateError, match="environment_stiffness of axis x"):
        plan_of(folder, "bare.yaml", settings=gains)
    plan = plan_of(folder, "bare.yaml", settings=gains, where="free_space")
    assert not [name for name in plan.fixed if name.startswith("environment")]


# --- what is typed ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        ("lead_s=0:0.03", MapAxis(name="lead_s", low=0.0, high=0.03, count=9)),
        ("K_l=0:0.03:20", MapAxis(name="lead_s", low=0.0, high=0.03, count=20)),
        ("damping=100:900", MapAxis(name="damping", low=100.0, high=900.0, count=9)),
        ("damping=100:1000", MapAxis(name="damping", low=100.0, high=1000.0, count=9, spacing="log")),
        ("damping=100:1000:lin", MapAxis(name="damping", low=100.0, high=1000.0, count=9)),
        ("K_e=2e4:5e4:30:log", MapAxis(name="environment_stiffness", low=2e4, high=5e4, count=30, spacing="log")),
    ],
)
def test_a_range_is_read(text: str, axis: MapAxis) -> None:
    assert parse_range(text, count=9) == axis
    assert parse_search(text.partition("=")[2], axis.name, count=9) == axis


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("lead_s", "NAME=LOW:HIGH"),
        ("lead_s=1", "NAME=LOW:HIGH"),
        ("lead_s=0:1:2:3", "NAME=LOW:HIGH"),
        ("lead_s=0:1:2:3:log", "NAME=LOW:HIGH"),
        ("lead_s=log", "NAME=LOW:HIGH"),
        ("lead_s=0:high", "'high' in 'lead_s=0:high' is not a number"),
        ("lead_s=0:0,03", "'0,03' in 'lead_s=0:0,03' is not a number"),
        ("lead_s=0:1:9.5", "a whole number"),
        ("lead_s=0:1:cubic", "a whole number, or log or lin"),
        ("lead_s=1:0", "LOW below HIGH"),
        ("lead_s=0:1:log", "above 0 for logarithmic spacing"),
        ("lead_s=0:nan", "finite"),
        ("lead_s=0:1:1", "between 2 and 2000"),
        ("speed=0:1", "one of mass, damping"),
    ],
)
def test_a_range_that_makes_no_sense_is_refused(text: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        parse_range(text, count=9)


@pytest.mark.parametrize(
    ("texts", "told"),
    [
        (["mass"], "NAME=VALUE"),
        (["mass=heavy"], "not a number"),
        (["speed=1"], "one of mass, damping"),
        (["mass=1", "M_a=2"], "set twice"),
        (["mass=0"], "above 0"),
        (["lead_s=-1"], "not below 0"),
        (["lead_s=inf"], "finite"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused(texts: list[str], told: str) -> None:
    with pytest.raises((UsageError, ParameterError), match=told):
        parse_settings(texts)


@pytest.mark.parametrize(
    ("picture", "data", "told"),
    [
        ("map.pdf", None, "the picture must end in .png or .svg"),
        ("map.svg", "map.txt", "the data file must end in .csv or .json"),
        ("map.svg", "twin.json", "is the file that is read"),
    ],
)
def test_files_that_cannot_be_written_as_asked_are_refused(picture: str, data: str | None, told: str) -> None:
    ask = MapAsk(source=Path("twin.json"), picture=Path(picture), data=None if data is None else Path(data))
    with pytest.raises(UsageError, match=told):
        check_targets(ask)


def test_the_data_lies_beside_the_picture() -> None:
    assert MapAsk(source=Path("a.yaml"), picture=Path("out/b.png")).table == Path("out/b.csv")


# --- plans --------------------------------------------------------------------------------------------------------


def axes_of(plan: MapPlan) -> tuple[MapAxis, MapAxis]:
    assert isinstance(plan.request, MapRequest)
    return plan.request.x, plan.request.y


def test_without_ranges_the_lead_is_drawn_over_the_damping_around_the_design(folder: Path) -> None:
    plan = plan_of(folder)
    x, y = axes_of(plan)
    assert (x.name, y.name, x.count * y.count) == ("damping", "lead_s", 10_800)
    assert plan.design == {"damping": 913.0000000000001, "lead_s": 0.0125}
    assert math.sqrt(x.low * x.high) == pytest.approx(913.0, rel=0.05)
    assert y.low < 0.0125 < y.high


@pytest.mark.parametrize(
    ("x", "y", "names"),
    [
        ("K_e=1e4:1e6", None, ("environment_stiffness", "lead_s")),
        ("lead_s=0:0.1", None, ("lead_s", "damping")),
        (None, "damping=100:900", ("lead_s", "damping")),
        (None, "mass=5:20", ("damping", "mass")),
    ],
)
def test_the_other_axis_is_lead_or_damping(folder: Path, x: str | None, y: str | None, names: tuple[str, str]) -> None:
    found = axes_of(plan_of(folder, x=x, y=y))
    assert tuple(axis.name for axis in found) == names


def test_a_setting_wins_over_the_file_and_reaches_every_point(folder: Path) -> None:
    plan = plan_of(folder, settings=["mass=7", "delay_s=0.004", "payload_damping_ratio=0.1"], x="payload_mass=4:40")
    assert isinstance(plan.request, MapRequest)
    plant, controller = plan.request.point(9.0, 0.01)
    assert (controller.mass_kg, plant.robot.delay_s, plant.payload.mass_kg) == (7.0, 0.004, 9.0)
    assert value_of("payload_damping_ratio", plant, controller) == pytest.approx(0.1)
    assert plan.fixed["payload_damping_ratio"] == 0.1
    assert not {"drag", "payload_mass", "payload_frequency_rad_per_s", "lead_s"} & set(plan.fixed)


def test_a_setting_of_what_varies_is_where_the_design_lies(folder: Path) -> None:
    gains = ["mass=13", "damping=2000", "lead_s=0.04"]
    plan = plan_of(folder, "identified.yaml", settings=gains)
    assert plan.design == {"damping": 2000.0, "lead_s": 0.04}
    x, y = axes_of(plan)
    assert (x.low, x.high, y.high) == (400.0, 10_000.0, 0.08)
    plan = plan_of(
        folder, "identified.yaml", settings=[*gains, "payload_mass=20"], x="payload_frequency_rad_per_s=50:500"
    )
    assert plan.design is not None
    assert plan.design["payload_frequency_rad_per_s"] == pytest.approx(math.sqrt(3e5 / 20.0))


def test_the_design_follows_from_a_payload_frequency(folder: Path) -> None:
    plan = plan_of(folder, x="payload_frequency_rad_per_s=50:500")
    assert plan.design is not None
    assert plan.design["payload_frequency_rad_per_s"] == pytest.approx(math.sqrt(3e5 / 16.0))


def test_gains_must_come_from_somewhere(folder: Path) -> None:
    with pytest.raises(UsageError, match="mass is not known; say --set mass=VALUE, or --controller FILE"):
        plan_of(folder, "identified.yaml")
    plan = plan_of(folder, "identified.yaml", settings=["mass=13"])
    assert plan.design is None
    assert [axis.name for axis in axes_of(plan)] == ["damping", "lead_s"]
    assert plan_of(folder, "identified.yaml", controller=folder / "controller.yaml").design is not None


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"x": "mass=5:20", "y": "M_a=5:20"}, "given once"),
        ({"x": "payload_mass=5:20", "settings": ["payload_frequency_rad_per_s=100"]}, "without payload_mass"),
        ({"x": "payload_mass=5:20", "y": "payload_frequency_rad_per_s=50:90"}, "without payload_mass"),
        ({"settings": ["drag=5", "payload_damping_ratio=0.1"]}, "without drag"),
        ({"search": "1:2"}, "--search goes with --show stable-damping"),
        ({"show": "stable-lead", "x": "K_l=0:0.01"}, "given once"),
        (
            {"show": "stable-lead", "y": "payload_damping_ratio=0.01:0.3:9"},
            "9 values .* too many curves; say at most 8",
        ),
        ({"show": "peak-contact", "approach_force": -1.0}, "above 0"),
        ({"show": "peak-contact", "x": "K_e=0:1e5"}, "a surface to touch"),
    ],
)
def test_a_request_that_contradicts_itself_is_refused(folder: Path, asked: dict[str, Any], told: str) -> None:
    with pytest.raises((UsageError, ParameterError), match=told):
        plan_of(folder, **asked)


def test_the_family_is_each_extension_alone_and_all_together() -> None:
    standard = AdmittanceController(mass_kg=13.0, damping_n_s_per_m=1000.0)
    assert controller_family(standard) == {"standard": standard}
    lead = replace(standard, lead_s=0.01)
    assert controller_family(lead) == {"standard": standard, "lead": lead}
    both = replace(lead, feedback_damping_s=5e-3)
    family = controller_family(both)
    assert list(family) == ["standard", "lead", "feedback damping", "lead + feedback damping"]
    assert (family["lead"], family["lead + feedback damping"]) == (lead, both)
    assert family["feedback damping"] == replace(standard, feedback_damping_s=5e-3)


def test_stable_lead_compares_damping_ratios_of_which_one_is_the_plants(folder: Path) -> None:
    plan = plan_of(folder, show="stable-lead")
    assert isinstance(plan.request, IntervalRequest)
    assert plan.design is not None
    ratios = [case.fixed["payload_damping_ratio"] for case in plan.request.cases.values()]
    assert ratios[1] == pytest.approx(plan.design["payload_damping_ratio"])
    assert plan.request.along.name == "payload_frequency_rad_per_s"
    alone = plan_of(folder, show="stable-lead", settings=["drag=100"])
    assert isinstance(alone.request, IntervalRequest)
    assert len(alone.request.cases) == 1


# --- data files ---------------------------------------------------------------------------------------------------


def rows_of(text: str) -> tuple[list[str], list[dict[str, str]]]:
    lines = text.splitlines()
    header = [line for line in lines if line.startswith("#")]
    return header, list(csv.DictReader(lines[len(header) :]))


def small_map(folder: Path, show: str = "delay") -> tuple[MapPlan, MapResult]:
    plan = plan_of(folder, show=show, x="damping=50:8000:7", y="lead_s=0:0.06:5", where="free_space")
    assert isinstance(plan.request, MapRequest)
    return plan, compute_map(plan.request)


def test_the_csv_holds_every_point_to_the_last_bit(folder: Path) -> None:
    plan, result = small_map(folder)
    assert {bool(np.any(test(result.values))) for test in (np.isnan, np.isinf)} == {True}
    header, rows = rows_of(table_text(plan, result, Path("map.csv")))
    assert "# fixed: mass (M_a) = 12.5 kg" in header
    assert "# fixed: sample time h = 0.0008 s" in header
    assert any(line.startswith("# varied: lead_s (K_l) from 0.0 to 0.06 s, 5 values") for line in header)
    read_back = np.array([float(row["delay"] or "nan") for row in rows]).reshape(5, 7)
    assert np.array_equal(read_back, result.values, equal_nan=True)
    assert [row["is_stable"] == "1" for row in rows] == result.is_stable.ravel().tolist()
    x, y = np.meshgrid(result.request.x.values(), result.request.y.values())
    assert [float(row["damping"]) for row in rows] == x.ravel().tolist()
    assert [float(row["lead_s"]) for row in rows] == y.ravel().tolist()


def test_the_json_says_the_same(folder: Path) -> None:
    plan, result = small_map(folder)
    tree = json.loads(table_text(plan, result, Path("map.json")), parse_constant=pytest.fail)
    assert (tree["format"], tree["show"], tree["unit"]) == ("autotune/map", "delay", "s")
    assert tree["x"]["values"] == result.request.x.values().tolist()
    assert tree["is_stable"] == result.is_stable.tolist()
    known = np.array([[math.nan if value is None else value for value in row] for row in tree["values"]])
    assert np.array_equal(known, np.where(np.isfinite(result.values), result.values, np.nan), equal_nan=True)
    assert tree["fixed"]["coupling_stiffness"] == {"value": 3e5, "unit": "N/m"}


def test_a_map_of_stability_has_no_values(folder: Path) -> None:
    plan, result = small_map(folder, "stability")
    _, rows = rows_of(table_text(plan, result, Path("map.csv")))
    assert list(rows[0]) == ["damping", "lead_s", "is_stable"]
    assert "values" not in json.loads(table_text(plan, result, Path("map.json")))


def small_intervals(folder: Path, **asked: Any) -> tuple[MapPlan, IntervalResult]:
    asked = {"show": "stable-lead", "x": "drag=60:700:6", "y": "damping=400:1200:2", **asked}
    plan = plan_of(folder, where="free_space", settings=["coupling_damping=0", "feedback_damping_s=0"], **asked)
    assert isinstance(plan.request, IntervalRequest)
    return plan, find_stable_intervals(plan.request)


def test_the_intervals_are_in_the_files(folder: Path) -> None:
    plan, result = small_intervals(folder)
    header, rows = rows_of(table_text(plan, result, Path("map.csv")))
    assert any(line.startswith("# searched: lead_s (K_l) from 0.0 to 0.1 s, 401 values") for line in header)
    tree = json.loads(table_text(plan, result, Path("map.json")))
    counts = set()
    for name, columns in result.intervals.items():
        for value, column, told in zip(result.request.along.values(), columns, tree["intervals"][name], strict=True):
            here = [row for row in rows if row["case"] == name and float(row["drag"]) == value]
            counts.add(len(column))
            if not column:
                assert [(row["interval"], row["lower"]) for row in here] == [("0", "")]
            else:
                ends = [(float(row["lower"]), float(row["upper"])) for row in here]
                assert ends == [(each.lower, each.upper) for each in column]
                bounds = [(row["lower_is_bound"] == "1", row["upper_is_bound"] == "1") for row in here]
                assert bounds == [(each.lower_is_bound, each.upper_is_bound) for each in column]
            assert [(each["lower"], each["upper"]) for each in told] == [(each.lower, each.upper) for each in column]
    assert counts == {0, 1}


# --- pictures -----------------------------------------------------------------------------------------------------


def written(folder: Path, **asked: Any) -> str:
    """Return the SVG of a request; texts stand in it as comments beside their outlines."""
    ask = MapAsk(source=folder / "controller.yaml", picture=folder / "map.svg", **asked)
    make_map(ask)
    return ask.picture.read_text(encoding="utf-8")


@pytest.mark.parametrize("show", ["stability", "modulus", "delay", "peak-contact"])
def test_a_picture_has_names_units_and_what_is_fixed(folder: Path, show: str) -> None:
    picture = written(folder, show=show, x="damping=100:5000:9", y="lead_s=0:0.06:7")
    for text in ("admittance damping $B_{a}$ [N·s/m]", "lead gain $K_{l}$ [s]", "$M_{p}$ = 16 kg", "design: "):
        assert text in picture
    quantity = MapQuantity(show)
    units = {"delay": " [ms]", "peak-contact": " [N]"}
    if quantity is not MapQuantity.STABILITY:
        assert f"<!-- {quantity.label}{units.get(show, '')} -->" in picture
    assert ("approach with 30 N" in picture) == quantity.is_peak


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_same_picture_has_the_same_bytes_and_no_date(folder: Path, suffix: str) -> None:
    plan, result = small_map(folder)
    pictures = {render(lambda: draw_map(plan, result, None), suffix) for _ in range(2)}
    assert len(pictures) == 1
    (picture,) = pictures
    assert picture.startswith(b"\x89PNG" if suffix == ".png" else b"<?xml")
    assert not any(word in picture for word in (b"dc:date", b"Matplotlib v", b"Software"))


@pytest.mark.parametrize(
    ("damping", "show", "told"),
    [
        ("damping=1:5:5", "modulus", "unstable everywhere"),
        ("damping=5e3:9e3:5", "modulus", ""),
        ("damping=5e3:9e3:5", "stability", ""),
    ],
)
def test_all_stable_and_all_unstable_can_be_drawn(folder: Path, damping: str, show: str, told: str) -> None:
    picture = written(folder, show=show, x=damping, y="lead_s=0:0.002:4", settings=["feedback_damping_s=0"])
    assert ("unstable everywhere" in picture) == bool(told)
    assert "limit of stability" not in picture


def test_a_margin_that_nothing_limits_can_be_drawn(folder: Path) -> None:
    """B_a is above B_p and there is little lead: no crossover in free space, see the maps of the ground floor."""
    quiet = ["feedback_damping_s=0", "damping=8500", "lead_s=0.0005"]
    picture = written(
        folder, show="phase", where="free_space", x="damping=8e3:9e3:4", y="lead_s=0:0.001:4", settings=quiet
    )
    assert "design: no limit" in picture


def test_lower_limits_alone_are_lines_and_all_else_is_panels(folder: Path) -> None:
    lines = written(folder, show="stable-damping", where="contact", x="K_e=1e5:1e6:7")
    assert "smallest stable admittance damping $B_{a}$ [N·s/m]" in lines
    assert all(f"<!-- {name} -->" in lines for name in ("standard", "lead", "feedback damping", "design"))
    panels = written(folder, show="stable-lead", x="payload_frequency_rad_per_s=40:400:7")
    assert "lead gain $K_{l}$ [s]" in panels
    assert "smallest" not in panels
    assert panels.count("payload frequency") == 2
    assert r"$\zeta$ = 0.1438" in panels


def test_what_has_several_intervals_is_never_told_by_one_line() -> None:
    whole = StableInterval(lower=1.0, upper=9.0, lower_is_bound=False, upper_is_bound=True)
    island = StableInterval(lower=0.1, upper=0.5, lower_is_bound=False, upper_is_bound=False)

    def only(*columns: Sequence[StableInterval]) -> bool:
        stub = object.__new__(IntervalResult)
        object.__setattr__(stub, "intervals", {"": columns})
        return has_lower_limits_only(stub)

    assert only([whole], [], [whole])
    assert not only([whole], [island, whole])
    assert not only([island])
    assert not only([], [])


def interval(lower: float, upper: float) -> StableInterval:
    return StableInterval(lower=lower, upper=upper, lower_is_bound=False, upper_is_bound=False)


def area(polygon: Sequence[tuple[float, float]]) -> float:
    x, y = np.array(polygon).T
    return float(0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))


@pytest.mark.parametrize(
    ("here", "there", "expected"),
    [
        # A trapezium; two of them; a triangle of half the width; nothing.
        ([interval(1.0, 3.0)], [interval(2.0, 6.0)], 3.0),
        ([interval(0.0, 1.0), interval(4.0, 6.0)], [interval(0.0, 1.0), interval(4.0, 6.0)], 3.0),
        ([interval(1.0, 3.0)], [], 0.5),
        ([], [], 0.0),
        # Two that meet: the half with the gap of 2, which closes to a tip, and the half without.
        ([interval(0.0, 4.0), interval(6.0, 10.0)], [interval(0.0, 10.0)], 4.5 + 5.0),
        ([interval(0.0, 10.0)], [interval(0.0, 4.0), interval(6.0, 10.0)], 4.5 + 5.0),
    ],
)
def test_the_area_between_two_columns_is_that_of_straight_lines(
    here: list[StableInterval], there: list[StableInterval], expected: float
) -> None:
    along = MapAxis(name="drag", low=1.0, high=2.0, count=2)
    pieces = list(_pieces(along, [here, there]))
    assert sum(area(polygon) for polygon, _ in pieces) == pytest.approx(expected)
    # Every piece has a lower and an upper edge, since no end here is a bound of the search.
    assert all(len(edges) == 2 for _, edges in pieces)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.0125, "0.0125"),
        (913.0000000000001, "913"),
        (3e5, "3×10⁵"),
        (1e6, "10⁶"),
        (1.234e-7, "1.234×10⁻⁷"),
    ],
)
def test_numbers_are_written_for_people(value: float, text: str) -> None:
    assert number(value) == text


# --- all of it ----------------------------------------------------------------------------------------------------


def test_the_summary_names_extremes_and_the_design(folder: Path) -> None:
    ask = MapAsk(
        source=folder / "controller.yaml",
        picture=folder / "map.png",
        show="modulus",
        x="damping=100:5000:9",
        y="lead_s=0:0.06:7",
    )
    made = make_map(ask)
    tree = summary_tree(made)
    assert isinstance(made.result, MapResult)
    values = made.result.values
    assert tree["smallest"]["value"] == np.nanmin(values)
    assert tree["largest"]["value"] == np.nanmax(values)
    assert tree["stable_share"] == np.mean(made.result.is_stable)
    assert (tree["design"]["damping"], tree["design"]["is_stable"]) == (913.0000000000001, True)
    assert made.design is not None
    assert tree["design"]["value"] == made.design.value
    assert {path.name for path in folder.iterdir()} >= {"map.png", "map.csv"}


def test_nothing_is_written_when_the_request_is_refused(folder: Path) -> None:
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(UsageError):
        make_map(MapAsk(source=folder / "controller.yaml", picture=folder / "map.svg", x="mass=2:1"))
    assert sorted(path.name for path in folder.iterdir()) == before
