"""Plants drawn from a certified set: the same whatever runs beside them, and the bound on the share of bad ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from autotune.formats.controller_record import admittance_controller
from autotune.validation.disturbances import Disturbances, axis_effects
from autotune.validation.sampled_contacts import CHUNK, CONFIDENCE, SampledContacts, largest_share
from problems.contact.many_contacts import FULL_CONTACT, LINEAR_CONTACT
from problems.stability.polynomials import STABLE
from tests.autotune.tuning.cases import small_controller
from tests.autotune.validation.test_validate import domain

UNCERTAIN = {
    "coupling_stiffness_n_per_m": (2.8e5, 3.2e5),
    "delay_s": (2.2e-3, 2.6e-3),
    "robot_bandwidth_hz": (3.0, 3.4),
}


def contacts(seed: int = 1) -> SampledContacts:
    controller = domain(uncertain=UNCERTAIN)(small_controller())
    return SampledContacts(
        domain=controller.certificate.domain["x"],
        law=admittance_controller(controller, "x"),
        sample_time_s=controller.sample_time_s,
        ticks=300,
        effects=axis_effects(controller, "x", Disturbances(), 0.02),
        seed=seed,
    )


def nothing(_: float) -> None:
    pass


def test_what_comes_out_hangs_on_the_seed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither on the processors nor on how many plants are asked for."""
    monkeypatch.setenv("PYTHON_CPU_COUNT", "1")
    alone = contacts().simulate(2 * CHUNK + 5, nothing, traced=3)
    monkeypatch.setenv("PYTHON_CPU_COUNT", "3")
    beside, fewer = contacts().simulate(2 * CHUNK + 5, nothing, traced=3), contacts().simulate(CHUNK + 9, nothing)
    np.testing.assert_array_equal(alone.peaks_n, beside.peaks_n)
    np.testing.assert_array_equal(alone.traces_n, beside.traces_n)
    np.testing.assert_array_equal(alone.peaks_n[: CHUNK + 9], fewer.peaks_n)
    assert not np.array_equal(contacts(2).simulate(9, nothing).peaks_n, alone.peaks_n[:9])


def test_the_peaks_are_those_of_the_scalar_simulation() -> None:
    of = contacts()
    found, draws = of.simulate(CHUNK, nothing), of.draw(0)
    assert np.all(found.verdicts == STABLE)
    for place in range(CHUNK):
        runs = [of.run(draws, place, disturbed=disturbed).peak_contact_force_n for disturbed in (False, True)]
        # Steps of 0.02 rad err by 1e-9.
        np.testing.assert_allclose(found.peaks_n[place, [LINEAR_CONTACT, FULL_CONTACT]], runs, rtol=1e-6)
    worst = of.worst(found, 4)
    assert list(found.peaks_n[worst, FULL_CONTACT]) == sorted(found.peaks_n[:, FULL_CONTACT], reverse=True)[:4]
    assert of.scenario(int(worst[0])) == draws.scenario(int(worst[0]))
    assert of.domain.plants.contains(of.scenario(int(worst[0])))


def test_where_rounding_could_decide_the_plants_are_simulated_one_by_one() -> None:
    """A delay of 70 samples makes a polynomial of too high a degree: eigenvalues decide."""
    slow = contacts()
    late = replace(slow.domain, delay_s=70.0 * slow.sample_time_s, uncertain={}, confidence=None)
    weak = replace(slow.law, mass_kg=100.0, damping_n_s_per_m=20000.0, lead_s=0.0)
    of = replace(slow, domain=late, law=weak)
    found, draws = of.simulate(2, nothing, traced=2), of.draw(0, 2)
    for place in range(2):
        run = of.run(draws, place)
        assert found.peaks_n[place, FULL_CONTACT] == run.peak_contact_force_n
        np.testing.assert_array_equal(found.traces_n[place], run.contact_force_n)


@pytest.mark.parametrize(("bad", "count"), [(0, 59), (1, 100), (7, 256), (99, 100)])
def test_with_the_largest_share_so_few_bad_plants_are_as_rare_as_the_confidence_says(bad: int, count: int) -> None:
    share = largest_share(np.arange(count) < bad)
    assert binom.cdf(bad, count, share) == pytest.approx(1.0 - CONFIDENCE, rel=1e-9)


def test_a_study_of_bad_plants_alone_bounds_nothing() -> None:
    assert largest_share(np.ones(5, dtype=np.bool_)) == 1.0
