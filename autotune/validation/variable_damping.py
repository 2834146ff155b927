"""Stability while B_a varies: small gain around one damping at which the modulus of the loop is proved.

The law's difference equation is M_a (y_{k+1} − 2y_k + y_{k−1}) + ½ B_a h (y_{k+1} − y_{k−1}) = (what drives it), with
the admittance's own output y = x^d + C_fb x. A B_a that is B_0 + Δ_k adds Δ_k times the speed of y to the left: a gain
from tick to tick around the loop of B_0. Cut there, that loop is (1 + C_fb X/X^d)/((M_a s + B_0)(1 + L)), L at the
command, s the Tustin image on the unit circle, where |M_a s + B_0| ≥ B_0. So any sequence with
|Δ_k| sup|1 + C_fb X/X^d| < m B_0 is stable where |1 + L| ≥ m is proved, and has one quadratic Lyapunov function.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from autotune.formats.certificate_record import Proof
from autotune.formats.controller_record import Controller
from autotune.formats.limits import VariableDampingSettings
from autotune.formats.units import axis_units
from problems.arrays import FloatArray
from problems.design.uncertainty import ALWAYS_UNCERTAIN, PlantSet
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel

from .axis_proof import STABILITY_WORK, Prover, modulus_claim
from .margins import sweep_margins
from .replay import robot_alone
from .replay_kernel import over_sample
from .report import Check

METHOD = "small gain around the modulus that is proved at one B_a"
# The largest of |1 + C_fb X/X^d| is looked for on so many frequencies, and between them bounded by its derivative.
_FREQUENCIES = 2**16
# An impulse response has ended where it is this small, in so many periods at most.
_ENDED, _LONGEST = 1e-13, 2**14
_ENDS_STIFFNESS, _ENDS_MASS = 9, 3
# What is proved of the modulus is needed with some room, so that rounding here decides nothing.
_ROOM = 1.0 + 1e-6


@dataclass(frozen=True, kw_only=True)
class VariedProof:
    """What came of the proof: the B_a around which, the modulus needed there, and whether that is proved."""

    centre: float
    needed_modulus: float
    holds: bool
    origin: str = ""

    def statement(self, plants: PlantSet, variable: VariableDampingSettings, name: str) -> Proof:
        """Return what a certificate states of it."""
        units, (low, high), (light, heavy) = axis_units(name), *_ranges(plants)
        others = "" if not plants.further else ", everything else at its nominal value"
        return Proof(
            claim=(
                f"axis {name}: stable while B_a varies in [{variable.lowest:g}, {variable.highest:g}] {units.damping}, "
                "however fast, while it stays in contact and while it stays in free space"
            ),
            method=METHOD,
            over=f"every M_p in [{light:g}, {heavy:g}] {units.mass}, K_e in [{low:g}, {high:g}] "
            f"{units.stiffness}{others}",
            numbers={"around": self.centre, "needed_modulus": self.needed_modulus},
        )


def _ranges(plants: PlantSet) -> tuple[tuple[float, float], tuple[float, float]]:
    return plants.environment_stiffness_n_per_m, plants.payload_mass_kg


def needed_modulus(
    law: AdmittanceController, robot: RobotModel, sample_time_s: float, span: tuple[float, float]
) -> float:
    """Return the modulus at the command from which any B_a in `span` [N·s/m] is stable around that of `law`."""
    around = law.damping_n_s_per_m
    farthest = max(span[1] - around, around - span[0])
    return _ROOM * farthest / around * _largest_feedback(law, robot, sample_time_s)


def _largest_feedback(law: AdmittanceController, robot: RobotModel, h: float) -> float:
    """Return an upper bound of |1 + C_fb X/X^d| over all frequencies, from the impulse response of C_fb X/X^d."""
    if law.feedback_damping_s == 0.0:
        return 1.0
    response = _feedback_response(law, robot, h)
    ticks = np.arange(len(response))
    largest = float(np.max(np.abs(1.0 + np.fft.rfft(response, _FREQUENCIES))))
    return largest + math.pi / _FREQUENCIES * float(np.sum(ticks * np.abs(response)))


def _feedback_response(law: AdmittanceController, robot: RobotModel, h: float) -> FloatArray:
    """Return C_fb x (n,) at the ticks after one command of 1 m in one period."""
    alone = robot_alone(robot, h)
    state, sent = np.zeros(len(alone.output)), np.zeros(alone.whole + 2 + _LONGEST)
    sent[alone.whole + 1] = 1.0
    half = 0.5 * law.velocity_filter_rad_per_s * h
    out, velocity, before, largest = [], 0.0, 0.0, 0.0
    for tick in range(_LONGEST):
        position = float(alone.output @ state)
        moved = law.velocity_filter_rad_per_s * (position - before)
        velocity, before = ((1.0 - half) * velocity + moved) / (1.0 + half), position
        out.append(law.feedback_damping_s * velocity)
        largest = max(largest, abs(velocity))
        if tick > alone.whole + 2 and np.max(np.abs(state)) + abs(velocity) <= _ENDED * largest:
            break
        state = over_sample(alone.sample, state, sent[tick], sent[tick + 1])
    return np.array(out)


def prove_varied(
    prover: Prover,
    plants: PlantSet,
    law: AdmittanceController,
    sample_time_s: float,
    variable: VariableDampingSettings,
    known: tuple[float, float] | None,
) -> VariedProof:
    """Prove an axis stable while its B_a varies in any way over the range of its variable damping.

    `known` are modulus and budget [s] that are proved, or claimed, of the law itself over K_e and M_p. Where that is
    not enough, the modulus is proved around the middle of the range, from which it need be least.
    """
    span, robot = (variable.lowest, variable.highest), plants.nominal.robot
    needed = needed_modulus(law, robot, sample_time_s, span)
    if known is not None and needed <= known[0]:
        claim = modulus_claim(plants, law, sample_time_s, ALWAYS_UNCERTAIN, *known)
    else:
        law = replace(law, damping_n_s_per_m=0.5 * (variable.lowest + variable.highest))
        needed = needed_modulus(law, robot, sample_time_s, span)
        if needed >= 1.0:
            return VariedProof(centre=law.damping_n_s_per_m, needed_modulus=needed, holds=False)
        claim = modulus_claim(plants, law, sample_time_s, ALWAYS_UNCERTAIN, needed, 1.0)
        claim = replace(claim, work=STABILITY_WORK)
    origin, found = prover.origin(claim), prover.prove(claim)
    return VariedProof(centre=law.damping_n_s_per_m, needed_modulus=needed, holds=found.holds, origin=origin)


def known_modulus(controller: Controller, name: str) -> tuple[float, float] | None:
    """Return modulus and budget of what a certificate says is proved of one axis over K_e and M_p."""
    for region in (controller.certificate.continuous or {}).get(name, ()):
        if region.over == ALWAYS_UNCERTAIN and region.share == 1.0:
            return region.modulus, region.budget_s
    return None


def modulus_at_ends(
    plants: PlantSet, law: AdmittanceController, sample_time_s: float, variable: VariableDampingSettings
) -> float:
    """Return the least |1 + L| of the loops that keep the lowest and the highest B_a, swept over K_e and M_p."""
    ends = (replace(law, damping_n_s_per_m=each) for each in (variable.lowest, variable.highest))
    swept = [sweep_margins(plants, each, sample_time_s, stiffness=_ENDS_STIFFNESS, mass=_ENDS_MASS) for each in ends]
    return min(each.values["modulus"] if each.largest_radius < 1.0 else 0.0 for each in swept)


def check_variable_damping(
    controller: Controller, name: str, law: AdmittanceController, prover: Prover
) -> tuple[Iterator[Check], tuple[Proof, ...]]:
    """Prove again what the file states of an axis whose B_a varies; return the checks, and what may be stated."""
    variable, plants = controller.damping_of(name), controller.certificate.domain[name].plants
    if variable is None:
        return iter(()), ()
    h, units = controller.sample_time_s, axis_units(name)
    found = prove_varied(prover, plants, law, h, variable, known_modulus(controller, name))
    span = f"B_a in [{variable.lowest:g}, {variable.highest:g}] {units.damping}"
    if not found.holds:
        message = f"stability while B_a varies is not proved: {span} needs |1 + L| > {found.needed_modulus:.4g}"
        return iter((Check(axis=name, name="variable damping", passed=False, message=message),)), ()
    at_ends = modulus_at_ends(plants, law, h, variable)
    message = (
        f"any change of {span} is stable: |1 + L| > {found.needed_modulus:.4g} is needed at B_a = {found.centre:g}, "
        f"and proved{found.origin}; at its ends the modulus is {at_ends:.4g} (swept)"
    )
    return iter((Check(axis=name, name="variable damping", passed=True, message=message),)), (
        found.statement(plants, variable, name),
    )
