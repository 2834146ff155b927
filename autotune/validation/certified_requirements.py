"""What a controller file promises of an axis: what was asked outright, and of soft requirements what is achieved."""

import math

from autotune.formats.certificate_record import Asked, Requirement, SoftRequirement
from autotune.formats.controller_record import Controller
from autotune.plugins import build_requirements, find_requirement
from problems.design.requirements import Requirements

_LEAST = 1e-300


def asked_of(controller: Controller, name: str) -> Asked:
    """Return what must hold of one axis: what was asked outright, and of what need not be met what was achieved."""
    hard, soft = controller.certificate.requirements_of(name) or {}, (controller.certificate.soft or {}).get(name, {})
    achieved = {key: _achieved(key, claim) for key, claim in soft.items()}
    return {**hard, **{key: claim for key, claim in achieved.items() if claim is not None}}


def _achieved(key: str, claim: SoftRequirement) -> Requirement | None:
    """Return what is certified of a soft requirement; None where nothing is."""
    reached, requirement = math.inf if claim.achieved is None else claim.achieved, find_requirement(key)
    is_upper = requirement is not None and requirement.is_upper_limit
    if reached == math.inf if is_upper else reached == 0.0:
        return None
    value: Requirement = reached
    return value if requirement is None else requirement.with_threshold(claim.asked, max(reached, _LEAST))


def certified_problem_requirements(controller: Controller, name: str) -> Requirements:
    """Return what the search of one axis was asked, hard and soft, as far as it is installed.

    What the file does not say was not asked, whatever is asked by default.
    """
    soft = (controller.certificate.soft or {}).get(name, {})
    asked = {**(controller.certificate.requirements_of(name) or {}), **{key: each.asked for key, each in soft.items()}}
    known = {k: v for k, v in asked.items() if find_requirement(k) is not None and not isinstance(v, bool)}
    prices = {key: each.soft_n for key, each in soft.items() if key in known}
    return build_requirements(known, prices, without_defaults=True)


def describe_soft(controller: Controller, name: str) -> str:
    """Say what is achieved of soft requirements; empty without any."""
    soft = (controller.certificate.soft or {}).get(name, {})
    text = ", ".join(
        f"{key} {'without limit' if claim.achieved is None else f'{claim.achieved:.4g}'}" for key, claim in soft.items()
    )
    return f"; achieved of soft requirements: {text}" if text else ""


def limit_n(controller: Controller, name: str) -> float | None:
    """Return the promised limit of the peak [N, about a turning axis N·m]; None without one."""
    limit = asked_of(controller, name).get("max_peak_force_n")
    return float(limit) if isinstance(limit, int | float) else None
