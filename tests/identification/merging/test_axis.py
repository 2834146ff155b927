"""One axis of several logs is one joint record: table, names of surfaces and covariance agree."""

from dataclasses import replace

import numpy as np
import pytest

from identification.given import Given
from identification.measured_response import FrequencyResponse, MeasuredResponse
from identification.merging.axis import estimate_of
from identification.merging.combine import NamedResult, combine_identified
from identification.payload.gravity import LOCAL_GRAVITY_STD
from identification.result import (
    ContactPhase,
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    LogPhase,
    PhaseKind,
    RobotEstimate,
    Status,
    Timeline,
)
from tests.identification.merging.test_combine import UNDECIDED, codes, combined, known, reported, vector


def recorded(values: dict[str, tuple[float, float]], correlation: float = 0.3) -> Identified:
    """Return a log with a joint record of K_s, B_s, B_p, M_p, omega, T_d and K_e, B_e, M_e of each surface in it."""
    names = tuple(values)
    found, std = np.array(list(values.values())).T
    matrix = np.outer(std, std) * (correlation + (1.0 - correlation) * np.eye(len(std)))
    record = Covariance(names=names, values=tuple(found.tolist()), matrix=tuple(map(tuple, matrix.tolist())))

    def one(symbol: str) -> Estimate:
        return known(*values[symbol]) if symbol in values else UNDECIDED

    def secant(name: str) -> Estimate:
        springs = [names.index("K_s"), names.index(f"{name}.K_e")]
        value = 1.0 / np.sum(1.0 / found[springs])
        slope = (value / found[springs]) ** 2
        return known(float(value), float(np.sqrt(slope @ matrix[np.ix_(springs, springs)] @ slope)))

    axis = reported().axes["x"]
    omega, omega_std = values["omega"]
    return replace(
        reported(),
        axes={
            "x": replace(
                axis,
                coupling=CouplingEstimate(stiffness_n_per_m=one("K_s"), damping_n_s_per_m=one("B_s")),
                drag_n_s_per_m=one("B_p"),
                mass_kg=one("M_p"),
                robot=RobotEstimate(
                    numerator=vector(omega, std=omega_std),
                    denominator=vector(1.0, omega, std=omega_std),
                    delay_s=one("T_d"),
                    bandwidth_hz=known(omega / (2.0 * np.pi), omega_std / (2.0 * np.pi)),
                ),
                environments=tuple(
                    EnvironmentEstimate(
                        name=name,
                        stiffness_n_per_m=one(f"{name}.K_e"),
                        secant_stiffness_n_per_m=secant(name),
                        damping_n_s_per_m=one(f"{name}.B_e"),
                        mass_kg=one(f"{name}.M_e"),
                        contacts=2,
                        peak_force_n=(40.0, 41.0),
                    )
                    for name in ("x1", "x2")
                    if f"{name}.K_e" in names
                ),
                covariance=record,
            )
        },
    )


PLANT = {
    "K_s": (3e5, 3e3), "B_s": (150.0, 5.0), "B_p": (330.0, 5.0), "M_p": (16.2, 0.05), "omega": (20.0, 0.2),
    "T_d": (2.4e-3, 1e-5),
}  # fmt: skip
SOFT, HARD = (1.2e5, 2e3), (4e5, 8e3)


def with_surfaces(*stiffness: tuple[float, float], **others: tuple[float, float]) -> Identified:
    walls: dict[str, tuple[float, float]] = {}
    for i, each in enumerate(stiffness, 1):
        walls |= {f"x{i}.K_e": each, f"x{i}.B_e": (40.0, 2.0), f"x{i}.M_e": (1.0, 0.01)}
    return recorded({**PLANT, **others, **walls})


def check_one_record(result: Identified) -> None:
    """The law: table and covariance have the same values, deviations and surfaces."""
    for axis in result.axes.values():
        record = axis.covariance
        assert record is not None
        std = np.sqrt(np.diag(np.array(record.matrix)))
        at = {name: (value, each) for name, value, each in zip(record.names, record.values, std, strict=True)}
        surfaces = {surface.name for surface in axis.environments}
        assert {name.partition(".")[0] for name in record.names if "." in name} == surfaces
        for name in record.names:
            if name in ("omega", "zeta"):
                continue
            estimate = estimate_of(axis, name)
            if estimate is not None and estimate.value is not None:
                # The same numbers: nothing but rounding is between them.
                assert (estimate.value, estimate.std) == pytest.approx(at[name], rel=1e-9, abs=0.0)
        if len(axis.robot.denominator.value or ()) == 2 and "omega" in at:
            omega, omega_std = at["omega"]
            bandwidth = axis.robot.bandwidth_hz
            # The bandwidth is found by bisection and its slope by a difference of a millionth.
            assert bandwidth.value == pytest.approx(omega / (2.0 * np.pi), rel=1e-6)
            assert bandwidth.std == pytest.approx(omega_std / (2.0 * np.pi), rel=1e-4)
            assert axis.robot.denominator.value == pytest.approx((1.0, omega), rel=1e-9)


def test_table_and_covariance_are_one_record() -> None:
    found = combined(with_surfaces(SOFT), with_surfaces((1.22e5, 2e3), K_s=(3.02e5, 4e3), B_p=(336.0, 4.0)))
    check_one_record(found)
    assert codes(found, "error") == []


def test_robots_that_disagree_are_as_wide_in_the_confidence_set_as_in_the_table() -> None:
    """Bandwidths of 3.1 and 3.7 Hz, each known to 0.3 %: the optimizer's set is the covariance's."""
    found = combined(with_surfaces(omega=(19.5, 0.06)), with_surfaces(omega=(23.2, 0.07)))
    check_one_record(found)
    assert "robot's natural frequency" in next(f.message for f in found.findings if f.code == "logs-disagree")
    record = found.axes["x"].covariance
    assert record is not None
    place = record.names.index("omega")
    half = 0.5 * (23.2 - 19.5)
    # Both logs lie within one deviation of the mean, give or take what each knows.
    assert np.sqrt(record.matrix[place][place]) == pytest.approx(half, rel=0.01)
    assert found.axes["x"].robot.bandwidth_hz.value == pytest.approx(21.35 / (2.0 * np.pi), rel=0.01)


@pytest.mark.parametrize("first", [True, False])
def test_a_log_without_the_coupling_still_counts_for_the_robot(first: bool) -> None:
    """Without a joint fit the robot's numbers stand alone: they must come into the record, or table and record part."""
    whole = with_surfaces(SOFT)
    robot_only = replace(
        whole.axes["x"],
        coupling=CouplingEstimate(stiffness_n_per_m=UNDECIDED, damping_n_s_per_m=UNDECIDED),
        drag_n_s_per_m=UNDECIDED,
        mass_kg=None,
        environments=(),
        covariance=None,
        robot=replace(whole.axes["x"].robot, delay_s=known(2.41e-3, 1e-5)),
    )
    other = replace(whole, axes={"x": robot_only})
    found = combined(*((whole, other) if first else (other, whole)))
    check_one_record(found)
    delay = found.axes["x"].robot.delay_s
    assert delay.value == pytest.approx(2.405e-3, abs=2e-6)  # the record's own correlations pull a little
    assert found.axes["x"].environments[0].name == "x1"


def test_surfaces_keep_their_numbers_under_their_new_names() -> None:
    first, second = with_surfaces(HARD), with_surfaces(SOFT, HARD)
    found = combined(first, second)
    check_one_record(found)
    stiffness = {each.name: each.stiffness_n_per_m.value for each in found.axes["x"].environments}
    assert stiffness == pytest.approx({"x1": HARD[0], "x2": SOFT[0]}, rel=0.02)
    assert [each.contacts for each in found.axes["x"].environments] == [4, 2]


def test_measured_responses_are_joined() -> None:
    point = (2.0, 0.9, -0.2, 0.01, 0.01)
    response = FrequencyResponse(command_to_pose=MeasuredResponse(points=(point,)))
    log = with_surfaces(SOFT)
    measured = replace(log, axes={"x": replace(log.axes["x"], frequency_response=response)})
    merged = combined(measured, measured).axes["x"].frequency_response
    assert merged is not None
    assert merged.command_to_pose is not None
    assert merged.command_to_pose.points == ((2.0, 0.9, -0.2, 0.00707107, 0.00707107),)


def test_a_renamed_surface_is_renamed_in_the_time_line_and_the_messages() -> None:
    touch = ContactPhase(
        onset_s=1.0, peak_s=1.1, peak_force_n=40.0, hold_s=None, release_s=None, bounces_s=(), surface="x1",
        hand_suspected=None,
    )  # fmt: skip
    line = Timeline(phases=(LogPhase(kind=PhaseKind.CONTACT, start_s=1.0, stop_s=2.0, axis="x", contact=touch),))
    about = Finding(code="impact-spike", severity="warning", message="Surface x1: a blow.", advice="")
    second = replace(with_surfaces(SOFT, HARD), timelines=(line,), findings=(about,))
    found = combined(with_surfaces(HARD), second)
    (phase,) = found.timelines[0].phases
    assert phase.contact is not None
    assert phase.contact.surface == "x2"
    assert found.findings[0].message == "log1: Surface x2: a blow."


def test_a_prior_counts_once_however_many_logs_there_are() -> None:
    """Two logs that tell B_s as 110 ± 10 together, a prior of 85 ± 10: the product of two densities is 97.5 ± 7.07."""
    parts = [recorded({**PLANT, "B_s": (110.0, 10.0 * np.sqrt(2.0))}, 0.0) for _ in range(2)]
    prior = {"x.coupling_damping_n_s_per_m": Given(value=85.0, std=10.0)}
    found = combine_identified([NamedResult(name=f"{i}", result=part) for i, part in enumerate(parts)], prior)
    check_one_record(found)
    damping = found.axes["x"].coupling.damping_n_s_per_m
    assert (damping.value, damping.std) == pytest.approx((97.5, 10.0 / np.sqrt(2.0)), rel=1e-6)
    assert damping.status is Status.GIVEN
    assert [f.code for f in found.findings] == ["given-used"]
    weighed = combine_identified(
        [NamedResult(name=f"{i}", result=reported(known(16.2, 0.1))) for i in range(2)],
        {"mass_kg": Given(value=16.3, std=0.05)},
    ).payload.mass_kg
    shared = LOCAL_GRAVITY_STD * 16.2
    log = np.hypot(np.sqrt((0.1**2 - shared**2) / 2.0), shared)
    assert weighed.std == pytest.approx((log**-2.0 + 0.05**-2.0) ** -0.5, rel=1e-9)


def test_a_prior_moves_what_is_correlated_with_it() -> None:
    parts = [NamedResult(name=f"{i}", result=with_surfaces(SOFT)) for i in range(2)]
    alone = combine_identified(parts).axes["x"]
    found = combine_identified(parts, {"x.coupling_stiffness_n_per_m": Given(value=3.03e5, std=0.0)}).axes["x"]
    assert found.coupling.stiffness_n_per_m.value == 3.03e5
    assert found.coupling.stiffness_n_per_m.std == 0.0
    before, after = (axis.environments[0].stiffness_n_per_m for axis in (alone, found))
    assert after.std is not None
    assert before.std is not None
    assert after.std < before.std
    assert after.value != before.value
