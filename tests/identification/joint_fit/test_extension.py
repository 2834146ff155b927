"""A part that swings on the payload, and dry friction of the coupling: another simulation within what is stated."""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from identification.axis_findings import latency_findings, payload_findings
from identification.joint_fit import extension
from identification.joint_fit.data import JointData, usual_coupling
from identification.joint_fit.extended_fit import Score, explains_misfit
from identification.joint_fit.extended_payload import Extension, extended_force
from identification.joint_fit.extension import Extended, extend_payload, with_extension
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.free_motion import fit_free_motion, fit_robot, with_fitted_noise
from identification.joint_fit.latency import WrenchLatency, find_wrench_filter, fit_filter
from identification.joint_fit.model import COUPLING_NAMES, SURFACE_NAMES, robot_model
from identification.joint_fit.noise import Smoother
from identification.joint_fit.path import SensorDynamics, commanded_path, measured_path
from identification.joint_fit.payload_search import unseen_by_log
from identification.joint_fit.result import (
    JointFit,
    JointSurface,
    PayloadPart,
    with_robot_of_pose,
    with_unexplained,
)
from identification.joint_fit.rubbing_coupling import fine_path, rubbed_force
from identification.joint_fit.solve import Point, Problem
from identification.result import Status
from identification.signals.segments import Span
from identification.verdicts import TWO_SIDED
from problems.arrays import FloatArray
from tests.identification.joint_fit.fine_cell import (
    DAMPING,
    DRAG,
    FINER,
    MASS,
    PERIOD_S,
    STIFFNESS,
    Cell,
    sweep,
)


def logged(cell: Cell, seed: int = 3, noise_n: float = 0.1) -> JointData:
    rng, x = np.random.default_rng(seed), sweep()
    force, position = cell.run(x)[::FINER], x[::FINER]
    count, rest = len(position), round(2.0 / PERIOD_S)
    moving = (Span(start=rest, stop=count - rest),)
    return JointData(
        period_s=PERIOD_S,
        position_m=position + 5e-7 * rng.standard_normal(count),
        force_n=force + noise_n * rng.standard_normal(count),
        command=None,
        rests=(Span(start=0, stop=rest - 300), Span(start=count - rest + 500, stop=count)),
        moving=moving,
        free=moving,
        holds=(),
        coupling=usual_coupling(MASS),
        robot=None,
        mass_kg=MASS,
    )


@cache
def plain() -> JointFit:
    """Return the fit of one mass on one spring."""
    return identify_joint(logged(Cell()))


def deviations(fit: JointFit) -> FloatArray:
    return np.asarray((fit.values - np.array([STIFFNESS, DAMPING, DRAG, MASS])) / fit.std)


def test_a_part_that_swings_is_reported_and_leaves_the_coupling_right() -> None:
    """One mass on one spring is 6 % off here, 10 deviations."""
    fit = identify_joint(logged(Cell(share=0.1)))
    assert fit.part is not None
    assert fit.friction_n is None
    assert abs(fit.part.mass_share[0] - 0.1) < 2.0 * fit.part.mass_share[1] < 0.06
    assert abs(fit.part.frequency_hz[0] - 38.0) < 2.0 * fit.part.frequency_hz[1] < 3.0
    assert abs(fit.part.damping_ratio[0] - 0.03) < 2.0 * fit.part.damping_ratio[1]
    assert fit.values[0] == pytest.approx(STIFFNESS, rel=0.015)
    assert fit.std[0] < 0.05 * STIFFNESS
    assert np.all(np.abs(deviations(fit)) < 2.5)


def test_all_that_an_unseen_part_moves_is_taken_at_the_frequency_that_moves_the_spring_most() -> None:
    """Not that which moves B_s more and shows in the log, nor one below the payload's own frequency."""
    coupling = np.array([8e4, 100.0, 60.0, 12.5])
    of = SimpleNamespace(
        values=lambda _: coupling, in_log=np.array([True, False, False, True]), sizes=coupling, shared=4
    )

    def look(frequency_hz: float, std: float, follows: list[float]) -> tuple[Score, float]:
        return Score(fall=0.0, way=0.0, std=std / 0.001, follows=0.001 * np.array(follows)), frequency_hz

    slow = look(10.0, 1e3, [9.0, 9.0, 0.0, 0.0])
    seen, unknown = look(30.0, 0.05, [0.1, 2.0, 0.0, 0.0]), look(60.0, 1e3, [0.09, 0.4, -0.01, 0.02])
    found = unseen_by_log(cast(Any, of), cast(Any, SimpleNamespace(theta=np.zeros(4))), [slow, seen, unknown])
    np.testing.assert_allclose(found / coupling, 0.05 * np.array([0.09, 0.4, -0.01, 0.02]), rtol=1e-6, atol=1e-12)


def test_a_part_that_the_log_cannot_show_is_in_the_damping_and_the_mass_of_a_surface() -> None:
    """A payload that looks heavier by ε in contact: its decay is that of larger dampings, the mass may be M_e."""
    fit = plain()
    k_s, b_s, b_p, mass = fit.values.tolist()
    k_e, b_e, size = 0.5 * k_s, 40.0, len(fit.values) + 3
    touched = replace(
        fit,
        names=(*COUPLING_NAMES, *(f"environment1_{name}" for name in SURFACE_NAMES)),
        values=np.array([*fit.values, k_e, b_e, 0.1]),
        covariance=np.diag((1e-3 * np.array([*fit.values, k_e, b_e, 0.1])) ** 2),
        surfaces=(
            JointSurface(
                sign=1,
                first_parameter=len(fit.values),
                secant_n_per_m=k_e / 1.5,
                secant_std_n_per_m=1.0,
                onsets=(0,),
                peak_force_n=(40.0,),
            ),
        ),
    )
    found = Extended(
        move=np.zeros(4),
        covariance=np.zeros((4, 4)),
        latency=fit.latency,
        unseen=np.array([-0.01 * k_s, 0.0, 0.0, 0.0]),
        left_n=0.1,
        is_wider=False,
    )
    gained = np.diag(with_extension(touched, found).covariance - touched.covariance)
    expected = np.array([0.01 * k_s, *[0.0] * (size - 3), 0.015 * (b_s + b_p + b_e), 0.015 * mass])
    np.testing.assert_allclose(gained, expected**2, atol=1e-12)
    # Contacts do not hold one that is told either.
    part = PayloadPart(mass_share=(0.1, 0.03), frequency_hz=(38.0, 1.0), damping_ratio=(0.03, 0.02))
    told = replace(found, part=part, move=-found.unseen, unseen=np.zeros(4))
    gained = np.diag(with_extension(touched, told).covariance - touched.covariance)
    np.testing.assert_allclose(gained, [*[0.0] * (size - 2), *expected[-2:] ** 2], atol=1e-12)


def test_a_part_is_not_reported_beside_a_larger_misfit() -> None:
    """Thirty times the noise at rest shakes the force in motion, so what fits a part may be some of that."""
    data = logged(Cell(share=0.1))
    shaken, moving = data.force_n.copy(), data.moving[0].slice
    shaken[moving] += 3.0 * np.random.default_rng(5).standard_normal(len(shaken[moving]))
    fit = identify_joint(replace(data, force_n=shaken))
    assert fit.part is None
    assert fit.friction_n is None
    assert fit.unexplained[0] > 10.0


@cache
def behind_a_filter() -> tuple[Problem, Point, WrenchLatency]:
    """Return one mass on one spring behind a filter, fitted to a payload of which 18 % swing, behind one of 72 Hz."""
    data = logged(Cell(share=0.18, filter_hz=72.0), noise_n=0.04)
    base, start = fit_robot(data)
    problem, point = fit_free_motion(data, base, start[:-3])
    behind = replace(problem.signals, sensor_dynamics=SensorDynamics(time_constant_s=2.7e-3))
    problem, point, std = fit_filter(replace(problem, signals=behind), point)
    latency = WrenchLatency(
        seconds=problem.signals.sensor_dynamics.time_constant_s, std_s=std, applied_s=0.0, is_filter=True
    )
    return with_fitted_noise(problem, point), point, latency


@pytest.mark.parametrize("is_told", [True, False])
def test_a_filter_and_a_part_are_fitted_together(monkeypatch: pytest.MonkeyPatch, is_told: bool) -> None:
    """A filter takes the place of a part all but for what the noise hides; untold, the part is in its deviation."""
    problem, point, latency = behind_a_filter()
    known_s = 1.0 / (2.0 * np.pi * 72.0)
    monkeypatch.setattr(extension, "beyond_noise", lambda *_: 0.0)
    monkeypatch.setattr(extension, "explains_misfit", lambda *_: False)
    # A force that was shifted has no exact samples, and shows no part that the noise hides.
    latency = latency if is_told else replace(latency, applied_s=1e-3)
    found = extend_payload(problem, point, latency, quiet_rms_n=0.05, is_held=True)
    assert abs(found.latency.seconds - known_s) < 1.5 * found.latency.std_s
    if not is_told:
        assert found.part is None
        assert found.latency.std_s > 1.5 * latency.std_s
        return
    assert found.part is not None
    assert found.latency.seconds == pytest.approx(known_s, rel=0.01)
    assert abs(found.part.mass_share[0] - 0.18) < 2.0 * found.part.mass_share[1] < 0.12
    assert abs(found.part.frequency_hz[0] - 38.0) < 2.0 * found.part.frequency_hz[1] < 3.0


def test_a_filter_that_is_known_badly_stays_in_the_loop() -> None:
    late = WrenchLatency(seconds=2e-3, std_s=0.8e-3, applied_s=0.0, is_filter=True, evidence=400.0)
    said, (finding,) = find_wrench_filter({"z": late}, 0.0, PERIOD_S)
    assert said is not None
    assert said.corner_hz is not None
    assert (said.corner_hz.status, finding.severity) == (Status.WEAK, "warning")


def test_a_filter_is_known_less_where_nothing_explains_what_is_left() -> None:
    late = WrenchLatency(seconds=2e-3, std_s=1e-4, applied_s=0.0, is_filter=True)
    fit = replace(plain(), latency=late)
    assert with_unexplained(fit, 0.2, 0.1, 0.1).latency.std_s == 1e-4
    assert with_unexplained(fit, 0.7, 0.1, 0.1).latency.std_s == pytest.approx(7e-4)
    delay = replace(late, is_filter=False, evidence=-50.0)
    left, explained = (with_unexplained(replace(fit, latency=delay), left, 0.1, 0.1).latency for left in (0.7, 0.1))
    assert left.std_s == 1e-4
    # Nor is a delay told from a filter there.
    for latency, status in ((explained, Status.IDENTIFIED), (left, Status.WEAK)):
        found, (about,) = find_wrench_filter({"z": latency}, 0.0, 1e-3)
        assert found is not None
        assert found.delay_s is not None
        assert found.delay_s.status is status
        assert ("so it may be a low-pass" in about.message) is (status is Status.WEAK)


def test_friction_in_the_coupling_is_reported_and_widens_what_it_moves() -> None:
    fit = identify_joint(logged(Cell(friction_n=1.5)))
    assert fit.friction_n is not None
    assert abs(fit.friction_n[0] - 1.5) < 2.0 * fit.friction_n[1] < 0.8
    assert fit.values[0] == pytest.approx(STIFFNESS, rel=0.01)
    assert np.all(np.abs(deviations(fit)) < 2.5)


def test_one_mass_on_one_spring_stays_as_it_is() -> None:
    fit = plain()
    assert fit.part is None
    assert fit.friction_n is None
    assert fit.std[0] < 0.01 * STIFFNESS
    assert np.all(np.abs(deviations(fit)) < 2.5)
    assert fit.unexplained == (0.0, 0.0)


def test_the_extended_force_is_that_of_fine_steps() -> None:
    """Within what the cubic between the samples and the steps of 25 µs leave."""
    cell, x = Cell(share=0.15, friction_n=1.0), sweep()
    path = measured_path(x[::FINER], Smoother(taps=np.pad([1.0], 3)))
    extension = Extension(mass_share=0.15, frequency_hz=38.0, damping_ratio=0.03, friction_n=1.0)
    coupling = np.array([STIFFNESS, DAMPING, DRAG, MASS])
    used = slice(1500, len(x) // FINER - 1500)
    fine = fine_path(path, used, PERIOD_S)
    force = rubbed_force(coupling, extension, np.zeros(5), fine, PERIOD_S)[:: fine.count]
    expected = cell.run(x)[::FINER][used]
    assert float(np.std(force - expected)) < 0.05 * float(np.std(expected))


@pytest.mark.parametrize("robot", [None, (40.0, 3.7e-3), (40.0, 0.9, 3.7e-3), (40.0, 4e-3)])
def test_without_friction_short_steps_are_those_of_a_sample(robot: tuple[float, ...] | None) -> None:
    """A path without a command, and robots of one and two poles whose command comes within a sample and at its end."""
    x, extension = sweep()[::FINER], Extension(mass_share=0.15, frequency_hz=38.0, damping_ratio=0.03)
    smoother, used = Smoother(taps=np.pad([1.0], 3)), slice(1500, 9000)
    if robot is None:
        path = measured_path(x, smoother)
    else:
        path = commanded_path(np.array(robot), x, 0.9 * x, smoother, PERIOD_S)
    coupling, own = np.array([STIFFNESS, DAMPING, DRAG, MASS]), np.array([1.0, 2.0, 0.5, -1.0, 0.7])
    fine = fine_path(path, used, PERIOD_S)
    force = rubbed_force(coupling, extension, own, fine, PERIOD_S)[:: fine.count]
    expected = extended_force(coupling, extension, own, path, used, PERIOD_S)
    np.testing.assert_allclose(force, expected, atol=1e-8 * float(np.max(np.abs(expected))))


@pytest.mark.parametrize(("prompt", "stopping_s"), [(1.0, 0.0), (1.0, 2e-3), (0.6, 2e-3), (0.0, 5e-4)])
def test_friction_that_is_never_overcome_lets_the_slip_go_as_its_law_says(prompt: float, stopping_s: float) -> None:
    """dw/dt = (1 − κ) a − w/τ under a steady pull: w goes to (1 − κ) a τ, and to 0 where friction is Coulomb's."""
    count, speed = 400, 0.03
    path = measured_path(
        np.linspace(0.0, speed * PERIOD_S * count, count, endpoint=False), Smoother(taps=np.pad([1.0], 3))
    )
    extension = Extension(friction_n=1e6, prompt=prompt, stopping_s=stopping_s)
    drag = 200.0
    # A spring that hardly pulls: what accelerates the slip is the drag.
    coupling = np.array([1e-3, 0.0, drag, MASS])
    fine = fine_path(path, slice(100, 300), PERIOD_S)
    force = rubbed_force(coupling, extension, np.zeros(3), fine, PERIOD_S)
    # The payload follows at all but the slip: F balances the drag.
    slip = -(1.0 - prompt) * stopping_s * drag * speed / MASS
    assert force[-1] == pytest.approx(-drag * (speed + slip), rel=1e-3)


@pytest.mark.parametrize(("both", "spread"), [(True, 0.01), (False, 0.6)])
def test_friction_has_no_value_beside_a_part_or_a_coupling_without_one(both: bool, spread: float) -> None:
    fit = plain()
    size = len(fit.values)
    covariance = np.zeros((size, size))
    covariance[0, 0] = (spread * STIFFNESS) ** 2
    part = PayloadPart(mass_share=(0.1, 0.03), frequency_hz=(38.0, 1.0), damping_ratio=(0.03, 0.02))
    found = Extended(
        move=np.zeros(size),
        covariance=covariance,
        latency=fit.latency,
        part=part if both else None,
        friction_n=(0.23, 0.05),
        unseen=np.zeros(size),
        left_n=0.1,
        is_wider=True,
    )
    reported = with_extension(fit, found)
    assert (reported.part, reported.friction_n) == (None, None)
    assert [each.code for each in payload_findings("z", reported)] == ["payload-unclear"]


@pytest.mark.parametrize(
    ("seconds", "shifted_s", "codes"),
    [
        (-1.3e-4, 0.0, []),
        (-2.9e-4, 0.0, ["wrench-lag"]),
        (-2.9e-4, 2.6e-4, ["clocks-agree"]),
        (-2.9e-4, 9e-4, ["wrench-lag"]),
    ],
)
def test_a_latency_is_reported_beyond_four_deviations_of_what_the_log_had(
    seconds: float, shifted_s: float, codes: list[str]
) -> None:
    """What the turning weight had shown, and the axes put back, was none."""
    late = WrenchLatency(seconds=seconds, std_s=3.5e-5, applied_s=seconds)
    assert [each.code for each in latency_findings("z", replace(plain(), latency=late), shifted_s)] == codes


def test_where_the_force_shows_no_robot_it_is_that_of_command_and_pose() -> None:
    names = (*COUPLING_NAMES, "robot_frequency_rad_per_s", "delay_s")
    vague = replace(
        plain(),
        names=names,
        values=np.array([STIFFNESS, DAMPING, DRAG, MASS, 24.0, 2e-3]),
        covariance=np.diag([1.0, 1.0, 1.0, 1.0, 4.0, 1e-6]),
        robot=robot_model(np.array([24.0, 2e-3])),
    )
    pose, spread = np.array([25.0, 2.4e-3]), np.diag([1e-4, 1e-10])
    known = with_robot_of_pose(vague, pose, spread)
    np.testing.assert_array_equal(known.values[4:], pose)
    np.testing.assert_array_equal(known.covariance[4:, 4:], spread)
    assert known.robot is not None
    assert known.robot.delay_s == 2.4e-3
    assert with_robot_of_pose(known, pose, 9.0 * spread) is known


@pytest.mark.parametrize("explains", [True, False])
def test_deviations_are_those_of_a_fit_that_explains_the_misfit_and_else_wider(explains: bool) -> None:
    fit, size, wide = plain(), len(plain().values), ((0, 0.5, 0.6), (1, 0.7, 1.0), (2, 1.0, 3.0))
    fit = replace(fit, ci95={fit.names[i]: (low * fit.values[i], high * fit.values[i]) for i, low, high in wide})
    found = Extended(
        move=np.zeros(size),
        covariance=np.diag((1e-5 * fit.values) ** 2),
        latency=fit.latency,
        explains=explains,
        unseen=np.zeros(size),
        left_n=0.1,
        is_wider=True,
    )
    expected = found.covariance if explains else fit.covariance + found.covariance
    np.testing.assert_allclose(with_extension(fit, found).covariance, expected, atol=1e-9 * np.max(expected))
    for i, low, high in wide:
        ends = 1.0 + np.array([-1.0, 1.0]) * TWO_SIDED * np.sqrt(expected[i, i]) / fit.values[i]
        ends = ends if explains else np.array([min(low, ends[0]), max(high, ends[1])])
        np.testing.assert_allclose(with_extension(fit, found).ci95[fit.names[i]], ends * fit.values[i], rtol=1e-9)


def test_a_robot_that_gives_way_leaves_the_joint_covariance() -> None:
    """Nothing is reported of the payload then, so no other fit takes the place of the joint one."""
    data = logged(Cell())
    problem, start = fit_robot(data)
    problem, point = fit_free_motion(data, problem, start[:-3])
    signals = replace(problem.signals, yielded_stds=(np.full((len(data.position_m), 4), 1e-9),))
    problem = replace(problem, signals=signals)
    found = extend_payload(problem, point, plain().latency, quiet_rms_n=0.1, is_held=True)
    assert found.is_wider
    assert not found.explains
    assert (found.part, found.friction_n) == (None, None)


@pytest.mark.parametrize("part_hz", [60.0, 80.0, 110.0])
def test_a_part_above_the_sweep_looks_like_a_softer_spring_and_is_in_the_deviations(part_hz: float) -> None:
    """K_s is off by the share times (ω_0/ω_2)² at least, in a sweep to 55 Hz that shows no part."""
    fit = identify_joint(logged(Cell(share=0.1, part_hz=part_hz)))
    assert fit.part is None
    softer = 0.1 * STIFFNESS / MASS / (2.0 * np.pi * part_hz) ** 2
    assert fit.values[0] < (1.0 - 0.9 * softer) * STIFFNESS
    assert np.all(np.abs(deviations(fit)) < 2.0)
    assert fit.std[0] < 0.04 * STIFFNESS


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """What two candidates leave: noise, and a swing of some size that the larger one explains."""

    swing_n: float
    quiet_rms_n: float = 1.0
    is_held: bool = True

    @property
    def problem(self) -> SimpleNamespace:
        return SimpleNamespace(signals=None)

    def errors(self, theta: FloatArray, _own: object, _kind: object) -> tuple[FloatArray, ...]:
        at = np.arange(4000)
        noise = np.sqrt(2.0) * np.cos(2.1 * at)  # RMS 1
        return (noise + theta[0] * self.swing_n * np.sin(0.3 * at),)


@pytest.mark.parametrize(("swing_n", "explains"), [(0.0, False), (0.05, False), (0.2, False), (0.6, True)])
def test_a_misfit_that_is_no_more_than_noise_may_make_shows_no_part(swing_n: float, explains: bool) -> None:
    """Of 4000 samples a mean of squares is known to 2 %, so that of 1 N rms three deviations are 0.1 N²."""
    more, less = (SimpleNamespace(theta=np.array([left]), own=(), kind=None) for left in (0.0, 1.0))
    assert explains_misfit(cast(Any, Misfit(swing_n=swing_n)), cast(Any, more), cast(Any, less)) is explains
