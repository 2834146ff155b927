"""What the least worst peak is where the noise of the command may be more or less, with bounds that hardly bind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from autotune.tuning.bounds import loosened_bounds
from autotune.tuning.search import SearchResult
from autotune.tuning.structure import equal_noise, search_above_a_tick, solve_or_none, without_rise
from problems.arrays import FloatArray
from problems.design.problem import NoiseLimit
from problems.model.controller import AdmittanceController
from problems.progress import no_progress
from problems.stability.noise_spectrum import RelativeSpectrum

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
    found: SearchResult,
    bounds: Mapping[str, tuple[float, float]],
    *,
    factors: Sequence[float] = FACTORS,
    spectrum: RelativeSpectrum | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[NoisePoint, ...]:
    """Search four gains for each of `factors` times the noise that the design found makes.

    Everything else is asked as of that design, the admittance's peak too, and `bounds`, those of four gains, are
    loosened as `optimize` does where the noise is limited. The pose's noise counts where it did, and the
    force's with the spectrum that the limit has, or with `spectrum` where nothing is limited.
    """
    known_noise = found.problem.requirements.command_noise
    if known_noise is not None:
        spectrum = known_noise.noise_spectrum
    report, present = progress or no_progress, equal_noise(found, spectrum)
    gains = without_rise(found, replace(found.problem, bounds=bounds))
    of_pose = None
    if known_noise is not None and known_noise.position_noise_rms_m and known_noise.force_noise_rms_n:
        of_pose = known_noise.position_noise_rms_m / known_noise.force_noise_rms_n
    known = [found.design] if gains.variables == found.problem.variables else list[FloatArray]()
    points = list[NoisePoint]()
    for factor in factors:
        limit = NoiseLimit(
            max_speed_rms_m_s=factor * present,
            force_noise_rms_n=1.0,
            position_noise_rms_m=of_pose,
            noise_spectrum=spectrum,
        )
        requirements = replace(gains.requirements, command_noise=limit)
        asked = replace(gains, bounds=loosened_bounds(gains), requirements=requirements)
        # A law that is quiet enough for less noise is one for more.
        best = search_above_a_tick(lambda each: solve_or_none(each, known, 0), asked, found)
        peak, law = (None, None) if not points else (points[-1].peak_force_n, points[-1].law)
        if best is not None and (peak is None or best.evaluation.objective_cost < peak):
            peak, law = best.evaluation.objective_cost, asked.controller(best.design)
            known.append(best.design)
        points.append(NoisePoint(factor=factor, noise_m_s_per_n=limit.max_speed_rms_m_s, peak_force_n=peak, law=law))
        report(1.0 / len(factors))
    return tuple(points)
