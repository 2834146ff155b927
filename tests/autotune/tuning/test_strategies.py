"""A damping that follows the speed, and a full stop: the lightest that is allowed, confirmed by the second method."""

import math
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from autotune.cli._optimized import damping_lines, response_lines
from autotune.errors import UsageError
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import CollisionResponse, VariableDampingSettings
from autotune.formats.problem import read_problem
from autotune.report.axis_design import axis_designs
from autotune.report.strategy_chart import strategy_chart
from autotune.tuning import strategies
from autotune.tuning.first_contacts import FirstContacts, contacts_of, peaks_of
from autotune.tuning.strategies import END_SHARE, StrategySettings, choose_strategies
from autotune.tuning.threshold import without_response
from autotune.validation.axis_proof import Prover
from autotune.validation.validate import validate_controller
from autotune.validation.variable_damping import METHOD, modulus_at_ends
from tests.autotune.tuning.responding import responding, varied


def test_the_lowest_damping_is_the_least_that_limit_and_margins_allow() -> None:
    controller = varied()
    chosen, tree = controller.damping_of("x"), controller.provenance["variable_damping"]["x"]
    assert chosen is not None
    assert chosen.lowest < controller.axes["x"].damping < chosen.highest
    assert tree["worst_contact_peak_n"]["with"] <= 50.0
    assert tree["hand_force_n_per_m_s"]["with"] < tree["hand_force_n_per_m_s"]["without"]
    # 6 % lighter with the same approach, and the peak is above the limit: bisection ends within some per cent.
    lighter = replace(chosen, lowest=0.94 * chosen.lowest)
    contacts = replace(contacts_of(controller, "x"), variable=lighter)
    peaks = [peaks_of(contacts.run(each.scenario(), None))[0] for each in controller.predicted["x"].scenarios]
    assert max(peaks) > 50.0
    # The rate limit crosses the range in 0.1 s at least.
    crossing = (chosen.highest - chosen.lowest) / chosen.largest_change * chosen.update_periods * 8e-4
    assert crossing >= 0.099


@pytest.mark.parametrize(
    ("least_allowed", "expected"),
    [(0.0, (500.0, 500.0)), (700.0, (700.0, 714.0)), (899.0, (900.0, 900.0)), (901.0, (math.inf, math.inf))],
    ids=["all of the span", "part of it", "its end alone", "nothing"],
)
def test_the_least_damping_of_a_span_is_bisected(
    monkeypatch: pytest.MonkeyPatch, least_allowed: float, expected: tuple[float, float]
) -> None:
    """With stand-ins of the runs: from the low end where that is allowed, and the constant B_a where nothing is."""

    def schedule(_contacts: object, lowest: float, highest: float) -> VariableDampingSettings:
        return VariableDampingSettings(
            highest=highest, lowest=lowest, decay_s_per_m=10.0, update_periods=1, largest_change=1.0
        )

    def run(_contacts: object, _scenarios: object, variable: VariableDampingSettings | None) -> strategies._Tried:
        return strategies._Tried(variable=variable, runs={}, worst=(1.0, 1.0))

    monkeypatch.setattr(strategies, "_schedule", schedule)
    monkeypatch.setattr(strategies, "_run", run)
    plain = run(None, None, None)
    contacts = cast(FirstContacts, None)
    found = strategies._lighter(
        contacts, (), 1200.0, (500.0, 900.0), lambda tried: tried.lowest >= least_allowed, plain
    )
    assert expected[0] <= found.lowest <= expected[1]
    assert found.highest == (0.0 if found is plain else 1200.0)


def test_both_ends_keep_most_of_the_modulus_that_is_asked() -> None:
    controller = varied()
    chosen, plants = controller.damping_of("x"), controller.certificate.domain["x"].plants
    assert chosen is not None
    found = modulus_at_ends(plants, admittance_controller(controller, "x"), 8e-4, chosen)
    assert found == pytest.approx(controller.provenance["variable_damping"]["x"]["modulus_at_ends"], rel=1e-12)
    search = responding().searches["x"]
    asked = search.problem.requirements.with_asked("max_peak_force_n", 50.0).with_asked("modulus_margin", found / 0.75)
    searches = {"x": replace(search, problem=replace(search.problem, requirements=asked))}
    plain = without_response(responding().controller)
    settings = StrategySettings(damping_bounds=(300.0, 2000.0))
    strict = choose_strategies(plain, searches, settings, Prover()).damping_of("x")
    assert strict is None or modulus_at_ends(plants, admittance_controller(controller, "x"), 8e-4, strict) >= (
        END_SHARE * found / 0.75
    )


def test_the_file_is_confirmed_by_replays_and_its_proof_made_again(tmp_path: Path) -> None:
    controller = varied()
    assert controller.collision.response is CollisionResponse.STOP
    write_controller(tmp_path / "controller.yaml", controller)
    again = read_controller(tmp_path / "controller.yaml").controller
    assert again == controller
    report = validate_controller(again)
    assert [(each.name, each.message) for each in report.checks if not each.passed] == []
    said = {each.name: each.message for each in report.checks}
    assert "any change of B_a in [" in said["variable damping"]
    assert said["collision response"].startswith("stop at ")
    assert [each.claim for each in controller.certificate.proved if each.method == METHOD]


def wider(controller: Controller) -> Controller:
    """The same file, whose B_a may go lower than was proved and predicted."""
    chosen = controller.damping_of("x")
    assert chosen is not None
    return replace(controller, variable_damping={"x": replace(chosen, lowest=0.5 * chosen.lowest)})


def test_a_range_that_was_widened_afterwards_is_found_out() -> None:
    checks = validate_controller(wider(varied())).checks
    wrong = {each.name: each.message for each in checks if not each.passed}
    assert "nothing verifies" in wrong["statements"] or "not proved" in wrong["variable damping"]
    assert "replayed" in wrong["varied peaks"]


def test_terminal_and_report_say_what_it_does() -> None:
    lines = [*damping_lines(varied()), *response_lines(varied())]
    assert "stable however B_a varies in that range, proved" in lines[1]
    assert lines[2].startswith("collision response: stop at ")
    chart = strategy_chart(axis_designs(varied())[0])
    assert chart is not None
    assert len(chart.panels) == 2
    assert "the collision is detected" in chart.caption
    assert strategy_chart(axis_designs(without_response(varied()))[0]) is None


def test_a_response_without_a_threshold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("collision_response: stop\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"needs free\.collision_threshold_n"):
        read_problem(path)
    path.write_text(
        "collision_response: stop\nfree:\n  collision_threshold_n: [5, 20]\n  variable_damping_n_s_per_m: [500, 900]\n",
        encoding="utf-8",
    )
    spec = read_problem(path)
    assert (spec.collision_response, spec.variable_damping) == (CollisionResponse.STOP, (500.0, 900.0))
