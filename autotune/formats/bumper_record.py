"""What `controller.yaml` says of a payload that is soft inside, as values; of straight axes only."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from problems.frozen import AboveZero, NotNegative, Rule, Text, freeze
from problems.model.plant import Bumper

from .proof_records import share_of
from .units import AXES

_Straight = Annotated[str, Rule(enum=AXES[:3])]


@dataclass(frozen=True, kw_only=True)
class BumperContacts:
    """What one axis does with a bumper: the least modulus and the largest peaks over `plants` of the certified set.

    These are sampled; `hardest` is the plant of the largest peak at the contact. `proved_modulus` is what |1 + L| is
    proved to exceed for `share` of K_e × M_p, everything else nominal; 0 where nothing is. The other fields are those
    of `ProvenRegion`.
    """

    modulus: AboveZero
    peak_contact_force_n: AboveZero
    peak_sensor_force_n: AboveZero
    hardest: Mapping[str, Annotated[float, Rule(minimum=0, maximum=1e9)]]
    plants: AboveZero
    proved_modulus: Annotated[float, Rule(minimum=0, exclusiveMaximum=1)] = 0.0
    share: Annotated[
        float, Rule(description="Share of the set that is proved; 1 is all of it", minimum=0, maximum=1)
    ] = 0.0
    cells: NotNegative = 0.0
    arcs: NotNegative = 0.0
    budget_s: NotNegative = 0.0
    run_time_s: NotNegative = 0.0

    def __post_init__(self) -> None:
        freeze(self, "hardest")


@dataclass(frozen=True, kw_only=True)
class BumperRecord:
    """A payload that touches with a part of its mass behind a spring and a damper, and what the axes do with it."""

    bumper: Annotated[
        Bumper,
        Rule(
            description="mass M_t, a part of the payload's, stiffness K_t and damping B_t of what touches",
            properties={
                "mass_kg": Rule(exclusiveMinimum=0, maximum=1000),
                "stiffness_n_per_m": Rule(exclusiveMinimum=0, maximum=1_000_000_000),
                "damping_n_s_per_m": Rule(minimum=0, maximum=10_000_000),
            },
        ),
    ]
    axes: Annotated[Mapping[_Straight, BumperContacts], Rule(minProperties=1)]
    method: Text
    proof_method: Text

    def __post_init__(self) -> None:
        freeze(self, "axes")

    def describe(self) -> str:
        """Return the bumper in words."""
        return describe_bumper(self.bumper)

    def sampled(self) -> Iterator[dict[str, Any]]:
        """Yield what was sampled of each axis, as `Proof` has it."""
        for name, each in self.axes.items():
            said = (
                f"|1 + L| at least {each.modulus:.3g}, at most {each.peak_contact_force_n:.4g} N at the contact and "
                f"{each.peak_sensor_force_n:.4g} N at the sensor"
            )
            yield {
                "claim": f"axis {name}: with {self.describe()} {said}",
                "method": self.method,
                "over": "the domain, and free space",
                "numbers": {"plants": each.plants},
            }

    def proved(self) -> Iterator[dict[str, Any]]:
        """Yield what is proved of each axis, as `Proof` has it."""
        for name, each in self.axes.items():
            if each.share > 0.0:
                yield {
                    "claim": f"axis {name}: stable with |1 + L| > {each.proved_modulus:.4g} with {self.describe()}",
                    "method": self.proof_method,
                    "over": share_of("every K_e and M_p of the domain, and free space, all else nominal", each.share),
                    "numbers": {"share": each.share, "cells": each.cells, "arcs": each.arcs},
                }


def describe_bumper(bumper: Bumper) -> str:
    """Return a bumper in words."""
    return (
        f"a bumper of {bumper.mass_kg:g} kg on {1e-3 * bumper.stiffness_n_per_m:g} N/mm and "
        f"{bumper.damping_n_s_per_m:g} N·s/m"
    )
