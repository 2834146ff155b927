"""The plants beyond K_e × M_p at which a certificate is held against: its own worst cases, corners, seeded samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from autotune.formats.certificate_record import AxisDomain, AxisMargins, Proof, ProvenRegion
from autotune.formats.controller_record import AxisPrediction
from autotune.formats.proof_records import BouncingProof
from autotune.formats.units import axis_units
from problems.design.uncertainty import ALWAYS_UNCERTAIN, STIFFNESS, SYMBOLS, PlantSet, Scenario
from problems.model.plant import Plant, WrenchFilter
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import RobotModel, bandwidth_hz

from .bouncing import bouncing_claim
from .driving_arm import led_claim

# Another sequence than the search's, so that it is not asked the same questions again.
SEED = 7919
_SAMPLES = 64
_REPLAYED = 4


@dataclass(frozen=True, kw_only=True)
class ValidationSamples:
    """What is looked at of the whole uncertainty: every plant for its margins, the first few for their peak too.

    `outside` names recorded worst cases that the domain does not hold.
    """

    scenarios: tuple[Scenario, ...]
    replayed: tuple[Scenario, ...]
    plants: tuple[Plant, ...]
    outside: tuple[str, ...]

    def extreme_ports(self) -> tuple[tuple[RobotModel, WrenchFilter], ...]:
        """Return the robots of the lowest and the highest bandwidth among the plants, behind the slowest filter."""
        robots = sorted({plant.robot for plant in self.plants}, key=bandwidth_hz)
        if not robots:
            return ()
        slowest = max((plant.wrench_filter for plant in self.plants), key=lambda each: each.time_constant_s)
        return tuple((robot, slowest) for robot in dict.fromkeys((robots[0], robots[-1])))


def build_validation_samples(domain: AxisDomain, margins: AxisMargins, predicted: AxisPrediction) -> ValidationSamples:
    """Return the plants of a domain that the grid over K_e × M_p leaves out; none where nothing else is uncertain."""
    if domain.uncertain is None:
        return ValidationSamples(scenarios=(), replayed=(), plants=(), outside=())
    whole = domain.plants
    named = {f"the worst plant of {name}": _scenario(case, whole) for name, case in margins.worst.items()}
    named |= {each.name: each.scenario() for each in predicted.scenarios if each.further}
    outside = tuple(name for name, scenario in named.items() if not whole.contains(scenario))
    samples = whole.samples(_SAMPLES, seed=SEED)
    scenarios = tuple(dict.fromkeys((*named.values(), *whole.corners(), *samples)))
    nominal = domain.plants.nominal
    return ValidationSamples(
        scenarios=scenarios,
        replayed=samples[:_REPLAYED],
        plants=tuple(scenario.plant(nominal) for scenario in scenarios),
        outside=outside,
    )


def recorded_plants(domain: AxisDomain, margins: AxisMargins) -> tuple[Plant, ...]:
    """Return the plants in contact at which the file says that a margin is smallest."""
    whole, nominal = domain.plants, domain.plants.nominal
    scenarios = dict.fromkeys(_scenario(case, whole) for case in margins.worst.values())
    return tuple(scenario.plant(nominal) for scenario in scenarios)


def sampled_claims(
    domain: AxisDomain,
    margins: AxisMargins,
    predicted: AxisPrediction,
    name: str,
    regions: Sequence[ProvenRegion] = (),
    bouncing: BouncingProof | None = None,
) -> tuple[Proof, ...]:
    """Return what is looked for, and not found, beyond what is proved.

    Of every axis that no contact bounces for ever, unless `bouncing` says that this is proved of all of it; where more
    than K_e and M_p is uncertain, of that set too. Where `regions` hold a proof over all that is uncertain, stability
    is none of it.
    """
    led = led_claim(name, predicted.peak_per_speed)
    searched: tuple[Proof, ...] = () if led is None else (led,)
    if bouncing is None or bouncing.impacts > 0.0:
        whole = "" if domain.uncertain is None else describe_set(domain, name)
        is_short = bouncing is not None and bouncing.is_proved
        searched = (bouncing_claim(name, domain, whole, is_short=is_short), *searched)
    if domain.uncertain is None:
        return searched
    others = build_validation_samples(domain, margins, predicted)
    is_proved = any(region.share == 1.0 and set(domain.uncertain) <= set(region.over) for region in regions)
    stable = "the margins stated" if is_proved else "stable with the margins stated"
    return (
        Proof(
            claim=f"axis {name}: {stable}, and no peak above the largest predicted",
            method="margins at recorded worst cases, corners and Sobol' samples of the whole set; some replayed",
            over=describe_set(domain, name),
            numbers={"plants": float(len(others.plants)), "replayed": float(len(others.replayed)), "seed": float(SEED)},
        ),
        *searched,
    )


def describe_set(domain: AxisDomain, name: str) -> str:
    """Return the ranges beyond K_e and M_p in words."""
    units = axis_units(name)
    # In the order of the table: that of the file's entries says nothing, and a file may be written again in another.
    ranges_text = [
        f"{SYMBOLS[name]} in [{low:g}, {high:g}] {units.unit(PARAMETERS[name].kind)}".rstrip()
        for name, (low, high) in domain.plants.further.items()
    ]
    cut = "" if domain.confidence is None else f", inside the {100.0 * domain.confidence.level:g} % confidence set"
    return f"K_e, M_p and {', '.join(ranges_text)}{cut}"


def _scenario(case: Mapping[str, float | str], whole: PlantSet) -> Scenario:
    """Return a recorded worst case as a point of the set; free space becomes its softest surface."""
    values = {key: float(value) for key, value in case.items()}
    values[STIFFNESS] = values[STIFFNESS] or whole.environment_stiffness_n_per_m[0]
    return Scenario(**values)


def scenario_of(plant: Plant, whole: PlantSet) -> Scenario:
    """Return a plant as a point of the set, free space as its softest surface."""
    found = {name: PARAMETERS[name].value(plant) for name in (*ALWAYS_UNCERTAIN, *whole.further)}
    # A bandwidth that is computed again may leave the set by a rounding error.
    return Scenario(
        **{name: min(max(value, whole.range_of(name)[0]), whole.range_of(name)[1]) for name, value in found.items()}
    )
