"""The paper's small robot with the gains of its collision experiment, and a threshold chosen for it, made once."""

from dataclasses import replace
from functools import cache
from pathlib import Path

from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.limits import CollisionResponse
from autotune.formats.problem import ProblemSpec
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.strategies import StrategySettings, choose_strategies
from autotune.tuning.threshold import ThresholdSettings, without_response
from autotune.validation.axis_proof import ProofOptions, Prover
from identification.result import CouplingEstimate, PayloadEstimate, RobotEstimate
from problems.design.objectives import SensorForce
from problems.design.problem import Requirements
from tests.autotune.tuning.cases import identified_axis, identified_plant, known, known_vector

# Printed: 6.3 kg, B_a = 800, K_l = 13 ms, 32 N/mm over robot travel. The rest as `examples/paper/collision.py` has it.
GAINS = {"mass": 13.0, "damping": 800.0, "lead_s": 0.013, "feedback_damping_s": 0.0075}
STIFFNESS = (2e4, 3.6e4)
NOTHING_ASKED = Requirements(
    modulus_margin=None,
    gain_margin_db=None,
    phase_margin_deg=None,
    delay_margin_s=None,
    free_space_admittance=None,
)
SPEC = ProblemSpec(
    bounds={name: (value, value) for name, value in GAINS.items()},
    requirements=NOTHING_ASKED,
    objective=SensorForce(),
    uncertain={"drag_n_s_per_m": (100.0, 150.0)},
    collision_threshold=(2.0, 40.0),
).with_options(payload_mass=(6.3, 6.3), environment_stiffness=STIFFNESS)


def small_robot() -> IdentifiedFile:
    axis = identified_axis()
    axis = replace(
        axis,
        coupling=CouplingEstimate(stiffness_n_per_m=known(3e5), damping_n_s_per_m=known(300.0)),
        drag_n_s_per_m=known(150.0),
        robot=RobotEstimate(
            numerator=known_vector(34.0),
            denominator=known_vector(1.0, 34.0),
            delay_s=known(2.4e-3),
            bandwidth_hz=known(5.41),
        ),
    )
    whole = identified_plant()
    payload = PayloadEstimate(mass_kg=known(6.3, 0.01), com_m=whole.payload.com_m)
    result = replace(whole, payload=payload, axes={"x": axis})
    return IdentifiedFile(result=result, provenance={}, path=Path("identified.yaml"), sha256="0" * 64)


@cache
def varied() -> Controller:
    """The same gains, whose B_a follows the speed, with a full stop; contacts may have 50 N."""
    found = responding()
    search = found.searches["x"]
    asked = search.problem.requirements.with_asked("max_peak_force_n", 50.0)
    searches = {"x": replace(search, problem=replace(search.problem, requirements=asked))}
    threshold = ThresholdSettings(bounds_n=(2.0, 40.0), response=CollisionResponse.STOP, noise_rms_n=0.14)
    settings = StrategySettings(damping_bounds=(300.0, 2000.0), threshold=threshold)
    return choose_strategies(without_response(found.controller), searches, settings, Prover())


@cache
def responding() -> Optimized:
    return optimize(small_robot(), SPEC, seed=1, proof=ProofOptions(further_s=0.1))
