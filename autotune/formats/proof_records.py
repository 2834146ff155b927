"""What `controller.yaml` says is proved beside the modulus: of a held payload, of peaks and of bouncing, as values."""

from dataclasses import dataclass
from typing import Annotated

from problems.contact.multiplier import Multiplier
from problems.design.hand import HandImpedance
from problems.frozen import AboveZero, NotNegative, Rule, Text


@dataclass(frozen=True, kw_only=True)
class HeldProof:
    """What of the modulus is proved while any hand up to `hand` holds the payload, on every surface and off it.

    K_e and M_p vary in their whole ranges, the rest is nominal. `modulus` and `share` are 0 where some such hand makes
    the loop unstable. The other fields are those of `ProvenRegion`.
    """

    hand: HandImpedance
    modulus: Annotated[float, Rule(description="What |1 + L| is proved to exceed", minimum=0, exclusiveMaximum=1)]
    method: Text
    share: Annotated[float, Rule(description="Share of the set that is proved; 1 is all of it", minimum=0, maximum=1)]
    cells: NotNegative
    arcs: NotNegative
    budget_s: AboveZero
    run_time_s: NotNegative


@dataclass(frozen=True, kw_only=True)
class PeakProof:
    """That no first contact exceeds `force_n`, wherever between two ticks it begins.

    K_e and M_p vary in their whole ranges, the rest is nominal.
    `staying` is the share in which the payload stays on the wall, so that its first contact is all of the contact. The
    other fields are those of `ProvenRegion`.
    """

    force_n: Annotated[float, Rule(description="What no first contact exceeds", exclusiveMinimum=0)]
    method: Text
    share: Annotated[float, Rule(description="Share of the set that is proved; 1 is all of it", minimum=0, maximum=1)]
    staying: Annotated[float, Rule(description="Share in which the payload stays on the wall", minimum=0, maximum=1)]
    cells: NotNegative
    budget_s: AboveZero
    run_time_s: NotNegative


@dataclass(frozen=True, kw_only=True)
class BouncingProof:
    """That no contact bounces for ever: whatever it begins with, it comes to rest under any constant force onto it.

    `over` varies in its whole range, K_e from above 0, the rest is nominal. `multiplier` shows it for `share` of that
    set, None where none was found. `impacts` were followed, and came to rest, over everything that is uncertain; 0
    where the proof covers that. The other fields are those of `ProvenRegion`.
    """

    over: Annotated[
        tuple[Text, ...], Rule(description="What varies in its whole range; the rest is nominal", minItems=1)
    ]
    method: Text
    share: Annotated[float, Rule(description="Share of the set that is proved; 1 is all of it", minimum=0, maximum=1)]
    multiplier: (
        Annotated[
            Multiplier,
            Rule(
                description="M(s) = η s + Σ c (1 − e^(−sτ)) + Σ b s/(s + λ) of a contact spring: η is rate_s, τ and c "
                "are shifts_s and shift_weights, λ and b fading_per_s and fading_weights; "
                "damper_s weighs the surface's damper",
                properties={"rate_s": Rule(minimum=0), "damper_s": Rule(minimum=0)},
            ),
        ]
        | None
    )
    impacts: Annotated[float, Rule(description="Impacts that were followed until they rested", minimum=0)]
    cells: NotNegative
    arcs: NotNegative
    budget_s: NotNegative
    run_time_s: NotNegative

    @property
    def is_proved(self) -> bool:
        """Whether all of the set is proved."""
        return self.share == 1.0


def share_of(over: str, share: float) -> str:
    """Return over what a claim is proved, and that it is only a share of that."""
    return over if share == 1.0 else f"only {100.0 * share:.3g} % of this set, the rest is swept: {over}"
