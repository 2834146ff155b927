"""The shared case `bounce` as a design problem on one plant, and a controller file as it was written before."""

from functools import cache

from autotune.formats.controller_record import Controller, RuntimePayload
from autotune.tuning.compare import judge_design
from autotune.tuning.record import build_controller
from autotune.validation.axis_proof import prove_axis
from problems.contact.transient import Approach
from problems.design.problem import DesignProblem, Requirements
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from tests.problems.contact.test_bouncing import B_P, B_S, BOUNCY, DELAY_S, K_E, K_S, M_P, PERIOD_S, POLE


def bouncing_problem(*, lead_s: tuple[float, float] = (BOUNCY.lead_s, BOUNCY.lead_s)) -> DesignProblem:
    """Return a problem whose only free variable is the lead; the largest, which is best for the peak, bounces."""
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=POLE, delay_s=DELAY_S),
            coupling_stiffness_n_per_m=K_S,
            coupling_damping_n_s_per_m=B_S,
            drag_n_s_per_m=B_P,
            environment_stiffness_n_per_m=(K_E, K_E),
            payload_mass_kg=(M_P, M_P),
        ),
        sample_time_s=PERIOD_S,
        approach=Approach(force_n=10.0),
        bounds={
            "mass": (BOUNCY.mass_kg, BOUNCY.mass_kg),
            "damping": (BOUNCY.damping_n_s_per_m, BOUNCY.damping_n_s_per_m),
            "lead_s": lead_s,
            "feedback_damping_s": (BOUNCY.feedback_damping_s, BOUNCY.feedback_damping_s),
        },
        requirements=Requirements(
            modulus_margin=0.33,
            gain_margin_db=None,
            phase_margin_deg=None,
            delay_margin_s=None,
            free_space_admittance=None,
        ),
    )


def written(law: AdmittanceController, axis: str = "x") -> Controller:
    """Return the controller file of a law on the case's plant, with everything proved and claimed but the bounces."""
    problem = bouncing_problem(lead_s=(law.lead_s, law.lead_s))
    design = [problem.bounds[name][0] for name in problem.variables]
    search = judge_design(problem, design)  # type: ignore[arg-type]
    modulus = min(each.margins.modulus for each in search.margins)
    payload = RuntimePayload(
        mass_kg=M_P, com_m=(0.0, 0.0, 0.1), force_bias_n=(0.0, 0.0, 0.0), torque_bias_n_m=(0.0, 0.0, 0.0)
    )
    proof = prove_axis(problem.plants, law, PERIOD_S, axis, modulus)
    return build_controller({axis: search}, payload, {axis: proof}, {"tool": "test"})


@cache
def bouncing_controller() -> Controller:
    """Return the file that was validated, and bounces."""
    return written(BOUNCY)
