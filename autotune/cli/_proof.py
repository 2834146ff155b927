"""The options of `autotune optimize` that say how closely, and over how much, the modulus is proved."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from autotune.validation.continuous import ProofWishes

_DECLARED = (
    click.option(
        "--slack",
        type=click.FloatRange(min=0.1, max=50.0),
        metavar="PERCENT",
        help="Prove the modulus to this much below the swept one; 5 by default.",
    ),
    click.option(
        "--proof-budget",
        type=click.FloatRange(min=0.0, max=1e6),
        metavar="SECONDS",
        help="Prove over all that is uncertain, for about so long (10); 0 leaves it out.",
    ),
)


def proof_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command and hand it `proof`: what is asked, or None."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        return function(*args, proof=_wishes(kwargs.pop("slack"), kwargs.pop("proof_budget")), **kwargs)

    for option in reversed(_DECLARED):
        command = option(command)
    return command


def _wishes(slack: float | None, budget_s: float | None) -> "ProofWishes | None":
    if slack is None and budget_s is None:
        return None
    from autotune.validation.continuous import ProofWishes

    usual = ProofWishes()
    return ProofWishes(
        slack=usual.slack if slack is None else 0.01 * slack,
        budget_s=max(usual.budget_s, budget_s or 0.0),
        further_s=usual.further_s if budget_s is None else budget_s,
    )
