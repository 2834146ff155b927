"""Ranges as they are typed, and the requests that are made of them."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import UsageError
from autotune.maps.options import MapOptions, check_targets, parse_range, parse_search, parse_settings
from autotune.maps.setup import MapSetup, controller_family
from problems.errors import ParameterError
from problems.maps.maps import MapAxis, MapRequest
from problems.maps.parameters import value_of
from problems.maps.search import IntervalRequest
from problems.model.controller import AdmittanceController
from tests.autotune.maps.map_cases import plan_of


def axes_of(setup: MapSetup) -> tuple[MapAxis, MapAxis]:
    assert isinstance(setup.request, MapRequest)
    return setup.request.x, setup.request.y


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
    ("text", "message"),
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
def test_a_range_that_makes_no_sense_is_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_range(text, count=9)


@pytest.mark.parametrize(
    ("texts", "message"),
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
def test_a_setting_that_makes_no_sense_is_refused(texts: list[str], message: str) -> None:
    with pytest.raises((UsageError, ParameterError), match=message):
        parse_settings(texts)


@pytest.mark.parametrize(
    ("picture", "data", "message"),
    [
        ("map.pdf", None, "the picture must end in .png or .svg"),
        ("map.svg", "map.txt", "the data file must end in .csv or .json"),
        ("map.svg", "twin.json", "is the file that is read"),
    ],
)
def test_files_that_cannot_be_written_as_asked_are_refused(picture: str, data: str | None, message: str) -> None:
    options = MapOptions(source=Path("twin.json"), picture=Path(picture), data=None if data is None else Path(data))
    with pytest.raises(UsageError, match=message):
        check_targets(options)


def test_the_data_lies_beside_the_picture() -> None:
    assert MapOptions(source=Path("a.yaml"), picture=Path("out/b.png")).table == Path("out/b.csv")


def test_without_ranges_the_lead_is_drawn_over_the_damping_around_the_design(folder: Path) -> None:
    setup = plan_of(folder)
    x, y = axes_of(setup)
    assert (x.name, y.name, x.count * y.count) == ("damping", "lead_s", 10_800)
    assert setup.design == {"damping": 913.0000000000001, "lead_s": 0.0125}
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
    setup = plan_of(folder, settings=["mass=7", "delay_s=0.004", "payload_damping_ratio=0.1"], x="payload_mass=4:40")
    assert isinstance(setup.request, MapRequest)
    plant, controller = setup.request.point(9.0, 0.01)
    assert (controller.mass_kg, plant.robot.delay_s, plant.payload.mass_kg) == (7.0, 0.004, 9.0)
    assert value_of("payload_damping_ratio", plant, controller) == pytest.approx(0.1)
    assert setup.fixed["payload_damping_ratio"] == 0.1
    assert not {"drag", "payload_mass", "payload_frequency_rad_per_s", "lead_s"} & set(setup.fixed)


def test_a_setting_of_what_varies_is_where_the_design_lies(folder: Path) -> None:
    gains = ["mass=13", "damping=2000", "lead_s=0.04"]
    setup = plan_of(folder, "identified.yaml", settings=gains)
    assert setup.design == {"damping": 2000.0, "lead_s": 0.04}
    x, y = axes_of(setup)
    assert (x.low, x.high, y.high) == (400.0, 10_000.0, 0.08)
    setup = plan_of(
        folder, "identified.yaml", settings=[*gains, "payload_mass=20"], x="payload_frequency_rad_per_s=50:500"
    )
    assert setup.design is not None
    assert setup.design["payload_frequency_rad_per_s"] == pytest.approx(math.sqrt(3e5 / 20.0))


def test_a_setting_that_stands_for_another_may_vary_as_well(folder: Path) -> None:
    setup = plan_of(folder, settings=["payload_frequency_rad_per_s=100"], x="payload_frequency_rad_per_s=50:500")
    assert setup.design is not None
    assert setup.design["payload_frequency_rad_per_s"] == 100.0
    assert isinstance(setup.request, MapRequest)
    assert setup.request.point(200.0, 0.01)[0].payload.mass_kg == pytest.approx(3e5 / 200.0**2)


def test_the_design_follows_from_a_payload_frequency(folder: Path) -> None:
    setup = plan_of(folder, x="payload_frequency_rad_per_s=50:500")
    assert setup.design is not None
    assert setup.design["payload_frequency_rad_per_s"] == pytest.approx(math.sqrt(3e5 / 16.0))


def test_gains_must_come_from_somewhere(folder: Path) -> None:
    with pytest.raises(UsageError, match=r"nothing gives mass \(M_a\) of the controller; say --set mass=VALUE, or"):
        plan_of(folder, "identified.yaml")
    with pytest.raises(
        UsageError, match=r"mass \(M_a\) and damping \(B_a\) .* --set mass=VALUE --set damping=VALUE, or"
    ):
        plan_of(folder, "identified.yaml", x="K_e=1e4:1e5", y="lead_s=0:0.03")
    setup = plan_of(folder, "identified.yaml", settings=["mass=13"])
    assert setup.design is None
    assert [axis.name for axis in axes_of(setup)] == ["damping", "lead_s"]
    assert plan_of(folder, "identified.yaml", controller=folder / "controller.yaml").design is not None


@pytest.mark.parametrize(
    ("asked", "message"),
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
def test_a_request_that_contradicts_itself_is_refused(folder: Path, asked: dict[str, Any], message: str) -> None:
    with pytest.raises((UsageError, ParameterError), match=message):
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
    setup = plan_of(folder, show="stable-lead")
    assert isinstance(setup.request, IntervalRequest)
    assert setup.design is not None
    ratios = [case.fixed["payload_damping_ratio"] for case in setup.request.cases.values()]
    assert ratios[1] == pytest.approx(setup.design["payload_damping_ratio"])
    assert setup.request.along.name == "payload_frequency_rad_per_s"
    alone = plan_of(folder, show="stable-lead", settings=["drag=100"])
    assert isinstance(alone.request, IntervalRequest)
    assert len(alone.request.cases) == 1
