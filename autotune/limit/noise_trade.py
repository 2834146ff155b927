"""What the least worst peak is where the noise of the command may be more or less, with bounds that hardly bind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from autotune.errors import InfeasibleError
from autotune.tuning.bounds import loosened_bounds
from autotune.tuning.search import solve_design
from problems.arrays import FloatArray
from problems.design.problem import DesignProblem, NoiseLimit
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.progress import no_progress
from problems.stability.noise import command_speed_gain

FACTORS = (0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True, kw_only=True)
class NoisePoint:
    """The least worst peak [N] with `factor` times the noise [m/s/N], and its gains; None where nothing is feasible."""

    factor: float
    noise_m_s_per_n: float
    peak_force_n: float | None
    law: AdmittanceController | None

    def to_dict(self) -> dict[str, float | None]:
        """Return it as plain data."""
        law = self.law
        return {
            "factor": self.factor,
            "noise_m_s_per_n": self.noise_m_s_per_n,
            "peak_force_n": self.peak_force_n,
            "mass": None if law is None else law.mass_kg,
            "damping": None if law is None else law.damping_n_s_per_m,
            "lead_s": None if law is None else law.lead_s,
            "feedback_damping_s": None if law is None else law.feedback_damping_s,
        }


def trade_text(points: Sequence[NoisePoint], unit: str) -> str:
    """Return the trade in one sentence."""
    peaks = ", ".join(
        f"no design with {each.factor:g}"
        if each.peak_force_n is None
        else f"{each.peak_force_n:.4g} {unit} with {each.factor:g}"
        for each in points
    )
    return f"peak against noise, M_a and K_l hardly bounded: {peaks} times the noise of the command"


def trade_noise(
    problem: DesignProblem,
    law: AdmittanceController,
    scenarios: Sequence[Scenario],
    *,
    factors: Sequence[float] = FACTORS,
    progress: Callable[[float], None] | None = None,
) -> tuple[NoisePoint, ...]:
    """Search four gains for each of `factors` times the noise that `law` makes over `scenarios`.

    Everything else is asked as in `problem`; M_a may be a fifth of its lower bound, K_l five times and
    B_fb twice the upper ones. The pose's noise counts as where `problem` limits that of the command.
    """
    report, h = progress or no_progress, problem.sample_time_s
    plants = [problem.plant(each) for each in scenarios]
    plants += [each.in_contact_with(FREE_SPACE) for each in plants]
    present = max(command_speed_gain(build_sampled_plant(each, h), law) for each in plants)
    bounds, points, known = loosened_bounds(problem), list[NoisePoint](), list[FloatArray]()
    known_noise = problem.requirements.command_noise
    of_pose = None
    if known_noise is not None and known_noise.position_noise_rms_m and known_noise.force_noise_rms_n:
        of_pose = known_noise.position_noise_rms_m / known_noise.force_noise_rms_n
    for factor in factors:
        limit = NoiseLimit(max_speed_rms_m_s=factor * present, force_noise_rms_n=1.0, position_noise_rms_m=of_pose)
        asked = replace(problem, bounds=bounds, requirements=replace(problem.requirements, command_noise=limit))
        try:
            # A law that is quiet enough for less noise is one for more.
            found = solve_design(asked, others=known)
        except InfeasibleError:
            peak, best = None, None
        else:
            peak, best = found.evaluation.objective_cost, asked.controller(found.design)
            known.append(found.design)
        points.append(NoisePoint(factor=factor, noise_m_s_per_n=limit.max_speed_rms_m_s, peak_force_n=peak, law=best))
        report(1.0 / len(factors))
    return tuple(points)
