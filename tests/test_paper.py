"""`docs/paper.md` and its tables say what `examples/paper/` computes, which obeys the laws that it rests on."""

import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from examples.paper import bode, page, port_passivity, table_one, verdicts
from examples.paper.continuous import continuous_loop
from examples.paper.paper_case import (
    COLOURS,
    EXPERIMENT_FEEDBACK_PER_SAMPLE_S,
    EXPERIMENT_FEEDBACK_S,
    FEEDBACK_PER_SAMPLE_S,
    FEEDBACK_S,
    LEAD_IDEAL,
    SAMPLE_TIME_S,
    STANDARD,
    example_controllers,
    example_plant,
    in_series,
    printed_robot,
)
from examples.paper.run_all import STUDIES
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius

NUMBER = re.compile(r"[−-]?\d+(?:\.\d+)?")
ROOT = Path(__file__).resolve().parent.parent
LARGEST_PICTURE_BYTES = 150_000


@cache
def _found(name: str) -> Any:
    if name != "table_one":
        return STUDIES[name].compute()
    # Where the page says that the minimum is, the fit must find it; the search from afar takes longer.
    stand = _cells(page.tables_on_page(_page(ROOT))["table-one-variants"])[1:]
    near = {}
    for name_, rate, ratio, delay_ms, *_ in stand:
        extra_ms = max(0.0, float(delay_ms) - 1e3 * table_one.VARIANTS[name_].shortest_delay_s)
        near[name_] = (float(rate), extra_ms, 1.0 if ratio == page.NONE else float(ratio))
    return table_one.compute(near)


def _tables(name: str) -> dict[str, page.Table]:
    return {table.name: table for table in STUDIES[name].tables(_found(name))}


def _page(repository: Path, name: str = "paper_tables.md") -> str:
    return (repository / "docs" / name).read_text(encoding="utf-8")


def _sections(text: str) -> dict[str, str]:
    """Return what stands below each heading."""
    return {each.splitlines()[0]: each for each in re.split(r"^## ", text, flags=re.MULTILINE)[1:]}


def _value(text: str) -> float:
    return float(text.replace("−", "-"))


def _last_digit(text: str) -> float:
    return float(10.0 ** -len(text.partition(".")[2]))


def _cells(table: str) -> list[list[str]]:
    """Return the cells of every line but the rule under the header."""
    lines = [line for line in table.splitlines() if set(line) - set("|-")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def _differences(stands: str, computed: str) -> list[str]:
    """Return where two tables differ by more than one unit of the last digit: a rounding may fall either way."""
    here, there = _cells(stands), _cells(computed)
    if [len(line) for line in here] != [len(line) for line in there]:
        return ["another number of rows or columns"]
    wrong = []
    for old, new in zip(chain.from_iterable(here), chain.from_iterable(there), strict=True):
        pairs = list(zip(NUMBER.findall(old), NUMBER.findall(new), strict=False))
        close = all(abs(_value(a) - _value(b)) <= 1.01 * _last_digit(a) for a, b in pairs)
        if NUMBER.sub("#", old) != NUMBER.sub("#", new) or not close:
            wrong.append(f"{old} on the page, {new} computed")
    return wrong


@pytest.mark.parametrize("name", list(STUDIES))
def test_the_page_shows_what_is_computed(repository: Path, name: str) -> None:
    stand = page.tables_on_page(_page(repository))
    wrong = {each: _differences(stand[each], table.markdown()) for each, table in _tables(name).items()}
    assert {each: found for each, found in wrong.items() if found} == {}


def test_the_page_has_a_place_for_every_table_and_no_other(repository: Path) -> None:
    computed = {each for name in STUDIES for each in _tables(name)}
    assert computed == set(page.tables_on_page(_page(repository)))


def test_a_changed_number_on_the_page_is_noticed() -> None:
    assert _differences("| a | 1.25 to 3 |", "| a | 1.26 to 3 |") == []
    assert _differences("| a | 1.25 to 3 |", "| a | 1.27 to 3 |") != []
    assert _differences("| a | – |", "| a | 3 |") != []


def test_every_bold_number_stands_in_a_table_of_its_section(repository: Path) -> None:
    tables = _sections(_page(repository))
    missing, seen = [], 0
    for name, section in _sections(_page(repository, "paper.md")).items():
        numbers = {found for table in page.tables_on_page(tables[name]).values() for found in NUMBER.findall(table)}
        for bold in re.findall(rf"\*\*({NUMBER.pattern})\*\*", section):
            seen += 1
            if bold not in numbers:
                missing.append(f"{name}: {bold}")
    assert seen > 50
    assert missing == []


def test_every_picture_is_small_shown_and_without_a_date(repository: Path) -> None:
    pictures = sorted((repository / "docs" / "paper").glob("*.svg"))
    shown = re.findall(r"!\[[^\]]{20,}\]\((paper/[\w]+\.svg)\)", _page(repository, "paper.md"))
    assert sorted(shown) == [f"paper/{picture.name}" for picture in pictures]
    for picture in pictures:
        text = picture.read_text(encoding="utf-8")
        assert len(text.encode()) < LARGEST_PICTURE_BYTES, picture.name
        assert "<dc:date>" not in text, picture.name


def test_a_picture_has_the_same_bytes_every_time(tmp_path: Path) -> None:
    found = _found("port_passivity")
    written = []
    for name in ("first.svg", "second.svg"):
        page.save(_only(port_passivity.draw(found)), tmp_path / name)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]


def _only(pictures: dict[str, Figure]) -> Figure:
    (figure,) = pictures.values()
    return figure


def test_a_script_prints_its_tables_and_writes_its_picture(repository: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(repository / "examples" / "paper" / "port_passivity.py"), str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120)
    for table in _tables("port_passivity").values():
        assert table.markdown() in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["passivity.svg"]


def test_places_and_tables_must_be_the_same() -> None:
    table = page.Table(name="a", header=("x", "y"), rows=(("1", "2"),))
    empty = "before\n<!-- table: a -->\n<!-- end -->\nafter"
    filled = page.put_on_page(empty, [table])
    assert page.tables_on_page(filled) == {"a": "| x | y |\n|---|---|\n| 1 | 2 |"}
    assert page.put_on_page(filled, [table]) == filled
    for wrong in ([], [table, replace(table, name="b")]):
        with pytest.raises(KeyError, match="place"):
            page.put_on_page(empty, wrong)


def test_every_controller_has_its_own_colour() -> None:
    assert set(COLOURS) == set(example_controllers())
    assert len(set(COLOURS.values())) == len(COLOURS)


def test_an_unstable_loop_has_neither_peak_nor_margin() -> None:
    table = _tables("bode")["bode-contact"]
    place = {title: i for i, title in enumerate(table.header)}
    unstable = [row for row in table.rows if row[place["sampled"]] == "unstable"]
    # docs/method.md, erratum 4: standard control with the printed numbers.
    assert STANDARD in [row[0] for row in unstable]
    for row in unstable:
        assert row[place["peak, sampled [dB]"]] == row[place["modulus margin"]] == page.NONE
    for row in table.rows:
        verdict, peak = row[place["continuous"]], row[place["peak, continuous [dB]"]]
        assert (verdict == "stable") == (peak != page.NONE)


@pytest.mark.parametrize("contact_n_per_m", [0.0, 5e5])
@pytest.mark.parametrize("damping", [1000.0, 2000.0])
def test_the_turns_of_the_continuous_loop_agree_with_fine_sampling(contact_n_per_m: float, damping: float) -> None:
    # An eighth of the period: hold and backward form together shift the stability limit by about 1 % of B_a here.
    plant = example_plant(contact_n_per_m=contact_n_per_m)
    fine = build_sampled_plant(plant, SAMPLE_TIME_S / 8.0)
    for name, controller in example_controllers(damping_n_s_per_m=damping).items():
        radius = spectral_radius(build_loop(fine, replace(controller, discretization="backward_euler")))
        assert verdicts.continuous_is_stable(plant, controller) == (radius < 1.0), name


def test_an_edge_of_stability_has_a_mode_on_the_unit_circle() -> None:
    plant, standard = (
        build_sampled_plant(example_plant(contact_n_per_m=0.0), SAMPLE_TIME_S),
        example_controllers()[STANDARD],
    )
    scan = np.linspace(0.0, 0.12, 31)
    (found,) = verdicts.stable_intervals([plant], lambda value: replace(standard, lead_s=value), scan)
    assert found.low == 0.0
    # A step of the scan is 4 ms, so the edge is known to 1 µs; the radius changes by 0.04 per second of K_l.
    assert spectral_radius(build_loop(plant, replace(standard, lead_s=found.high))) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("lead_s", [0.0, 0.004, 0.008, 0.0084, 0.03])
def test_the_port_without_delay_is_passive_where_its_closed_form_says(lead_s: float) -> None:
    controller = replace(example_controllers()[STANDARD], lead_s=lead_s)
    plant = example_plant(contact_n_per_m=0.0, robot=printed_robot(0.0))
    omega = 2.0 * np.pi * np.geomspace(0.1, 1e4, 4000)
    real = continuous_loop(plant, controller, omega).rendered_admittance.real
    limit = port_passivity.passive_up_to_hz(controller, 20.0)
    expected = np.full(len(omega), True) if limit is None else omega < 2.0 * np.pi * limit
    np.testing.assert_array_equal(real >= 0.0, expected)


def test_the_fitted_robot_is_a_minimum_and_uses_four_rows_only() -> None:
    assumed = table_one.IN_COUPLING
    found = table_one.fit(assumed, near=(8.0, 2.0, 1.0))
    best = np.array([np.log(found.rate_rad_per_s), 100.0 * found.delay_s])

    def error(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        return float(np.sum(table_one.residuals(values, assumed) ** 2))

    # Steps of 2 % in bandwidth and 1 ms in delay change the error by far more than the fit's tolerance, 1e-6.
    for step in ((0.02, 0.0), (-0.02, 0.0), (0.0, 0.1)):
        assert error(best + np.array(step)) > error(best)
    assert len(table_one.residuals(best, assumed)) == len(table_one.FITTED)
    assert sorted((*table_one.FITTED, *table_one.PREDICTED)) == list(range(len(table_one.ROWS)))


def test_the_readings_of_the_printed_numbers() -> None:
    # docs/method.md, errata 2 and 6.
    readings = [FEEDBACK_S, FEEDBACK_PER_SAMPLE_S, EXPERIMENT_FEEDBACK_S, EXPERIMENT_FEEDBACK_PER_SAMPLE_S]
    assert readings == pytest.approx([2e-5 * 1e3, 2e-5 * 1250.0, 7.5e-6 * 1e3, 7.5e-6 * 1250.0])
    assert 1.0 / (1.0 / in_series(32.3e3, 3e5) + 1.0 / 3e5) == pytest.approx(32.3e3)


def test_the_free_space_curve_of_the_unstable_combination_is_dashed_only() -> None:
    found: bode.Found = _found("bode")
    assert not found.free[LEAD_IDEAL].sampled_is_stable
    assert found.free[LEAD_IDEAL].modulus is None
    stable: Sequence[str] = [name for name, curve in found.free.items() if curve.sampled_is_stable]
    assert set(found.free) - set(stable) == {LEAD_IDEAL}
