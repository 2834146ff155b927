"""What a certificate claims of a sampled loop, the sets of plants that it speaks of, and what came of the proof."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import pairwise

import numpy as np

from problems.arrays import FloatArray
from problems.design.hand import HandImpedance
from problems.design.uncertainty import ENVIRONMENT_MASS, MASS, STIFFNESS, UNCERTAIN, PlantSet, Scenario
from problems.errors import ParameterError
from problems.frozen import freeze
from problems.model.plant import FREE_SPACE, Environment, Plant
from problems.model.plant_parameters import PARAMETERS, with_values
from problems.model.robot import vary_robot
from problems.model.sampled import Controller, split_delay

Interval = tuple[float, float]

# A proof's work is counted, not timed, so that the same input gives the same file; this many are done in a second.
WORK_PER_SECOND = 40_000
LAG, LATE = "wrench_time_constant_s", "wrench_delay_s"
PROVABLE = tuple(name for name in UNCERTAIN if PARAMETERS[name].is_provable)
"""What is proved over, M_e as part of the mass in contact (`build_families`)."""
_ENVIRONMENT = frozenset(name for name in UNCERTAIN if PARAMETERS[name].part == "environment")


@dataclass(frozen=True, kw_only=True)
class Claim:
    """That a sampled loop is stable, with |1 + L| > `modulus` at both break points, in contact and in free space.

    It is claimed of every plant in the box of `plants`, whatever cuts that; with a `hand`, of each of them held by
    every such hand, with its spring or without. A `modulus` of None claims stability alone. `work` bounds the effort of
    the proof.
    """

    plants: PlantSet
    law: Controller
    sample_time_s: float
    modulus: float | None
    work: int
    hand: HandImpedance | None = None


@dataclass(frozen=True, kw_only=True)
class Family:
    """A nominal plant and closed ranges of its parameters, under a hold of `sample_time_s`.

    `ranges` is keyed by the names of `problems.design.uncertainty`; what is not named is nominal. Free space is a
    nominal environment that is FREE_SPACE; a range of K_e from 0 is every stiffness above 0. Raises ParameterError for
    a name that is not provable, for a range that is none, for an environment with mass, for a filter of the wrench
    that reaches 0, and for a delay that crosses a whole number of samples, where the loop changes its order
    (`build_families` cuts there). A delay of the wrench makes the same loop as a longer T_d: `build_families` adds
    them, and `shared_delay` then holds the ranges of both. So does an environment's mass with a larger payload, in
    contact: `shared_mass` holds the ranges of both.
    """

    nominal: Plant
    ranges: Mapping[str, Interval]
    sample_time_s: float
    shared_delay: tuple[Interval, Interval] | None = None
    shared_mass: tuple[Interval, Interval] | None = None

    def __post_init__(self) -> None:
        freeze(self, "ranges")
        for name, (low, high) in self.ranges.items():
            if name not in PROVABLE or name == ENVIRONMENT_MASS:
                raise ParameterError("ranges", name, f"one of {', '.join(PROVABLE)}")
            if not 0.0 <= low <= high < math.inf:
                raise ParameterError(name, (low, high), "[lowest, highest] with 0 ≤ lowest ≤ highest")
        environment, bumper = self.nominal.environment, self.nominal.bumper
        if bumper is not None and not bumper.mass_kg < self.range_of(MASS)[0]:
            must = f"below the payload's {self.range_of(MASS)[0]:g} kg"
            raise ParameterError("bumper.mass_kg", bumper.mass_kg, must)
        if environment.mass_kg != 0.0:
            raise ParameterError("environment.mass_kg", environment.mass_kg, "0, to be proved over")
        softest, stiffest = self.range_of(STIFFNESS)
        if stiffest <= 0.0 and (_ENVIRONMENT & self.ranges.keys() or not environment.is_free_space):
            raise ParameterError(STIFFNESS, softest, "greater than 0 in contact")
        if self.nominal.wrench_filter.delay_s > 0.0 or LATE in self.ranges:
            raise ParameterError(LATE, self.range_of(LATE), "0 (`build_families` adds it to the delay)")
        if LAG in self.ranges and not min(self.nominal.wrench_filter.time_constant_s, self.ranges[LAG][0]) > 0.0:
            raise ParameterError(LAG, self.ranges[LAG], "greater than 0, as the nominal one")
        if self.range_of(MASS)[0] <= 0.0:
            raise ParameterError(MASS, self.range_of(MASS)[0], "greater than 0")
        self.delay()

    def range_of(self, name: str) -> Interval:
        """Return the range of one parameter, from nominal to nominal where none is given."""
        if name in self.ranges:
            return self.ranges[name]
        value = PARAMETERS[name].value(self.nominal)
        return value, value

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of what has more than one value, in a fixed order."""
        return tuple(name for name in PROVABLE if self.range_of(name)[0] < self.range_of(name)[1])

    @property
    def is_free_space(self) -> bool:
        """Whether nothing is touched, so that the loop keeps its integrator."""
        return self.range_of(STIFFNESS)[1] == 0.0

    @property
    def is_soft(self) -> bool:
        """Whether K_e is all from above 0 on, so that the loop comes as near to its integrator as one likes."""
        low, high = self.range_of(STIFFNESS)
        return low == 0.0 < high

    def delay(self) -> tuple[int, bool]:
        """Return the whole samples of delay, and whether a fraction may remain."""
        low, high = self.range_of("delay_s")
        whole, fraction = split_delay(low, self.sample_time_s)
        if low == high:
            return whole, fraction > 0.0
        last, rest = split_delay(high, self.sample_time_s)
        if last > whole and not (last == whole + 1 and rest == 0.0):
            raise ParameterError(
                "delay_s", (low, high), "within two ticks of the controller; cut it with `build_families`"
            )
        return whole, True

    def in_free_space(self) -> "Family":
        """Return the same plants with nothing to touch."""
        kept = {name: span for name, span in self.ranges.items() if name not in _ENVIRONMENT}
        if self.shared_mass is not None:
            kept[MASS] = self.shared_mass[0]
        return replace(self, nominal=self.nominal.in_contact_with(FREE_SPACE), ranges=kept, shared_mass=None)

    def on_springs_up_to(self, stiffness: float) -> "Family":
        """Return plants of free space on springs to ground of every stiffness from above 0 [N/m]."""
        nominal = self.nominal.in_contact_with(Environment(stiffness_n_per_m=stiffness))
        return replace(self, nominal=nominal, ranges={**self.ranges, STIFFNESS: (0.0, stiffness)})

    def box(self) -> FloatArray:
        """Return the coordinates' ends (d, 2), rounded outwards; the payload's is 1/M_p, or 1/(M_p − M_t)."""
        spans = [self.range_of(name) for name in self.varying]
        rows = [
            self._by_mass(low, high) if name == MASS else (low, high)
            for name, (low, high) in zip(self.varying, spans, strict=True)
        ]
        return np.array(rows, dtype=np.float64).reshape(-1, 2)

    def _by_mass(self, low: float, high: float) -> Interval:
        """Return the ends of the payload's coordinate; of a payload with a bumper it is that of the rest."""
        if self.nominal.bumper is not None:
            part = self.nominal.bumper.mass_kg
            low, high = float(np.nextafter(low - part, 0.0)), float(np.nextafter(high - part, np.inf))
        return float(np.nextafter(1.0 / high, 0.0)), float(np.nextafter(1.0 / low, np.inf))

    def is_held_by_nothing(self, cell: FloatArray) -> bool:
        """Return whether plants of a cell (d, 2) come as near as one likes to those on no spring at all."""
        return self.is_soft and bool(cell[self.varying.index(STIFFNESS), 0] == 0.0)

    def springs_of(self, cell: FloatArray) -> tuple[int, float]:
        """Return which coordinate of a cell (d, 2) is K_e, which varies, and the largest in the cell [N/m]."""
        place = self.varying.index(STIFFNESS)
        return place, float(cell[place, 1])

    def softest_of(self, cells: Sequence[FloatArray]) -> float | None:
        """Return the least K_e in cells (d, 2) [N/m], None where it does not vary."""
        if STIFFNESS not in self.varying:
            return None
        return min(float(cell[self.varying.index(STIFFNESS), 0]) for cell in cells)

    def scenario(self, point: FloatArray) -> Scenario:
        """Return the plant at coordinates (d,) as a point of the uncertainty."""
        values = dict(zip(self.varying, np.asarray(point).tolist(), strict=True))
        if MASS in values:
            part = 0.0 if self.nominal.bumper is None else self.nominal.bumper.mass_kg
            values[MASS] = 1.0 / values[MASS] + part
        inside = {name: min(max(value, self.ranges[name][0]), self.ranges[name][1]) for name, value in values.items()}
        if self.shared_delay is not None:
            own, late = _parted(inside.get("delay_s", self.range_of("delay_s")[0]), self.shared_delay)
            inside |= {"delay_s": own, LATE: late}
        if self.shared_mass is not None:
            own, moved = _parted(inside.get(MASS, self.range_of(MASS)[0]), self.shared_mass)
            inside |= {MASS: own, ENVIRONMENT_MASS: moved}
        return Scenario(**{STIFFNESS: self.range_of(STIFFNESS)[0], MASS: self.range_of(MASS)[0], **inside})

    def plant(self, point: FloatArray) -> Plant:
        """Return the plant at coordinates (d,)."""
        return self.scenario(point).plant(self.nominal)


def _parted(whole: float, spans: tuple[Interval, Interval]) -> tuple[float, float]:
    """Return two numbers whose sum is `whole`, each as far into its range as the other."""
    (low, high), (other_low, other_high) = spans
    width = high - low + other_high - other_low
    share = min(max((whole - low - other_low) / width, 0.0), 1.0) if width > 0.0 else 0.0
    return low + share * (high - low), other_low + share * (other_high - other_low)


def families_of(claim: Claim) -> dict[str, list[Family]]:
    """Return the families of a claim by where they are: the fields of `CombinedCertificate`."""
    plants, hand = claim.plants, claim.hand
    if hand is not None:
        # A hand holds what bears a bumper, and not what touches.
        plants.nominal.require_one_piece()
        plants = hand.on_contact(plants)
    contact = build_families(plants.nominal, plants.ranges, claim.sample_time_s)
    free = [family.in_free_space() for family in contact]
    found = {"free_space": free, "contact": list(contact)}
    if hand is not None and hand.stiffness_n_per_m > 0.0:
        found["held"] = [family.on_springs_up_to(hand.stiffness_n_per_m) for family in free]
    return found


def build_families(nominal: Plant, ranges: Mapping[str, Interval], sample_time_s: float) -> tuple[Family, ...]:
    """Return all plants as families in contact, cut where the delay passes a tick of the controller.

    While they touch, payload and environment are one mass M_p + M_e, so that the loop is that of such a payload on an
    environment without mass. In free space it is M_p alone (`Family.in_free_space`).
    """
    nominal, ranges, shared_mass = _with_joined_masses(nominal, ranges)
    late = ranges.get(LATE, (nominal.wrench_filter.delay_s,) * 2)
    shared: tuple[Interval, Interval] | None = None
    if late[1] > 0.0:
        own = ranges.get("delay_s", (nominal.robot.delay_s, nominal.robot.delay_s))
        shared = own, (late[0], late[1])
        ranges = {name: span for name, span in ranges.items() if name not in {LATE, "delay_s"}}
        if own[0] < own[1] or late[0] < late[1]:
            # Rounded outwards: the range must hold every sum.
            ranges["delay_s"] = float(np.nextafter(own[0] + late[0], 0.0)), float(np.nextafter(own[1] + late[1], 1.0))
        robot = vary_robot(nominal.robot, delay_s=nominal.loop_delay_s)
        nominal = replace(nominal, robot=robot, wrench_filter=replace(nominal.wrench_filter, delay_s=0.0))
    low, high = ranges.get("delay_s", (nominal.robot.delay_s, nominal.robot.delay_s))
    first, last = math.floor(low / sample_time_s) + 1, math.ceil(high / sample_time_s)
    ends = [low, *(each for k in range(first, last) if low < (each := k * sample_time_s) < high), high]
    spans = [dict(ranges) if "delay_s" not in ranges else {**ranges, "delay_s": span} for span in pairwise(ends)]
    return tuple(
        Family(nominal=nominal, ranges=each, sample_time_s=sample_time_s, shared_delay=shared, shared_mass=shared_mass)
        for each in spans
    )


def _with_joined_masses(
    nominal: Plant, ranges: Mapping[str, Interval]
) -> tuple[Plant, Mapping[str, Interval], tuple[Interval, Interval] | None]:
    """Return plant and ranges with M_e in the payload, rounded outwards, and the ranges of both where there is any."""
    moved = ranges.get(ENVIRONMENT_MASS, (nominal.environment.mass_kg,) * 2)
    kept = {name: span for name, span in ranges.items() if name != ENVIRONMENT_MASS}
    if moved[1] == 0.0:
        return nominal, kept, None
    nominal.require_one_piece()
    own = ranges.get(MASS, (nominal.payload.mass_kg,) * 2)
    kept[MASS] = float(np.nextafter(own[0] + moved[0], 0.0)), float(np.nextafter(own[1] + moved[1], np.inf))
    return with_values(nominal, {ENVIRONMENT_MASS: 0.0}), kept, (own, moved)


class Verdict(Enum):
    """How an attempt to prove a claim ended; the text says what that means."""

    PROVED = "holds for every plant of the set at every frequency"
    REFUTED = "is false at the plant and frequency named"
    RAN_OUT = "is proved for the share of the set that is named, and the rest was not decided"


@dataclass(frozen=True, kw_only=True)
class ProofOutcome:
    """The outcome: `cells` of plants and `arcs` that were proved, the `work` spent, the `share` of the set proved.

    `modulus` is 0 where the claim was stability alone. Where it is false, `plant` and `frequency_rad_per_s` name the
    point; where the work ran out, everything below `stiffness_up_to_n_per_m` is proved (None if K_e does not vary), and
    `plant` lies in a part that is not.
    """

    verdict: Verdict
    modulus: float
    cells: int
    arcs: int
    work: int
    share: float
    plant: Scenario | None = None
    frequency_rad_per_s: float | None = None
    stiffness_up_to_n_per_m: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the claim is proved for the whole set."""
        return self.verdict is Verdict.PROVED


@dataclass(frozen=True, kw_only=True)
class CombinedCertificate:
    """What came of the parts of a claim: one part per family of plants; behind a refuted one they are left out.

    `free_space`, `contact` and `held` (by the spring of a hand alone) hold the parts by where they hold.
    """

    free_space: tuple[ProofOutcome, ...]
    contact: tuple[ProofOutcome, ...]
    held: tuple[ProofOutcome, ...] = ()

    @cached_property
    def parts(self) -> tuple[ProofOutcome, ...]:
        """All parts, those of free space first."""
        return (*self.free_space, *self.held, *self.contact)

    @property
    def holds(self) -> bool:
        """Whether all of it is proved."""
        return all(part.holds for part in self.parts)

    @property
    def false(self) -> ProofOutcome | None:
        """Return the part whose claim is false."""
        return next((part for part in self.parts if part.verdict is Verdict.REFUTED), None)

    @property
    def failed(self) -> ProofOutcome | None:
        """Return the part that is false, or else one that is not proved; None where all is."""
        return self.false or next((part for part in self.parts if not part.holds), None)

    @property
    def share(self) -> float:
        """Return the share proved of that part of which least is proved."""
        return min(part.share for part in self.parts)

    @property
    def cells(self) -> int:
        """Return the number of cells of plants that were proved."""
        return sum(part.cells for part in self.parts)

    @property
    def arcs(self) -> int:
        """Return the number of pairs of cell and arc that were proved."""
        return sum(part.arcs for part in self.parts)

    @property
    def run_time_s(self) -> float:
        """Return the work spent in seconds of `WORK_PER_SECOND`, which no clock makes differ from run to run."""
        return sum(part.work for part in self.parts) / WORK_PER_SECOND

    def up_to(self, lowest: float) -> float:
        """Return the K_e up to which everything is proved, free space too; `lowest` where nothing is."""
        open_parts = [part for part in self.parts if not part.holds]
        ends = [lowest if p.stiffness_up_to_n_per_m is None else p.stiffness_up_to_n_per_m for p in open_parts]
        return min(ends, default=math.inf)
