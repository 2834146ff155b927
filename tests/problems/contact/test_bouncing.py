"""Contacts that bounce for ever, against a small simulator of another make: scipy's filters, exponentials and roots."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.signal import bilinear

from problems.arrays import FloatArray
from problems.contact.bouncing import Ending, follow_contact, settling_window
from problems.contact.transient import Approach, SampledContact, build_sampled_contact
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import UnstableLoopError
from tests.problems.axes import linear_controller

PERIOD_S = 8e-4
# The shared case `bounce`: stable in contact and in free space, with a modulus margin of a third and more.
BOUNCY = AdmittanceController(mass_kg=6.6788, damping_n_s_per_m=3582.1, lead_s=0.042425, feedback_damping_s=0.024376)
CALMED = replace(BOUNCY, lead_s=0.03)
POLE, DELAY_S, FILTER = 41.42, 0.00172616, BOUNCY.velocity_filter_rad_per_s
K_S, B_S, B_P, M_P, K_E = 365_490.0, 2.207, 78.109, 4.0, 3_120_224.0


def bouncing_plant() -> Plant:
    return Plant(
        robot=RobotModel(numerator=np.array([POLE]), denominator=np.array([1.0, POLE]), delay_s=DELAY_S),
        coupling=Coupling(stiffness_n_per_m=K_S, damping_n_s_per_m=B_S),
        payload=PayloadDynamics(mass_kg=M_P, drag_n_s_per_m=B_P),
        environment=Environment(stiffness_n_per_m=K_E),
    )


def pair() -> SampledContact:
    return build_sampled_contact(build_sampled_plant(bouncing_plant(), PERIOD_S))


def impact(law: AdmittanceController, ratio: float, force: float = 3.0) -> Approach:
    return Approach(speed_m_s=ratio * force / (law.damping_n_s_per_m + B_P), after_impact_n=force)


@dataclass(frozen=True, kw_only=True)
class Played:
    """Times at which the contact was left, and the largest contact force of each touch, of which it is the end [s]."""

    left_s: FloatArray
    peaks_n: FloatArray


def play(law: AdmittanceController, force: float, speed: float, duration_s: float) -> Played:
    """Simulate from rest before the wall: each sample in two exact pieces, each touch found by Brent's method.

    F^d is what leads to `speed` until the first touch, and `force` from then on; `duration_s` counts from there.
    """
    # States x, x_p, v_p; input the position command that acts.
    free = np.array([[-POLE, 0.0, 0.0], [0.0, 0.0, 1.0], [(K_S - B_S * POLE) / M_P, -K_S / M_P, -(B_S + B_P) / M_P]])
    held = free.copy()
    held[2, 1] -= K_E / M_P
    drive = np.array([POLE, 0.0, B_S * POLE / M_P])
    whole, late = divmod(DELAY_S, PERIOD_S)

    def flow(touching: bool, span: float) -> FloatArray:
        block = np.zeros((4, 4))
        block[:3, :3], block[:3, 3] = held if touching else free, drive
        return np.asarray(expm(block * span))

    spans = (late, PERIOD_S - late)
    steps = {(touching, span): flow(touching, span) for touching in (True, False) for span in spans}
    forward = bilinear([law.lead_s, 1.0], [law.mass_kg, law.damping_n_s_per_m, 0.0], 1.0 / PERIOD_S)
    feedback = bilinear([law.feedback_damping_s * FILTER, 0.0], [1.0, FILTER], 1.0 / PERIOD_S)
    ahead = speed * (law.damping_n_s_per_m + B_P)
    s = np.array([-0.6 * speed, -0.6 * speed, 0.0, 0.0])
    inputs, outputs, seen, damped = [0.0, 0.0], [s[0], s[0]], [s[0]], [0.0]
    commands, touching, first, left, peaks, largest = [s[0]] * 4, False, math.inf, [], [], 0.0
    tick = 0
    while tick * PERIOD_S < first + duration_s:
        x, sensed = s[0], K_S * (s[1] - s[0]) + B_S * (s[2] - POLE * (commands[-int(whole) - 1] - s[0]))
        u = (ahead if math.isinf(first) else force) + sensed
        (b, a), (c, d) = forward, feedback
        y = (b[0] * u + b[1] * inputs[-1] + b[2] * inputs[-2] - a[1] * outputs[-1] - a[2] * outputs[-2]) / a[0]
        w = (c[0] * x + c[1] * seen[-1] - d[1] * damped[-1]) / d[0]
        inputs, outputs, seen, damped = [inputs[-1], u], [outputs[-1], y], [x], [w]
        commands = [*commands[1:], y - w]
        for span, command in zip(spans, (commands[-int(whole) - 2], commands[-int(whole) - 1]), strict=True):
            rest = span
            s[3] = command
            while rest > 0.0:
                end = (steps[touching, span] if rest == span else flow(touching, rest)) @ s
                if (end[1] > 0.0) == touching:
                    largest, s, rest = max(largest, K_E * end[1]), end, 0.0
                    continue
                when = brentq(lambda t, s=s, touching=touching: (flow(touching, t) @ s)[1], 1e-3 * rest, rest)
                s, rest, touching = flow(touching, when) @ s, rest - when, not touching
                # On the side that the next piece starts from.
                s[1] = 1e-16 if touching else -1e-16
                first = min(first, tick * PERIOD_S)
                if not touching:
                    left.append(tick * PERIOD_S - first)
                    peaks.append(largest)
                    largest = 0.0
        tick += 1
    return Played(left_s=np.array(left), peaks_n=np.array(peaks))


def test_the_case_is_stable_in_both_of_its_modes() -> None:
    both = pair()
    for plant in (both.contact, both.free):
        assert spectral_radius(build_loop(plant, BOUNCY)) < 1.0


def test_another_simulator_sees_the_same_endless_bounce() -> None:
    approach = impact(BOUNCY, 24.0)
    seen = follow_contact(pair(), BOUNCY, approach)
    played = play(BOUNCY, 3.0, approach.speed_m_s or 0.0, 2.0)
    late = played.left_s > 1.5
    assert seen.ending is Ending.BOUNCING
    # Half a second holds 47 bounces, so a rate counted in it is known to 2 %.
    assert seen.leaves_per_s == pytest.approx(np.sum(late) / 0.5, rel=0.03)
    # The other simulator looks at the force at the ends of its pieces: at most 0.5 ms apart, of a touch of 4 ms.
    assert seen.peak_contact_force_n == pytest.approx(np.max(played.peaks_n[late]), rel=0.05)
    # What the case was found with: 13.9 N after a minute.
    assert seen.peak_contact_force_n == pytest.approx(13.9, rel=0.01)


@pytest.mark.parametrize(("law", "ratio"), [(CALMED, 24.0), (BOUNCY, 1.0)])
def test_what_comes_to_rest_does_so_in_both_simulators(law: AdmittanceController, ratio: float) -> None:
    approach = impact(law, ratio)
    assert follow_contact(pair(), law, approach).ending is Ending.SETTLED
    played = play(law, 3.0, approach.speed_m_s or 0.0, 2.0)
    assert len(played.left_s) == 0 or np.max(played.left_s) < 1.0


@pytest.mark.parametrize("ratio", [2.0, 12.0])
def test_the_ending_hangs_on_the_ratio_of_speed_and_force_alone(ratio: float) -> None:
    one, other = (follow_contact(pair(), BOUNCY, impact(BOUNCY, ratio, force)) for force in (0.5, 200.0))
    assert one.ending is other.ending
    # The motion scales with the force, to the rounding of the moments at which contact begins and ends.
    assert other.peak_contact_force_n == pytest.approx(400.0 * one.peak_contact_force_n, rel=1e-6)


@pytest.mark.parametrize("ratio", [2.0, 24.0])
@pytest.mark.parametrize("gains", [BOUNCY, CALMED])
def test_a_law_as_a_matrix_ends_as_the_paper_s_own(gains: AdmittanceController, ratio: float) -> None:
    law, both = linear_controller(gains, PERIOD_S), pair()
    own, other = (follow_contact(both, each, impact(gains, ratio)) for each in (gains, law))
    assert own.ending is other.ending
    if own.ending is Ending.BOUNCING:
        # Contact begins and ends on a grid of a twentieth of a sample there.
        assert other.peak_contact_force_n == pytest.approx(own.peak_contact_force_n, rel=0.02)


def test_an_unstable_loop_has_no_settling_time() -> None:
    with pytest.raises(UnstableLoopError):
        settling_window(pair(), replace(BOUNCY, damping_n_s_per_m=100.0))
