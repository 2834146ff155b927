"""What the log tells of the wrench's filter or delay enters the plant and the set that must be safe."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec, Uncertain
from autotune.tuning.problems import build_problems
from autotune.tuning.record import build_domain
from autotune.validation.margins import sweep_margins
from identification.errors import EstimateError
from identification.result import Estimate, Finding, Identified, Status, WrenchFilterEstimate
from problems.design.evaluation import build_scenarios
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario
from problems.model.plant import WrenchFilter
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.tuning.cases import absent, identified_plant, known
from tests.autotune.tuning.turning import SQUARE, two_axes
from tests.conftest import RunCli
from tests.problems.axes import admittance

CORNER = WrenchFilterEstimate(corner_hz=known(50.0, 0.5))
DELAY = WrenchFilterEstimate(delay_s=known(2.4e-3, 1e-5))
TAU = 1.0 / (2.0 * math.pi * 50.0)


def seen_by(wrench: WrenchFilterEstimate | None) -> Identified:
    plant = identified_plant()
    return replace(plant, sensor=replace(plant.sensor, wrench_filter=wrench))


def built(
    wrench: WrenchFilterEstimate | None, said: Uncertain | None = None, spec: ProblemSpec | None = None
) -> DesignProblem:
    return build_problems(seen_by(wrench), replace(spec or ProblemSpec(), uncertain=said or {}))["x"]


def test_without_an_entry_the_plant_is_as_it_was() -> None:
    found = built(None)
    assert found.plants.nominal.wrench_filter == WrenchFilter()
    assert not {"wrench_time_constant_s", "wrench_delay_s"} & set(found.plants.further)
    assert build_domain(found).wrench_filter is None


def test_a_filter_that_was_found_and_taken_out_of_the_file_is_asked_for() -> None:
    found = Finding(code="wrench-filter", severity="info", message="The wrench passes 50 Hz.", advice="")
    cut = replace(seen_by(None), findings=(found,))
    with pytest.raises(UsageError, match=r"no sensor\.wrench_filter, and its findings say: The wrench passes 50 Hz"):
        build_problems(cut, ProblemSpec())
    said = replace(ProblemSpec(), uncertain={"wrench_time_constant_s": (0.0, 0.0)})
    assert build_problems(cut, said)["x"].plants.nominal.wrench_filter.is_none
    late = replace(ProblemSpec(), uncertain={"wrench_delay_s": (0.0, 1e-3)})
    assert build_problems(cut, late)["x"].plants.nominal.wrench_filter == WrenchFilter(delay_s=0.5e-3)
    told = replace(seen_by(None), findings=(replace(found, code="other"),))
    assert build_problems(told, ProblemSpec())["x"].plants.nominal.wrench_filter.is_none
    assert not built(CORNER).plants.nominal.wrench_filter.is_none


def test_a_corner_becomes_a_state_with_its_95_percent_range() -> None:
    found = built(CORNER)
    assert found.plants.nominal.wrench_filter.time_constant_s == pytest.approx(TAU, rel=1e-12)
    assert found.plants.nominal.wrench_filter.delay_s == 0.0
    low, high = found.plants.further["wrench_time_constant_s"]
    # 50 ± 0.5 Hz: two deviations, five digits, outwards.
    assert low <= 1.0 / (2.0 * math.pi * 51.0) <= low * (1.0 + 1e-4)
    assert high >= 1.0 / (2.0 * math.pi * 49.0) >= high * (1.0 - 1e-4)
    domain = build_domain(found)
    assert domain.wrench_filter == found.plants.nominal.wrench_filter
    assert domain.plants.nominal.wrench_filter == found.plants.nominal.wrench_filter


def test_a_delay_becomes_a_delay_and_leaves_the_position_alone() -> None:
    found = built(DELAY)
    assert found.plants.nominal.wrench_filter == WrenchFilter(delay_s=2.4e-3)
    low, high = found.plants.further["wrench_delay_s"]
    assert 2.3799e-3 <= low <= 2.38e-3
    assert 2.42e-3 <= high <= 2.4201e-3
    assert found.bounds["feedback_damping_s"] == (0.0, 0.0)
    for extra in (
        ProblemSpec(bounds={"feedback_damping_s": (0.0, 0.01)}),
        ProblemSpec(free={"compensation_mass_kg": (0.0, 5.0)}),
    ):
        with pytest.raises(UsageError, match=r"late by a pure delay.*Set bounds of .* to \[0, 0\]"):
            built(DELAY, spec=extra)


@pytest.mark.parametrize(
    ("wrench", "said", "nominal", "ranges"),
    [
        (CORNER, {"wrench_time_constant_s": "nominal"}, WrenchFilter(time_constant_s=TAU), {}),
        (CORNER, {"wrench_time_constant_s": (0.0, 0.0)}, WrenchFilter(), {}),
        (
            CORNER,
            {"wrench_time_constant_s": (1e-3, 2e-3)},
            WrenchFilter(time_constant_s=2e-3),
            {"wrench_time_constant_s": (1e-3, 2e-3)},
        ),
        (None, {"wrench_delay_s": (0.0, 1e-3)}, WrenchFilter(delay_s=0.5e-3), {"wrench_delay_s": (0.0, 1e-3)}),
        (
            WrenchFilterEstimate(
                delay_s=Estimate(value=None, std=None, status=Status.WEAK, ci95=(1e-3, 3e-3), method="by hand")
            ),
            {},
            WrenchFilter(delay_s=2e-3),
            {"wrench_delay_s": (1e-3, 3e-3)},
        ),
        (
            WrenchFilterEstimate(corner_hz=replace(known(50.0), status=Status.GIVEN)),
            {},
            WrenchFilter(time_constant_s=TAU),
            {},
        ),
        (
            WrenchFilterEstimate(
                corner_hz=Estimate(value=None, std=None, status=Status.WEAK, ci95=(40.0, 60.0), method="by hand")
            ),
            {},
            WrenchFilter(time_constant_s=TAU),
            # 1/(2π f), five digits, outwards.
            {"wrench_time_constant_s": (2.6525e-3, 3.9789e-3)},
        ),
        (DELAY, {"wrench_delay_s": "nominal"}, WrenchFilter(delay_s=2.4e-3), {}),
        (
            DELAY,
            {"wrench_delay_s": (1e-3, 3e-3)},
            WrenchFilter(delay_s=2.4e-3),
            {"wrench_delay_s": (1e-3, 3e-3)},
        ),
        (
            DELAY,
            {"wrench_delay_s": (3e-3, 4e-3)},
            WrenchFilter(delay_s=3e-3),
            {"wrench_delay_s": (3e-3, 4e-3)},
        ),
        (
            WrenchFilterEstimate(delay_s=known(1e-5, 2e-5)),
            {},
            WrenchFilter(delay_s=1e-5),
            {"wrench_delay_s": (0.0, 5e-5)},
        ),
        (
            WrenchFilterEstimate(delay_s=replace(known(2.4e-3, 1e-5), ci95=(2.3e-3, 2.41e-3))),
            {},
            WrenchFilter(delay_s=2.4e-3),
            {"wrench_delay_s": (2.3e-3, 2.42e-3)},
        ),
        (
            WrenchFilterEstimate(delay_s=replace(known(2.4e-3, 1e-5), ci95=(2.39e-3, 2.5e-3))),
            {},
            WrenchFilter(delay_s=2.4e-3),
            {"wrench_delay_s": (2.38e-3, 2.5e-3)},
        ),
    ],
    ids=[
        *("nominal", "none", "a range", "a range of nothing", "weak", "given", "a weak corner"),
        *("nominal delay", "around a delay", "beyond a delay", "not below 0", "interval below", "interval above"),
    ],
)
def test_problem_yaml_wins_and_a_weak_value_is_its_interval(
    wrench: WrenchFilterEstimate | None,
    said: Uncertain,
    nominal: WrenchFilter,
    ranges: dict[str, tuple[float, float]],
) -> None:
    found = built(wrench, said)
    assert found.plants.nominal.wrench_filter.time_constant_s == pytest.approx(nominal.time_constant_s, rel=1e-12)
    assert found.plants.nominal.wrench_filter.delay_s == pytest.approx(nominal.delay_s, rel=1e-12)
    assert {name: span for name, span in found.plants.further.items() if name.startswith("wrench")} == ranges


def test_torques_pass_the_same_filter() -> None:
    """x through the lever is the same loop, filter and all; what is said of the filter once is said of both."""
    plant = two_axes()
    plant = replace(plant, sensor=replace(plant.sensor, wrench_filter=CORNER))
    found = build_problems(plant, ProblemSpec())
    assert (
        found["ry"].plants.nominal.wrench_filter
        == found["x"].plants.nominal.wrench_filter
        == built(CORNER).plants.nominal.wrench_filter
    )
    straight = admittance(6.0, 1600.0, 0.012)
    turning = replace(straight, mass_kg=6.0 * SQUARE, damping_n_s_per_m=1600.0 * SQUARE)
    moduli = []
    for axis, law, scale in (("x", straight, 1.0), ("ry", turning, SQUARE)):
        point = Scenario(environment_stiffness_n_per_m=1.1e5 * scale, payload_mass_kg=16.0 * scale)
        sampled = build_sampled_plant(found[axis].plant(point), found[axis].sample_time_s)
        moduli.append(find_margins(sampled, law).modulus)
    assert moduli[1] == pytest.approx(moduli[0], rel=1e-6)
    said = ProblemSpec(uncertain={"wrench_time_constant_s": (1e-3, 2e-3)})
    both = build_problems(plant, said)
    assert {each.plants.further["wrench_time_constant_s"] for each in both.values()} == {(1e-3, 2e-3)}


@pytest.mark.parametrize(
    ("wrench", "said", "error", "message"),
    [
        (WrenchFilterEstimate(corner_hz=absent("the sweep is too slow")), {}, EstimateError, "the sweep is too slow"),
        (WrenchFilterEstimate(corner_hz=known(50.0, 30.0)), {}, EstimateError, "with a range that reaches 0"),
        (None, {"wrench_time_constant_s": "identified"}, UsageError, "says nothing of it"),
        (None, {"wrench_time_constant_s": (0.0, 1e-3)}, UsageError, r"above 0 at both ends, or \[0, 0\] for none"),
    ],
)
def test_a_filter_that_nobody_knows_is_refused(
    wrench: WrenchFilterEstimate | None, said: Uncertain, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        built(wrench, said)


def test_margins_of_the_search_and_of_validation_hold_the_slowest_filter() -> None:
    """The filter's slow end is the worst modulus of three, and the optimizer's is the sweep's by other code."""
    problem, law = built(CORNER), admittance(6.0, 1600.0, 0.012)
    prepared = build_scenarios(problem, problem.plants.corners())
    by_lag: dict[float, float] = {}
    for scenario, plant in zip((*prepared.scenarios, *prepared.free_of), prepared.plants, strict=True):
        lag = scenario.wrench_time_constant_s or 0.0
        found = find_margins(plant.sampled, law).modulus
        by_lag[lag] = min(found, by_lag.get(lag, math.inf))
    fast, slow = problem.plants.further["wrench_time_constant_s"]
    assert by_lag[slow] < by_lag[fast]
    domain = build_domain(problem)
    others = [scenario.plant(domain.plants.nominal) for scenario in prepared.scenarios]
    swept = sweep_margins(domain.plants, law, problem.sample_time_s, stiffness=5, mass=2, others=others)
    # A grid of 6,000 points and the modes: 1e-3 of a minimum.
    assert swept.values["modulus"] <= by_lag[slow] * (1.0 + 1e-3)
    assert swept.values["modulus"] == pytest.approx(by_lag[slow], rel=2e-2)
    plain = replace(domain.plants.nominal, wrench_filter=WrenchFilter())
    assert find_margins(build_sampled_plant(plain, problem.sample_time_s), law).modulus > 1.1 * by_lag[slow]


def test_a_law_beside_a_late_wrench_is_validated_in_a_hand_and_by_its_admittance_s_peak(
    run_cli: RunCli, tmp_path: Path
) -> None:
    """Such a law has no B_fb: what validation looks at must not ask for the usual bounds of it."""
    (tmp_path / "plant.yaml").write_text(
        "format: autotune/plant\nversion: 1\nmass: 16\ncoupling_stiffness: 3e5\ndrag: 630\n"
        "robot: {bandwidth: 3.2, delay: 2.4e-3}\nenvironment_stiffness: [1e5, 1.2e5]\nsample_time: 8e-4\n"
        "wrench_delay: 0.004\nforce_noise: 0.5\n",
        encoding="utf-8",
    )
    (tmp_path / "problem.yaml").write_text(
        "structure: gains\nrequirements: {held_by_hand: {min_modulus: 0.2}, admittance_peak: 1.2}\n", encoding="utf-8"
    )
    done = run_cli("optimize", "plant.yaml", "--problem", "problem.yaml", "--proof-budget", "0")
    assert done.returncode == 0, done.stderr
    assert "B_fb 0 ms" in done.stdout
    assert "ok     modulus held by a hand: found " in done.stdout
    assert "ok     admittance peak: found " in done.stdout
