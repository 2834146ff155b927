"""What every scenario must meet, or may miss at a price: each requirement as required/achieved, ≤ 1 when it is met."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from .._checks import interval, non_negative, positive
from ..errors import ParameterError
from ..frozen import freeze

# What is missed more than a thousandfold costs no more, and no price is above this: costs stay comparable numbers.
LARGEST_SHARE = 1e3
LARGEST_PRICE_N = 1e6
UPPER_LIMITS = ("max_peak_force_n", "command_noise")
"""Requirements that are met from below."""


@dataclass(frozen=True, kw_only=True)
class AdmittanceTarget:
    """|G(j2πf)| ≥ `min_m_s_per_n` for f in `band_hz` (MODEL.md, "Free-space admittance target")."""

    min_m_s_per_n: float = 7e-4
    band_hz: tuple[float, float] = (0.1, 2.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "min_m_s_per_n", positive("min_m_s_per_n", self.min_m_s_per_n))
        object.__setattr__(self, "band_hz", interval("band_hz", self.band_hz))
        positive("band_hz", self.band_hz[0])

    def scaled(self, factor: float) -> "AdmittanceTarget":
        """Return the same target, asking for `factor` times as much."""
        return replace(self, min_m_s_per_n=self.min_m_s_per_n * factor)


@dataclass(frozen=True, kw_only=True)
class NoiseLimit:
    """The commanded speed's RMS [m/s] under white force noise of `force_noise_rms_n`, at most `max_speed_rms_m_s`.

    The noise is None until somebody knows the sensor; a problem needs the number. (`problems.stability.noise`)
    """

    max_speed_rms_m_s: float
    force_noise_rms_n: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "max_speed_rms_m_s", positive("max_speed_rms_m_s", self.max_speed_rms_m_s))
        if self.force_noise_rms_n is not None:
            object.__setattr__(self, "force_noise_rms_n", non_negative("force_noise_rms_n", self.force_noise_rms_n))

    def ratio(self, gain_m_s_per_n: float) -> float:
        """Return achieved/allowed for a speed RMS per newton of noise."""
        return (self.force_noise_rms_n or 0.0) * gain_m_s_per_n / self.max_speed_rms_m_s

    def scaled(self, factor: float) -> "NoiseLimit":
        """Return the same limit, `factor` times as high."""
        return replace(self, max_speed_rms_m_s=self.max_speed_rms_m_s * factor)


@dataclass(frozen=True, kw_only=True)
class PassivityTarget:
    """Re G(j2πf) ≥ 0, the port F → V passive, for every f up to `passive_below_hz` (`problems.stability.passivity`)."""

    passive_below_hz: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "passive_below_hz", positive("passive_below_hz", self.passive_below_hz))

    def scaled(self, factor: float) -> "PassivityTarget":
        """Return the same target up to `factor` times the frequency."""
        return replace(self, passive_below_hz=self.passive_below_hz * factor)


Asked = float | AdmittanceTarget | NoiseLimit | PassivityTarget


@dataclass(frozen=True, kw_only=True)
class Requirements:
    """What every scenario must meet; None asks for nothing. Stability is always asked.

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
    free_space_admittance: AdmittanceTarget | None = field(default_factory=AdmittanceTarget)
    command_noise: NoiseLimit | None = None
    passivity: PassivityTarget | None = None
    soft_n: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (
            "modulus_margin",
            "gain_margin_db",
            "phase_margin_deg",
            "delay_margin_s",
            "decay_rate_per_s",
            "max_peak_force_n",
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, positive(name, value))
        if self.modulus_margin is not None and self.modulus_margin >= 1.0:
            raise ParameterError(
                "modulus_margin", self.modulus_margin, "below 1 (|1 + L| tends to 1 at high frequency)"
            )
        for name, price in self.soft_n.items():
            if name not in REQUIREMENTS:
                raise ParameterError("soft_n", name, f"given for {', '.join(REQUIREMENTS)} only")
            if getattr(self, name) is None:
                raise ParameterError(f"{name}.soft_n", price, "given together with what is asked")
            if positive(f"{name}.soft_n", price) > LARGEST_PRICE_N:
                raise ParameterError(f"{name}.soft_n", price, f"at most {LARGEST_PRICE_N:g} N (or ask for it outright)")
        freeze(self, "soft_n")

    def asked(self) -> dict[str, Asked]:
        """Return what is asked, by name, hard and soft."""
        return {name: getattr(self, name) for name in REQUIREMENTS if getattr(self, name) is not None}

    def cost_n(self, name: str, ratio: float) -> float:
        """Return what a soft requirement costs at required/achieved `ratio`; a ratio that is no number costs most."""
        missed = LARGEST_SHARE if math.isnan(ratio) else ratio - 1.0
        return self.soft_n[name] * min(max(missed, 0.0), LARGEST_SHARE)

    def split(self, ratios: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """Return the ratios of hard requirements, and those of soft ones."""
        hard = {name: value for name, value in ratios.items() if name not in self.soft_n}
        return hard, {name: value for name, value in ratios.items() if name in self.soft_n}


REQUIREMENTS = tuple(each.name for each in fields(Requirements) if each.name != "soft_n")
"""The names of all requirements."""


def level(asked: Asked) -> float:
    """Return the number of a requirement that is asked for more or less of: a margin, |G|, a speed RMS, a frequency."""
    if isinstance(asked, AdmittanceTarget):
        return asked.min_m_s_per_n
    if isinstance(asked, NoiseLimit):
        return asked.max_speed_rms_m_s
    return asked.passive_below_hz if isinstance(asked, PassivityTarget) else asked


def achieved(name: str, asked: Asked, ratio: float) -> float:
    """Return what was achieved where required/achieved is `ratio`, in the unit of what is asked."""
    if name in UPPER_LIMITS:
        return level(asked) * ratio
    return level(asked) / ratio if ratio > 0.0 else math.inf


def eased(requirements: Requirements, name: str, share: float) -> Requirements:
    """Return the requirements with one of them asked for less by `share`."""
    asked: Any = requirements.asked()[name]
    factor = 1.0 + share if name in UPPER_LIMITS else 1.0 - share
    less: dict[str, Any] = {name: asked * factor if isinstance(asked, float) else asked.scaled(factor)}
    return replace(requirements, **less)
