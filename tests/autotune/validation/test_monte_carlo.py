"""Simulated contacts of the certified set: the file's own model by a second method, and what disturbances may add."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.validation.disturbances import Disturbances, axis_effects
from autotune.validation.monte_carlo import AxisMonteCarlo, run_monte_carlo
from autotune.validation.monte_carlo_checks import monte_carlo_checks, monte_carlo_tree
from problems.contact.nonlinearities import DeadbandType
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.requirements import NoiseLimit
from problems.errors import ParameterError
from problems.model.sampled import build_sampled_plant
from tests.autotune.tuning.cases import small_controller
from tests.autotune.validation.test_validate import domain, peaks

NOTHING = Disturbances(noise_rms=(0.0, 0.0), speed_limit=(10.0, 10.0), late_share=0.0)
FEW = 8


def gains(controller: Controller, **values: Any) -> Controller:
    return replace(controller, axes={"x": replace(controller.axes["x"], **values)})


def on_x(
    controller: Controller, *, count: int = FEW, seed: int = 1, reported: Disturbances | None = None
) -> AxisMonteCarlo:
    (found,) = run_monte_carlo(controller, count=count, seed=seed, disturbances=reported)
    return found


def test_the_peaks_of_the_linear_loop_are_those_of_the_exact_transient() -> None:
    """The nonlinear simulation, and the transient in which every event is located, plant by plant."""
    controller = small_controller()
    found = on_x(controller)
    certified = controller.certificate.domain["x"]
    law, h = admittance_controller(controller, "x"), controller.sample_time_s
    exact = [
        simulate_contact(
            build_sampled_contact(build_sampled_plant(each.plant.plant(certified.plants.nominal), h)),
            law,
            Approach(force_n=30.0),
        )
        for each in found.worst
    ]
    assert len(exact) == FEW
    assert found.contact is not None
    assert found.sensor is not None
    # The contact's peak is that of a tenth of a sample in one, exact in the other: its top is flat to 1e-4 there.
    assert found.contact.linear.largest == pytest.approx(max(each.peak_contact_force_n for each in exact), rel=1e-4)
    assert found.sensor.linear.largest == pytest.approx(max(each.peak_sensor_force_n for each in exact), rel=1e-4)
    assert found.contact.predicted == max(s.peak_contact_force_n for s in controller.predicted["x"].scenarios)


def test_without_disturbances_the_full_simulation_is_the_linear_one() -> None:
    found = on_x(gains(small_controller(), deadband=0.0), reported=NOTHING)
    assert found.contact is not None
    assert found.contact.observed == found.contact.linear
    assert found.contact.limit == pytest.approx(1.02 * found.contact.predicted)


def test_a_good_file_passes_and_shows_what_was_simulated() -> None:
    found = run_monte_carlo(small_controller(), count=16)
    checks = monte_carlo_checks(found)
    assert [(check.name, check.passed) for check in checks] == [("sampled peaks", True), ("full simulation", True)]
    assert "with 5 N deadband, 0.2 N noise, at most 0.25 m/s, 1 % of the commands late" in checks[1].message
    tree: dict[str, Any] = monte_carlo_tree(found)["x"]  # type: ignore[assignment]
    assert "none of 16 plants breaks a limit, with 95 % confidence no more than 17 % of all do" in checks[1].message
    assert (tree["samples"], tree["seed"], tree["unit"], tree["unstable"]) == (16, 1, "N", None)
    # With this share of bad plants none of 16 would be bad once in 20 studies.
    assert (tree["violating"], tree["confidence"]) == (0, 0.95)
    assert (1.0 - tree["largest_share"]) ** 16 == pytest.approx(0.05)
    for what in ("contact", "sensor"):
        shares = tree[what]["observed"]["quantiles"]
        assert list(shares) == ["0.5", "0.95", "0.99"]
        assert list(shares.values()) == sorted(shares.values())
        assert shares["0.99"] <= tree[what]["observed"]["largest"] <= tree[what]["limit"]
    worst = tree["worst"]
    assert len(worst) == 10
    assert [each["contact"] for each in worst] == sorted((each["contact"] for each in worst), reverse=True)
    assert worst[0]["contact"] == tree["contact"]["observed"]["largest"]
    assert worst[0]["plant"] == tree["contact"]["observed"]["plant"]
    assert {"environment_stiffness_n_per_m", "payload_mass_kg"} <= set(worst[0]["parameters"])
    for each in worst:
        # Steps of 0.02 rad err by 1e-9.
        assert each["repeated_contact"] == pytest.approx(each["contact"], rel=1e-6)
    assert sum(tree["distribution"]["counts"]) == 16
    assert tree["distribution"]["edges"][-1] == worst[0]["contact"]


def test_the_seed_settles_everything() -> None:
    trees = [monte_carlo_tree(run_monte_carlo(small_controller(), count=4, seed=seed)) for seed in (3, 3, 4)]
    assert trees[0] == trees[1]
    assert trees[0] != trees[2]


@pytest.mark.parametrize("kind", [DeadbandType.THRESHOLD, DeadbandType.SUBTRACTIVE])
@pytest.mark.parametrize("width", [2.0, 12.0])
def test_a_deadband_adds_no_more_than_a_constant_force_of_its_width(kind: DeadbandType, width: float) -> None:
    """The reason of the limit: F^d + b in place of F^d scales the whole contact, and no deadband is worse than that."""
    controller = gains(small_controller(), deadband=width, deadband_type=kind)
    found = on_x(controller, reported=NOTHING)
    assert found.contact is not None
    shifted = on_x(domain(approach_force_n=30.0 + width)(gains(controller, deadband=0.0)), reported=NOTHING)
    assert shifted.contact is not None
    # Linear but for the touch: exactly in proportion (rounding of 4000 steps).
    assert shifted.contact.linear.largest == pytest.approx(found.contact.linear.largest * (1 + width / 30.0), rel=1e-9)
    assert found.contact.observed.largest <= shifted.contact.linear.largest * (1.0 + 1e-9)
    assert found.contact.observed.largest > found.contact.linear.largest or width < 6.1  # B_p v, the drag it hides
    assert all(check.passed for check in monte_carlo_checks((found,)))


def test_peaks_that_are_predicted_too_small_are_found_out() -> None:
    checks = monte_carlo_checks(run_monte_carlo(peaks(0.9, 1.0)(small_controller()), count=FEW))
    assert [check.passed for check in checks] == [False, True]
    assert "more than the largest predicted" in checks[0].message
    assert f" of {FEW} plants break" in checks[1].message
    assert "contact force" in checks[0].message


def test_a_plant_of_the_set_whose_loop_is_unstable_is_named() -> None:
    weak = domain(uncertain={"delay_s": (2.4e-3, 2.4e-2)})(small_controller())
    found = run_monte_carlo(weak, count=FEW)
    (check,) = monte_carlo_checks(found)
    assert (check.name, check.passed) == ("sampled peaks", False)
    assert "the loop is not stable at K_e" in check.message
    assert found[0].unstable is not None
    assert 0 < found[0].violating <= FEW
    assert f"; {found[0].violating} of {FEW} plants break" in check.message


def test_disturbances_that_explain_less_than_they_do_fail() -> None:
    """Half of all commands late is more delay than any plant of the set has, and no bias of the force."""
    controller = gains(small_controller(), deadband=0.0)
    found = on_x(controller, reported=replace(NOTHING, late_share=0.85))
    (linear, full) = monte_carlo_checks((found,))
    assert linear.passed
    assert not full.passed
    assert "85 % of the commands late explain" in full.message


def test_a_simulation_that_is_not_possible_is_no_verification() -> None:
    fast = domain(approach_speed_m_s=0.5, approach_force_n=None)(small_controller())
    (check,) = monte_carlo_checks(run_monte_carlo(fast, count=2, disturbances=Disturbances(speed_limit=(0.1, None))))
    assert (check.name, check.passed) == ("full simulation", False)
    assert check.message.startswith("not possible: approach.speed_m_s")


def test_plants_without_any_delay_are_left_out_and_reported_so() -> None:
    """What `optimize` writes for them is verified by the exact transients; it would otherwise never be valid."""
    (check,) = monte_carlo_checks(run_monte_carlo(domain(delay_s=0.0)(small_controller()), count=2))
    assert (check.name, check.verdict) == ("full simulation", "note")
    assert check.message.startswith("not simulated: robot.delay_s")


def test_what_is_not_said_is_taken_from_the_file_and_then_as_usual() -> None:
    controller = small_controller()
    assert axis_effects(controller, "x", Disturbances(), 0.02).force_noise_rms_n == 0.2
    limited = replace(
        controller.certificate,
        requirements={
            **controller.certificate.requirements,
            "command_noise": NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.3),
        },
    )
    assert axis_effects(replace(controller, certificate=limited), "x", Disturbances(), 0.02).force_noise_rms_n == 0.3
    reported = Disturbances(noise_rms=(0.4, None), sensor_range=(200.0, None), speed_limit=(0.1, None), late_share=0.0)
    effects = axis_effects(replace(controller, certificate=limited), "x", reported, 0.02)
    assert (effects.force_noise_rms_n, effects.force_limit_n, effects.late_share) == (0.4, 200.0, 0.0)
    assert effects.limits is not None
    assert effects.limits.speed_m_s == 0.1
    fast = axis_effects(controller, "x", Disturbances(), 0.2).limits
    assert fast is not None
    assert fast.speed_m_s == 0.4
    assert effects.deadband is not None
    assert (effects.deadband.width_n, effects.deadband.kind) == (5.0, "threshold")


def test_an_axis_that_turns_has_its_own_units_and_noise() -> None:
    """The same numbers about rx are the same contact, in N·m and rad."""
    straight = gains(small_controller(), deadband=0.0)
    certificate = straight.certificate
    turning = replace(
        straight,
        axes={"rx": straight.axes["x"]},
        limits=None,
        predicted={"rx": straight.predicted["x"]},
        certificate=replace(
            certificate,
            domain={"rx": certificate.domain["x"]},
            margins={"rx": certificate.margins["x"]},
            continuous=None,
        ),
    )
    (found,) = run_monte_carlo(turning, count=2)
    assert (found.effects.force_noise_rms_n, found.effects.limits) == (0.02, None)
    assert found.contact is not None
    plain = on_x(straight, count=2).contact
    assert plain is not None
    assert found.contact.linear == plain.linear
    assert " N·m at the contact" in monte_carlo_checks((found,))[1].message


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"noise_rms": (-0.1, None)}, "noise_rms"),
        ({"noise_rms": (np.nan, None)}, "noise_rms"),
        ({"sensor_range": (None, 0.0)}, "sensor_range"),
        ({"speed_limit": (np.inf, None)}, "speed_limit"),
        ({"late_share": 1.0}, "late_share"),
    ],
)
def test_a_cell_that_cannot_be_is_refused(values: dict[str, Any], name: str) -> None:
    with pytest.raises(ParameterError) as caught:
        Disturbances(**values)
    assert caught.value.name == name


def test_no_plant_at_all_is_refused() -> None:
    with pytest.raises(ParameterError, match="samples must be at least 1"):
        run_monte_carlo(small_controller(), count=0)
