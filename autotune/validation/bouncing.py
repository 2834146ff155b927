"""Search the certified set for contacts that bounce for ever, which stable loops in contact and apart do not exclude.

The linear unilateral contact scales with its forces: only the ratio of the speed at the impact to the steady speed
under the force that goes on, s = v (B_a + B_p)/F^d, decides how it ends. So one range of s covers all speeds and
forces.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.errors import CertificateError
from autotune.formats.certificate_record import AxisDomain, Proof
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from problems.contact.bouncing import ContactOutcome, Ending, follow_contact, settling_window
from problems.contact.linear_controller_contact import force_per_speed
from problems.contact.transient import Approach, SampledContact, build_sampled_contact
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError

RUNS, SEED = 1024, 104_729
SPEEDS, LEAST_FORCE = (0.5, 2.0), 0.05
"""Speeds at the impact as multiples of the approach's, and the least F^d as a share of the force that drives it."""
_SAMPLES, _FEWEST_RUNS = 32, 8
# Of the impacts, where a proof already covers K_e and M_p.
_SHORT = 4
METHOD = "impacts of the exact sampled loop with a unilateral contact, followed over settling times; a search, no proof"


@dataclass(frozen=True, kw_only=True)
class Impact:
    """One impact: the plant, the speed at which it is touched [m/s or rad/s], and F^d from then on [N or N·m].

    `ratio` is s, the speed over the steady one under that force.
    """

    scenario: Scenario
    speed: float
    force: float
    ratio: float

    @property
    def approach(self) -> Approach:
        """How it begins."""
        return Approach(speed_m_s=self.speed, after_impact_n=self.force)


@dataclass(frozen=True, kw_only=True)
class BounceSearch:
    """What was searched of one axis, and the first impact that bounces on; `bounced` says how.

    `decaying` impacts were still left when they were given up, weaker and weaker. `refusal` says why no contact could
    be followed.
    """

    axis: str
    runs: int
    plants: int
    decaying: int = 0
    found: Impact | None = None
    bounced: ContactOutcome | None = None
    refusal: str = ""

    @property
    def passed(self) -> bool:
        """Whether nothing was found."""
        return self.found is None and not self.refusal

    def message(self) -> str:
        """Return what was found in a sentence."""
        units = axis_units(self.axis)
        if self.refusal:
            return self.refusal
        if self.found is None or self.bounced is None:
            weaker = f", {self.decaying} of them slowly" if self.decaying else ""
            return (
                f"none found: {self.runs} impacts on {self.plants} plants come to rest{weaker} (speeds up to "
                f"{SPEEDS[1]:g} times the approach's, {units.force_name} down to {100.0 * LEAST_FORCE:g} % of it)"
            )
        impact, bounced = self.found, self.bounced
        return (
            f"the contact bounces for ever at {describe_impact(impact, self.axis)}: after "
            f"{bounced.duration_s:.3g} s it is still left {bounced.leaves_per_s:.3g} times a second, with impacts of "
            f"{bounced.peak_contact_force_n:.3g} {units.force}"
        )


def describe_impact(impact: Impact, axis: str) -> str:
    """Return an impact in words."""
    units = axis_units(axis)
    return (
        f"{scenario_text(impact.scenario, units)}, touched at {impact.speed:.3g} {units.speed} with F^d = "
        f"{impact.force:.3g} {units.force}"
    )


def drawn_plants(domain: AxisDomain) -> tuple[Scenario, ...]:
    """Return the plants that are searched: ends of K_e and M_p, corners of the whole set, and Sobol' samples of it."""
    whole = domain.plants
    ends = (
        Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass)
        for stiffness in domain.environment_stiffness_n_per_m
        for mass in domain.payload_mass_kg
    )
    return tuple(dict.fromkeys((*ends, *whole.corners(), *whole.samples(_SAMPLES, seed=SEED))))


def drawn_ratios(plants: int, *, is_short: bool = False) -> tuple[tuple[float, ...], ...]:
    """Return for every plant the ratios s of its impacts: spread by equal ratios, begun at another place each.

    The largest come first: what bounces at all bounces after them, and is found before the slow ones in between.
    """
    fewer = _SHORT if is_short else 1
    each = max(_FEWEST_RUNS // fewer, -(-RUNS // (fewer * plants)))
    low, high = SPEEDS[0], SPEEDS[1] / LEAST_FORCE
    begun = np.random.default_rng(SEED).random(plants)
    return tuple(tuple((low * (high / low) ** ((np.arange(each) + at) / each)).tolist()[::-1]) for at in begun)


def search_bouncing(
    axis: str,
    domain: AxisDomain,
    law: AdmittanceController | LinearController,
    sample_time_s: float,
    progress: Callable[[float], None] | None = None,
    *,
    is_short: bool = False,
) -> BounceSearch:
    """Follow `RUNS` impacts on plants of a domain and stop at the first one that bounces for ever.

    Speeds go up to twice the approach's, F^d from the force that drives it down to 5 % of it. Deterministic. A search
    that `is_short` follows a quarter.
    """
    nominal, plants = domain.plants.nominal, drawn_plants(domain)
    if domain.approach_force_n is None and domain.approach_speed_m_s is None:
        return BounceSearch(axis=axis, runs=0, plants=len(plants), refusal="the domain names no approach")
    ratios = drawn_ratios(len(plants), is_short=is_short)
    done, decaying = 0, 0
    for scenario, of_plant in zip(plants, ratios, strict=True):
        try:
            pair = build_sampled_contact(build_sampled_plant(scenario.plant(nominal), sample_time_s))
            window, impacts = settling_window(pair, law), impacts_of(scenario, pair, domain, law, of_plant)
        except (ParameterError, UnstableLoopError) as error:
            where = scenario_text(scenario, axis_units(axis))
            return BounceSearch(axis=axis, runs=done, plants=len(plants), refusal=f"{where}: {error}")
        for impact in impacts:
            seen, done = follow_contact(pair, law, impact.approach, window=window), done + 1
            decaying += seen.ending is Ending.DECAYING
            if seen.ending is Ending.BOUNCING:
                return BounceSearch(
                    axis=axis, runs=done, plants=len(plants), decaying=decaying, found=impact, bounced=seen
                )
        if progress is not None:
            progress(1.0 / len(plants))
    return BounceSearch(axis=axis, runs=done, plants=len(plants), decaying=decaying)


def impacts_of(
    scenario: Scenario,
    pair: SampledContact,
    domain: AxisDomain,
    law: AdmittanceController | LinearController,
    ratios: Sequence[float],
) -> tuple[Impact, ...]:
    """Return the impacts of one plant with these ratios s of speed and force.

    The speed is s times the approach's under its own force, and from twice on that speed under a smaller one.
    """
    if isinstance(law, LinearController):
        resistance = force_per_speed(pair, law)
    else:
        resistance = law.damping_n_s_per_m + pair.free.plant.payload.drag_n_s_per_m
    speed = domain.approach_speed_m_s
    driving = (domain.approach_force_n or 0.0) if speed is None else speed * resistance
    return tuple(
        Impact(
            scenario=scenario,
            speed=min(ratio, SPEEDS[1]) * driving / resistance,
            force=driving * min(1.0, SPEEDS[1] / ratio),
            ratio=ratio,
        )
        for ratio in ratios
    )


def bouncing_claim(axis: str, domain: AxisDomain, whole: str, *, is_short: bool = False) -> Proof:
    """Return what the search says of one axis once it found nothing; `whole` names a set of more than K_e and M_p."""
    units, plants = axis_units(axis), len(drawn_plants(domain))
    (low, high), (light, heavy) = domain.environment_stiffness_n_per_m, domain.payload_mass_kg
    ranges = f"M_p in [{light:g}, {heavy:g}] {units.mass}, K_e in [{low:g}, {high:g}] {units.stiffness}"
    return Proof(
        claim=f"axis {axis}: no contact found that bounces for ever",
        method=METHOD,
        over=f"{whole or ranges}; impacts at {SPEEDS[0]:g} to {SPEEDS[1]:g} times the approach's speed, F^d at "
        f"{LEAST_FORCE:g} to 1 times its {units.force_name}",
        numbers={
            "runs": float(sum(len(each) for each in drawn_ratios(plants, is_short=is_short))),
            "plants": float(plants),
            "seed": float(SEED),
        },
    )


class RefutedError(CertificateError):
    """A claim about `axis` is false, or cannot be proved, at the plant `scenario`.

    `impact` is the contact on it that bounces for ever, None where it is something else.
    """

    def __init__(self, message: str, *, axis: str, scenario: Scenario, impact: Impact | None = None) -> None:
        super().__init__(message)
        self.axis, self.scenario, self.impact = axis, scenario, impact
