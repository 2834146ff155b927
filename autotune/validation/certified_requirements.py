"""What a controller file promises of an axis: what was asked outright, and of soft requirements what is achieved."""

import math
from dataclasses import replace

from autotune.formats.controller_record import AdmittanceRequirement, Asked, Controller, Requirement, SoftRequirement
from problems.design.requirements import NoiseLimit, PassivityTarget

_NO_SPEED = 1e-300


def asked_of(controller: Controller, name: str) -> Asked:
    """Return what must hold of one axis: what was asked outright, and of what need not be met what was achieved."""
    hard, soft = controller.certificate.requirements_of(name) or {}, (controller.certificate.soft or {}).get(name, {})
    return {**hard, **{key: promise for key, claim in soft.items() if (promise := _promise(claim)) is not None}}


def _promise(claim: SoftRequirement) -> Requirement | None:
    """Return what a soft requirement promises; None where nothing is."""
    asked, reached = claim.asked, math.inf if claim.achieved is None else claim.achieved
    if isinstance(asked, NoiseLimit):
        return replace(asked, max_speed_rms_m_s=max(reached, _NO_SPEED)) if reached < math.inf else None
    if reached == 0.0:
        return None
    if isinstance(asked, AdmittanceRequirement):
        return replace(asked, min_m_s_per_n=reached)
    # A port that is passive up to the Nyquist frequency is so just below it.
    return PassivityTarget(passive_below_hz=reached) if isinstance(asked, PassivityTarget) else reached


def soft_told(controller: Controller, name: str) -> str:
    """Say what is achieved of what was only wished; empty where nothing was."""
    soft = (controller.certificate.soft or {}).get(name, {})
    told = ", ".join(
        f"{key} {'without limit' if claim.achieved is None else f'{claim.achieved:.4g}'}" for key, claim in soft.items()
    )
    return f"; achieved of what was only wished: {told}" if told else ""


def limit_n(controller: Controller, name: str) -> float | None:
    """Return the promised limit of the peak [N, about a turning axis N·m]; None without one."""
    limit = asked_of(controller, name).get("max_peak_force_n")
    return float(limit) if isinstance(limit, int | float) else None
