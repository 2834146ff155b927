"""The force that no B_a and K_l get below, against laws whose margins, noise and peaks are found by other code."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.certificate.least_peak import Asked, _Search, find_least_peak
from autotune.tuning.search import solve_design
from benchmarks.tuning_problems import paper_cell
from problems.contact.transient import Approach, simulate_contact
from problems.contact.transient import build_sampled_contact as paired
from problems.design.requirements import band_frequencies
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, WrenchFilter
from problems.model.response import free_space_admittance
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins
from problems.stability.noise import command_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum

PROBLEM = paper_cell((5e5, 5e5), (16.0, 16.0))
PLANT = PROBLEM.plant(PROBLEM.scenarios(2, 2)[0])
H = PROBLEM.sample_time_s
LAW = AdmittanceController(
    mass_kg=5.0, damping_n_s_per_m=1034.0, lead_s=0.0201, feedback_damping_s=0.027, velocity_filter_rad_per_s=120.0
)
BAND = band_frequencies(PLANT.robot, (0.1, 2.0))
ASKED = Asked(modulus=0.5, min_m_s_per_n=7e-4, band_rad_per_s=BAND)
CONTACT = paired(build_sampled_plant(PLANT, H))
FREE = build_sampled_plant(PLANT.in_contact_with(FREE_SPACE), H)

HIGH = RelativeSpectrum(frequency_hz=(20.0, 200.0, 500.0), relative_density=(0.3, 2.0, 5.0))


def law_at(damping: float, lead: float) -> AdmittanceController:
    return replace(LAW, damping_n_s_per_m=damping, lead_s=lead)


def peak_of(law: AdmittanceController, approach: Approach = PROBLEM.approach) -> float:
    return simulate_contact(CONTACT, law, approach).peak_contact_force_n


def meets(law: AdmittanceController, asked: Asked) -> bool:
    """Whether a law meets what is asked, by its exact margins, its loop's response and its loop's covariance."""
    try:
        margins = [find_margins(each, law) for each in (CONTACT.contact, FREE)]
    except UnstableLoopError:
        return False
    if asked.modulus is not None and min(each.modulus for each in margins) < asked.modulus:
        return False
    if asked.min_m_s_per_n is not None:
        least = float(np.min(np.abs(free_space_admittance(FREE, law, asked.band_rad_per_s))))
        if least < asked.min_m_s_per_n:
            return False
    noise = asked.noise_m_s_per_n
    return noise is None or noise >= max(
        command_speed_gain(each, law, asked.noise_spectrum) for each in (CONTACT.contact, FREE)
    )


def cells(seed: int, count: int, width: float) -> list[tuple[float, float, float, float]]:
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(count):
        low, short = float(np.exp(rng.uniform(np.log(200.0), np.log(4000.0)))), float(rng.uniform(0.0, 0.028))
        drawn.append((low, low * np.exp(width * rng.uniform(0.1, 1.0)), short, short + 0.03 * width * rng.uniform()))
    return drawn


def laws_in(cell: tuple[float, float, float, float], seed: int) -> list[AdmittanceController]:
    low, high, short, long = cell
    rng = np.random.default_rng(seed)
    corners = [(low, short), (low, long), (high, short), (high, long)]
    inside = [(float(rng.uniform(low, high)), float(rng.uniform(short, long))) for _ in range(6)]
    return [law_at(*each) for each in (*corners, *inside)]


def test_the_papers_cell_has_nothing_better_within_a_percent_and_the_search_is_that_near() -> None:
    found = solve_design(PROBLEM)
    law = PROBLEM.controller(found.design)
    reached = peak_of(law)
    bounds = PROBLEM.bounds["damping"], PROBLEM.bounds["lead_s"]
    least = find_least_peak([PLANT], law, PROBLEM.approach, H, bounds, ASKED, reached_n=reached, tolerance=0.01)
    assert 0.99 * reached <= least.force_n <= reached
    assert least.cells < 400


@pytest.mark.parametrize("approach", [PROBLEM.approach, Approach(speed_m_s=0.03)])
def test_no_law_of_a_grid_that_meets_what_is_asked_lies_below(approach: Approach) -> None:
    bounds = (900.0, 1300.0), (0.01, 0.03)
    grid = [law_at(b, k) for b in np.linspace(*bounds[0], 21) for k in np.linspace(*bounds[1], 21)]
    asked = replace(ASKED, modulus=0.45)
    best = min(peak_of(each, approach) for each in grid if meets(each, asked))
    least = find_least_peak([PLANT], LAW, approach, H, bounds, asked, reached_n=best, tolerance=0.005)
    assert 0.95 * best < least.force_n <= best


def test_a_false_bound_is_not_reached() -> None:
    """A force above that of a law that meets everything is never given, however much is reached."""
    assert meets(LAW, replace(ASKED, modulus=0.49))
    bounds = (500.0, 2000.0), (0.0, 0.03)
    least = find_least_peak(
        [PLANT], LAW, PROBLEM.approach, H, bounds, replace(ASKED, modulus=0.49), reached_n=1.1 * peak_of(LAW)
    )
    assert least.force_n <= peak_of(LAW)


@pytest.mark.parametrize("approach", [PROBLEM.approach, Approach(speed_m_s=0.03)])
def test_no_law_of_a_cell_peaks_below_its_bound(approach: Approach) -> None:
    search = _Search([PLANT], LAW, approach, H, Asked())
    near = 0
    for i, cell in enumerate(cells(3, 40, 0.2)):
        bound = search.least_peak(cell)
        peaks = []
        for law in laws_in(cell, i):
            try:
                peaks.append(peak_of(law, approach))
            except UnstableLoopError:
                continue
        assert all(bound <= each for each in peaks)
        near += bool(peaks) and bound > 0.9 * min(peaks)
    assert near > 5


@pytest.mark.parametrize("approach", [PROBLEM.approach, Approach(speed_m_s=0.03)])
def test_of_a_single_law_the_bound_is_its_largest_force_at_a_tick(approach: Approach) -> None:
    """The touch falls on a tick; of the sample of the touch alone an interval is left, a thousandth of the force."""
    search, stable = _Search([PLANT], LAW, approach, H, Asked()), 0
    for cell in cells(4, 20, 1e-9):
        try:
            trace = simulate_contact(CONTACT, law_at(cell[0], cell[2]), approach)
        except UnstableLoopError:
            continue
        stable += 1
        largest = float(np.max(trace.contact_force_n))
        assert 0.998 * largest <= search.least_peak(cell) <= trace.peak_contact_force_n
    assert stable > 10


@pytest.mark.parametrize(
    "asked",
    [
        Asked(modulus=0.5),
        Asked(min_m_s_per_n=7e-4, band_rad_per_s=BAND),
        Asked(noise_m_s_per_n=2e-3),
        Asked(noise_m_s_per_n=3e-3),
        Asked(noise_m_s_per_n=2e-3, noise_spectrum=HIGH),
    ],
)
def test_of_a_dropped_cell_no_law_meets_what_is_asked(asked: Asked) -> None:
    search = _Search([PLANT], LAW, PROBLEM.approach, H, asked)
    dropped = 0
    for i, cell in enumerate(cells(5, 60, 0.1)):
        if search.is_dropped(cell) or search.is_dropped_where_its_middle_is_worst(cell):
            dropped += 1
            assert not any(meets(law, asked) for law in laws_in(cell, i))
    assert 5 <= dropped < 60


def test_what_it_is_not_made_for_is_refused() -> None:
    def found(law: AdmittanceController, plant: object = PLANT, approach: Approach = PROBLEM.approach) -> None:
        bounds = (500.0, 2000.0), (0.0, 0.03)
        find_least_peak([plant], law, approach, H, bounds, ASKED, reached_n=70.0)  # type: ignore[list-item]

    with pytest.raises(ParameterError, match="four gains by Tustin's rule"):
        found(replace(LAW, compensation_mass_kg=2.0))
    with pytest.raises(ParameterError, match="wrench_filter"):
        found(LAW, replace(PLANT, wrench_filter=WrenchFilter(time_constant_s=1e-3)))
    with pytest.raises(ParameterError, match="one under F\\^d"):
        found(LAW, approach=Approach(force_n=30.0, driven_by="hand"))
