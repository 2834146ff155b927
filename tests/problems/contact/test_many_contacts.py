"""Many contacts at once against the same contacts one by one, by Runge–Kutta steps alone."""

from dataclasses import replace

import numpy as np
import pytest

from problems.contact.many_contacts import (
    FULL_CONTACT,
    FULL_SENSOR,
    LINEAR_CONTACT,
    LINEAR_SENSOR,
    REFUSED,
    build_side,
    simulate_plants,
)
from problems.contact.nonlinear_simulation import DrawnNoise, NonlinearRun, needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import (
    NO_NONLINEARITIES,
    Collision,
    CommandLimits,
    Deadband,
    Nonlinearities,
    VariableDamping,
)
from problems.contact.transient import Approach
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant, WrenchFilter
from problems.model.plant_arrays import build_plant_arrays
from problems.model.plant_parameters import with_values
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError
from problems.stability.polynomials import STABLE, UNSTABLE
from tests.problems.axes import PERIOD_S, PRESS, admittance, one_pole, paper_plant
from tests.problems.nonlinear_runs import COMPENSATING, FIRM

TICKS = 300
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=2.4e-3)
DISTURBED = Nonlinearities(
    deadband=Deadband(width_n=5.0),
    force_noise_rms_n=0.2,
    limits=CommandLimits(speed_m_s=0.25),
    late_share=0.02,
)
SOFT = {
    "environment_stiffness_n_per_m": (2e4, 5e5),
    "payload_mass_kg": (8.0, 16.0),
    "coupling_stiffness_n_per_m": (2.5e5, 3.5e5),
    "environment_damping_n_s_per_m": (0.0, 200.0),
    "delay_s": (1.9e-3, 2.9e-3),
    "robot_bandwidth_hz": (2.5, 3.5),
}
SETTLED = FIRM, PRESS


def columns(count: int, ranges: dict[str, tuple[float, float]], seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.uniform(low, high, count) for name, (low, high) in ranges.items()}


def draws(count: int, effects: Nonlinearities, seed: int = 5) -> DrawnNoise:
    rng = np.random.default_rng(seed)
    noise = effects.force_noise_rms_n * rng.standard_normal((count, TICKS))
    return DrawnNoise(noise, rng.random((count, TICKS)) < effects.late_share)


def one_by_one(
    plant: Plant,
    law: tuple[AdmittanceController, Approach],
    effects: Nonlinearities,
    noise: DrawnNoise | None = None,
) -> NonlinearRun:
    controller, approach = law
    return simulate_nonlinear(
        plant,
        controller,
        approach,
        sample_time_s=PERIOD_S,
        duration_s=TICKS * PERIOD_S,
        effects=effects,
        substeps=needed_substeps(plant, PERIOD_S),
        noise=noise,
    )


@pytest.mark.parametrize(
    ("nominal", "ranges", "law", "effects", "count"),
    [
        pytest.param(paper_plant(coupling_damping=100.0), SOFT, SETTLED, DISTURBED, 200, id="disturbed"),
        pytest.param(
            paper_plant(robot=TWO_POLES),
            {**SOFT, "robot_damping_ratio": (0.7, 0.9), "coupling_damping_n_s_per_m": (50.0, 150.0)},
            (admittance(mass=10.0, damping=3000.0), Approach(force_n=30.0, driven_by="hand")),
            replace(DISTURBED, force_limit_n=40.0, deadband=None),
            20,
            id="two poles, by hand, clipped",
        ),
        pytest.param(
            replace(paper_plant(), wrench_filter=WrenchFilter.from_corner(150.0)),
            {"wrench_time_constant_s": (1e-3, 2e-3), "payload_mass_kg": (8.0, 16.0)},
            (FIRM, Approach(speed_m_s=0.02, after_impact_n=10.0)),
            replace(DISTURBED, deadband=Deadband(width_n=2.0, kind="subtractive")),  # type: ignore[arg-type]
            20,
            id="filtered",
        ),
        pytest.param(
            # A light payload on a hard wall leaves it and comes back.
            paper_plant(mass=4.0, drag=20.0, coupling=3e4, coupling_damping=5.0, environment_damping=15.0),
            {"environment_stiffness_n_per_m": (1e5, 1e6), "payload_mass_kg": (3.0, 5.0)},
            (admittance(damping=800.0, lead=0.01), PRESS),
            DISTURBED,
            20,
            id="bouncing",
        ),
        pytest.param(
            paper_plant(coupling_damping=100.0),
            SOFT,
            (COMPENSATING, PRESS),
            replace(DISTURBED, collision=Collision(threshold_n=25.0), variable_damping=VariableDamping(
                scale_n_s_per_m=3500.0, floor_n_s_per_m=3000.0)),
            20,
            id="reset and variable damping",
        ),
        pytest.param(
            paper_plant(coupling=3e6, mass=2.0, coupling_damping=2000.0),
            {"environment_stiffness_n_per_m": (2e6, 4e6), "payload_mass_kg": (1.5, 2.5)},
            SETTLED,
            replace(DISTURBED, late_share=0.0),
            10,
            id="fast: in steps alone",
        ),
    ],
)  # fmt: skip
def test_the_peaks_are_those_of_the_contacts_one_by_one(
    nominal: Plant,
    ranges: dict[str, tuple[float, float]],
    law: tuple[AdmittanceController, Approach],
    effects: Nonlinearities,
    count: int,
) -> None:
    values = columns(count, ranges, seed=1)
    controller, approach = law
    drawn = draws(count, effects)
    found = simulate_plants(
        build_plant_arrays(nominal, values),
        controller,
        approach,
        sample_time_s=PERIOD_S,
        effects=effects,
        draws=drawn,
        traced=3,
    )
    stable = 0
    for i in range(count):
        plant = with_values(nominal, {name: float(column[i]) for name, column in values.items()})
        try:
            linear = one_by_one(plant, law, NO_NONLINEARITIES)
            full = one_by_one(plant, law, effects, DrawnNoise(drawn.force_n[i], drawn.late[i]))
        except UnstableLoopError:
            assert found.verdicts[i] == UNSTABLE
            assert np.all(np.isnan(found.peaks_n[i]))
            continue
        stable += 1
        assert found.verdicts[i] == STABLE
        # Runge–Kutta steps of 0.02 rad err by 1e-9 of the force; more substeps than needed see the top of a fast one.
        np.testing.assert_allclose(
            found.peaks_n[i, [LINEAR_CONTACT, LINEAR_SENSOR, FULL_CONTACT, FULL_SENSOR]],
            [
                linear.peak_contact_force_n,
                linear.peak_sensor_force_n,
                full.peak_contact_force_n,
                full.peak_sensor_force_n,
            ],
            rtol=1e-6,
        )
        if i < len(found.traces_n):
            # Each kink inside a step, where a payload leaves the wall and comes back, costs the square of the step.
            np.testing.assert_allclose(found.traces_n[i], full.contact_force_n, atol=1e-3)
    assert stable > 0.5 * count


@pytest.mark.parametrize(
    "plant",
    [
        pytest.param(paper_plant(coupling_damping=100.0, environment_damping=50.0), id="slow, whole delay"),
        pytest.param(paper_plant(robot=replace(TWO_POLES, delay_s=2.1e-3)), id="two poles, fraction"),
        pytest.param(paper_plant(mass=0.5, stiffness=5e7, coupling_damping=2000.0), id="fast, in many pieces"),
    ],
)
def test_the_parts_of_a_sample_make_the_sampled_plant(plant: Plant) -> None:
    sampled = build_sampled_plant(plant, PERIOD_S)
    side = build_side(*plant.robot.ascending(), plant.parameters(), PERIOD_S, sampled.fraction)
    phi, gamma, gamma_old, gamma_push = side.step
    for found, exact in (
        (phi, sampled.phi),
        (gamma, sampled.gamma),
        (gamma_old, sampled.gamma_old),
        (gamma_push, sampled.gamma_push),
    ):
        # Rounding, of the swing of 8 rad in a sample of the fast plant as well.
        np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-11 * np.max(np.abs(exact), initial=1e-9))
    np.testing.assert_allclose(side.flow[:, :-2], sampled.rate)


def test_a_plant_is_the_same_alone_and_among_others() -> None:
    nominal, values = paper_plant(coupling_damping=100.0), columns(8, SOFT, seed=2)
    drawn = draws(8, DISTURBED)

    def peaks(part: slice) -> np.ndarray:
        plants = build_plant_arrays(nominal, {name: column[part] for name, column in values.items()})
        some = DrawnNoise(drawn.force_n[part], drawn.late[part])
        return simulate_plants(
            plants, FIRM, PRESS, sample_time_s=PERIOD_S, effects=DISTURBED, draws=some
        ).peaks_n  # fmt: skip

    np.testing.assert_array_equal(np.vstack([peaks(slice(0, 3)), peaks(slice(3, 8))]), peaks(slice(0, 8)))


def test_what_the_scalar_simulation_refuses_is_refused() -> None:
    """Without delay, and with damping in the coupling, F hangs on the command of the same tick."""
    plant = paper_plant(coupling_damping=100.0, robot=one_pole(0.0))
    plants = build_plant_arrays(plant, {"payload_mass_kg": np.array([8.0, 16.0])})
    found = simulate_plants(
        plants, FIRM, PRESS, sample_time_s=PERIOD_S, effects=DISTURBED, draws=draws(2, DISTURBED)
    )  # fmt: skip
    assert list(found.verdicts) == [REFUSED, REFUSED]
    weak = replace(DISTURBED, deadband=Deadband(width_n=5.0))
    found = simulate_plants(
        build_plant_arrays(paper_plant(), {"payload_mass_kg": np.array([8.0])}),
        FIRM,
        Approach(force_n=4.0, driven_by="hand"),
        sample_time_s=PERIOD_S,
        effects=weak,
        draws=draws(1, weak),
    )
    assert list(found.verdicts) == [REFUSED]
