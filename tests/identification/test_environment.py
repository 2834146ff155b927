"""Contacts that scipy's integrator made, and what is not a contact."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.coupling import CouplingFit
from identification.environment import Contact, find_holds, group_surfaces, identify_contact
from identification.segments import Span
from tests.identification.synthetic import Load, Touch, ramp, touch

FloatArray = NDArray[np.float64]

H_S = 1e-3
LOAD = Load(stiffness=2.4e5, damping=120.0, drag=280.0, mass=14.0)


def known(load: Load, *, stiffness_std: float = 0.0) -> CouplingFit:
    covariance = np.zeros((4, 4))
    covariance[0, 0] = stiffness_std**2
    return CouplingFit(
        stiffness_n_per_m=load.stiffness,
        damping_n_s_per_m=load.damping,
        drag_n_s_per_m=load.drag,
        mass_kg=load.mass,
        covariance=covariance,
        fit_error=0.0,
        band_hz=(0.25, 70.0),
    )


@cache
def made(stiffness: float, depth_m: float) -> Touch:
    return touch(LOAD, stiffness, 50.0, H_S, depth_m=depth_m)


def hold_of(made_touch: Touch) -> Span:
    return Span(start=made_touch.hold_start + 50, stop=len(made_touch.position_m))


def found(made_touch: Touch, *, sign: int = 1, noise_n: float = 0.0) -> Contact | None:
    rng = np.random.default_rng(6)
    force = made_touch.force_n + noise_n * rng.standard_normal(len(made_touch.force_n))
    position = made_touch.position_m + 1e-6 * (noise_n > 0.0) * rng.standard_normal(len(force))
    return identify_contact(hold_of(made_touch), sign * position, sign * force, H_S, known(LOAD), max(noise_n, 0.01))


@pytest.mark.parametrize(("stiffness", "depth_m"), [(2.0e4, 3e-3), (6.0e4, 1e-3), (2.0e5, 5e-4)])
def test_the_walls_stiffness_is_found_with_the_coupling_taken_out(stiffness: float, depth_m: float) -> None:
    contact = found(made(stiffness, depth_m))
    assert contact is not None
    # The low pass of 60 Hz and the first 12 ms that are skipped cost a percent where payload and wall still ring.
    assert contact.stiffness_n_per_m == pytest.approx(stiffness, rel=0.02)
    series = stiffness * LOAD.stiffness / (stiffness + LOAD.stiffness)
    assert contact.hold_force_n == pytest.approx(series * depth_m, rel=0.02)
    assert contact.peak_force_n == pytest.approx(-np.min(made(stiffness, depth_m).force_n), rel=1e-9)
    # Touch is at 8 mm; a threshold of 3 N is passed within a few samples.
    reached = np.flatnonzero(made(stiffness, depth_m).position_m > 8e-3)[0] * H_S
    assert contact.onset_s == pytest.approx(reached, abs=0.02)


def test_a_wall_on_the_other_side_is_the_same_wall() -> None:
    right, left = found(made(6.0e4, 1e-3)), found(made(6.0e4, 1e-3), sign=-1)
    assert right is not None
    assert left is not None
    assert (right.sign, left.sign) == (1, -1)
    assert left.stiffness_n_per_m == pytest.approx(right.stiffness_n_per_m, rel=1e-9)
    assert left.peak_force_n == pytest.approx(right.peak_force_n, rel=1e-9)


def test_noise_moves_the_stiffness_no_further_than_stated() -> None:
    contact = found(made(6.0e4, 1e-3), noise_n=0.2)
    assert contact is not None
    assert contact.stiffness_n_per_m == pytest.approx(6.0e4, rel=0.05)
    assert abs(contact.stiffness_n_per_m - 6.0e4) < 5.0 * contact.stiffness_std_n_per_m


def test_the_peak_is_that_of_the_first_touch_though_the_hold_comes_late() -> None:
    late = made(6.0e4, 1e-3)
    force = np.concatenate([late.force_n[: late.hold_start], np.full(1200, -45.0), late.force_n[late.hold_start :]])
    position = np.insert(late.position_m, late.hold_start, np.full(1200, late.position_m[-1]))
    spike = late.hold_start - 60
    force[spike : spike + 5] -= 80.0
    hold = Span(start=late.hold_start + 1300, stop=len(force))
    contact = identify_contact(hold, position, force, H_S, known(LOAD), 0.01)
    assert contact is not None
    assert contact.peak_force_n == pytest.approx(-np.min(force))


def test_no_wall_has_a_negative_damping() -> None:
    """In a slow approach speed and depth are alike; noise then trades stiffness for a damping below zero."""
    rng, slow = np.random.default_rng(12), made(2.0e4, 3e-3)
    found_below = 0
    for _ in range(30):
        noisy = slow.position_m + 2e-5 * rng.standard_normal(len(slow.position_m))
        force = slow.force_n + 0.3 * rng.standard_normal(len(slow.force_n))
        contact = identify_contact(hold_of(slow), noisy, force, H_S, known(LOAD), 0.3)
        if contact is not None:
            found_below += contact.damping_n_s_per_m == 0.0
            assert contact.damping_n_s_per_m >= 0.0
            assert contact.damping_std_n_s_per_m > 0.0
    assert found_below > 0


def test_a_steady_pull_without_an_onset_is_no_contact() -> None:
    n = 2000
    position, force = 0.02 * np.concatenate([ramp(n // 2), np.ones(n // 2)]), np.full(n, -30.0)
    hold = Span(start=n // 2 + 50, stop=n)
    assert identify_contact(hold, position, force, H_S, known(LOAD), 0.1) is None


def test_holds_are_rests_under_force() -> None:
    force = np.concatenate([np.zeros(500), np.full(500, -20.0), np.zeros(500), np.full(500, 9.0)])
    rests = tuple(Span(start=500 * i, stop=500 * (i + 1)) for i in range(4))
    assert find_holds(rests, force, 4.0) == (rests[1], rests[3])


def contact(stiffness: float, *, sign: int = 1, onset_s: float = 0.0, std: float = 500.0) -> Contact:
    return Contact(
        sign=sign,
        onset_s=onset_s,
        peak_force_n=40.0,
        hold_force_n=30.0,
        stiffness_n_per_m=stiffness,
        stiffness_std_n_per_m=std,
        damping_n_s_per_m=40.0,
        damping_std_n_s_per_m=5.0,
        fit_error=0.02,
    )


def test_contacts_that_felt_alike_are_one_surface() -> None:
    contacts = [
        contact(1.50e5, onset_s=1.0),
        contact(5.0e4, onset_s=2.0),
        contact(1.46e5, onset_s=3.0),
        contact(5.2e4, onset_s=4.0),
        contact(5.1e4, sign=-1, onset_s=5.0),
    ]
    surfaces = group_surfaces(contacts, known(LOAD))
    assert [[c.onset_s for c in s.contacts] for s in surfaces] == [[5.0], [2.0, 4.0], [1.0, 3.0]]
    soft = surfaces[1]
    assert soft.stiffness_n_per_m == pytest.approx(5.1e4)
    assert 1.0 / soft.secant_n_per_m == pytest.approx(1.0 / 5.1e4 + 1.0 / LOAD.stiffness)


def test_contacts_that_scatter_widen_the_deviation() -> None:
    (surface,) = group_surfaces([contact(9.0e4, std=10.0), contact(1.0e5, std=10.0)], known(LOAD))
    # Two values 1e4 apart: the mean is known to half of that, and to a percent in the secant at best.
    model = 0.01 * 9.5e4 * (1.0 + 9.5e4 / LOAD.stiffness)
    assert surface.stiffness_std_n_per_m == pytest.approx(np.hypot(5.0e3, model), rel=1e-6)


def test_what_is_not_known_of_the_coupling_is_not_known_of_the_wall() -> None:
    """1/K_e = 1/secant − 1/K_s, so dK_e = (K_e/K_s)² dK_s: a wall seen through a soft coupling is seen badly."""
    std = [
        surface.stiffness_std_n_per_m
        for known_to in (0.0, 2.4e3)
        for surface in group_surfaces([contact(4.8e5, std=0.0)], known(LOAD, stiffness_std=known_to))
    ]
    assert std[1] == pytest.approx(np.hypot(std[0], 4.0 * 2.4e3))


def test_a_wall_much_stiffer_than_the_coupling_is_badly_known() -> None:
    """The secant of a stiff wall is nearly K_s: a percent of it is eleven percent of a K_e that is ten times K_s."""
    (surface,) = group_surfaces([contact(10.0 * LOAD.stiffness, std=0.0)], known(LOAD))
    assert surface.stiffness_std_n_per_m / surface.stiffness_n_per_m == pytest.approx(0.11, rel=1e-6)
    assert surface.secant_std_n_per_m / surface.secant_n_per_m == pytest.approx(0.01, rel=1e-6)


def test_no_contact_is_no_surface() -> None:
    assert group_surfaces([], known(LOAD)) == ()
