"""A payload that an arm drives to a surface and on: what of it is claimed, and contacts by another method.

The arm is M_h, B_h and K_h between payload and an aim (`problems.design.driving_hand`). Here the plant goes in exact
substeps under the paper's difference equation, from rest, as in `replay`.
"""

import math
from dataclasses import replace

import numpy as np

from autotune.formats.certificate_record import AxisDomain, Proof
from autotune.formats.controller_record import PeakPerSpeed
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.arrays import FloatArray
from problems.compiled import compiled
from problems.design.driving_hand import driving_hands
from problems.design.hand import HandImpedance
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.hold import hold
from problems.model.plant import Environment, PayloadDynamics, Plant, build_plant_matrices

from .replay import equation_gains, settling_samples
from .replay_kernel import EquationGains, difference_step, rest_at

_METHOD = "contacts simulated, with an arm at the ends of K_e and M_p and in the hardest predicted one; no proof"
_SUBSTEPS = 20
_SPEED_M_S, _AFTER_S, _SHORTEST_S = 0.05, 1.0, 0.4
# The two sets of step matrices, and the columns of inputs: the command, the hand.
_AWAY, _TOUCHING, _COMMAND, _HAND = 0, 1, 0, 1
_ROBOT, _PAYLOAD, _VELOCITY = 0, -2, -1


def driven_plants(domain: AxisDomain, hardest: Scenario) -> tuple[Plant, ...]:
    """Return the plants of which that is claimed: the ends of K_e and M_p, and the hardest predicted contact."""
    ends = (
        Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass)
        for mass in domain.payload_mass_kg
        for stiffness in domain.environment_stiffness_n_per_m
    )
    return tuple(each.plant(domain.plants.nominal) for each in dict.fromkeys((*ends, hardest)))


def led_claim(name: str, led: PeakPerSpeed | None) -> Proof | None:
    """Return what is sampled of a payload that is led by hand; None of a file that says nothing of an arm."""
    if led is None or led.drives is None or led.arm is None or led.drives_for_s is None:
        return None
    unit, arm = axis_units(name).damping, led.arm.describe(turning=name in ROTATIONAL_AXES)
    held = "" if led.holds is None else f", {led.holds:.4g} where its mass moves along"
    return Proof(
        claim=(
            f"axis {name}: led by hand, per speed of the touch, no contact peaks above {led.pushes_on:.4g} {unit} "
            f"where the hand pushes on{held}, {led.lets_go:.4g} where it lets go, {led.drives:.4g} where {arm} drives "
            f"on for {led.drives_for_s:g} s"
        ),
        method=_METHOD,
        over="K_e and M_p",
    )


def replay_driven(
    plant: Plant, law: AdmittanceController, arm: HandImpedance, sample_time_s: float, drives_for_s: float
) -> float:
    """Return the peak force on the surface per speed of the touch [N·s/m] of a payload that an arm drives on.

    Raises ParameterError for a surface with a mass and a law that acts at once through a coupling with damping.
    """
    if plant.environment.mass_kg > 0.0:
        raise ParameterError("environment.mass_kg", plant.environment.mass_kg, "0 where an arm drives the payload")
    h, surface = sample_time_s, plant.environment
    payload = PayloadDynamics(
        mass_kg=plant.payload.mass_kg + arm.mass_kg,
        drag_n_s_per_m=plant.payload.drag_n_s_per_m + arm.damping_n_s_per_m,
    )
    held = replace(plant, payload=payload, environment=Environment(stiffness_n_per_m=arm.stiffness_n_per_m))
    touching = Environment(
        stiffness_n_per_m=arm.stiffness_n_per_m + surface.stiffness_n_per_m,
        damping_n_s_per_m=surface.damping_n_s_per_m,
    )
    sides = [build_plant_matrices(each, h) for each in (held, replace(held, environment=touching))]
    if plant.loop_delay_s == 0.0 and sides[0].d_force != 0.0:
        raise ParameterError("robot.delay_s", 0.0, "above 0 with damping in the coupling")
    steps = [hold(each.a, np.column_stack([each.b, each.push]), 1.0 / _SUBSTEPS) for each in sides]
    settled = settling_samples(held, law, h, _SHORTEST_S)
    after = max(settled, math.ceil((drives_for_s + _AFTER_S) / h))
    drag = law.damping_n_s_per_m + plant.payload.drag_n_s_per_m
    ahead = _SPEED_M_S * drag / arm.stiffness_n_per_m
    time = h / _SUBSTEPS * (np.arange(_SUBSTEPS * (settled + after)) + 0.5) - settled * h
    aim = _SPEED_M_S * np.minimum(time, drives_for_s) + ahead
    pull = arm.stiffness_n_per_m * aim + arm.damping_n_s_per_m * _SPEED_M_S * (time < drives_for_s)
    peak, speed = _drive(
        np.array([phi for phi, _ in steps]),
        np.array([gamma for _, gamma in steps]),
        (sides[0].c_force, float(sides[0].d_force)),
        sides[0].c_position,
        equation_gains(law, h),
        (float(surface.stiffness_n_per_m), surface.damping_n_s_per_m / h),
        pull,
        round(plant.loop_delay_s / h * _SUBSTEPS),
        float(-_SPEED_M_S * settled * h + ahead),
    )
    # At rest both springs carry the same, and the admittance may creep up to that.
    rest = float(aim[-1]) / (1.0 / surface.stiffness_n_per_m + 1.0 / arm.stiffness_n_per_m)
    return float(max(peak, rest) / (speed / h)) if speed > 0.0 else math.inf


def find_driven(
    led: PeakPerSpeed, domain: AxisDomain, hardest: Scenario, law: AdmittanceController, sample_time_s: float
) -> float:
    """Return the largest peak per speed [N·s/m] by this method, 0 of a file that states none."""
    if led.arm is None or led.drives_for_s is None:
        return 0.0
    found = (
        replay_driven(plant, law, arm, sample_time_s, led.drives_for_s)
        for plant in driven_plants(domain, hardest)
        for arm in driving_hands(led.arm)
    )
    return max(found)


@compiled
def _drive(
    phi: FloatArray,
    gamma: FloatArray,
    force_row: tuple[FloatArray, float],
    position_row: FloatArray,
    gains: EquationGains,
    surface: tuple[float, float],
    pull: FloatArray,
    late: int,
    start: float,
) -> tuple[float, float]:
    """Return the largest force on the surface, and the speed at the touch per sample."""
    (stiffness, damping), (of_state, of_command) = surface, force_row
    count = len(position_row)
    state, following, past = np.zeros(count), np.zeros(count), rest_at(start)
    state[_ROBOT] = state[_PAYLOAD] = start
    ticks = len(pull) // _SUBSTEPS
    whole, part = late // _SUBSTEPS, late % _SUBSTEPS
    sent = np.full(whole + 1 + ticks, start)
    peak = speed = 0.0
    for tick in range(ticks):
        force, position = of_state @ state + of_command * sent[tick], float(position_row @ state)
        past = difference_step(gains, past, force, position, False)
        sent[whole + 1 + tick] = past.sent
        for sub in range(_SUBSTEPS):
            pressed = stiffness * state[_PAYLOAD] + damping * state[_VELOCITY]
            presses = state[_PAYLOAD] > 0.0 and pressed > 0.0
            if presses and speed == 0.0:
                speed = state[_VELOCITY]
            peak = max(peak, pressed) if presses else peak
            side = _TOUCHING if presses else _AWAY
            command = sent[tick] if sub < part else sent[tick + 1]
            outside = pull[tick * _SUBSTEPS + sub]
            # Row by row: a product of matrices would make an array at each substep.
            for row in range(count):
                total = gamma[side, row, _COMMAND] * command + gamma[side, row, _HAND] * outside
                for column in range(count):
                    total += phi[side, row, column] * state[column]
                following[row] = total
            state, following = following, state
    return peak, speed
