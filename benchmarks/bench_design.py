"""One design in one scenario: stability, modulus margin and peak force, beside python-control (with slycot).

Both start from the sampled plant and the controller's parameters, which change from call to call. Ours is what the
optimizer runs, which also takes the modulus in free space. python-control closes
the loop from the Tustin forms, takes its poles, the modulus margin from the H∞ norm of the sensitivity (slycot's
ab13dd) or from a grid of 2000 frequencies, and `forced_response` over the same number of samples; the scenario is one
that stays in contact. The plant's states are scaled for it beforehand: as they stand (metres beside metres per sample)
ab13dd is 5 % off on this loop. The last table is the same over many designs and scenarios: the cost per evaluation does
not grow.

Usage: python benchmarks/bench_design.py
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np
from scipy.linalg import matrix_balance

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.timing import best
from problems.arrays import FloatArray
from problems.contact.transient import Approach, SampledContact, build_sampled_contact, transient_from
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.objectives import SensorForce
from problems.design.problem import DesignProblem, Requirements
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet, Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant

Vector = np.ndarray[tuple[int], np.dtype[np.float64]]

H = 8e-4
APPROACH = Approach(force_n=30.0)
DESIGNS = 200
_ASKED = 0.1
"""Any modulus: its share of what is reached says what that is."""
try:
    import slycot  # noqa: F401 - python-control uses it when it is there

    HAS_SLYCOT = True
except ImportError:
    HAS_SLYCOT = False


def main() -> int:
    pair = build_sampled_contact(build_sampled_plant(_plant(1e5), H))
    designs = np.array([(10.0, 1200.0 + i, 0.02, 0.0) for i in range(DESIGNS)])
    first = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1200.0, lead_s=0.02)
    batch = _batch(1)
    result = _evaluate(batch, designs)  # compiled code is loaded outside the measurement
    scale = _scale(pair)
    samples = len(transient_from(pair, first, APPROACH).time_s)
    fast = best(lambda: _evaluate(batch, designs), 20) / DESIGNS
    print(f"{samples} samples")
    print("                        stable  modulus margin  peak at the sensor [N]   time [µs]  ratio")
    _print("autotune", result, fast, fast)
    for name, norm in (("python-control, grid", False), ("python-control, slycot", True)):
        if norm and not HAS_SLYCOT:
            continue
        theirs = peer(pair, scale, first, samples, norm)
        slow = best(lambda by_norm=norm: peer(pair, scale, first, samples, by_norm), 10)  # type: ignore[misc]
        _print(name, theirs, slow, fast)
    print("\nscenarios  designs  per evaluation [µs]")
    for scenarios in (1, 9, 81):
        several = _batch(scenarios)
        for count in (10, 100):
            _evaluate(several, designs[:count])
            seconds = best(lambda s=several, n=count: _evaluate(s, designs[:n]), 5)  # type: ignore[misc]
            print(f"{scenarios:9d}  {count:7d}  {seconds / (scenarios * count) * 1e6:19.1f}")
    return 0


def _print(name: str, row: tuple[bool, float, float], seconds: float, fast: float) -> None:
    print(f"{name:22s}  {row[0]!s:>6}  {row[1]:14.9f}  {row[2]:22.12f}  {seconds * 1e6:10.1f}  {seconds / fast:5.0f}")


def peer(
    pair: SampledContact, scale: Vector, controller: AdmittanceController, samples: int, by_norm: bool
) -> tuple[bool, float, float]:
    """Return stability, modulus margin and peak of −F by python-control."""
    plant = pair.contact
    d = plant.whole_delay
    gamma, row = plant.gamma[:, None] / scale[:, None], plant.c_force[None, :] * scale
    held = control.ss(plant.phi * scale / scale[:, None], gamma, row, [[0.0]], H)
    shift = control.ss(np.eye(d, k=-1), np.eye(d, 1), np.eye(1, d, k=d - 1), [[0.0]], H)
    numerator = [controller.lead_s, 1.0]
    denominator = [controller.mass_kg, controller.damping_n_s_per_m, 0.0]
    admittance = control.c2d(control.ss(control.tf(numerator, denominator)), H, "tustin")
    loop = -held * shift * admittance
    closed = control.feedback(loop, 1)  # L/(1 + L), from F^d to −F
    stable = bool(np.max(np.abs(closed.poles())) < 1.0)
    if by_norm:
        margin = 1.0 / control.linfnorm(1 - closed)[0]
    else:
        grid = np.geomspace(2.0 * np.pi * 0.2, np.pi / H, 2000)
        margin = np.min(np.abs(1.0 + control.frequency_response(loop, grid).complex))
    start = _steady_state(pair, scale, controller, admittance)
    response = control.forced_response(closed, np.arange(samples) * H, np.full(samples, 30.0), start)
    return stable, float(margin), float(np.max(response.outputs))


def _scale(pair: SampledContact) -> Vector:
    """Return powers of two that balance the plant with its input and output."""
    plant = pair.contact
    whole = np.block([[plant.phi, plant.gamma[:, None]], [plant.c_force, np.zeros(1)]])
    _, (scale, _) = matrix_balance(whole, permute=False, separate=True)
    return np.asarray(scale[:-1] / scale[-1])


def _steady_state(
    pair: SampledContact, scale: Vector, controller: AdmittanceController, admittance: control.StateSpace
) -> Vector:
    """Return the steady approach in python-control's order of states: admittance, past commands, plant."""
    n, d = pair.contact.state_count, pair.contact.whole_delay
    speed = 30.0 / (controller.damping_n_s_per_m - pair.ramp[0, -1] * H)
    plant, command = pair.ramp[0, :n] * speed * H / scale, pair.ramp[0, n] * speed * H
    force = controller.damping_n_s_per_m * speed
    # The admittance's two states from its command at this tick and at the next.
    a, b, c, direct = admittance.A, admittance.B[:, 0] * force, admittance.C[0], admittance.D[0, 0] * force
    right = [command - direct, command + speed * H - direct - c @ b]
    own = np.linalg.solve(np.array([c, c @ a]), right)
    return np.concatenate([own, command - speed * H * np.arange(1, d + 1), plant])


def _plant(stiffness: float, mass: float = 16.0) -> Plant:
    return Plant(
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
        coupling=Coupling(stiffness_n_per_m=3e5, damping_n_s_per_m=0.0),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=630.0),
        environment=Environment(stiffness_n_per_m=stiffness),
    )


def _batch(count: int) -> BatchEvaluator:
    side = round(count**0.5)
    problem = DesignProblem(
        plants=PlantSet(nominal=_plant(1e5), ranges={STIFFNESS: (5e4, 1.5e5), MASS: (12.0, 20.0)}),
        sample_time_s=H,
        approach=APPROACH,
        requirements=Requirements(
            modulus_margin=_ASKED,
            gain_margin_db=None,
            phase_margin_deg=None,
            delay_margin_s=None,
            free_space_admittance=None,
        ),
        objective=SensorForce(),
    )
    stiffness = np.geomspace(5e4, 1.5e5, side) if side > 1 else [1e5]
    mass = np.linspace(12.0, 20.0, side) if side > 1 else [16.0]
    scenarios = [
        Scenario(environment_stiffness_n_per_m=float(k), payload_mass_kg=float(m)) for k in stiffness for m in mass
    ]
    return build_batch_evaluator(build_scenarios(problem, scenarios))


def _evaluate(batch: BatchEvaluator, designs: FloatArray) -> tuple[bool, float, float]:
    """Return stability, modulus margin and peak of the first design in its first contact."""
    found = batch.evaluate(designs, peaks_if_missed=True)
    return (
        bool(found.is_stable[0]),
        _ASKED / float(found.rows["modulus_margin"][0, 0]),
        float(found.objective_rows[0, 0]),
    )


if __name__ == "__main__":
    sys.exit(main())
