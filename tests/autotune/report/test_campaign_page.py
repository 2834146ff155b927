"""The pages of many: a campaign's runs and a schedule's classes, each number where the record has it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from autotune.campaign.work import RunOutcome
from autotune.charts.chart import Band, Chart, Points
from autotune.formats.schedule import Schedule, read_schedule, write_schedule
from autotune.report.campaign_page import build_campaign_page
from autotune.report.page import Note, Page, Table, render_page
from autotune.report.schedule_page import build_schedule_page
from tests.autotune.campaign.test_fleet import TRUE, fleet, outcome
from tests.autotune.formats.test_schedule import make_schedule

SEVERAL_AXES = {
    "payload.mass_kg": (16.0, 0.02),
    "sensor.force_bias_n.x": (3.2, 0.0014),
    "clocks.wrench_offset_s": (1e-3, 1e-5),
    "x.coupling_stiffness_n_per_m": (3e5, 3e3),
    "rz.coupling_stiffness_n_per_m": (3e3, 30.0),
    "x.table.stiffness_n_per_m": (1e5, 1e3),
    "x.wall.stiffness_n_per_m": (1e6, 1e4),
}
MON, TUE = (1.0 * 86400.0 * 365.0 * 50.0, 86400.0 * (365.0 * 50.0 + 1.0))


def section(page: Page, key: str) -> tuple[object, ...]:
    return next((each.blocks for each in page.sections if each.key == key), ())


def table(page: Page, key: str) -> Table:
    (found,) = (each for each in section(page, key) if isinstance(each, Table))
    return found


def texts(of: Table) -> list[list[str]]:
    return [[cell.text for cell in row] for row in of.rows]


def points(chart: Chart) -> dict[str, Points]:
    return {each.label: each for each in chart.panels[0].elements if isinstance(each, Points)}


def check_sides(of: Table) -> None:
    """A column is set to the right if and only if its entries are numbers, with a unit or a deviation or without."""
    for i, head in enumerate(of.heads()):
        entries = [row[i].text for row in of.rows if row[i].text]
        are_numbers = bool(entries) and all(re.fullmatch(r"[+-]?\d+(\.\d+)?( .*)?", each) for each in entries)
        assert head.is_number == are_numbers, head.text


def test_a_campaign_with_a_refusal_a_change_and_a_lost_certificate() -> None:
    runs = [
        replace(outcome("a", "mon", TRUE, at=MON), peaks_n={"x": (50.0, 40.0), "rz": (None, 3.0)}),
        replace(
            outcome("a", "tue", (16.0, 3.3e5, 2.4e-3), at=TUE),
            peaks_n={"x": (60.0, 45.0)},
            outside=("K_s is 330", "K_e too"),
        ),
        replace(
            outcome("b", "mon", TRUE, at=MON),
            peaks_n={"x": (None, 42.0), "rz": (None, 2.0)},
            damage="b.mcap is damaged.",
        ),
        RunOutcome(cell="b", run="tue", key="", refused="log", reason="it is cut"),
        RunOutcome(cell="c", run="mon", key="", refused="estimate", reason="it stands still"),
        RunOutcome(cell="d", run="mon", key="", refused="log", reason="it is empty"),
    ]
    page = build_campaign_page(runs, "a footer")
    assert [each.key for each in page.sections] == [
        "certificates", "refused", "damaged", "changes", "peaks", "runs",
    ]  # fmt: skip
    assert (page.tone, page.footer) == ("bad", "a footer")
    assert page.lead.startswith("6 runs of 4 cells, 3 refused, 1 certificate no longer valid; 1 change")
    notes = [each.text for each in section(page, "certificates") if isinstance(each, Note)]
    assert notes == ["a/tue: K_s is 330.", "a/tue: K_e too."]
    # What is refused most often comes first.
    assert texts(table(page, "refused")) == [
        ["log", "2", "b", "tue", "it is cut"],
        ["", "", "d", "mon", "it is empty"],
        ["estimate", "1", "c", "mon", "it stands still"],
    ]
    assert texts(table(page, "changes")) == [
        ["a", "mon", "tue", "x: K_s", "300", "330", "N/mm", "+10 %", f"{3e4 / np.hypot(3e3, 3e3):.1f}"]
    ]
    every, of_x = (each for each in section(page, "runs") if isinstance(each, Table))
    assert every.columns == ("cell", "run", "recorded", "outcome", "payload mass [kg]")
    assert texts(every)[0] == ["a", "mon", "2019-12-20 00:00", "good", "16.000 ± 0.020"]
    assert texts(every)[3] == ["b", "tue", "", "log", ""]
    assert (of_x.caption, of_x.columns) == (
        "Axis x: value ± standard deviation", ("cell", "run", "K_s [N/mm]", "T_d [ms]"),
    )  # fmt: skip
    assert texts(of_x)[0] == ["a", "mon", "300.0 ± 3.0", "2.400 ± 0.020"]
    # What was refused has no values.
    assert [row[:2] for row in texts(of_x)] == [["a", "mon"], ["a", "tue"], ["b", "mon"]]
    assert [(row[3].text, row[3].tone) for row in every.rows[:3]] == [
        ("good", "good"), ("certificate no longer holds", "bad"), ("damaged log", "warn"),
    ]  # fmt: skip
    assert [row[3].tone for row in every.rows[3:]] == ["bad"] * 3
    (drift,) = (each for each in section(page, "changes") if isinstance(each, Chart))
    assert (drift.title, drift.caption) == ("a: x: K_s", "1: mon; 2: tue")
    assert points(drift)["identified"].y.tolist() == [300.0, 330.0]
    band = drift.panels[0].elements[0]
    assert isinstance(band, Band)
    assert (band.low.tolist(), band.high.tolist()) == ([294.0, 324.0], [306.0, 336.0])
    (damage,) = (each for each in section(page, "damaged") if isinstance(each, Note))
    assert damage.text == "b/mon: b.mcap is damaged."
    for each in (table(page, "refused"), table(page, "changes"), every, of_x):
        check_sides(each)


def test_dates_and_short_names_stay_in_one_line_and_no_table_has_two_axes() -> None:
    long = "the-recording-of-a-name-beyond-all-measure"
    runs = [replace(outcome("press-3", run, TRUE, at=MON), values=SEVERAL_AXES) for run in ("2026-11-01-mon", long)]
    page = build_campaign_page(runs, "")
    every, *of_axes = (each for each in section(page, "runs") if isinstance(each, Table))
    assert [[cell.is_whole for cell in row[:3]] for row in every.rows] == [[True, True, True], [True, False, True]]
    assert [each.caption.partition(":")[0] for each in of_axes] == ["Axis x", "Axis x, surfaces", "Axis rz", "Sensor"]
    assert every.columns[4:] == ("payload mass [kg]",)
    assert [each.columns[2:] for each in of_axes] == [
        ("K_s [N/mm]",), ("table: K_e [N/mm]", "wall: K_e [N/mm]"), ("K_s [N·m/rad]",),
        ("force bias x [N]", "lateness of the wrench's clock [ms]"),
    ]  # fmt: skip
    assert 'class="whole" data-label="recorded">2019-12-20 00:00<' in render_page(page)


def test_peaks_are_those_of_each_cells_newest_run_by_axis() -> None:
    runs = [
        replace(outcome("a", "mon", TRUE, at=1.0), peaks_n={"x": (50.0, 40.0)}),
        replace(outcome("a", "tue", TRUE, at=2.0), peaks_n={"x": (60.0, 45.0), "rz": (None, 3.0)}),
        replace(
            outcome("b", "mon", TRUE, at=1.0),
            peaks_n={"x": (None, 42.0)},
            peaks_at={"x": "K_e 96 to 145 N/mm, approach with 30 N"},
            log_peaks_n={"x": (70.0, 33.0)},
            log_peaks_at={"x": "table, 18.2 mm/s"},
        ),
        outcome("c", "mon", TRUE, at=1.0),
    ]
    page = build_campaign_page(runs, "")
    assert page.tone == "good"
    in_log, straight, turning = (each for each in section(page, "peaks") if isinstance(each, Chart))
    shown = points(in_log)
    assert shown["in the log"].y.tolist() == [70.0]
    assert shown["with the new controller at the same speed"].y.tolist() == [33.0]
    assert (in_log.caption, in_log.panels[0].y.limits) == ("1: b (table, 18.2 mm/s)", (0.0, 1.1 * 70.0))
    assert straight.caption == "1: a; 2: b (K_e 96 to 145 N/mm, approach with 30 N)"
    assert (", at the sensor," in in_log.title, ", at the contact," in straight.title) == (True, True)
    shown = points(straight)
    assert (shown["with the new controller"].x.tolist(), shown["with the new controller"].y.tolist()) == (
        [1.0, 2.0],
        [45.0, 42.0],
    )
    before = shown["with the gains of the log"]
    assert (before.x.tolist(), before.y.tolist()) == ([1.0], [60.0])
    assert "Peaks of 2 cells with the new controller, from 42 to 45 N" in straight.alternative
    assert straight.panels[0].x.limits == (0.5, 2.5)
    assert list(points(turning)) == ["with the new controller"]
    assert turning.panels[0].y.label == "peak [N·m]"
    assert turning.panels[0].x.limits == (0.5, 1.5)


def test_a_cell_unlike_the_others_is_named_with_their_median_and_one_by_all_together() -> None:
    cells = fleet(40)
    cells[7] = outcome("c7", "mon", (27.0, TRUE[1], TRUE[2]))
    page = build_campaign_page(cells, "")
    assert page.tone == "warn"
    assert [each.key for each in page.sections] == ["unusual", "runs"]
    odd = table(page, "unusual")
    check_sides(odd)
    (alone,) = (row for row in texts(odd) if row[1] == "payload mass")
    assert (alone[0], alone[2], alone[4]) == ("c7", "27", "kg")
    assert 15.0 < float(alone[3]) < 17.0
    together = [row for row in texts(odd) if row[1] == "all together"]
    assert all(row[4] == "squared distance" and float(row[2]) > float(row[3]) for row in together)


def test_a_schedule_shows_every_class_with_its_peaks_and_what_one_for_all_costs(tmp_path: Path) -> None:
    schedule = make_schedule()
    page = page_of(schedule, tmp_path / "cell")
    tree = read_schedule(tmp_path / "cell" / "schedule.yaml").tree
    found = table(page, "classes")
    check_sides(found)
    assert page.lead.startswith(f"{len(tree['classes'])} classes, ")
    rows = texts(found)
    expected = [(entry, axis) for entry in tree["classes"] for axis in entry["axes"]]
    assert [(row[0], row[1]) for row in rows] == [(entry["name"], axis) for entry, axis in expected]
    for row, (entry, axis) in zip(rows, expected, strict=True):
        unit = "N·m" if axis.startswith("r") else "N"
        cells = dict(zip(found.columns, row, strict=True))
        key = "peak_torque_n_m" if axis.startswith("r") else "peak_force_n"
        assert cells["peak"] == f"{entry['axes'][axis][key]:.4g} {unit}"
        assert entry["checksum"].startswith(cells["checksum"])
        costs = ("102.4 N", "+9.31 N") if (entry["name"], axis) == ("m14-18", "x") else (cells["peak"], f"+0 {unit}")
        assert (cells["with one for all"], cells["costs"]) == costs
        low, high = entry["payload_mass_kg"]
        assert cells["payload [kg]"] == (f"{low:g}" if low == high else f"{low:g} to {high:g}")
        if "K_e [N/mm]" in cells and entry["environment_stiffness_n_per_m"]:
            low, high = (1e-3 * end for end in entry["environment_stiffness_n_per_m"])
            assert cells["K_e [N/mm]"] == (f"{low:g}" if low == high else f"{low:g} to {high:g}")
    for chart in (each for each in section(page, "classes") if isinstance(each, Chart)):
        own = points(chart)["with its own controller"]
        assert own.x.tolist() == list(range(1, len(own.y) + 1))
        assert chart.panels[0].x.limits == (0.5, len(tree["classes"]) + 0.5)
        assert f"from {own.y.min():.4g} to {own.y.max():.4g} " in chart.alternative


def page_of(schedule: Schedule, folder: Path) -> Page:
    write_schedule(folder, schedule)
    return build_schedule_page(read_schedule(folder / "schedule.yaml"))
