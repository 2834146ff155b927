"""Bounds of all that lies above half the sampling frequency, beside the sum over 800 of the frequencies that mix."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.certificate.family import Family
from autotune.certificate.other_frequencies import OtherFrequencies
from problems.contact.multiplier import Multiplier
from problems.model.plant import FREE_SPACE, Plant, WrenchFilter
from tests.autotune.certificate.test_bouncing import SOME, damped, lifted
from tests.autotune.certificate.test_enclosures import LAWS
from tests.problems.axes import PERIOD_S

K_E, REACH = 1.3e5, 400
OMEGA = np.pi / PERIOD_S * np.array([0.05, 0.5, 0.9, 0.999])
# What its real part, its size and its size above the sampling frequency are, is the same number.
PLAIN = Multiplier(rate_s=0.0, shifts_s=(), shift_weights=(), fading_per_s=(1.0,), fading_weights=(0.3,), damper_s=2e-4)
RANGES = {"payload_mass_kg": (15.0, 17.0), "drag_n_s_per_m": (200.0, 500.0), "coupling_stiffness_n_per_m": (2.8e5, 3e5)}


def free(coupling_damping: float, lag_s: float = 0.0) -> Plant:
    coupling = replace(damped().coupling, damping_n_s_per_m=coupling_damping)
    return damped(environment=FREE_SPACE, coupling=coupling, wrench_filter=WrenchFilter(time_constant_s=lag_s))


def family(plant: Plant, **ranges: tuple[float, float]) -> Family:
    return Family(nominal=plant, ranges=ranges, sample_time_s=PERIOD_S)


def largest(plant: Plant, multiplier: Multiplier | None, damping: float = 0.0) -> tuple[float, float]:
    """Return (Σ b* R⁻¹ b)^½ of all frequencies but ω, for what drives the spring and damper and what senses them.

    R_k is the real part of what both take at one frequency; without a multiplier it is that of the velocity.
    """
    found = []
    for omega in OMEGA:
        s, given, moved, sensed, _ = (
            each if np.ndim(each) == 0 else np.delete(each, REACH)
            for each in lifted(plant, LAWS["feedback"], omega, REACH)
        )
        moved = moved / (1.0 - np.exp(-s * PERIOD_S)) / PERIOD_S
        if multiplier is None:
            takes, sizes = np.real(s * given)[:, None, None], s[:, None]
        else:
            by, kappa = multiplier.response(s.imag), multiplier.damper_s if damping else 0.0
            takes, sizes = np.real(by * (1.0 / K_E + given))[:, None, None], by[:, None]
            if damping:
                across = 0.5 * (by * given + np.conj(kappa * s * given))
                lossy = kappa / damping + np.real(kappa * s * given)
                takes = np.array([[takes[:, 0, 0], across], [np.conj(across), lossy]]).transpose(2, 0, 1)
                sizes = np.stack([by, kappa * s], axis=1)
        ways = moved[:, None] * sizes, sensed[:, None] * np.ones(sizes.shape[1])
        inverse = np.linalg.inv(takes)
        found.append([np.sqrt(np.einsum("ni,nij,nj->", b.conj(), inverse, b).real) for b in ways])
    drives, senses = np.max(found, axis=0)
    return float(drives), float(senses)


@pytest.mark.parametrize("damping", [0.0, 50.0, 2000.0])
@pytest.mark.parametrize("coupling_damping", [0.0, 120.0])
@pytest.mark.parametrize("multiplier", [SOME, PLAIN], ids=["some", "plain"])
def test_no_sum_over_the_frequencies_exceeds_its_bound(
    damping: float, coupling_damping: float, multiplier: Multiplier
) -> None:
    plant = free(coupling_damping)
    bound = OtherFrequencies.of(family(plant), multiplier, K_E, damping)
    drives, senses = largest(plant, multiplier, damping)
    # Of a spring and one term the bound is the sum itself, but for ζ where every second frequency lies higher.
    drives_least, senses_least = (
        (0.9, 0.75) if multiplier is PLAIN and not damping and not coupling_damping else (0.3, 0.3)
    )
    assert drives_least * bound.drives < drives <= bound.drives
    assert senses_least * bound.senses < senses <= bound.senses
    assert (bound.damper, bound.compliance) == ((multiplier.damper_s, 1.0 / damping) if damping else (0.0, 0.0))


@pytest.mark.parametrize(("coupling_damping", "lag_s", "share"), [(0.0, 0.0, 0.9), (120.0, 1e-3, 0.5)])
def test_no_sum_of_velocities_exceeds_its_bound(coupling_damping: float, lag_s: float, share: float) -> None:
    plant = free(coupling_damping, lag_s)
    bound, (drives, senses) = OtherFrequencies.of_velocity(family(plant)), largest(plant, None)
    assert share * bound.drives < drives <= bound.drives
    assert share * bound.senses < senses <= bound.senses


def test_a_bound_of_a_family_holds_for_its_corners_and_is_that_of_none_softer() -> None:
    plant = free(120.0, 1e-3)
    bounds = (
        OtherFrequencies.of(family(plant, **RANGES), SOME, K_E, 50.0),
        OtherFrequencies.of_velocity(family(plant, **RANGES)),
    )
    found = []
    for mass in RANGES["payload_mass_kg"]:
        for drag in RANGES["drag_n_s_per_m"]:
            for stiffness in RANGES["coupling_stiffness_n_per_m"]:
                payload = replace(plant.payload, mass_kg=mass, drag_n_s_per_m=drag)
                coupling = replace(plant.coupling, stiffness_n_per_m=stiffness)
                corner = replace(plant, payload=payload, coupling=coupling)
                own = OtherFrequencies.of(family(corner), SOME, K_E, 50.0), OtherFrequencies.of_velocity(family(corner))
                found.append([number for each in own for number in (each.drives, each.senses)])
                for each, sums in zip(bounds, (largest(corner, SOME, 50.0), largest(corner, None)), strict=True):
                    assert sums[0] <= each.drives
                    assert sums[1] <= each.senses
    whole = [number for each in bounds for number in (each.drives, each.senses)]
    assert np.all(np.max(found, axis=0) <= np.array(whole) * (1.0 + 1e-12))
    # The worst of the first is one corner; of the second mass and drag count from different ends.
    assert whole[:2] == pytest.approx(np.max(found, axis=0)[:2], rel=1e-12)
    assert np.all(np.array(whole) < 1.3 * np.max(found, axis=0))


def test_where_nothing_is_bounded_the_bounds_are_infinite() -> None:
    """A payload that still swings above π/h, a real part that is eaten up, impulses through a damper unfiltered."""
    light = replace(free(0.0), payload=replace(damped().payload, mass_kg=3e5 * (PERIOD_S / np.pi) ** 2))
    heavy = replace(light, payload=replace(light.payload, mass_kg=1.1 * light.payload.mass_kg))
    stiff = PLAIN.least_real(np.pi / PERIOD_S) * heavy.payload.mass_kg
    assert OtherFrequencies.of(family(light), PLAIN, K_E, 0.0).drives == np.inf
    assert OtherFrequencies.of(family(heavy), PLAIN, 1e-3 * stiff, 0.0).drives < np.inf
    assert OtherFrequencies.of(family(free(0.0)), PLAIN, 1e12, 0.0).drives == np.inf
    assert OtherFrequencies.of_velocity(family(free(120.0))).senses == np.inf
    assert OtherFrequencies.of_velocity(family(free(120.0, 1e-4))).senses < np.inf


@pytest.mark.parametrize("damper", [0.0, 0.7])
def test_what_the_others_leave_is_positive_as_a_matrix_of_all(damper: float) -> None:
    """The others have `room` left of 1, and take of spring and damper what drives them and what they sense.

    Which share of both is common to spring and damper is not known: each is held against all of them twice.
    """
    rng = np.random.default_rng(7)
    bound = OtherFrequencies(drives=0.5, senses=0.8, damper=damper, compliance=0.3 if damper else 0.0)
    spring, velocity, driven, sensed, closed, moved, across = rng.uniform(0.0, 1.0, (7, 2000)) * np.array(
        [[1.0], [1.0], [1.0], [1.0], [3.0], [1.0], [0.4]]
    )
    left = bound.leave(spring, velocity, driven, sensed, closed, moved, across)
    drives = closed * 0.5
    room, by_spring = 1.0 - drives * 0.8, 0.5 * (driven * 0.8 + sensed * drives)
    by_damper = 0.5 * (damper * moved * 0.8 + sensed * drives)
    none, both = np.zeros_like(spring), np.sqrt(2.0)
    if damper:
        rows = [
            [spring, across, both * by_spring, none],
            [across, damper * (velocity + 0.3), none, both * by_damper],
            [both * by_spring, none, room, none],
            [none, both * by_damper, none, room],
        ]
    else:
        rows = [[spring, by_spring], [by_spring, room]]
    least = np.linalg.eigvalsh(np.array(rows).transpose(2, 0, 1))[:, 0]
    assert np.array_equal(left, least > 0.0)
    assert 50 < np.count_nonzero(left) < 1900
    endless = replace(bound, drives=np.inf).leave(spring, velocity, driven, sensed, closed, moved, across)
    assert not np.any(endless)
