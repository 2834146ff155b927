"""What every scenario must meet, or may miss at a price: each requirement as required/achieved, ≤ 1 when it is met."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from ..._checks import positive
from ...errors import ParameterError
from ...frozen import FrozenDict, freeze, short_repr
from ...text import meant
from .admittance import AdmittanceTarget
from .base import Requirement
from .command_noise import NoiseLimit
from .contact_at_speed import ContactAtSpeed
from .held_by_hand import HeldByHand
from .multiplicative_error import MultiplicativeError
from .passivity import PassivityTarget
from .registry import BUILT_IN

# What is missed more than a thousandfold costs no more, and no price is above this: costs stay comparable numbers.
LARGEST_SHARE = 1e3
LARGEST_PRICE_N = 1e6
_DEFAULT_ADMITTANCE = AdmittanceTarget(is_default=True)
_NOTHING: Mapping[str, float] = FrozenDict()

RequirementValue = (
    float | AdmittanceTarget | ContactAtSpeed | HeldByHand | MultiplicativeError | NoiseLimit | PassivityTarget
)
"""The threshold of a requirement, with what belongs to it."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Requirements:
    """What every scenario must meet; None asks for nothing. Stability is always asked.

    The fields are the requirements of the paper and their companions. Any other of the registry is an argument by its
    name, too, as `min_damping_ratio=0.2`, and so are those of `plugins`: requirements of other packages, which the
    registry does not know. `further` holds what is asked of these.
    `max_peak_force_n` limits the force on the environment, whatever the objective is. `soft_n` maps the name of a
    requirement to a price: it need not be met, and missing it by a share s (required/achieved − 1 in the worst
    scenario) counts as s times that many newtons more peak force.
    """

    modulus_margin: float | None = 0.5
    gain_margin_db: float | None = 6.0
    phase_margin_deg: float | None = 30.0
    delay_margin_s: float | None = 1e-3
    decay_rate_per_s: float | None = None
    max_peak_force_n: float | None = None
    free_space_admittance: AdmittanceTarget | None = _DEFAULT_ADMITTANCE
    command_noise: NoiseLimit | None = None
    passivity: PassivityTarget | None = None
    multiplicative_error: MultiplicativeError | None = None
    further: Mapping[str, RequirementValue] = field(default_factory=dict)
    plugins: tuple[Requirement[Any], ...] = ()
    soft_n: Mapping[str, float] = field(default_factory=dict)

    def __init__(
        self,
        *,
        modulus_margin: float | None = modulus_margin,
        gain_margin_db: float | None = gain_margin_db,
        phase_margin_deg: float | None = phase_margin_deg,
        delay_margin_s: float | None = delay_margin_s,
        decay_rate_per_s: float | None = None,
        max_peak_force_n: float | None = None,
        free_space_admittance: AdmittanceTarget | None = _DEFAULT_ADMITTANCE,
        command_noise: NoiseLimit | None = None,
        passivity: PassivityTarget | None = None,
        multiplicative_error: MultiplicativeError | None = None,
        further: Mapping[str, RequirementValue] = _NOTHING,
        plugins: tuple[Requirement[Any], ...] = (),
        soft_n: Mapping[str, float] = _NOTHING,
        **registered: RequirementValue | None,
    ) -> None:
        """Ask for the fields, and of `registered` for any other requirement by its name."""
        said = dict(locals())
        asked = {name: value for name, value in {**further, **registered}.items() if value is not None}
        for each in fields(self):
            object.__setattr__(self, each.name, asked if each.name == "further" else said[each.name])
        self._check()

    def __repr__(self) -> str:
        return short_repr(self, "Requirements")

    def _check(self) -> None:
        """Raise ParameterError for a name that is none and a value out of range; keep values in their own types."""
        for name in FIELDS:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, BUILT_IN[name].checked(getattr(self, name)))
        known = {name: each for name, each in self.kinds().items() if name not in FIELDS}
        for name in self.further:
            if name not in known:
                hint = meant(name, (*self.kinds(), "soft_n", "plugins"))
                raise ParameterError("a requirement", name, f"one of {', '.join(self.kinds())}", hint=hint)
        further = {name: known[name].checked(self.further[name]) for name in known if name in self.further}
        object.__setattr__(self, "further", FrozenDict(further))
        for name, price in self.soft_n.items():
            if name not in self.kinds():
                must = f"given for {', '.join(self.kinds())} only"
                raise ParameterError("soft_n", name, must, hint=meant(name, self.kinds()))
            if name not in self.asked():
                raise ParameterError(f"{name}.soft_n", price, "given together with what is asked")
            if positive(f"{name}.soft_n", price) > LARGEST_PRICE_N:
                raise ParameterError(f"{name}.soft_n", price, f"at most {LARGEST_PRICE_N:g} N (or ask for it outright)")
        freeze(self, "soft_n")

    def kinds(self) -> dict[str, Requirement[Any]]:
        """Return all requirements that may be asked here, by name."""
        return {**BUILT_IN, **{each.name: each for each in self.plugins}}

    def asked(self) -> dict[str, RequirementValue]:
        """Return what is asked, by name, hard and soft."""
        of_fields = {name: getattr(self, name) for name in FIELDS if getattr(self, name) is not None}
        return {**of_fields, **self.further}

    def of(self, *depends_on: str) -> Iterator[tuple[Requirement[Any], Any]]:
        """Yield the requirements that are asked and what is asked of each: those that depend on one, then the next."""
        kinds, asked = self.kinds(), self.asked()
        for part in depends_on:
            yield from ((kinds[name], value) for name, value in asked.items() if kinds[name].depends_on == part)

    def kind(self, name: str) -> Requirement[Any]:
        """Return the requirement of a name."""
        return self.kinds()[name]

    def with_asked(self, name: str, value: RequirementValue | None) -> "Requirements":
        """Return the same with another value of one requirement, or with None without it."""
        if name in FIELDS:
            change: dict[str, Any] = {name: value}
            return replace(self, **change)
        kept = {key: each for key, each in self.further.items() if key != name}
        return replace(self, further=kept if value is None else {**kept, name: value})

    def relaxed(self, name: str, share: float) -> "Requirements":
        """Return the requirements with one of them asked for less by a share."""
        return self.with_asked(name, self.kind(name).relaxed(self.asked()[name], share))

    def threshold(self, name: str) -> float:
        """Return the number of a requirement that is asked for more or less of."""
        return self.kind(name).threshold(self.asked()[name])

    def cost_n(self, name: str, ratio: float) -> float:
        """Return what a soft requirement costs at required/achieved `ratio`; a ratio that is no number costs most."""
        missed = LARGEST_SHARE if math.isnan(ratio) else ratio - 1.0
        return self.soft_n[name] * min(max(missed, 0.0), LARGEST_SHARE)

    def split(self, ratios: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the ratios of hard requirements, and those of soft ones."""
        hard = {name: value for name, value in ratios.items() if name not in self.soft_n}
        return hard, {name: value for name, value in ratios.items() if name in self.soft_n}


FIELDS = tuple(each.name for each in fields(Requirements) if each.name in BUILT_IN)
"""The names of the requirements that are fields of `Requirements`."""
