"""What the driver says of logs that lack something: a sentence that helps, and never a made-up number."""

import dataclasses
import weakref
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.advice import advise
from identification.errors import EstimateError, LogError
from identification.identify import identify_cell, identify_with_evidence
from identification.result import Estimate, Finding, Identified, Status, TouchCause, VectorEstimate
from identification.signals.aligned import AlignedLog, align
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import BoolArray, ComplexArray, FloatArray
from tests.autotune.simulation.runs import demo_run

PROGRAM = Program(pose_count=6, jogging_s=0.0, sweep_s=7.0, contact_count=3)


def simulated(program: Program) -> Recording:
    return simulate_cell(SimulatedCell(), program, seed=5).recording


def finding(found: Identified, code: str) -> Finding:
    (only,) = [f for f in found.findings if f.code == code]
    return only


def estimates(value: Any) -> Iterator[Estimate | VectorEstimate]:
    """Every estimate in the tree."""
    if isinstance(value, Estimate | VectorEstimate):
        yield value
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from estimates(part)
    elif isinstance(value, tuple):
        for part in value:
            yield from estimates(part)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from estimates(getattr(value, field.name))


def check_honesty(found: Identified) -> None:
    """No value where nothing is known, a finite value with a finite deviation elsewhere."""
    seen = list(estimates(found))
    assert len(seen) > 6
    for estimate in seen:
        if estimate.status is Status.UNIDENTIFIABLE:
            assert estimate.value is None
            assert estimate.std is None
            assert estimate.note
        else:
            assert estimate.value is not None
            assert estimate.std is not None
            assert np.all(np.isfinite(estimate.value))
            assert np.all(np.isfinite(estimate.std))


def sliced(signal: PoseSignal | WrenchSignal, keep: BoolArray | slice) -> Any:
    arrays = {
        field.name: getattr(signal, field.name)[keep]
        for field in dataclasses.fields(signal)
        if isinstance(getattr(signal, field.name), np.ndarray)
    }
    return dataclasses.replace(signal, **arrays)


@pytest.fixture(scope="module")
def demo_recording() -> Recording:
    """The demo cell through a shorter program."""
    return simulated(PROGRAM)


@pytest.fixture(scope="module")
def complete(demo_recording: Recording) -> Identified:
    return identify_cell(demo_recording)


def test_a_complete_log_has_no_error_and_no_empty_number(complete: Identified) -> None:
    check_honesty(complete)
    assert [f for f in complete.findings if f.severity == "error"] == []


def test_measured_responses_are_those_of_the_cell() -> None:
    truth, measured = SimulatedCell(), identify_cell(demo_run().recording).axes["x"].frequency_response
    assert measured is not None
    pose, force, felt = measured.command_to_pose, measured.command_to_force, measured.pose_to_force
    assert pose is not None
    assert force is not None
    assert felt is not None

    def closed_forms(frequency_hz: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        s = 2j * np.pi * frequency_hz
        spring = truth.coupling.damping_n_s_per_m * s + truth.coupling.stiffness_n_per_m
        payload = (truth.payload_mass_kg * s + truth.drag_n_s_per_m) * s
        return 20.0 / (s + 20.0) * np.exp(-s * 2.4e-3), -spring * payload / (spring + payload)

    for each, place in ((pose, 0), (felt, 1), (force, None)):
        forms = closed_forms(each.frequency_hz)
        true = forms[0] * forms[1] if place is None else forms[place]
        # The sampled responses fold by less than 1 % of themselves up to 40 Hz, a thirtieth of the rate.
        inside = np.abs(each.values - true) <= each.radius_95 + 0.01 * np.abs(true)
        assert len(inside) > 30
        assert np.mean(inside) > 0.93
        assert np.median(each.radius_95 / np.abs(true)) < 0.01


def test_a_log_without_torques_shows_everything_along_straight_axes(
    demo_recording: Recording, complete: Identified
) -> None:
    wrench = demo_recording.wrench
    forces = dataclasses.replace(
        wrench, torque_n_m=np.full_like(wrench.torque_n_m, np.nan), measured_axes=("x", "y", "z")
    )
    found = identify_cell(dataclasses.replace(demo_recording, wrench=forces))
    assert found.payload.mass_kg.value == pytest.approx(complete.payload.mass_kg.value, rel=1e-3)
    assert found.payload.com_m.value is None
    assert found.payload.inertia_kg_m2 is None
    assert found.sensor.torque_noise_rms_n_m is None
    assert found.sensor.noise is not None
    assert found.sensor.noise.torque_n2_m2_per_hz == ()
    straight = {name: axis for name, axis in complete.axes.items() if name in "xyz"}
    assert list(found.axes) == list(straight)
    for name, axis in straight.items():
        stiffness = found.axes[name].coupling.stiffness_n_per_m
        assert stiffness.value == pytest.approx(axis.coupling.stiffness_n_per_m.value, rel=1e-2)
    codes = [(each.code, each.severity) for each in advise(found) if "centre of mass" in each.message]
    assert codes == [("unidentifiable", "error")]


def test_contacts_are_reported_as_left_out_of_gravity(complete: Identified) -> None:
    reported = finding(complete, "rests-with-contact")
    assert reported.severity == "info"
    assert "did not fit the payload's weight" in reported.message


def test_a_log_without_contact_says_so_and_has_no_environment() -> None:
    found = identify_cell(simulated(dataclasses.replace(PROGRAM, contact_count=0)))
    check_honesty(found)
    reported = finding(found, "no-contact")
    assert reported.severity == "error"
    assert "no contact" in reported.message
    assert "Record 3 or more contacts" in reported.advice
    assert found.axes["x"].environments == ()
    # The rest of the log is as good as ever.
    assert found.axes["x"].coupling.stiffness_n_per_m.value == pytest.approx(
        SimulatedCell().coupling.stiffness_n_per_m, rel=0.05
    )


def test_one_pose_is_not_enough_for_gravity() -> None:
    with pytest.raises(EstimateError, match=r"at least 4 clearly different tool orientations.*found 1; record 6 to 12"):
        identify_cell(simulated(Program(pose_count=1)))


def test_three_poses_are_not_enough_either() -> None:
    # Two tilted poses and the working orientation itself.
    with pytest.raises(EstimateError, match=r"found 3; record"):
        identify_cell(simulated(Program(pose_count=2)))


def test_a_log_without_free_motion_has_no_coupling() -> None:
    found = identify_cell(simulated(Program(jogging_s=0.0, sweep_s=0.0, contact_count=0)))
    check_honesty(found)
    assert found.axes == {}
    reported = finding(found, "no-travel")
    assert reported.severity == "error"
    assert "sweep" in reported.advice


def test_contacts_alone_do_not_show_the_coupling() -> None:
    found = identify_cell(simulated(dataclasses.replace(PROGRAM, sweep_s=0.0)))
    check_honesty(found)
    reported = finding(found, "coupling")
    assert reported.severity == "error"
    assert "record a commanded sweep" in reported.message
    axis = found.axes["x"]
    assert axis.coupling.stiffness_n_per_m.value is None
    assert axis.environments == ()


def test_a_log_without_command_has_no_robot(demo_recording: Recording, complete: Identified) -> None:
    found = identify_cell(dataclasses.replace(demo_recording, command=None))
    check_honesty(found)
    reported = finding(found, "no-command")
    assert reported.severity == "error"
    assert "--command-topic" in reported.advice
    robot = found.axes["x"].robot
    assert all(estimate.value is None for estimate in estimates(robot))
    assert found.sample_time_s.status is Status.WEAK
    # The same payload on the same spring, less sure without the robot's exact path.
    for with_command, without in zip(
        vars(complete.axes["x"].coupling).values(), vars(found.axes["x"].coupling).values(), strict=True
    ):
        assert abs(with_command.value - without.value) < 4.0 * without.std
        assert without.std > with_command.std
    assert {e.stiffness_n_per_m.status for e in found.axes["x"].environments} <= {Status.WEAK, Status.UNIDENTIFIABLE}


def test_a_command_from_another_time_has_no_robot(demo_recording: Recording) -> None:
    assert demo_recording.command is not None
    command = demo_recording.command
    late = dataclasses.replace(command, stamp_ns=command.stamp_ns + 10**12)
    found = identify_cell(dataclasses.replace(demo_recording, command=late))
    check_honesty(found)
    assert "both count on one clock" in finding(found, "robot").message
    assert found.axes["x"].robot.delay_s.value is None


def test_a_pose_that_echoes_the_command_is_no_robot(demo_recording: Recording) -> None:
    found = identify_cell(dataclasses.replace(demo_recording, command=demo_recording.pose))
    check_honesty(found)
    reported = finding(found, "robot")
    assert reported.severity == "error"
    assert "no echo of the command" in reported.message
    assert found.axes["x"].robot.denominator.value is None


def test_a_constant_offset_between_command_and_pose_does_not_matter(
    demo_recording: Recording, complete: Identified
) -> None:
    assert demo_recording.command is not None
    command = demo_recording.command
    moved = dataclasses.replace(command, position_m=command.position_m + np.array([1e-3, -2e-3, 5e-4]))
    found = identify_cell(dataclasses.replace(demo_recording, command=moved)).axes["x"].robot
    # Only the rounding of the shifted numbers differs.
    assert found.bandwidth_hz.value == pytest.approx(complete.axes["x"].robot.bandwidth_hz.value, rel=1e-6)


@pytest.mark.parametrize("shift_s", [-1000.0, 1000.0])
def test_wrench_and_pose_of_different_times_are_refused(demo_recording: Recording, shift_s: float) -> None:
    pose = demo_recording.pose
    other = dataclasses.replace(pose, stamp_ns=pose.stamp_ns + int(shift_s * 1e9))
    with pytest.raises(LogError, match=r"found 0\.000 s in common .* count on one clock"):
        identify_cell(dataclasses.replace(demo_recording, pose=other))


@pytest.mark.parametrize("which", ["wrench", "pose", "command"])
def test_a_hole_of_half_a_second_is_refused_with_its_place(demo_recording: Recording, which: str) -> None:
    signal = getattr(demo_recording, which)
    seconds = (signal.stamp_ns - signal.stamp_ns[0]) * 1e-9
    holed = sliced(signal, (seconds < 12.0) | (seconds > 12.5))
    with pytest.raises(LogError, match=rf"`{signal.topic}` has a gap of 0\.50\d s at 1[12]\.\d+ s.*record again"):
        identify_cell(dataclasses.replace(demo_recording, **{which: holed}))


def test_a_flipped_wrench_is_read_as_the_other_bodys(demo_recording: Recording, complete: Identified) -> None:
    """The weight shows that a sign is wrong, the forces of acceleration that it is the wrench's and not gravity's."""
    wrench = demo_recording.wrench
    flipped = dataclasses.replace(wrench, force_n=-wrench.force_n, torque_n_m=-wrench.torque_n_m)
    found = identify_cell(dataclasses.replace(demo_recording, wrench=flipped))
    assert "convention-found" in {finding.code for finding in found.findings}
    # The same numbers with the other sign, exactly.
    assert (found.payload.mass_kg, found.payload.com_m) == (complete.payload.mass_kg, complete.payload.com_m)
    # Sums of arrays that lie elsewhere in memory round elsewhere, which the descent carries on.
    for one, other in zip(estimates(found.axes), estimates(complete.axes), strict=True):
        assert one.status is other.status
        if one.value is not None and one.std is not None:
            assert one.value == pytest.approx(other.value, rel=1e-9)
            assert one.std == pytest.approx(other.std, rel=1e-6)


def test_millimetres_are_not_mistaken_for_metres(demo_recording: Recording) -> None:
    """In millimetres the encoder's noise alone is faster than anything at rest may be."""
    pose = demo_recording.pose
    with pytest.raises(EstimateError, match=r"never at rest in this log.*positions are in metres"):
        identify_cell(
            dataclasses.replace(demo_recording, pose=dataclasses.replace(pose, position_m=1e3 * pose.position_m))
        )


def test_a_wrench_after_a_deadband_is_noticed(demo_recording: Recording) -> None:
    wrench = demo_recording.wrench
    cut = np.where(np.abs(wrench.force_n) < 12.0, 0.0, wrench.force_n)
    found = identify_cell(dataclasses.replace(demo_recording, wrench=dataclasses.replace(wrench, force_n=cut)))
    check_honesty(found)
    # The smallest value that passes is the width, but for what of the noise lies above it.
    assert found.sensor.deadband_n.value == pytest.approx(12.0, abs=0.05)
    assert "threshold" in found.sensor.deadband_n.note
    assert "deadband-applied" in {finding.code for finding in found.findings}


def test_the_same_recording_gives_the_same_numbers(demo_recording: Recording, complete: Identified) -> None:
    assert identify_cell(demo_recording) == complete


def test_an_axis_of_rotation_is_reported_in_its_own_units_beside_the_tensor() -> None:
    cell = SimulatedCell.turning("ry")
    found = identify_cell(simulate_cell(cell, Program.turning(jogging_s=0.0, contact_count=2), seed=3).recording)
    check_honesty(found)
    assert [f for f in found.findings if f.severity == "error"] == []
    (axis,) = found.axes.values()
    (surface,) = axis.environments
    assert surface.name == "ry1"
    assert axis.mass_kg is not None
    for estimate, truth in (
        (axis.coupling.stiffness_n_per_m, cell.coupling.stiffness_n_per_m),
        (axis.drag_n_s_per_m, cell.drag_n_s_per_m),
        (axis.mass_kg, cell.moved_mass_kg),
        (surface.stiffness_n_per_m, cell.environment.stiffness_n_per_m),
        (axis.robot.delay_s, cell.robot.delay_s),
    ):
        assert estimate.status is Status.IDENTIFIED
        assert estimate.value is not None
        assert estimate.std is not None
        # 4.4 deviations: the quantile of 1e-5 for one value.
        assert abs(estimate.value - truth) < 4.4 * estimate.std
    kinds = {phase.kind.value for phase in found.timelines[0].phases}
    assert {"rest", "turning"} <= kinds
    touches = found.timelines[0].touches
    assert [(touch.axis, touch.surface) for touch in touches] == [("ry", "ry1")] * 2
    program = Program.turning(jogging_s=0.0, contact_count=2)
    for touch in touches:
        # N·m and rad/s: the torque is held against the surface, and drives the approach.
        assert touch.held_force == pytest.approx(program.contact_force_n, rel=0.03)
        asked = program.contact_force_n / (cell.controller.damping_n_s_per_m + cell.drag_n_s_per_m)
        assert touch.approach_speed == pytest.approx(asked, rel=0.1)


def test_the_time_line_names_the_surface_of_each_contact(complete: Identified) -> None:
    (line,) = complete.timelines
    contacts = [phase.contact for phase in line.phases if phase.contact is not None]
    assert [contact.surface for contact in contacts] == ["x1"] * PROGRAM.contact_count
    assert not any(contact.hand_suspected for contact in contacts)
    assert "hand-in-contact" not in {finding.code for finding in complete.findings}
    assert [touch.surface for touch in line.touches] == [contact.surface for contact in contacts]
    for touch, contact in zip(line.touches, contacts, strict=True):
        assert touch.cause is TouchCause.WALL
        assert (touch.onset_s, touch.release_s) == (contact.onset_s, contact.release_s)
        assert touch.peak_force == contact.peak_force_n
        # F^d is held until the speed is steady: F^d/(B_a + B_p).
        cell = SimulatedCell()
        speed = PROGRAM.contact_force_n / (cell.controller.damping_n_s_per_m + cell.drag_n_s_per_m)
        assert touch.approach_speed == pytest.approx(speed, rel=0.05)


def test_the_logged_wrench_is_let_go_of_before_the_axes_are_fitted(
    demo_recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = [dataclasses.replace(demo_recording)]
    logged = weakref.ref(held[0])

    def fitted(weighed: Any, *_: object, with_signals: bool) -> tuple[str, None]:
        assert with_signals
        assert np.isnan(weighed.read.recording.wrench.force_n).all()
        return "gone" if logged() is None else "held", None

    monkeypatch.setattr("identification.identify._identify", fitted)
    said: Any = identify_with_evidence(held.pop())[0]
    assert said == "gone"


@pytest.mark.parametrize("with_signals", [False, True])
def test_without_signals_the_wrench_on_the_clock_of_the_log_is_let_go_of_too(
    demo_recording: Recording, monkeypatch: pytest.MonkeyPatch, with_signals: bool
) -> None:
    logs: list[weakref.ref[AlignedLog]] = []

    def noted(recording: Recording) -> AlignedLog:
        log = align(recording)
        logs.append(weakref.ref(log))
        return log

    def seen(log: AlignedLog, *_: object) -> None:
        held = [each() is not None for each in logs]
        raise EstimateError(f"{held} {bool(np.isnan(log.force_S_n).all())}")

    monkeypatch.setattr("identification.identify.align", noted)
    monkeypatch.setattr("identification.identify.find_axes", seen)
    with pytest.raises(EstimateError, match=r"\[True\] False" if with_signals else r"\[False\] True"):
        identify_with_evidence(demo_recording, with_signals=with_signals)


def test_without_signals_the_result_is_the_same(demo_recording: Recording, complete: Identified) -> None:
    found, evidence = identify_with_evidence(demo_recording, with_signals=False)
    assert found == complete
    assert evidence is not None
    assert evidence.payload is not None
    assert not evidence.axes
