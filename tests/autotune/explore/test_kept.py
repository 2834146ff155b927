"""Designs that are kept beside each other."""

import re

import numpy as np
import pytest
from bokeh.document import Document

from autotune.explore.kept import MOST, read_click
from autotune.explore.page import ExplorePage, build_page
from autotune.explore.saving import Target
from tests.autotune.explore.start import DESIGN, small_exploration


@pytest.fixture
def page(tmp_path_factory: pytest.TempPathFactory) -> ExplorePage:
    return build_page(small_exploration(), Target(tmp_path_factory.mktemp("kept") / "controller.yaml"), Document())


def turn(page: ExplorePage, name: str, value: float) -> None:
    page.sliders[name].value = page.ranges[name].position(value)
    page._answer()


def test_kept_designs_stand_beside_each_other_and_a_click_returns_to_one(page: ExplorePage) -> None:
    page._keep()
    turn(page, "damping", 1400.0)
    page._keep()
    click = page.keeper.table.tags[0]
    assert page.keeper.table.text.count("<tr>") == 3
    assert "<td>1250</td>" in page.keeper.table.text
    assert "<td>1400</td>" in page.keeper.table.text
    heads = re.findall(r'<th scope="col">([^<]*)</th>', page.keeper.table.text)
    assert heads[1:5] == ["M_a [kg]", "B_a [N·s/m]", "K_l [ms]", "B_fb [ms]"]
    assert heads[5:8] == ["worst peak [N]", "modulus margin", "|G| [m/s/N]"]
    # The curve of the second one is that of the present design.
    kept, now = page.figures.sources["kept"].data, page.figures.sources["contact"].data
    assert kept["text"] == ["1", "2"]
    assert np.array_equal(kept["ys"][1], now["y"])
    assert not np.array_equal(kept["ys"][0], now["y"])
    click.said = "return 1 1"
    assert page.designs["x"].tolist() == DESIGN.tolist()
    assert page.ranges["damping"].value(page.sliders["damping"].value) == 1250.0
    click.said = "remove 1 2"
    assert page.figures.sources["kept"].data["text"] == ["2"]
    assert "<td>1250</td>" not in page.keeper.table.text


def test_kept_designs_are_judged_on_the_plant_and_the_requirements_that_are_set(page: ExplorePage) -> None:
    page._keep()
    before = np.array(page.figures.sources["kept"].data["ys"][0])
    assert "feasible" in page.keeper.table.text
    turn(page, "payload_mass_kg", 20.0)
    assert not np.array_equal(page.figures.sources["kept"].data["ys"][0], before)
    turn(page, "asked-modulus_margin", 0.9)
    assert ">misses<" in page.keeper.table.text
    turn(page, "coupling_damping_n_s_per_m", 0.0)
    turn(page, "delay_s", page.ranges["delay_s"].high)
    assert ">unstable<" in page.keeper.table.text
    assert page.figures.sources["kept"].data["ys"] == []


def test_an_axis_shows_its_own_and_no_more_than_fit(page: ExplorePage) -> None:
    for i in range(MOST):
        turn(page, "damping", 1300.0 + i)
        page._keep()
    page._keep()
    assert "kept already" in page.searcher.status.text
    turn(page, "damping", 1500.0)
    page._keep()
    assert f"At most {MOST} designs" in page.searcher.status.text
    page.choice.value = "y"
    assert page.keeper.table.text == ""
    assert page.figures.sources["kept"].data["ys"] == []


@pytest.mark.parametrize(
    ("said", "read"),
    [
        ("return 12 3", ("return", 12)),
        ("remove 1 1", ("remove", 1)),
        ("return x", None),
        ("", None),
        ("save 1 1", None),
    ],
)
def test_a_click_says_what_and_which(said: str, read: tuple[str, int] | None) -> None:
    assert read_click(said) == read
