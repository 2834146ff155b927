"""What any linear controller could do: affine forces, the controller of a response, the force that none gets below."""

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import InfeasibleError
from autotune.formats.controller import write_controller
from autotune.validation.certified_requirements import certified_problem_requirements
from benchmarks.tuning_problems import paper_cell
from problems.contact.linear_controller_contact import simulate_linear_contact, trace_linear_contact
from problems.contact.transient import Approach, SampledContact, build_sampled_contact, simulate_contact
from problems.design.problem import AdmittanceTarget, DesignProblem, NoiseLimit, Requirements
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Coupling, Environment, PayloadDynamics, Plant
from problems.model.response import free_space_admittance
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.noise import command_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum
from tests.autotune.tuning.cases import small_controller
from tests.conftest import RunCli

pytest.importorskip("cvxpy", reason="needs the extra `limit`")

from autotune.limit.judge import ReachedPeak
from autotune.limit.limit import NEGLECTED_AT_REST, NEGLECTED_BELOW, _meets, find_limit, hardest
from autotune.limit.programs import ConvexStep, EqualDemands, at_rest, lower_bound, noise_rows
from autotune.limit.signals import ContactSignals, contact_signals
from autotune.limit.youla import YoulaBasis

_H = 8e-4
_TICKS = 300
_APPROACH = Approach(force_n=30.0)
_PLANT = """\
format: autotune/plant
version: 1
mass: 16
coupling_stiffness: 3e5
drag: 630
robot: {bandwidth: 3.2, delay: 2.4e-3}
environment_stiffness: [5e5, 5e5]
sample_time: 8e-4
"""


def _pair(delay_s: float = 2.4e-3, coupling_damping: float = 0.0) -> SampledContact:
    plant = Plant(
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=delay_s),
        coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=coupling_damping),
        payload=PayloadDynamics(mass_kg=16.0, drag_n_s_per_m=630.0),
        environment=Environment(stiffness_n_per_m=2e5),
    )
    return build_sampled_contact(build_sampled_plant(plant, _H))


_LAW = AdmittanceController(mass_kg=8.0, damping_n_s_per_m=1300.0, lead_s=0.018, feedback_damping_s=0.01)

_SPECTRA = (
    RelativeSpectrum(frequency_hz=(5.0, 40.0, 80.0, 400.0), relative_density=(1.0, 1.0, 0.1, 1e-3)),
    RelativeSpectrum(frequency_hz=(20.0, 200.0, 500.0), relative_density=(0.3, 2.0, 5.0)),
)


def _signals(pair: SampledContact) -> ContactSignals:
    return contact_signals(pair, simulate_contact(pair, _LAW, _APPROACH).contact_speed_m_s, _TICKS)


def _basis(pair: SampledContact) -> YoulaBasis:
    return YoulaBasis(taps=40, decays=np.array([0.9, 0.99]), loop=build_loop(pair.contact, _LAW))


def _asked(
    pair: SampledContact, noise_factor: float = 1.0, modulus: float = 0.3, spectrum: RelativeSpectrum | None = None
) -> EqualDemands:
    noise = max(command_speed_gain(plant, _LAW, spectrum) for plant in (pair.contact, pair.free))
    return EqualDemands(
        modulus=modulus,
        min_m_s_per_n=None,
        band_rad_per_s=np.zeros(0),
        noise_m_s_per_n=noise_factor * noise,
        driving_force_n=30.0,
        at_contact=True,
        spectrum=spectrum,
    )


@pytest.mark.parametrize(("delay_s", "coupling_damping"), [(2.4e-3, 0.0), (2.0e-3, 150.0), (0.0, 80.0)])
def test_a_first_contact_is_the_answer_to_the_ramp_of_the_wall(delay_s: float, coupling_damping: float) -> None:
    """F_e and −F of the exact transient, ticks apart, come from Q and what the wall does to the plant alone."""
    pair = _pair(delay_s, coupling_damping)
    exact, found, basis = simulate_contact(pair, _LAW, _APPROACH), _signals(pair), _basis(pair)
    q = basis.pulses(_TICKS) @ basis.start()
    command = np.convolve(q, found.wall_force)[:_TICKS]
    pressed = found.wall_contact + np.convolve(found.contact_pulse, command)[:_TICKS]
    sensed = -found.steady_force_n - found.wall_force + np.convolve(found.force_pulse, command)[:_TICKS]
    # Until the payload leaves, both are the same linear motion; rounding grows with some hundred ticks.
    stop = int(np.argmax(exact.contact_force_n[1:] <= 0.0)) or min(_TICKS, len(exact.time_s) - 1)
    assert pressed[:stop] == pytest.approx(exact.contact_force_n[:stop], abs=1e-6)
    # At the tick of the touch the sensor still reads the approach.
    assert sensed[1:stop] == pytest.approx(exact.sensor_force_n[1:stop], abs=1e-6)


@pytest.mark.parametrize("delay_s", [2.4e-3, 2.0e-3])
def test_the_controller_of_the_design_s_response_is_the_design(delay_s: float) -> None:
    pair = _pair(delay_s)
    basis, signals = _basis(pair), _signals(pair)
    law = basis.controller(basis.start(), signals.open, _H)
    for plant in (pair.contact, pair.free):
        assert spectral_radius(build_loop(plant, law)) == pytest.approx(
            max(spectral_radius(build_loop(plant, _LAW)), 0.99), abs=1e-6
        )
        assert command_speed_gain(plant, law) == pytest.approx(command_speed_gain(plant, _LAW), rel=1e-8)
    exact = simulate_contact(pair, _LAW, _APPROACH)
    found = simulate_linear_contact(pair, law, _APPROACH)
    assert found.contact_speed_m_s == pytest.approx(exact.contact_speed_m_s, rel=1e-8)
    # The linear law's contact is stepped in twentieths of a sample: the peak's curvature is all that is lost.
    assert found.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=1e-4)


def test_what_the_program_asks_of_the_design_is_what_the_exact_loop_says() -> None:
    pair = _pair()
    basis, signals = _basis(pair), _signals(pair)
    rows, values = at_rest(basis, signals, 30.0)
    assert rows @ basis.start() == pytest.approx(values, rel=1e-6)
    for loop, plant in enumerate((pair.contact, pair.free)):
        # Under a spectrum the exact loop's own sum over frequencies is that near.
        for spectrum, near in ((None, 1e-6), *((each, 1e-3) for each in _SPECTRA)):
            slope, offset = noise_rows(basis, (signals,), basis.start(), loop, _H, spectrum)
            rms = float(np.linalg.norm(slope @ basis.start() + offset))
            assert rms == pytest.approx(command_speed_gain(plant, _LAW, spectrum), rel=near)


@pytest.mark.parametrize("spectrum", [None, *_SPECTRA], ids=["white", "low", "high"])
def test_a_step_of_the_program_softens_the_contact_of_the_exact_loop(spectrum: RelativeSpectrum | None) -> None:
    pair = _pair()
    basis, signals, asked = _basis(pair), _signals(pair), _asked(pair, spectrum=spectrum)
    step = ConvexStep(basis, (signals,), asked)
    moved = step.solve(step.start(basis.start()))
    law = basis.controller(moved, signals.open, _H)
    found = simulate_linear_contact(pair, law, _APPROACH)
    exact = simulate_contact(pair, _LAW, _APPROACH)
    assert found.contact_speed_m_s == pytest.approx(exact.contact_speed_m_s, rel=1e-6)
    assert found.peak_contact_force_n < exact.peak_contact_force_n
    assert command_speed_gain(pair.contact, law, spectrum) <= asked.noise_m_s_per_n * 1.001
    # No linear controller gets below the bound, so neither does this one.
    assert lower_bound(signals, asked, 120).force_n <= found.peak_contact_force_n


@pytest.mark.parametrize("spectrum", [None, *_SPECTRA], ids=["white", "low", "high"])
@pytest.mark.parametrize(
    "law",
    [
        AdmittanceController(mass_kg=8.0, damping_n_s_per_m=1300.0, lead_s=0.018, feedback_damping_s=0.01),
        AdmittanceController(mass_kg=6.0, damping_n_s_per_m=1300.0, lead_s=0.022, feedback_damping_s=0.02),
        AdmittanceController(mass_kg=12.0, damping_n_s_per_m=1300.0, lead_s=0.012, feedback_damping_s=0.005),
    ],
)
def test_no_controller_of_the_same_speed_and_noise_is_below_the_bound(
    law: AdmittanceController, spectrum: RelativeSpectrum | None
) -> None:
    pair = _pair()
    noise = command_speed_gain(pair.contact, law, spectrum) / command_speed_gain(pair.contact, _LAW, spectrum)
    trace = simulate_contact(pair, law, _APPROACH)
    signals = contact_signals(pair, trace.contact_speed_m_s, _TICKS)
    # Its own noise and no modulus to speak of: the bound is of everything that could be done with as much.
    asked = _asked(pair, noise_factor=noise * 1.001, modulus=0.01, spectrum=spectrum)
    assert lower_bound(signals, asked, 100).force_n < trace.peak_contact_force_n


@pytest.mark.parametrize(
    ("changed", "is_met"),
    [
        ({}, True),
        ({"noise_m_s_per_n": 2e-4 * (1.0 + 1e-6)}, False),
        ({"modulus": 0.5 * (1.0 - 1e-6)}, False),
        ({"min_m_s_per_n": 6e-4 * (1.0 - 1e-6)}, False),
    ],
)
def test_what_has_just_what_is_asked_meets_it_and_a_millionth_less_does_not(
    changed: dict[str, float], is_met: bool
) -> None:
    asked = EqualDemands(
        modulus=0.5,
        min_m_s_per_n=6e-4,
        band_rad_per_s=np.array([1.0]),
        noise_m_s_per_n=2e-4,
        driving_force_n=30.0,
        at_contact=True,
    )
    equal = {"modulus": 0.5, "min_m_s_per_n": 6e-4, "noise_m_s_per_n": 2e-4}
    trace = simulate_contact(_pair(), _LAW, _APPROACH)
    found = ReachedPeak(peak_force_n=40.0, gain_db=6.0, phase_deg=30.0, delay_s=1e-3, trace=trace, **(equal | changed))
    assert _meets(found, asked, 1.0) == is_met
    # The modulus that Q itself shows counts as that of the controller.
    assert not _meets(found, asked, 1.0 - 1e-6)


def test_what_happens_before_the_command_can_answer_is_in_the_bound() -> None:
    """Without limits of noise and modulus the force of the first delayed ticks is left, which nothing can change."""
    pair = _pair()
    signals = _signals(pair)
    asked = _asked(pair, noise_factor=1e6, modulus=1e-3)
    late = pair.contact.chain_length
    assert late == 3
    # The force of a tick is answered a tick later at the earliest, and `late` ticks later the robot begins to move.
    untouched = float(np.max(signals.wall_contact[: late + 1]))
    assert lower_bound(signals, asked, 20).force_n >= untouched * (1.0 - 1e-4)


@pytest.mark.parametrize("target", [AdmittanceTarget(min_m_s_per_n=6.5e-4, band_hz=(0.1, 3.0)), None])
def test_the_admittance_of_the_design_is_the_least_of_the_band_that_is_asked(
    target: AdmittanceTarget | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without one it is that at 1 Hz, and nothing is asked of it; the noise is that of the law."""
    monkeypatch.setattr("autotune.limit.limit._attain", lambda *_: (None, None))
    problem = paper_cell((5e5, 5e5), (16.0, 16.0))
    problem = replace(problem, requirements=replace(problem.requirements, free_space_admittance=target))
    law = replace(_LAW, damping_n_s_per_m=1100.0, lead_s=0.02, mass_kg=5.0, feedback_damping_s=0.027)
    found = find_limit(problem, law, hardest(problem, law, problem.scenarios(2, 2), 1))
    free = build_sampled_plant(problem.plant(found.scenarios[0]).in_contact_with(FREE_SPACE), problem.sample_time_s)
    grid = 2.0 * np.pi * (np.geomspace(0.1, 3.0, 400) if target else np.array([1.0]))
    least = float(np.min(np.abs(free_space_admittance(free, law, grid))))
    assert found.design.min_m_s_per_n == pytest.approx(least, rel=1e-6)
    assert found.asked.min_m_s_per_n == (None if target is None else 6.5e-4)
    assert (len(found.asked.band_rad_per_s) > 0) is (target is not None)
    contact = build_sampled_plant(problem.plant(found.scenarios[0]), problem.sample_time_s)
    noise = max(command_speed_gain(plant, law) for plant in (free, contact))
    assert found.asked.noise_m_s_per_n == pytest.approx(noise, rel=1e-9)
    assert found.design.trace.driving_force_n == found.asked.driving_force_n
    if target is None:
        return
    # Where the noise is limited, as `optimize` does unasked, it is so often that limit.
    allowed = NoiseLimit(max_speed_rms_m_s=1e-4, force_noise_rms_n=0.02)
    quiet = replace(problem, requirements=replace(problem.requirements, command_noise=allowed))
    assert find_limit(quiet, law, found.scenarios, noise_factor=3.0).asked.noise_m_s_per_n == pytest.approx(0.015)
    twice = find_limit(problem, law, found.scenarios, noise_factor=2.0)
    assert twice.asked.noise_m_s_per_n == pytest.approx(2.0 * noise, rel=1e-9)
    assert twice.bound.force_n <= found.bound.force_n * (1.0 + 1e-6) <= found.design.peak_force_n * (1.0 + 1e-6)


def test_the_command_prints_design_reached_and_bound(
    run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Half the pulses: the law is the same, and reaches a little less.
    monkeypatch.setattr("autotune.limit.limit._TAPS", 75)
    (tmp_path / "plant.yaml").write_text(_PLANT, encoding="utf-8")
    problem = "format: autotune/problem\nversion: 1\nrequirements: {phase_margin_deg: 35}\n"
    (tmp_path / "problem.yaml").write_text(problem, encoding="utf-8")
    done = run_cli("limit", "plant.yaml", "--problem", "problem.yaml", "--json", "--plot", "limit.svg")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["axes"]["x"]
    design, attained, bound = found["design"], found["attained"], found["lower_bound"]["force_n"]
    assert bound < attained["peak_force_n"] < design["peak_force_n"]
    assert attained["modulus"] >= found["modulus_margin"] - 1e-12
    # Whoever stays m away from −1 keeps these too; between few frequencies a law of many ticks seems to keep less.
    assert attained["gain_db"] >= 20.0 * np.log10(1.0 + attained["modulus"]) - 0.1
    assert attained["phase_deg"] >= np.degrees(2.0 * np.arcsin(0.5 * attained["modulus"])) - 0.1
    assert attained["noise_m_s_per_n"] <= found["noise_m_s_per_n"] * (1.0 + 1e-9)
    assert attained["min_m_s_per_n"] >= 7e-4 - 1e-12
    # The design keeps the phase that is asked, and what gets nearer spends it.
    assert design["phase_deg"] >= 35.0 > attained["phase_deg"]
    # 6 dB are asked by default.
    assert found["missed"] == {
        "gain_margin_db": {"asked": 6.0, "attained": attained["gain_db"]},
        "phase_margin_deg": {"asked": 35.0, "attained": attained["phase_deg"]},
    }
    assert (tmp_path / "limit.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert found["neglected"]["lower_bound"] == NEGLECTED_BELOW


def test_no_controller_gets_below_the_force_that_presses_on_at_rest(run_cli: RunCli, tmp_path: Path) -> None:
    """On a soft surface the design's peak is F^d itself, so that nothing better is looked for."""
    soft = _PLANT.replace("[5e5, 5e5]", "[3e3, 3e3]")
    (tmp_path / "plant.yaml").write_text(soft, encoding="utf-8")
    done = run_cli("limit", "plant.yaml")
    assert done.returncode == 0, done.stderr
    assert "axis x: 30 N; no controller gets below 30 N, the F^d that presses on when it has stopped\n" in done.stdout
    assert f"neglected by the force that none gets below: {NEGLECTED_AT_REST}" in done.stdout


def test_a_controller_beside_a_plant_that_it_is_not_certified_for_is_looked_at_and_said(
    run_cli: RunCli, tmp_path: Path
) -> None:
    soft = _PLANT.replace("[5e5, 5e5]", "[3e3, 3e3]")
    for name, text in (("a.yaml", soft), ("b.yaml", soft.replace("mass: 16", "mass: 12"))):
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert run_cli("optimize", "a.yaml", "--structure", "gains", "--proof-budget", "0").returncode == 0
    said = "the controller is not certified for the contact looked at, "
    for name, where in (("a.yaml", ""), ("b.yaml", f"Axis x: {said}K_e 3 N/mm, M_p 12 kg.")):
        done = run_cli("limit", name, "--controller", "controller.yaml")
        assert done.returncode == 0, done.stderr
        assert where in done.stderr
        assert (said in done.stderr) == bool(where)


def test_a_controller_is_looked_at_in_the_contacts_of_its_file_and_under_what_it_was_made_for(
    run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hardest contact of a file need not be at an end of the ranges; who asks of a plant need not ask again."""
    file = small_controller()
    between = replace(file.predicted["x"].scenarios[0], environment_stiffness_n_per_m=1.13e5)
    outside = replace(between, environment_stiffness_n_per_m=3e5)
    predicted = replace(file.predicted["x"], scenarios=(between, outside))
    write_controller(tmp_path / "controller.yaml", replace(file, predicted={"x": predicted}))
    plant = _PLANT.replace("[5e5, 5e5]", "[1e5, 1.2e5]")
    (tmp_path / "plant.yaml").write_text(plant, encoding="utf-8")
    seen: list[tuple[DesignProblem, set[float]]] = []

    def looked_at(
        problem: DesignProblem, _law: object, scenarios: Iterable[Scenario], *_: object, **__: object
    ) -> None:
        seen.append((problem, {each.environment_stiffness_n_per_m for each in scenarios}))
        raise InfeasibleError("Enough was seen.")

    monkeypatch.setattr("autotune.limit.limit.hardest", looked_at)
    for words in (("controller.yaml",), ("plant.yaml", "--controller", "controller.yaml")):
        assert run_cli("limit", *words).returncode == 5
    own = certified_problem_requirements(file, "x")
    assert own != Requirements()
    for problem, stiffnesses in seen:
        assert problem.requirements == own
        assert problem.approach == file.certificate.domain["x"].approach
        assert {1e5, 1.13e5, 1.2e5} <= stiffnesses
        assert 3e5 not in stiffnesses
    (tmp_path / "problem.yaml").write_text("requirements: {modulus_margin: 0.31}\n", encoding="utf-8")
    asked = ("plant.yaml", "--controller", "controller.yaml", "--problem", "problem.yaml")
    assert run_cli("limit", *asked).returncode == 5
    assert seen[-1][0].requirements.modulus_margin == 0.31


@pytest.mark.parametrize("delay_s", [2.4e-3, 0.0])
def test_every_linear_law_ends_at_the_force_of_the_bound(delay_s: float) -> None:
    """A law that approaches under F^d integrates, so that it stops at that force alone, whatever its order."""
    pair = _pair(delay_s)
    basis, signals = _basis(pair), _signals(pair)
    law = basis.controller(basis.start(), signals.open, _H)
    for each in (simulate_contact(pair, _LAW, _APPROACH), trace_linear_contact(pair, law, _APPROACH)):
        assert each.contact_force_n[-1] == pytest.approx(30.0, rel=0.02)
        assert each.peak_contact_force_n >= 30.0


def test_optimize_says_and_draws_how_far_its_design_is(
    run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("autotune.limit.limit._TAPS", 75)
    (tmp_path / "plant.yaml").write_text(_PLANT, encoding="utf-8")
    done = run_cli("optimize", "plant.yaml", "--limit", "--report", "r.html", "--proof-budget", "0")
    assert done.returncode == 0, done.stderr
    (said,) = (line.strip() for line in done.stdout.splitlines() if "no linear controller of this noise" in line)
    missed = r"a gain margin of 3\.\d+ where 6 dB is asked and a phase margin of 29\.\d+ where 30° is asked"
    assert re.fullmatch(rf".* N is reached, with {missed}", said)
    (traded,) = (line.strip() for line in done.stdout.splitlines() if "times the noise of the command" in line)
    peaks = [float(each) for each in re.findall(r"([\d.]+) N with", traded)]
    # Less is asked the more noise is allowed; at the noise of the design the bounds are wider.
    assert len(peaks) == 4
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[1] <= float(said.split()[0]) * 1.001
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert f"Axis x: {said}." in page
    assert 'id="x-limit' in page
    # From the file alone the same is said with how to get it.
    done = run_cli("report", "controller.yaml", "--samples", "0")
    assert done.returncode == 0, done.stderr
    assert "the force that none gets below: optimize --limit" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (("--for", "ros2_control"), "--limit looks at our own law, which ros2_control does not run"),
        (("--schedule", "payload=16"), "--limit is about one controller"),
    ],
)
def test_the_limit_of_another_law_or_of_many_is_refused(
    run_cli: RunCli, tmp_path: Path, other: tuple[str, str], message: str
) -> None:
    (tmp_path / "plant.yaml").write_text(_PLANT, encoding="utf-8")
    done = run_cli("optimize", "plant.yaml", "--limit", *other)
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr


def test_an_axis_that_is_not_there_and_a_wrong_picture_are_usage(run_cli: RunCli, tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text(_PLANT, encoding="utf-8")
    done = run_cli("limit", "plant.yaml", "--plot", "limit.pdf")
    assert done.returncode == 2
    assert ".svg or .png" in done.stderr
    assert not (tmp_path / "limit.pdf").exists()
