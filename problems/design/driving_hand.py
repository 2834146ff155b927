"""A hand with an impedance that drives the payload on to a surface, and goes on for a while before it stops."""

import itertools
import math
from collections.abc import Iterable

import numpy as np

from ..contact.nonlinear_simulation import Operator, needed_substeps, simulate_operator
from ..model.controller import AdmittanceController
from ..model.plant import Plant
from ..model.response import hand_force_per_speed
from ..model.sampled import build_loop, build_sampled_plant, spectral_radius
from ..stability.margins import UnstableLoopError
from .hand import HandImpedance

REACTION_S = 0.2
"""How long such a hand goes on after the touch: an assumption, about the time of a simple reaction."""
# Any speed gives the same ratio.
_SPEED_M_S = 0.05
# A part of the motion has gone when it has decayed to exp(-7), a thousandth.
_DECAY_EXPONENTS, _SHORTEST_S, _LONGEST_S, _AFTER_S = 7.0, 0.4, 6.0, 1.0


def driving_hands(hand: HandImpedance) -> tuple[HandImpedance, ...]:
    """Return the hands at the ends of mass and damper with the whole spring; without one, a hand pushes as a force."""
    ends = itertools.product((0.0, hand.mass_kg), (0.0, hand.damping_n_s_per_m))
    found = (HandImpedance(mass_kg=m, damping_n_s_per_m=b, stiffness_n_per_m=hand.stiffness_n_per_m) for m, b in ends)
    return tuple(dict.fromkeys(found))


def driven_peak(
    plant: Plant, law: AdmittanceController, hand: HandImpedance, sample_time_s: float, reaction_s: float = REACTION_S
) -> float:
    """Return the peak force on the environment per speed of the touch [N·s/m], infinite where the loop is not stable.

    The hand is K_h, B_h and M_h between the payload and an aim, which moves at a steady speed ahead of it, goes on for
    `reaction_s` after the touch and rests from then on. Simulated from rest; all forces scale with the speed.
    """
    h = sample_time_s
    operator = Operator(
        mass_kg=hand.mass_kg,
        damping_n_s_per_m=hand.damping_n_s_per_m,
        stiffness_n_per_m=hand.stiffness_n_per_m,
        path_m=np.zeros(1),
    )
    held = operator.held(plant)
    radius = spectral_radius(build_loop(build_sampled_plant(held, h), law))
    if not radius < 1.0:
        return math.inf
    settled = _DECAY_EXPONENTS / -math.log(radius) * h
    approach = min(max(settled, _SHORTEST_S), _LONGEST_S)
    # While all moves steadily the spring gives what drag and law take, and the aim is so far ahead.
    lead = _SPEED_M_S * hand_force_per_speed(plant, law) / hand.stiffness_n_per_m
    time = h * np.arange(math.ceil((approach + reaction_s + max(settled, _AFTER_S)) / h))
    path = _SPEED_M_S * np.minimum(time - approach, reaction_s) + lead
    driven = Operator(
        mass_kg=hand.mass_kg,
        damping_n_s_per_m=hand.damping_n_s_per_m,
        stiffness_n_per_m=hand.stiffness_n_per_m,
        path_m=path,
    )
    substeps = max(needed_substeps(held, h), needed_substeps(plant, h))
    try:
        run = simulate_operator(plant, law, driven, sample_time_s=h, substeps=substeps, leaps=True)
    except UnstableLoopError:
        return math.inf
    return max(run.peak_contact_force_n, _at_rest(plant, path[-1], hand)) / (run.impact_speed_m_s or _SPEED_M_S)


def _at_rest(plant: Plant, aim: float, hand: HandImpedance) -> float:
    """Return the force [N] at rest, which the admittance may creep up to: both springs in series behind the aim."""
    surface, spring = plant.environment.stiffness_n_per_m, hand.stiffness_n_per_m
    return surface * spring / (surface + spring) * aim


def largest_driven_peak(
    plants: Iterable[Plant], law: AdmittanceController, hand: HandImpedance, sample_time_s: float
) -> float:
    """Return the largest peak per speed over plants and the hands of `driving_hands`."""
    hands = driving_hands(hand)
    return max(driven_peak(plant, law, each, sample_time_s) for plant in plants for each in hands)
