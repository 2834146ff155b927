"""The limits that `optimize` chooses, what `problem.yaml` may say of them, and what `validate` refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import LimitsSpec, ResidualPeaks
from autotune.formats.yaml12 import parse_document
from autotune.tuning.limits import LimitsSettings, largest_motion, limits_settings, with_limits
from autotune.validation.replay import replay_contact
from autotune.validation.validate import validate_controller
from problems.design.requirements import HANDS, ContactAtSpeed, Hand
from tests.autotune.tuning.cases import FAST_SPEC, identified_plant, known, small_controller

pytestmark = pytest.mark.usefixtures("shared_results")


def messages(controller: Controller) -> str:
    """What validation says against the limits; everything else must pass."""
    failed = [check for check in validate_controller(controller).checks if not check.passed]
    assert {check.name for check in failed} == {"limits"}
    return failed[0].message


def test_every_value_has_its_reason_and_room() -> None:
    controller = small_controller()
    limits = controller.limits
    assert limits is not None
    tree = {name for name in vars(limits) if name not in ("axes", "noise", "reasons")}
    assert set(limits.reasons) == tree | {"axes.x.speed", "axes.x.acceleration"}
    speed, acceleration = largest_motion(controller, "x")
    # Twice, and what noise adds.
    assert limits.axes["x"].speed >= 2.0 * speed
    assert limits.axes["x"].acceleration >= 2.0 * acceleration
    worst = max(each.peak_sensor_force_n for each in controller.predicted["x"].scenarios)
    assert limits.force_n >= 2.0 * (16.0 * 9.80665 + worst)
    assert limits.rest_force_n <= controller.axes["x"].deadband


def test_the_peaks_hold_the_weight_that_may_be_left_over() -> None:
    """Scaled by (F^d + r)/F^d; a second method presses the same contact with F^d + r."""
    controller = small_controller()
    reported, domain = controller.predicted["x"].with_residual_weight, controller.certificate.domain["x"]
    worst = max(controller.predicted["x"].scenarios, key=lambda each: each.peak_contact_force_n)
    assert reported is not None
    assert controller.limits is not None
    assert reported.force_n == controller.limits.rest_force_n
    force = domain.approach_force_n or 0.0
    plant = worst.scenario().plant(domain.plants.nominal)
    law = admittance_controller(controller, "x")
    seen = replay_contact(plant, law, controller.sample_time_s, force + reported.force_n)
    # As between a predicted contact and its replay: the touch falls between two ticks.
    assert reported.peak_contact_force_n == pytest.approx(seen.peak_contact_force_n, rel=0.02)
    assert reported.peak_contact_force_n > worst.peak_contact_force_n


def test_noise_and_what_was_left_over_in_the_log_widen_them() -> None:
    plant = identified_plant()
    sensor = replace(plant.sensor, position_noise_rms_m=known(5e-5), gravity_residual_rms_n=known(1.1))
    wish = limits_settings(replace(plant, sensor=sensor), FAST_SPEC)
    assert (wish.noise.force_n, wish.noise.position_m, wish.noise.gravity_residual_n) == (0.14, 5e-5, 1.1)
    quiet, noisy = small_controller().limits, with_limits(small_controller(), wish).limits
    assert quiet is not None
    assert noisy is not None
    assert noisy.axes["x"].acceleration > quiet.axes["x"].acceleration
    assert noisy.pose_speed_m_s > quiet.pose_speed_m_s
    # Three times 1.1 N, rounded up to two digits, inside the deadband of 5 N.
    assert noisy.rest_force_n == 3.3
    drowned = with_limits(small_controller(), replace(wish, noise=replace(wish.noise, gravity_residual_n=4.0))).limits
    assert drowned is not None
    assert drowned.rest_force_n == 5.0
    with pytest.raises(
        UsageError, match=r"too noisy for a limit of its speed: .* of 0\.001 m .* where at most 20 and 50"
    ):
        with_limits(small_controller(), replace(wish, noise=replace(wish.noise, position_m=1e-3)))


def test_a_problem_says_its_own() -> None:
    spec = LimitsSpec(values={"force_n": 660.0, "rest_samples": 250}, axes={"x": {"speed": 0.4}})
    limits = with_limits(small_controller(), LimitsSettings(spec=spec)).limits
    assert limits is not None
    assert (limits.force_n, limits.rest_samples, limits.axes["x"].speed) == (660.0, 250, 0.4)
    assert limits.reasons["force_n"] == limits.reasons["axes.x.speed"] == "said in problem.yaml"


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"x": {"speed": 0.01}}, r"limits\.axes\.x\.speed must be above 0\.0\d+, .* found 0\.01"),
        ({"x": {"acceleration": 1.0}}, r"limits\.axes\.x\.acceleration must be above \d"),
        ({"z": {"speed": 1.0}}, r"limits\.axes must name tuned axes, x; found z"),
    ],
)
def test_a_limit_that_the_certified_contacts_reach_is_refused(axes: dict[str, dict[str, float]], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        with_limits(small_controller(), LimitsSettings(spec=LimitsSpec(axes=axes)))


def test_validation_finds_limits_that_are_too_low_and_peaks_without_the_residual() -> None:
    whole = small_controller()
    limits, predicted = whole.limits, whole.predicted["x"]
    assert limits is not None
    assert predicted.with_residual_weight is not None
    slow = replace(limits, axes={"x": replace(limits.axes["x"], speed=0.02)})
    assert "limits.axes.x.speed is 0.02 m/s, and certified contacts command" in messages(replace(whole, limits=slow))
    hard = replace(limits, axes={"x": replace(limits.axes["x"], acceleration=5.0)})
    assert "limits.axes.x.acceleration is 5 m/s²" in messages(replace(whole, limits=hard))
    assert "limits.force_n is 180 N" in messages(replace(whole, limits=replace(limits, force_n=180.0)))
    mine = replace(limits, rest_force_n=6.0)
    assert "6 N may be left over, more than the deadband of 5" in messages(replace(whole, limits=mine))
    plain = ResidualPeaks(force_n=1.0, peak_sensor_force_n=30.0, peak_contact_force_n=30.0)
    for without in (None, plain):
        bare = replace(whole, predicted={"x": replace(predicted, with_residual_weight=without)})
        assert "with_residual_weight" in messages(bare)


@pytest.mark.parametrize("key", ["speed", "acceleration", "force_n", "pose_speed_m_s", "stale_pose_s", "rest_samples"])
def test_validation_finds_limits_that_let_more_through_than_follows(key: str) -> None:
    """A limit that was raised, with a new checksum, is no longer twice what the contacts command."""
    whole = small_controller()
    assert whole.limits is not None
    of_axis = key in ("speed", "acceleration")
    place = f"axes.x.{key}" if of_axis else key
    raised = 2 * getattr(whole.limits.axes["x"] if of_axis else whole.limits, key)
    change = {"axes": {"x": replace(whole.limits.axes["x"], **{key: raised})}} if of_axis else {key: raised}
    limits = replace(whole.limits, **change)
    assert f"limits.{place} is {raised:.4g}, and what the file holds makes it" in messages(
        replace(whole, limits=limits)
    )
    said = replace(limits, reasons={**limits.reasons, place: "said in problem.yaml"})
    (check,) = (each for each in validate_controller(replace(whole, limits=said), is_short=True).checks[-1:])
    assert f"{place}: said in problem.yaml" in check.message


def asking(controller: Controller, asked: ContactAtSpeed) -> Controller:
    """The controller, of which `contact_at_speed` is asked too."""
    requirements = {**controller.certificate.requirements, "contact_at_speed": asked}
    return replace(controller, certificate=replace(controller.certificate, requirements=requirements))


def test_a_limit_of_the_force_at_a_speed_limits_the_speed_of_the_robot() -> None:
    """Contacts scale with their speed, so the stated peaks per speed say how fast a limit of the force allows.

    That is less than what the certified contacts command as F^d comes at once, and more than how fast the robot goes.
    """
    whole = small_controller()
    per_speed, usual = whole.predicted["x"].peak_per_speed, whole.limits
    assert per_speed is not None
    assert usual is not None
    domain, gains = whole.certificate.domain["x"], whole.axes["x"]
    approach, commanded = (domain.approach_force_n or 0.0) / gains.damping, largest_motion(whole, "x")[0]
    safe = 1.5 * approach
    assert safe < 0.5 * commanded
    asked = ContactAtSpeed(speed_m_s=0.01, max_force_n=safe * per_speed.lets_go, hand="lets_go")
    limited = with_limits(asking(whole, asked), LimitsSettings())
    assert limited.limits is not None
    found = limited.limits.axes["x"]
    assert (found.speed, found.acceleration) == (usual.axes["x"].speed, usual.axes["x"].acceleration)
    # The robot of this cell has one pole, at 20 rad/s, and the hold adds h/2.
    assert found.followed_lag_s == pytest.approx(0.05, rel=0.2)
    assert found.followed_speed == pytest.approx(safe, rel=0.02)
    assert found.followed_speed is not None
    assert found.followed_speed < safe
    assert "contact_at_speed" in limited.limits.reasons["axes.x.followed_speed"]
    (check,) = (each for each in validate_controller(limited, is_short=True).checks if each.name == "limits")
    assert check.passed
    assert "behind the lag" in check.message
    for share, wrong in ((2.0, "and what the file holds makes it"), (0.5, "and certified contacts command")):
        other = replace(found, followed_speed=share * found.followed_speed)
        tampered = replace(limited, limits=replace(limited.limits, axes={"x": other}))
        assert f"limits.axes.x.followed_speed is {other.followed_speed:.4g}" in messages(tampered)
        assert wrong in messages(tampered)


def test_a_limit_above_the_speed_that_is_safe_is_not_chosen_and_said_only_with_a_note() -> None:
    """Half of the speed of the certified approach is asked to be safe: no limit holds both."""
    whole = small_controller()
    per_speed, domain = whole.predicted["x"].peak_per_speed, whole.certificate.domain["x"]
    assert per_speed is not None
    approach = (domain.approach_force_n or 0.0) / (whole.axes["x"].damping + domain.drag_n_s_per_m)
    asked = ContactAtSpeed(speed_m_s=0.001, max_force_n=0.5 * approach * per_speed.pushes_on)
    fast = asking(whole, asked)
    with pytest.raises(InfeasibleError, match=r"Axis x: up to [\d.]+ m/s no contact exceeds") as refused:
        with_limits(fast, LimitsSettings())
    (line,) = refused.value.to_paste
    assert line in str(refused.value)
    said = parse_document(line.encode(), Path("p"), error=UsageError, exact=False).tree["limits"]
    limited = with_limits(fast, LimitsSettings(spec=LimitsSpec(axes=said["axes"])))
    assert limited.limits is not None
    value = said["axes"]["x"]["followed_speed"]
    assert limited.limits.axes["x"].followed_speed == value > approach
    (note,) = (each for each in validate_controller(limited, is_short=True).checks if each.name == "speed limit")
    assert note.passed
    assert note.warns
    more = value / (0.5 * approach) * asked.max_force_n
    assert float(note.message.rpartition("it may be ")[2].split(" N")[0]) == pytest.approx(more, rel=0.02)
    assert not [each for each in validate_controller(whole, is_short=True).checks if each.name == "speed limit"]
    with pytest.raises(UsageError, match=r"limits\.axes\.x\.followed_speed must be above 0\.0\d+"):
        with_limits(fast, LimitsSettings(spec=LimitsSpec(axes={"x": {"followed_speed": 0.9 * approach}})))


def test_a_problem_may_limit_the_speed_of_the_robot_without_a_limit_of_the_force() -> None:
    limits = with_limits(
        small_controller(), LimitsSettings(spec=LimitsSpec(axes={"x": {"followed_speed": 0.2}}))
    ).limits
    assert limits is not None
    assert limits.axes["x"].followed_speed == 0.2
    assert limits.axes["x"].followed_lag_s == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("hand", HANDS)
def test_validation_finds_peaks_per_speed_that_are_too_low(hand: Hand) -> None:
    whole = small_controller()
    predicted = whole.predicted["x"]
    assert predicted.peak_per_speed is not None
    lower = replace(predicted.peak_per_speed, **{hand: 0.95 * getattr(predicted.peak_per_speed, hand)})
    tampered = replace(whole, predicted={"x": replace(predicted, peak_per_speed=lower)})
    failed = [check for check in validate_controller(tampered).checks if not check.passed]
    # What is said to be sampled is no longer that, and the contacts are harder.
    assert [check.name for check in failed] == ["statements", "led by hand"]
    assert hand.replace("_", " ") in failed[1].message


def test_a_file_without_limits_is_noted_and_passes() -> None:
    whole = small_controller()
    (check,) = [each for each in validate_controller(replace(whole, limits=None)).checks if each.name == "limits"]
    assert (check.passed, check.verdict) == (True, "note")
    assert "the runtime takes its defaults" in check.message


def test_the_command_of_the_replay_is_that_of_the_simulation() -> None:
    """The start from rest under 30 N: both roads see the same largest speed to their grids, half a percent."""
    whole = small_controller()
    domain, law = whole.certificate.domain["x"], admittance_controller(whole, "x")
    worst = max(whole.predicted["x"].scenarios, key=lambda each: each.peak_contact_force_n)
    plant = worst.scenario().plant(domain.plants.nominal)
    seen = replay_contact(plant, law, whole.sample_time_s, domain.approach_force_n or 0.0)
    speed, acceleration = largest_motion(replace(whole, axes={"x": replace(whole.axes["x"], deadband=0.0)}), "x")
    assert seen.largest_speed_m_s == pytest.approx(speed, rel=0.02)
    assert seen.largest_acceleration_m_s2 <= 1.02 * acceleration
    assert np.isfinite(acceleration)
