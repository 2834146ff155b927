"""Verify a controller from its file alone: every claim, then contacts with many plants of the certified set."""

from collections.abc import Callable
from dataclasses import dataclass

from autotune.formats.controller_record import Controller

from .disturbances import Disturbances
from .law import check_targets, of_own_law
from .monte_carlo import SAMPLES, SEED, AxisMonteCarlo, run_monte_carlo
from .monte_carlo_checks import monte_carlo_checks
from .report import Check
from .validate import validate_controller


@dataclass(frozen=True, kw_only=True)
class Verified:
    """The checks of a controller, and the simulations behind the last of them (none if there were none)."""

    checks: tuple[Check, ...]
    simulated: tuple[AxisMonteCarlo, ...]


def verify(
    controller: Controller,
    *,
    samples: int = SAMPLES,
    seed: int = SEED,
    disturbances: Disturbances | None = None,
    progress: Callable[[float], None] | None = None,
) -> Verified:
    """Verify all claims, and if they hold simulate `samples` plants with the disturbances of the cell.

    `progress` takes the share of the work done since its last call, 1 of the claims and 1 of the simulation. Nothing is
    raised for a check that fails.
    """
    report = validate_controller(controller, progress)
    simulated: tuple[AxisMonteCarlo, ...] = ()
    # Behind a claim that does not hold there is nothing to simulate: an unstable loop has no peaks.
    if samples and report.passed:
        simulated = run_monte_carlo(controller, count=samples, seed=seed, disturbances=disturbances, progress=progress)
    checks = (*report.checks, *monte_carlo_checks(simulated))
    return Verified(checks=(*check_targets(controller), *of_own_law(controller, checks)), simulated=simulated)
