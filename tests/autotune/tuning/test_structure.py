"""Laws with more freedom at equal noise: what they save, by other simulations than the search's, and what is kept."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, get_args

import numpy as np
import pytest

from autotune.api import load
from autotune.cli._pareto import FrontWriter
from autotune.cli._proved import noise_lines
from autotune.errors import InfeasibleError, UsageError
from autotune.explore.sliders import build_gain_sliders
from autotune.export.designing import specs_for
from autotune.export.targets import TARGETS
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ProblemSpec, Structure
from autotune.runtime.load import read_law
from autotune.studies.front import FrontRequest
from autotune.tuning import structure as structure_module
from autotune.tuning.noise_limit import NoiseOf
from autotune.tuning.optimize import optimize
from autotune.tuning.problems import build_problems
from autotune.tuning.search import SearchResult, solve_design
from autotune.tuning.structure import StructureSearch, choose_structure, equal_noise, limited_problem
from autotune.tuning.structure_choice import PRICE, StructureChoice
from autotune.validation.axis_proof import ProofOptions
from autotune.validation.replay import equation_gains, robot_alone
from autotune.validation.replay_kernel import follow_forces
from autotune.validation.requirements import speed_rms
from benchmarks.tuning_problems import paper_cell
from problems.contact.nonlinear_simulation import simulate_nonlinear
from problems.design.hand import HandImpedance
from problems.design.problem import DEFAULT_BOUNDS, DesignProblem, NoiseLimit, Requirements, biquad_bounds
from problems.design.requirements import AdmittancePeak, HeldByHand
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.response import free_space_admittance, loop_response
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import FAST_SPEC, fast_optimized, identified_plant, known

H = 8e-4
HAND = HandImpedance()


@pytest.mark.parametrize(("corner", "time_s"), [(25.0, 0.03), (100.0, 0.01), (600.0, 0.002)])
def test_a_biquad_that_does_nothing_is_one_of_the_problem_s_designs(corner: float, time_s: float) -> None:
    """Zero and pole are the same, at the corner or at the nearest bound: the response is that of the four gains."""
    corners = {"biquad_zero_s": (0.002, 0.03), "biquad_pole_s": (0.002, 0.03)}
    problem = replace(papers_cell(), bounds={**DEFAULT_BOUNDS, **biquad_bounds(H, 30.0), **corners})
    plain = np.array([6.0, 1250.0, 0.018, 0.005])
    design = structure_module._neutral(problem, plain, corner)
    found = dict(zip(problem.variables, design.tolist(), strict=True))
    assert found["biquad_zero_s"] == found["biquad_pole_s"] == time_s
    plant = build_sampled_plant(problem.plant(problem.scenarios(2, 2)[0]), problem.sample_time_s)
    grid = np.geomspace(1.0, 3000.0, 50)
    with_biquad, without = (
        loop_response(plant, law, grid).at_command
        for law in (problem.controller(design), papers_cell().controller(plain))
    )
    np.testing.assert_allclose(with_biquad, without, rtol=1e-9)


def papers_cell() -> DesignProblem:
    """The paper's nominal cell."""
    return paper_cell((5e5, 5e5), (16.0, 16.0))


@cache
def plain() -> SearchResult:
    return solve_design(papers_cell())


@cache
def chosen() -> tuple[SearchResult, StructureChoice]:
    return choose_structure(plain(), "biquad", HAND, seed=0)


def law_of(found: SearchResult) -> AdmittanceController:
    return found.problem.controller(found.design)


def test_on_the_papers_cell_equal_noise_takes_a_fifth_of_the_peak_and_a_biquad_more() -> None:
    found, choice = chosen()
    gains, noise, biquad = (choice.costs[each] for each in ("gains", "noise", "biquad"))
    assert gains is not None
    assert noise is not None
    assert biquad is not None
    assert gains == pytest.approx(72.56, abs=0.05)
    assert noise < 0.80 * gains
    assert biquad < 0.98 * noise
    assert choice.taken == "biquad"
    assert choice.bounds == plain().problem.bounds
    assert law_of(found).has_biquad
    # A simulation that knows no matrix exponential.
    plant = found.problem.plant(found.problem.scenarios(2, 2)[0])
    run = simulate_nonlinear(plant, law_of(found), found.problem.approach, sample_time_s=H, duration_s=0.5)
    assert run.peak_contact_force_n == pytest.approx(biquad, rel=2e-3)


def test_noise_modulus_and_admittance_are_those_of_the_four_gains_by_a_second_method() -> None:
    found, choice = chosen()
    plant = found.problem.plant(found.problem.scenarios(2, 2)[0])
    # The answer to one tick of force, squared and summed.
    both = [plant, plant.in_contact_with(FREE_SPACE)]
    before, after = (float(np.max(speed_rms(both, law_of(each), H))) for each in (plain(), found))
    assert after <= before * (1.0 + 1e-4)
    assert before == pytest.approx(choice.noise_m_s_per_n, rel=1e-2)
    sampled = build_sampled_plant(plant, H)
    response = loop_response(sampled, law_of(found), np.geomspace(0.5, 3900.0, 20_000))
    assert min(np.min(np.abs(1.0 + each)) for each in (response.at_force, response.at_command)) > 0.4999
    band = 2.0 * np.pi * np.geomspace(0.1, 2.0, 50)
    assert np.min(np.abs(free_space_admittance(sampled, law_of(found), band))) > 6.999e-4


def test_a_hand_is_held_as_well_as_by_the_four_gains() -> None:
    found, _ = chosen()
    hand = HeldByHand(min_modulus=0.5)
    held = [structure_module._least_held(each, hand) for each in (plain(), found)]
    assert held[1] >= 0.895 * held[0]


def test_no_structure_runs_ahead_of_the_steady_approach() -> None:
    """What a contact soon after the start would find: F^d comes at once, and the speed over the steady one, by time."""
    found, _ = chosen()
    law, robot = law_of(found), found.problem.plants.nominal.robot
    position = follow_forces(robot_alone(robot, H), equation_gains(law, H), np.full(4000, 30.0))
    assert np.max(np.diff(position)) / H < 1.1 * 30.0 / law.damping_n_s_per_m
    response = free_space_admittance(
        build_sampled_plant(found.problem.plants.nominal, H), law, 2.0 * np.pi * np.geomspace(0.01, 100.0, 5000)
    )
    assert np.max(np.abs(response)) * law.damping_n_s_per_m < 1.051


def test_what_rises_already_may_go_on_rising(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AdmittancePeak, "achieved", lambda *_: 1.3697)
    limited = limited_problem(papers_cell(), 3e-3, has_biquad=False)
    assert structure_module.without_rise(plain(), limited).requirements.asked()["admittance_peak"] == 1.37
    said = replace(limited, requirements=replace(limited.requirements, further={"admittance_peak": 1.2}))
    assert structure_module.without_rise(plain(), said) == said


def test_of_a_law_that_no_hand_may_hold_no_modulus_in_a_hand_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure_module, "_least_held", lambda _found, _hand: 0.0)
    asked: list[DesignProblem] = []

    def solved(problem: DesignProblem, *_: object, **__: object) -> SearchResult:
        asked.append(problem)
        return plain()

    monkeypatch.setattr(structure_module, "solve_or_none", solved)
    _, choice = choose_structure(plain(), "biquad", HAND, seed=0)
    assert choice.taken == "gains"
    assert [structure_module._HELD in each.requirements.asked() for each in asked] == [False, False]


def test_a_noise_that_is_asked_is_the_limit_that_is_said() -> None:
    twice = 2.0 * chosen()[1].noise_m_s_per_n
    limit = NoiseLimit(max_speed_rms_m_s=0.2 * twice, force_noise_rms_n=0.2)
    asked = Requirements(command_noise=limit)
    found, choice = choose_structure(solve_design(replace(papers_cell(), requirements=asked)), "noise", HAND, seed=0)
    assert found.problem.requirements.command_noise == limit
    assert choice.noise_m_s_per_n == pytest.approx(twice)
    said = choice.message("x", found.problem)
    assert f"with the noise of the command that is asked ({1e3 * twice:.3g} mm/s per N) in the place of" in said
    # More noise is never worse.
    noise, less = choice.costs["noise"], chosen()[1].costs["noise"]
    assert noise is not None
    assert less is not None
    assert noise < less


def test_what_feedback_of_a_noisy_pose_makes_of_the_command_counts() -> None:
    """Of a pose without noise B_fb is free, and most of what wider bounds save is its."""
    silent, _ = choose_structure(plain(), "noise", HAND, seed=0)
    found, choice = choose_structure(plain(), "noise", HAND, seed=0, measured=NoiseOf(force=0.14, position=2e-6))
    assert choice.costs["noise"] is not None
    assert law_of(silent).feedback_damping_s > 0.05
    plant = found.problem.plant(found.problem.scenarios(2, 2)[0])
    both = [plant, plant.in_contact_with(FREE_SPACE)]
    total = np.hypot(
        0.14 * speed_rms(both, law_of(found), H), 2e-6 * speed_rms(both, law_of(found), H, on_position=True)
    )
    assert float(np.max(total)) <= 0.14 * choice.noise_m_s_per_n * (1.0 + 1e-4)
    assert law_of(found).feedback_damping_s < 0.1 * law_of(silent).feedback_damping_s
    assert "per N, the pose's counted too) in the place of" in choice.message("x", found.problem)


@pytest.mark.parametrize(
    ("position", "said", "is_of_jitter"), [(2e-6, (), True), (2e-8, (), False), (2e-6, ("mass",), True)]
)
def test_the_limit_is_the_larger_of_the_four_gains_noise_and_the_robots_jitter(
    position: float, said: tuple[str, ...], is_of_jitter: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[DesignProblem] = []

    def solved(_plain: object, problem: DesignProblem, *_: object, **__: object) -> SearchResult:
        asked.append(problem)
        return plain()

    monkeypatch.setattr(structure_module, "solve_limited", solved)
    measured = NoiseOf(force=0.05, position=position)
    _, choice = choose_structure(plain(), "noise", HAND, seed=0, said=said, measured=measured)
    limit, of_gains, of_robot = asked[0].requirements.command_noise, 0.05 * equal_noise(plain()), 2**0.5 * position / H
    assert limit is not None
    assert limit.max_speed_rms_m_s == pytest.approx(of_robot if is_of_jitter else of_gains, rel=1e-5)
    message = choice.message("x", plain().problem)
    assert (asked[0].bounds["mass"] == DEFAULT_BOUNDS["mass"]) == bool(said)
    jitter, gains = f"{1e3 * of_robot:.3g} mm/s", f"{1e3 * of_gains:.3g} mm/s"
    plants = [plain().problem.plant(each) for each in plain().active.scenarios]
    plants += [each.in_contact_with(FREE_SPACE) for each in plants]
    both = np.hypot(
        0.05 * speed_rms(plants, law_of(plain()), H), position * speed_rms(plants, law_of(plain()), H, on_position=True)
    )
    total = f"{1e3 * float(np.max(both)):.3g} mm/s"
    if is_of_jitter:
        assert f"limited to {jitter} RMS, the robot's jitter at rest (√2 · 2 µm of pose noise per tick" in message
        assert f"which is more than the {gains} that the four gains in their bounds make of the sensor's" in message
    else:
        assert (
            f"limited to the {gains} RMS that the four gains in their bounds make of the sensor's noise ({total} with "
            f"the pose's), which is more than the {jitter} of the" in message
        )


def test_a_jitter_beside_which_the_approach_is_slow_is_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 µm per tick are 35 mm/s that no robot at rest has: the note shows the line that limits it."""
    monkeypatch.setattr(structure_module, "solve_limited", lambda *_, **__: plain())
    # The drag of the payload is felt as well.
    speed = 30.0 / (law_of(plain()).damping_n_s_per_m + papers_cell().plants.nominal.payload.drag_n_s_per_m)
    for position, share in ((20e-6, 2**0.5 * 20e-6 / H / speed), (2e-6, None)):
        measured = NoiseOf(force=0.05, position=position)
        message = choose_structure(plain(), "noise", HAND, seed=0, measured=measured)[1].message("x", plain().problem)
        asked = f"requirements: {{command_noise: {{max_speed_rms_m_s: {0.05 * equal_noise(plain()):.3g}}}}}"
        assert message.endswith(f"for as little as the four gains make of the sensor's say {asked}.") == (
            share is not None
        )
        assert share is None or f"That noise is {100.0 * share:.0f} % of the {1e3 * speed:.3g} mm/s of the" in message


@pytest.mark.parametrize(("least", "asked"), [(0.9, 0.45), (0.4, 0.36)])
def test_of_four_gains_held_firmly_no_more_is_kept_in_a_hand_than_elsewhere(
    least: float, asked: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bounds that were widened made the four gains firmer in a hand, and what they are compared to harder."""
    monkeypatch.setattr(structure_module, "_least_held", lambda _found, _hand: least)
    held = structure_module._held(plain(), papers_cell(), HAND).requirements.asked()["held_by_hand"]
    assert isinstance(held, HeldByHand)
    assert held.min_modulus == asked


@pytest.mark.parametrize("is_said", [False, True])
def test_a_law_of_wider_bounds_is_slower_than_a_tick(is_said: bool) -> None:
    """With much noise allowed the lightest M_a is the best: it ends above h B_a, unless somebody said its bounds."""
    problem = paper_cell((1e5, 1e5), (16.0, 16.0))
    first = solve_design(replace(problem, bounds={"mass": (0.2, 100.0)}) if is_said else problem)
    limited = limited_problem(first.problem, 20.0 * equal_noise(solve_design(problem)), has_biquad=False, said=["mass"])
    if not is_said:
        limited = limited_problem(problem, 20.0 * equal_noise(first), has_biquad=False)
    found = structure_module.solve_limited(first, limited, HAND, [first], seed=0)
    assert found is not None
    share = law_of(found).mass_kg / (problem.sample_time_s * law_of(found).damping_n_s_per_m)
    assert (share < 0.5) if is_said else (1.0 <= share < 1.2)


@pytest.mark.parametrize(("needed_kg", "bounds"), [(0.2, [0.877, 0.08, 0.835, 0.877]), (1e3, [0.877])])
def test_a_guess_that_leaves_no_law_is_dropped(needed_kg: float, bounds: list[float]) -> None:
    """Where only lighter masses hold, the loosest bound is tried too; nothing slow enough is then nothing."""
    seen: list[float] = []

    def search(problem: DesignProblem) -> SearchResult | None:
        seen.append(problem.bounds["mass"][0])
        if seen[-1] > needed_kg:
            return None
        mass = 0.1 if needed_kg < 1.0 else 5.0
        return cast(
            "SearchResult", SimpleNamespace(problem=plain().problem, design=np.array([mass, *plain().design[1:]]))
        )

    limited = limited_problem(papers_cell(), 3e-3, has_biquad=False)
    found = structure_module.search_above_a_tick(search, limited, plain())
    assert (found is None) == (needed_kg < 1.0)
    assert seen[: len(bounds)] == pytest.approx(bounds[: len(seen)], rel=0.02)


@pytest.mark.parametrize("force", [None, 0.0])
def test_noise_of_the_pose_alone_loosens_no_bound(force: float | None) -> None:
    """Without the sensor's noise nothing says how much of the pose's B_fb may bring into the command."""
    plant = identified_plant()
    silent = replace(plant.sensor.force_noise_rms_n, value=force)
    sensor = replace(plant.sensor, position_noise_rms_m=known(2e-6), force_noise_rms_n=silent)
    search = StructureSearch(ProblemSpec(), replace(plant, sensor=sensor), 0)
    assert search.searched({"x": plain()}) == {"x": plain()}
    (note,) = search.notes({"x": plain()})
    assert note.startswith("Axis x: the four gains stay in their bounds: the log shows noise of the pose but none of")
    assert not search.choices


def test_bounds_that_somebody_said_hold() -> None:
    said = {"mass", "lead_s"}
    bounds = limited_problem(papers_cell(), 3e-3, has_biquad=False, said=said).bounds
    assert {name: bounds[name] for name in said} == {name: DEFAULT_BOUNDS[name] for name in said}
    assert bounds["feedback_damping_s"][1] > DEFAULT_BOUNDS["feedback_damping_s"][1]
    every = {"mass", "lead_s", "feedback_damping_s"}
    found, choice = choose_structure(plain(), "noise", HAND, seed=0, said=every)
    assert found is plain()
    assert dict(choice.costs) == {"gains": plain().evaluation.cost}


def test_unasked_the_noise_of_the_identified_sensor_is_limited_in_the_place_of_bounds() -> None:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    proof = ProofOptions(further_s=0.0)
    spec = replace(FAST_SPEC, bounds={})
    found, bounded = (
        optimize(plant, replace(spec, structure=each), seed=1, proof=proof, replays=False) for each in (None, "gains")
    )
    today, noise = (each.searches["x"] for each in (bounded, found))
    assert noise.evaluation.cost < 0.99 * today.evaluation.cost
    limit = noise.problem.requirements.command_noise
    assert limit is not None
    assert limit.force_noise_rms_n == identified_plant().sensor.force_noise_rms_n.value
    # By the answer to one tick of force: the noise is that of the bounded gains.
    problem = today.problem
    plants = [problem.plant(each) for each in today.active.scenarios]
    plants += [each.in_contact_with(FREE_SPACE) for each in plants]
    before, after = (float(np.max(speed_rms(plants, law_of(each), problem.sample_time_s))) for each in (today, noise))
    assert after <= before * (1.0 + 1e-3)
    assert limit.max_speed_rms_m_s == pytest.approx(before * (limit.force_noise_rms_n or 0.0), rel=1e-2)


def test_where_nothing_is_found_the_four_gains_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object, **_options: object) -> SearchResult:
        raise InfeasibleError("nothing")

    monkeypatch.setattr(structure_module, "solve_design", refuse)
    found, choice = choose_structure(plain(), "biquad", HAND, seed=0)
    assert found is plain()
    assert choice.taken == "gains"
    message = choice.message("x", plain().problem)
    assert "no design with a biquad too. Taken: the four gains in their bounds, the only design" in message


def test_what_saves_less_than_its_price_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = SimpleNamespace(asked=lambda: {"held_by_hand": None})
    hardly = SimpleNamespace(
        evaluation=SimpleNamespace(cost=plain().evaluation.cost * (1.0 - 0.5 * PRICE)),
        problem=SimpleNamespace(requirements=asked, controller=plain().problem.controller),
        design=plain().design,
    )
    monkeypatch.setattr(structure_module, "solve_design", lambda *_args, **_options: hardly)
    found, choice = choose_structure(plain(), "noise", HAND, seed=0)
    assert found is plain()
    assert choice.taken == "gains"


def test_the_noise_in_the_place_of_bounds_is_proposed_where_it_was_not_searched() -> None:
    active = [SimpleNamespace(name="lower bound of mass", price=1.0)]
    reports, searches = {"x": SimpleNamespace(active=active)}, {"x": plain()}
    found: Any = SimpleNamespace(noise_limitable={"x"}, optimality_reports=reports, searches=searches)
    (line,) = noise_lines(found, "x")
    assert "--structure noise" in line
    found.noise_limitable = frozenset()
    assert not list(noise_lines(found, "x"))


def test_elsewhere_a_structure_is_refused(tmp_path: Path) -> None:
    spec = ProblemSpec(structure="biquad")
    with pytest.raises(UsageError, match="structure: biquad is searched by optimize"):
        build_problems(identified_plant(), spec)
    request = FrontRequest()
    writer = FrontWriter(request, tmp_path / "controller.yaml")
    with pytest.raises(UsageError, match="leave --structure biquad out"):
        writer.check(spec)
    for each in (None, "gains", "noise"):
        writer.check(replace(spec, structure=each))
    with pytest.raises(UsageError, match="crisp runs another law"):
        specs_for(TARGETS["crisp"], spec)


def test_the_explorers_sliders_move_a_biquad() -> None:
    problem = limited_problem(papers_cell(), 3e-3, has_biquad=True)
    titles = [each.title for each in build_gain_sliders(problem, "x")][-4:]
    zero, damping, pole, _ = titles
    assert (zero, damping, pole) == ("τ_z biquad zero [ms]", "ζ_z damping of the zero", "τ_p biquad pole [ms]")


def test_a_design_with_a_biquad_is_proved_written_loaded_and_read_again(tmp_path: Path) -> None:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    proof = ProofOptions(further_s=0.0)
    found = optimize(plant, replace(FAST_SPEC, structure="biquad"), seed=1, proof=proof, replays=False)
    today = fast_optimized().searches["x"].evaluation.cost
    assert found.searches["x"].evaluation.cost < 0.97 * today
    path = tmp_path / "controller.yaml"
    write_controller(path, found.controller)
    controller = read_controller(path).controller
    law = admittance_controller(controller, "x")
    assert law.has_biquad
    assert any("Taken: the biquad" in note for note in controller.provenance["notes"])
    biquad = controller.axes["x"].biquad
    assert biquad is not None
    assert f"biquad: {biquad.describe()}" in repr(load(path))
    # The runtime's difference equation is that of the file.
    blocks = read_law(path).axes[0].blocks
    assert blocks[6, 0] == pytest.approx(_acting_at_once(law), rel=1e-12)


def _acting_at_once(law: AdmittanceController) -> float:
    """Return N at s = 2/h: what of the force passes the biquad at once."""
    s = 2.0 / H
    above = 1.0 + 2.0 * law.biquad_zero_damping_ratio * law.biquad_zero_s * s + (law.biquad_zero_s * s) ** 2
    below = 1.0 + 2.0 * law.biquad_pole_damping_ratio * law.biquad_pole_s * s + (law.biquad_pole_s * s) ** 2
    return above / below


def test_a_structure_is_one_of_those_that_there_are() -> None:
    for each in get_args(Structure):
        assert ProblemSpec(structure=each).structure == each
    with pytest.raises(ParameterError, match="structure must be one of gains, noise, biquad"):
        ProblemSpec(structure=cast(Any, "other"))
