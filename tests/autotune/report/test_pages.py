"""Pages of a controller: what they say is what the file and the kernels say, and every page keeps the law of pages."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from autotune.charts.chart import Band, Bars, Chart, Heat, Line, Panel, Points, Scale
from autotune.formats.canonical import short
from autotune.formats.controller import ControllerFile, controller_tree
from autotune.formats.controller_record import Controller
from autotune.formats.schedule import write_schedule
from autotune.prediction.law import PresentGains
from autotune.report.axis_design import axis_designs, contact_of, modulus_of, over_stiffness
from autotune.report.controller_charts import admittance_chart, nyquist_chart
from autotune.report.controller_tables import compared_blocks
from autotune.report.from_files import report_files
from autotune.report.optimize_page import build_front_page, build_optimize_page
from autotune.report.page import Facts, Note, Page, Section, Table, join_pages, render_page
from autotune.report.validate_page import Validated, build_validate_page
from autotune.tuning.compare import compare
from autotune.validation.against_log import LogComparison
from autotune.validation.monte_carlo import run_monte_carlo
from autotune.validation.monte_carlo_checks import monte_carlo_checks
from autotune.validation.report import Check, ValidationReport
from problems.model.controller import AdmittanceController
from tests.autotune.formats.test_schedule import make_schedule
from tests.autotune.report.page_law import check_page, unpacked
from tests.autotune.tuning.cases import fast_optimized, small_controller
from tests.autotune.validation.test_against_log import own

CHECKSUM = "0123456789abcdef" * 4
GOOD = ValidationReport(checks=(Check(axis="x", name="margins", passed=True, message="as claimed"),))


def present(controller: Controller, name: str = "old.yaml", checksum: str = "fedcba98" * 8) -> PresentGains:
    """Return the gains of a file."""
    return PresentGains.of_file(ControllerFile(controller=controller, checksum=checksum, path=Path(name), sha256=""))


@cache
def controller_page() -> Page:
    found = fast_optimized()
    axes = dict(found.controller.axes)
    stiffer = replace(found.controller, axes={"x": replace(axes["x"], damping=1.2 * axes["x"].damping)})
    steps = {name: search.steps for name, search in found.searches.items()}
    return build_optimize_page(found.controller, CHECKSUM, steps=steps, old=present(stiffer))


def charts_of(page: Page) -> dict[str, Chart]:
    return {each.key: each for section in page.sections for each in section.blocks if isinstance(each, Chart)}


def lines_of(chart: Chart, panel: int) -> dict[str, Line]:
    return {each.label: each for each in chart.panels[panel].elements if isinstance(each, Line)}


def texts_of(page: Page) -> str:
    tables = [each for section in page.sections for each in section.blocks if isinstance(each, Table)]
    return "\n".join(" | ".join(cell.text for cell in row) for table in tables for row in table.rows)


def test_the_page_of_a_search_keeps_the_law_and_carries_every_figure_twice() -> None:
    page = controller_page()
    text = render_page(page)
    seen = check_page(text)
    assert len(seen.pictures) == len(charts_of(page)) == 6
    assert short(CHECKSUM) in text
    for key in charts_of(page):
        reported = json.loads(unpacked(text, f"{key}-data"))
        assert reported["roots"] == [root["id"] for root in reported["document"]["roots"]]
        assert all(text.count(f'id="{key}-live-{i}"') == 1 for i in range(len(reported["roots"])))
    assert "Bokeh" in unpacked(text, "engine")


def test_the_contact_before_and_after_reaches_the_peaks_that_the_file_and_the_comparison_show() -> None:
    found, chart = fast_optimized(), charts_of(controller_page())["x-contact"]
    scenarios = found.controller.predicted["x"].scenarios
    lines = lines_of(chart, 0)
    hardest = max(scenarios, key=lambda each: each.peak_contact_force_n)
    # The peak of the file is searched between the ticks, which the curve has alone.
    assert np.max(lines["the hardest, at the surface"].y) == pytest.approx(hardest.peak_contact_force_n, rel=2e-3)
    assert np.max(lines["at the sensor"].y) == pytest.approx(hardest.peak_sensor_force_n, rel=1e-9)
    (band,) = (each for each in chart.panels[0].elements if isinstance(each, Band))
    assert np.max(band.high) == pytest.approx(np.max(lines["the hardest, at the surface"].y), rel=1e-9)
    # Where every contact is at its own peak or later, the gentlest peak bounds the band's lower edge.
    gentlest = min(each.peak_contact_force_n for each in scenarios)
    assert 0.0 < np.max(band.low) <= gentlest * (1.0 + 1e-9)
    axes = dict(found.controller.axes)
    stiffer = replace(found.controller, axes={"x": replace(axes["x"], damping=1.2 * axes["x"].damping)})
    old = compare(present(stiffer), found.searches)["x"].old.performance
    assert old is not None
    assert np.max(lines["before"].y) == pytest.approx(old.peak_contact_force_n, rel=5e-3)


def test_the_comparison_shows_whose_curves_are_drawn_and_what_the_certificate_says_of_its_own() -> None:
    blocks = [each for section in controller_page().sections for each in section.blocks if isinstance(each, Table)]
    (compared,) = (each for each in blocks if "before is old.yaml" in each.caption)
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in compared.rows}
    controller = fast_optimized().controller
    (design,) = axis_designs(controller)
    assert rows["checksum"] == ["fedcba98", short(CHECKSUM)]
    assert float(rows["B_a [N·s/m]"][0]) == pytest.approx(1.2 * float(rows["B_a [N·s/m]"][1]), rel=1e-5)
    # What is found anew on the ends and the worst cases is what the certificate claims; the peak is the file's.
    margins = controller.certificate.margins["x"]
    assert float(rows["modulus margin"][-1]) == pytest.approx(margins.modulus, rel=1e-3)
    assert float(rows["delay margin [ms]"][-1]) == pytest.approx(1e3 * (margins.delay_s or 0.0), rel=1e-3)
    peak = max(each.peak_contact_force_n for each in design.predicted.scenarios)
    assert float(rows["largest peak at the contact [N]"][-1]) == pytest.approx(peak, rel=1e-3)
    facts = next(each for each in controller_page().sections[-1].blocks if isinstance(each, Facts))
    assert ("old.yaml", "checksum fedcba98") in [(fact.value, fact.detail) for fact in facts.facts]


def test_a_comparison_says_that_gains_are_the_same_or_that_a_loop_is_unstable() -> None:
    controller = small_controller()
    (design,) = axis_designs(controller)
    same = present(controller, "same.yaml", CHECKSUM)
    note, table = compared_blocks(design, same, CHECKSUM)
    assert isinstance(note, Note)
    assert "has the same gains" in note.text
    assert isinstance(table, Table)
    assert all(row[1].text == row[2].text for row in table.rows)
    wild = replace(controller, axes={"x": replace(controller.axes["x"], damping=50.0)})
    (table,) = compared_blocks(design, present(wild), CHECKSUM)
    assert isinstance(table, Table)
    assert [row[1].text for row in table.rows[5:]] == ["unstable"] * 7
    (note,) = compared_blocks(replace(design, name="y"), same, CHECKSUM)
    assert isinstance(note, Note)
    assert "has no axis y" in note.text


def test_margins_maps_and_loops_meet_the_certificate() -> None:
    controller, charts = fast_optimized().controller, charts_of(controller_page())
    (design,) = axis_designs(controller)
    claimed = controller.certificate.margins["x"].modulus
    # The smallest distance of the drawn loops to −1 is the margin; the curve between its points comes no closer.
    loops = [line for line in lines_of(nyquist_chart(design, None), 0).items() if line[0] == "worst plant"]
    loops += [line for line in lines_of(nyquist_chart(design, None), 1).items() if line[0] == "worst plant"]
    closest = min(float(np.nanmin(np.hypot(line.x + 1.0, line.y))) for _, line in loops)
    assert closest == pytest.approx(claimed, rel=2e-3)
    low, high = design.domain.environment_stiffness_n_per_m
    curve = over_stiffness(design, design.law, 16.0, np.array([low, high]))
    assert np.all(curve.modulus >= claimed * (1.0 - 1e-6))
    highest = max(each.peak_contact_force_n for each in design.predicted.scenarios)
    assert np.max(curve.peak_n) == pytest.approx(highest, rel=1e-6)
    (heat,) = (each for each in charts["x-map"].panels[0].elements if isinstance(each, Heat))
    # At the cell nearest to the design the map shows about the design's own margin; somewhere it is unstable.
    row, column = (
        int(np.argmin(np.abs(side - value)))
        for side, value in ((heat.y, 1e3 * design.law.lead_s), (heat.x, design.law.damping_n_s_per_m))
    )
    assert heat.values[row, column] == pytest.approx(claimed, abs=0.05)
    assert np.any(np.isnan(heat.values))


def test_an_unstable_loop_has_no_numbers_to_draw() -> None:
    (design,) = axis_designs(small_controller())
    wild = AdmittanceController(mass_kg=5.0, damping_n_s_per_m=50.0)
    plant = design.corners()[0]
    assert np.isnan(modulus_of(plant, wild, design.sample_time_s))
    assert contact_of(design, wild, design.predicted.scenarios[0].scenario()) is None
    chart = nyquist_chart(design, wild)
    assert not any("before" in label for label in lines_of(chart, 0))


def test_two_controllers_are_named_in_the_picture_of_free_motion_and_one_is_not() -> None:
    (design,) = axis_designs(fast_optimized().controller)
    for old, names in (
        (None, {""}),
        (AdmittanceController(mass_kg=20.0, damping_n_s_per_m=3000.0), {"before", "after"}),
    ):
        assert set(lines_of(admittance_chart(design, old), 0)) - {"asked"} == names


def test_the_page_says_what_was_asked_what_it_costs_and_how_the_search_came_there() -> None:
    found, page = fast_optimized(), controller_page()
    text = texts_of(page)
    for active in found.optimality_reports["x"].active:
        if active.price > 0.01 and "bound" not in active.name:
            assert f"{active.price:.2f} N" in text
    steps = found.searches["x"].steps
    best = [step.best_cost for step in steps if step.whole_cost is None]
    assert best == sorted(best, reverse=True)
    assert steps[-1].whole_cost == pytest.approx(found.searches["x"].evaluation.cost)
    assert [step.evaluations for step in steps] == sorted(step.evaluations for step in steps)
    assert "modulus margin | 0.5 | " in text


def test_the_page_of_a_validation_has_checks_band_and_measured_contacts() -> None:
    controller = small_controller()
    simulated = run_monte_carlo(controller, count=6)
    checks = (*GOOD.checks, *monte_carlo_checks(simulated))
    validated = Validated(
        report=ValidationReport(checks=checks), simulated=simulated, compared=own(), signed_by="key 7"
    )
    page = build_validate_page(controller, CHECKSUM, validated)
    check_page(render_page(page))
    charts = charts_of(page)
    (band,) = simulated
    assert band.band is not None
    assert band.contact is not None
    # The quantiles lie in order, and the highest of all runs is the largest peak (which is searched between the ticks).
    assert np.all(np.diff(band.band.levels, axis=0) >= 0.0)
    assert np.max(band.band.levels) == pytest.approx(band.contact.observed.largest, rel=0.01)
    assert "x-band" in charts
    (bars,) = (each for each in charts["x-distribution"].panels[0].elements if isinstance(each, Bars))
    assert np.sum(bars.heights) == 6
    assert bars.edges[-1] == band.contact.observed.largest
    text = render_page(page)
    assert "None of 6 plants breaks a limit, with 95 % confidence no more than 39 % of all do, drawn from the" in text
    assert "Axis x: the 6 plants of 6 with the largest contact forces" in text
    drawn = [lines_of(chart, i) for key, chart in charts.items() if "measured" in key for i in range(len(chart.panels))]
    assert len(drawn) == len(own().contacts)
    strongest = max(each.measured_peak_n for each in own().contacts)
    assert max(np.max(lines["measured"].y) for lines in drawn) == pytest.approx(strongest)
    assert "key 7" in render_page(page)


def test_what_fails_is_said_first_and_nothing_of_it_is_drawn() -> None:
    wrong = Check(axis="x", name="margins", passed=False, message="modulus is claimed as 0.9, found 0.5")
    page = build_validate_page(small_controller(), CHECKSUM, Validated(report=ValidationReport(checks=(wrong,))))
    assert page.tone == "bad"
    assert page.lead.startswith("NOT valid: 1 of 1 checks failed, first axis x, margins: modulus is claimed")
    assert charts_of(page) == {}


def test_a_front_is_drawn_with_the_chosen_controller_and_a_table() -> None:
    points = [
        {"mass": 6.0, "damping": 1300.0, "lead_s": 0.02, "feedback_damping_s": 0.0, "values": {"a": p, "b": q}}
        for p, q in ((50.0, 6e-4), (55.0, 7e-4), (61.0, 8e-4))
    ]
    objectives = [{"name": "a", "unit": "N"}, {"name": "b", "unit": "m/s/N"}]
    front = {"objectives": objectives, "points": points, "chosen": 1, "scenarios": 12}
    page = build_front_page({"axes": {"x": front}, "provenance": {"tool": "autotune"}})
    check_page(render_page(page))
    assert "2 | 55 | 0.0007 | 6 | 1300 | 20 | 0 | the controller written" in texts_of(page)


def test_several_reports_on_one_page_do_not_get_into_each_others_way() -> None:
    page = build_validate_page(small_controller(), CHECKSUM, Validated(report=GOOD))
    joined = join_pages("Both", [("a.yaml", page), ("b.yaml", replace(page, tone="bad"))])
    seen = check_page(render_page(joined))
    assert joined.tone == "bad"
    assert len(seen.pictures) == 2 * len(charts_of(page))
    assert join_pages("One", [("a.yaml", page)]) is page
    twice = (Section(key="a", title="A", blocks=()), Section(key="a", title="B", blocks=()))
    with pytest.raises(ValueError, match="must differ"):
        render_page(Page(title="t", lead="l", sections=twice))


def test_what_the_user_should_know_beside_a_controller_is_on_its_page() -> None:
    found = fast_optimized().controller
    said = "Axis x: the noise of the command is limited to 3.54 mm/s RMS."
    noted = replace(found, provenance={**found.provenance, "notes": [said]})
    page = build_optimize_page(noted, CHECKSUM)
    notes = [each.text for section in page.sections for each in section.blocks if isinstance(each, Note)]
    assert said in notes


def test_what_stands_in_a_file_cannot_become_part_of_the_page() -> None:
    found = small_controller()
    evil = replace(found, provenance={"tool": '<script>alert(1)</script><img src="//x.example/a.png">'})
    text = render_page(build_validate_page(evil, CHECKSUM, Validated(report=GOOD)))
    check_page(text)
    assert "<script>alert" not in text
    assert re.search(r"&lt;script&gt;alert", text)
    assert controller_tree(found)["status"] == "validated"


def test_a_schedule_is_a_table_of_its_classes_in_the_units_of_each_axis(tmp_path: Path) -> None:
    write_schedule(tmp_path / "cell", make_schedule())
    page = report_files([tmp_path / "cell" / "schedule.yaml"]).page
    rows = texts_of(page).splitlines()
    assert len(rows) == 4
    assert rows[0].startswith("m14-18 | x | 14 to 18 | 93.1 N | 102.4 N | +9.31 N | ")
    assert rows[3].startswith("m18 | rz | 18 | 93.1 N·m | 93.1 N·m | +0 N·m | ")
    # The figure shows the numbers of the table.
    own, common = (each for each in charts_of(page)["x-classes"].panels[0].elements if isinstance(each, Points))
    assert (own.names[0], own.y[0], common.y[0]) == ("m14-18", pytest.approx(93.1), pytest.approx(102.4, abs=0.05))
    text = render_page(page)
    check_page(text)
    assert text == render_page(page)


def test_a_log_without_contacts_is_left_out() -> None:
    nothing = LogComparison(contacts=(), passed_over=0, mass_kg=16.0, is_weighed=True)
    page = build_validate_page(small_controller(), CHECKSUM, Validated(report=GOOD, compared=nothing))
    assert "measured" not in charts_of(page)


@pytest.mark.parametrize("live", [(True, False), (False, False)])
def test_the_engine_is_on_a_page_with_a_single_figure_that_can_be_zoomed(live: tuple[bool, bool]) -> None:
    line = Line(x=np.array([0.0, 1.0]), y=np.array([0.0, 2.0]), label="a line", role="after")
    panel = Panel(x=Scale(label="time [s]"), y=Scale(label="force [N]"), elements=(line,))
    alternative = "A line that rises from nothing to two newtons in a second."
    charts = tuple(
        Chart(key=f"c{i}", title="Line", alternative=alternative, panels=(panel,), live=each)
        for i, each in enumerate(live)
    )
    text = render_page(Page(title="Lines", lead="Two.", sections=(Section(key="s", title="Both", blocks=charts),)))
    check_page(text)
    assert [f'id="c{i}-data"' in text for i in range(2)] == list(live)
    assert ('id="engine"' in text) is any(live)
