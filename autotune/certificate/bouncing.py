"""That every contact of a set comes to rest: a multiplier for the unilateral spring in the sampled loop, in balls.

In free space the payload answers to a contact force p with x_p = −G p: the continuous plant, and the sampled loop that
moves it. On the frequencies ω_k = ω + 2πk/h that a sampler mixes (Chen and Francis, Optimal Sampled-Data Control
Systems, 1995)

    G_kl = P(jω_k) δ_kl + A_k D(e^{jωh}) W_l / h

with P from force to x_p at a flange at rest, W to the measured force, D the closed loop from there to the command, A
from the held command to x_p. With a multiplier M the contact comes to rest if M (G + 1/K_e) has a positive Hermitian
part, uniformly in ω and the plant (docs/method.md, "Bouncing").
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray, IntArray
from problems.contact.multiplier import Multiplier
from problems.design.uncertainty import MASS, STIFFNESS
from problems.errors import ParameterError
from problems.model.robot import bandwidth_hz
from problems.model.sampled import Controller

from .balls import turn
from .base_plant import is_stable
from .bounds import PlantCell, linear_part
from .certify import CELL_WORK
from .circle import Circle
from .family import LAG, LATE, Family
from .law import law_polynomials
from .other_frequencies import OtherFrequencies
from .plant_cells import Raw, coefficients, half_widths, loop_groups, with_derivatives
from .plant_polynomials import plant_polynomials
from .taylor import Taylor, taylor_of, turned

_Flags = NDArray[np.bool_]

_AT_ONCE = 4096
_NARROWEST = 1e-7
# Some roundings of one operation.
_EPS = 8.0 * float(np.finfo(np.float64).eps)
DAMPING = "environment_damping_n_s_per_m"


@dataclass(frozen=True, kw_only=True)
class RestOutcome:
    """What came of an attempt: the `share` of the set for which every contact comes to rest, in `cells`, by `work`."""

    share: float
    cells: int
    arcs: int
    work: int

    @property
    def holds(self) -> bool:
        """Whether it is proved for the whole set."""
        return self.share == 1.0


def prove_rest(
    family: Family,
    law: Controller,
    multiplier: Multiplier | None,
    *,
    work: int,
    progress: Callable[[float], None] | None = None,
) -> RestOutcome:
    """Prove that no contact of these plants bounces for ever, whatever it begins with, under any constant F^d > 0.

    Parameters
    ----------
    family
        Plants in contact; what is proved for the stiffest K_e and the largest B_e holds for all below.
    law
        The control law under the hold of the family; not one that holds a position, or follows it.
    multiplier
        What it is proved by; None is passivity, M = s: the surface may then be any passive one, with a mass.
    work
        Bound of the effort, as for `certify`.
    progress
        Is passed the share of the set proved since the last call.

    Returns
    -------
    RestOutcome
        How much of the set is proved. A multiplier that does not do for a plant says nothing of its contacts.

    Raises
    ------
    ParameterError
        For plants or laws that this proof does not cover.
    """
    search = _Proof(family, law, multiplier, work)
    while search.waiting and not search.is_stuck and search.work < work:
        before = search.share
        search.step()
        if progress is not None and search.share > before:
            progress(search.share - before)
    share = search.share if search.waiting else 1.0
    return RestOutcome(share=share, cells=search.cells, arcs=search.arcs, work=search.work)


def check_covered(family: Family, law: Controller) -> Any:
    """Return the law's polynomials; raises ParameterError for what the proof does not cover."""
    family.nominal.require_one_piece()
    found = law_polynomials(law, family.sample_time_s)
    if found.holds_position or found.follows:
        raise ParameterError("law", "one with the measured position", "one whose command is an integral of the force")
    if family.shared_delay is not None and found.position:
        raise ParameterError(LATE, family.shared_delay[1], "0 for a law that reads the position too, which is not late")
    return found


@dataclass(frozen=True, kw_only=True)
class _Port:
    """The contact below π/h: `spring` M (G + 1/K_e), `velocity` s G, `across` ½ (M G + κ conj(s G)).

    `driven` is M A D/h, `moved` s A D/h, `sensed` W and `through` w D/z^c; `velocity` and `across` are 0 for a surface
    without damping.
    """

    spring: Taylor
    velocity: Taylor
    across: Taylor
    driven: Taylor
    moved: Taylor
    sensed: Taylor
    through: Taylor


@dataclass(frozen=True, kw_only=True)
class _Part:
    cell: FloatArray
    arcs: IntArray
    share: float


class _Proof:
    """The cells of plants in free space that wait, and what was counted."""

    def __init__(self, family: Family, law: Controller, multiplier: Multiplier | None, work: int) -> None:
        self.law = check_covered(family, law)
        self.compliance, self.damping = 1.0 / family.range_of(STIFFNESS)[1], family.range_of(DAMPING)[1]
        if multiplier is None:
            self.compliance = self.damping = 0.0
        self.family, self.multiplier, self.h = family.in_free_space(), multiplier, family.sample_time_s
        self.box = self.family.box()
        whole, has_fraction = self.family.delay()
        self.chain = whole + int(has_fraction)
        groups = self._groups(plant_polynomials(self.family, self.box))
        sizes = tuple(len(part) for part in groups)
        self.circle = Circle(self.law, self.chain, sizes, is_deflated=True, pull=True)
        self.others = (
            OtherFrequencies.of_velocity(self.family)
            if multiplier is None
            else OtherFrequencies.of(self.family, multiplier, family.range_of(STIFFNESS)[1], self.damping)
        )
        first = np.arange(self.circle.count_of_first)
        self.waiting = [_Part(cell=self.box, arcs=first, share=1.0)]
        self.most, self.work, self.cells, self.arcs, self.share = work, 0, 0, 0, 0.0
        self.is_stuck = not is_stable(self.family, law, np.mean(self.box, axis=1))

    def _groups(self, found: Raw) -> tuple[list[Any], ...]:
        """Return the groups of the closed loop in free space, and d again for what drives it."""
        groups = loop_groups(self.family, self.law, found, is_deflated=True)
        return (*groups, groups[0])

    def step(self) -> None:
        """Judge a cell, and cut it where its plants are to blame."""
        part = self.waiting.pop()
        cell = with_derivatives(part.cell, *map(self._groups, coefficients(self.family, part.cell)))
        self.work += CELL_WORK
        arcs, left, blame = part.arcs, [np.zeros(0, dtype=np.int64)], np.zeros(len(self.box))
        while len(arcs):
            now, arcs = arcs[:_AT_ONCE], arcs[_AT_ONCE:]
            holds, in_middle, shares = self.judge(now, part.cell, cell)
            self.work += len(now)
            if not np.all(in_middle) or self.work > self.most:
                self.waiting.append(part)
                self.is_stuck = True
                return
            self.arcs += int(np.sum(holds))
            failed, wide = ~holds, np.ptp(self.circle.angles(now), axis=1) > _NARROWEST
            by_plant = failed & ((np.argmax(shares, axis=1) > 0) | ~wide)
            left.append(now[by_plant])
            blame += np.sum(shares[by_plant, 1:], axis=0)
            arcs = np.concatenate([self.circle.halves(now[failed & ~by_plant]), arcs])
        rest = np.concatenate(left)
        if len(rest):
            self._cut(part, rest, blame)
            return
        self.cells, self.share = self.cells + 1, self.share + part.share

    def _cut(self, part: _Part, arcs: IntArray, blame: FloatArray) -> None:
        if np.all(part.cell[:, 0] == part.cell[:, 1]):
            self.waiting.append(part)
            self.is_stuck = True
            return
        side = int(np.argmax(blame))
        low, high = part.cell[side]
        upper, lower = part.cell.copy(), part.cell.copy()
        upper[side, 0] = lower[side, 1] = 0.5 * (low + high)
        self.waiting += [_Part(cell=each, arcs=arcs, share=0.5 * part.share) for each in (upper, lower)]

    def judge(self, arcs: IntArray, cell: FloatArray, plants: PlantCell) -> tuple[_Flags, _Flags, FloatArray]:
        """Return on which arcs the claim holds, where it does in the middle, and what each direction loses."""
        port = self.response(arcs, cell, plants)
        spring, sizes = port.spring, (port.driven, port.sensed, port.through, port.moved, port.across)
        in_middle = self.others.leave(
            spring.terms[:, 0].real, port.velocity.terms[:, 0].real, *(np.abs(each.terms[:, 0]) for each in sizes)
        )
        holds = self.others.leave(
            spring.least_real(), port.velocity.least_real(), *(each.magnitude() for each in sizes)
        )
        lost = np.abs(spring.terms[:, 1:].real) + spring.rest
        if self.damping > 0.0:
            # Each in units of its own size.
            parts = (spring, port.velocity.plus(1.0 / self.damping), port.across)
            lost = np.sum([(np.abs(e.terms[:, 1:]) + e.rest) / np.abs(e.terms[:, :1]) for e in parts], axis=0)
        return holds, in_middle, np.asarray(lost)

    def response(self, arcs: IntArray, cell: FloatArray, plants: PlantCell) -> "_Port":
        """Return how the contact answers below π/h.

        With A = P (K_s + B_s s) r e^{−sT_d} (1 − 1/z)/s and D = β_F z^c d/(w χ/w) nothing of it is large at s = 0.
        """
        found = self.circle.at(arcs)
        parts = [
            (jet[0] @ each, jet[1] @ each, jet[2] @ whole)
            for jet, each, whole in zip(found.groups, plants.groups, plants.whole(), strict=True)
        ]
        closed = taylor_of(linear_part(parts[:-1], (1.0,) + (-1.0,) * (len(parts) - 2), found.half))
        through = taylor_of(linear_part(parts[-1:], (1.0,), found.half)) * closed.inverse()
        middle = np.mean(self.circle.angles(arcs), axis=1)
        values = _Values(self.family, cell, middle, found.half)
        one = values.s.times(0.0).plus(1.0)
        over_s = (
            one
            if self.multiplier is None
            else values.widened(multiplier_over_s(self.multiplier, middle, found.half, self.h))
        )
        stiff = values["coupling_stiffness_n_per_m"] + values["coupling_damping_n_s_per_m"] * values.s
        payload = values.payload()
        moved = (payload * stiff * values.robot() * values.late(self.chain - 1) * through).times(1.0 / self.h)
        sensed = payload * stiff
        if LAG in self.family.varying or self.family.nominal.wrench_filter.time_constant_s > 0.0:
            sensed = sensed * (values[LAG] * values.s).plus(1.0).inverse()
        driven, multiplied = over_s * moved, values.s * over_s
        spring = payload.plus(self.compliance) * multiplied + driven * sensed
        velocity = across = moved.times(0.0)
        if self.damping > 0.0 and self.multiplier is not None:
            velocity = moved * sensed + values.s * payload
            turned_back = velocity.conjugate().times(self.multiplier.damper_s)
            across = (multiplied * payload + driven * sensed + turned_back).times(0.5)
        return _Port(
            spring=spring,
            velocity=velocity,
            across=across,
            driven=driven,
            moved=moved,
            sensed=sensed,
            through=through,
        )


def multiplier_over_s(multiplier: Multiplier, middle: FloatArray, half: FloatArray, sample_time_s: float) -> Taylor:
    """Return M(s)/s on arcs (m,) of the unit circle with these middles above 0 and half widths [rad/sample].

    It is η + Σ c ∫ e^{−st} dt over [0, τ] + Σ b/(s + λ).
    """
    h, size = sample_time_s, len(middle)
    omega, width = middle / h, half / h * (1.0 + 1e-12)
    value, slope = np.full(size, multiplier.rate_s, dtype=np.complex128), np.zeros(size, dtype=np.complex128)
    rest = np.zeros(size)
    # What an arc from 0 on has of 1/ω is not bounded.
    largest = 1.0 / np.where(omega > 1.001 * width, omega - width, 1e-300)
    for shift, weight in multiplier.shifts:
        points, _ = turn(-omega * shift, np.zeros(size))
        whole = (1.0 - points.mid) / (1j * omega)
        change = shift * points.mid / omega - whole / omega
        # Where the shifted part turns much within an arc, only its size is used.
        smooth, loose = width**2 * shift**3 / 6.0, largest * (1.0 + (width / omega) ** 2)
        is_smooth = smooth < loose
        value = value + weight * np.where(is_smooth, whole, 1.0 / (1j * omega))
        slope = slope + weight * np.where(is_smooth, change, 1j / omega**2)
        lost = (points.rad + _EPS * (1.0 + omega * shift)) * (3.0 / omega + shift) + _EPS * shift
        rest = rest + weight * (np.where(is_smooth, smooth, loose) + lost)
    for rate, weight in multiplier.fading:
        pole = 1.0 / (1j * omega + rate)
        value, slope = value + weight * pole, slope - 1j * weight * pole**2
        rest = rest + weight * (width * np.abs(pole)) ** 2 * np.minimum(1.0 / rate, largest)
    terms = np.stack([value, width * slope], axis=1)
    rounding = 4.0 * (len(multiplier.shifts) + len(multiplier.fading) + 4) * _EPS * np.sum(np.abs(terms), axis=1)
    return Taylor(terms=terms, rest=np.asarray(rest * (1.0 + 1e-12) + rounding)[:, None])


class _Values:
    """The plant's parameters over a cell, and s on the arcs."""

    def __init__(self, family: Family, cell: FloatArray, middle: FloatArray, half: FloatArray) -> None:
        self.family, self.count = family, len(middle)
        self.n = 1 + len(cell)
        self.angle = self._linear(middle, 0, half)
        self.s = self.angle.times(1j / family.sample_time_s)
        self.places = {name: i for i, name in enumerate(family.varying)}
        self.middles, self.halves = np.mean(cell, axis=1), half_widths(cell)

    def _linear(self, value: FloatArray | float, place: int, half: FloatArray | float) -> Taylor:
        terms = np.zeros((self.count, 1 + self.n), dtype=np.complex128)
        terms[:, 0] = value
        terms[:, 1 + place] = half
        return Taylor(terms=terms, rest=np.zeros((self.count, self.n)))

    def widened(self, of_frequency: Taylor) -> Taylor:
        """Return what depends on the frequency only, with directions of the plants."""
        add = ((0, 0), (0, self.n - 1))
        return Taylor(terms=np.pad(of_frequency.terms, add), rest=np.pad(of_frequency.rest, add))

    def __getitem__(self, name: str) -> Taylor:
        """Return a parameter, of the mass 1/M_p."""
        if name in self.places:
            i = self.places[name]
            return self._linear(self.middles[i], 1 + i, self.halves[i])
        value = self.family.range_of(name)[0]
        return self._linear(1.0 / value if name == MASS else value, 0, 0.0).plus(0.0)

    def payload(self) -> Taylor:
        """Return P = 1/(M_p s² + (B_p + B_s) s + K_s)."""
        light, s = self[MASS], self.s
        damping = self["drag_n_s_per_m"] + self["coupling_damping_n_s_per_m"]
        return light * (s * s + light * (damping * s + self["coupling_stiffness_n_per_m"])).inverse()

    def robot(self) -> Taylor:
        """Return r(s), whose frequencies move with the bandwidth."""
        numerator, denominator = self.family.nominal.robot.ascending()
        s = self.s
        if "robot_bandwidth_hz" in self.places:
            s = s * self["robot_bandwidth_hz"].inverse().times(bandwidth_hz(self.family.nominal.robot))
        return _polynomial(numerator, s) * _polynomial(denominator, s).inverse()

    def late(self, samples: int) -> Taylor:
        """Return z^samples e^{−sT_d}."""
        delay = self["delay_s"].times(-1.0 / self.family.sample_time_s).plus(float(samples))
        return turned(self.angle * delay)


def _polynomial(ascending: FloatArray, s: Taylor) -> Taylor:
    out = s.times(0.0).plus(float(ascending[-1]))
    for each in ascending[-2::-1]:
        out = (out * s).plus(float(each))
    return out
