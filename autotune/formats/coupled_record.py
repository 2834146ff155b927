"""What `controller.yaml` says of axes that act on each other through the payload; on rx, ry, rz N·m, rad and kg·m²."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from problems.errors import ParameterError
from problems.frozen import AboveZero, FrozenDict, NotNegative, Rule, Text, freeze
from problems.model.coupled import RigidPayload
from problems.text import significant

from .units import AXES, Axis

Vector = tuple[float, float, float]
PRODUCTS: Mapping[str, tuple[int, int]] = FrozenDict(
    {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
)
"""Places of the components of an inertia tensor."""
_Place = Annotated[Vector, Rule(items=Rule(minimum=-5, maximum=5))]
_Straight = Annotated[str, Rule(enum=AXES[:3])]
_Product = Annotated[str, Rule(enum=[*PRODUCTS])]


@dataclass(frozen=True, kw_only=True)
class HeldAxis:
    """The coupling and the drag of an axis that is not tuned: the robot holds it, and the payload swings on it."""

    coupling_stiffness_n_per_m: AboveZero
    coupling_damping_n_s_per_m: NotNegative
    drag_n_s_per_m: NotNegative


@dataclass(frozen=True, kw_only=True)
class CoupledBody:
    """The payload as a rigid body: mass, centre of mass and inertia about the sensor's origin, in its frame.

    Of the inertia, components that are not there are not known, and no axis that is checked takes them; `held` are the
    axes that are known and not tuned, `missing` says what is not known, `contact_points_m` where the payload may touch.
    """

    mass_kg: AboveZero
    com_m: Annotated[Vector, Rule(items=Rule(minimum=-2, maximum=2))]
    inertia_kg_m2: Mapping[_Product, float]
    held: Mapping[Axis, HeldAxis]
    contact_points_m: tuple[_Place, ...] = ()
    missing: tuple[Text, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "inertia_kg_m2", "held")
        unknown = sorted(set(self.inertia_kg_m2) - set(PRODUCTS)) + sorted(set(self.held) - set(AXES))
        if unknown:
            raise ParameterError("inertia_kg_m2", unknown[0], f"one of {', '.join(PRODUCTS)}")

    def rigid(self) -> RigidPayload:
        """Return the body; what is not known of its inertia is 0."""
        inertia = np.zeros((3, 3))
        for name, value in self.inertia_kg_m2.items():
            i, j = PRODUCTS[name]
            inertia[i, j] = inertia[j, i] = value
        return RigidPayload(mass_kg=self.mass_kg, com_S_m=np.array(self.com_m), inertia_S_kg_m2=inertia)


@dataclass(frozen=True, kw_only=True)
class TogetherMargins:
    """Of one axis while the loops of all others are closed: |1 + L|, and the balanced disk margin."""

    modulus: NotNegative
    disk: NotNegative


@dataclass(frozen=True, kw_only=True)
class PointContact:
    """The worst contact of one axis with a point of the payload: its largest peak, and the one without the others.

    The peak comes `time_of_peak_s` after the touch, on the plant that is named. `largest_ratio` is that of the peak to
    the one that the axis has alone on the same plant, the largest over the plants, `leaves` the largest number of times
    that the payload left the surface before it came to rest.
    """

    point_m: _Place
    environment_stiffness_n_per_m: float
    payload_mass_kg: float
    peak_contact_force_n: AboveZero
    time_of_peak_s: NotNegative
    largest_ratio: AboveZero
    leaves: NotNegative


@dataclass(frozen=True, kw_only=True)
class CoupledProof:
    """How far stability, and the smallest singular value of I + L above `modulus`, is proved of axes together.

    The loops are cut `at` the forces or at the commands. Of `axes`, in free space and touching along each of them, or
    with `points` of the payload by the axis along which they touch; over K_e and the payload's mass, all else is
    nominal. `share` of the set is proved; `cells` of plants were looked at, in work counted as for `ProvenRegion`.
    """

    axes: tuple[Axis, ...]
    modulus: AboveZero
    method: Text
    share: Annotated[float, Rule(minimum=0, maximum=1)]
    cells: NotNegative
    budget_s: AboveZero
    run_time_s: NotNegative
    points: Mapping[_Straight, tuple[_Place, ...]] = field(default_factory=FrozenDict)
    at: Annotated[str, Rule(enum=["force", "command"])] = "force"

    def __post_init__(self) -> None:
        freeze(self, "points")

    def of_what(self) -> str:
        """Return of what it is proved, in words."""
        count = sum(len(each) for each in self.points.values())
        where = f", touching with {count} points of the payload" if count else ""
        return f"{'–'.join(self.axes)} together{where}"


@dataclass(frozen=True, kw_only=True)
class CoupledCertificate:
    """What several axes do together: swept over the ends of K_e and M_p, in free space and touching along each axis.

    `groups` are the axes that the payload couples by more than `uncoupled` (largest |M_ij|/√(M_ii M_jj) between
    groups), each checked whole; `neglected` is the share of its modulus that one loses to the axes outside of it.
    `modulus` is the smallest singular value of I + L at `modulus_hz`, torques divided by the lever of 0.2 m, the loops
    cut at the forces or at the commands, whichever is less;
    `modulus_apart` that of the axes one by one, `disk` the disk margin of all loops at a time. `points` are
    contacts by axis, `method` says how they were found; `min_modulus` is what was asked of `modulus`.
    """

    axes: Annotated[tuple[Axis, ...], Rule(minItems=1)]
    body: CoupledBody
    groups: tuple[tuple[Axis, ...], ...]
    coupling: Annotated[float, Rule(minimum=0, maximum=1)]
    uncoupled: Annotated[float, Rule(minimum=0, maximum=1)]
    neglected: NotNegative
    modulus: NotNegative
    modulus_hz: NotNegative
    modulus_apart: NotNegative
    disk: NotNegative
    spectral_radius: NotNegative
    loops: Mapping[Axis, TogetherMargins]
    points: Mapping[_Straight, tuple[PointContact, ...]]
    method: Text
    proofs: tuple[CoupledProof, ...] = ()
    min_modulus: Annotated[float | None, Rule(minimum=0, maximum=1)] = None

    def __post_init__(self) -> None:
        freeze(self, "loops", "points")

    def sentences(self) -> Iterator[str]:
        """Yield what the sweep found, in words."""
        groups = [group for group in self.groups if len(group) > 1]
        if not groups:
            yield (
                f"axes together: {', '.join(self.axes)} hardly act on each other (coupling {self.coupling:.2g}); "
                f"|1 + L| at least {(1.0 - self.neglected) * self.modulus:.3g} with all loops closed, swept"
            )
        else:
            shown = " and ".join("–".join(group) for group in groups)
            yield (
                f"axes together ({shown}, coupled by {self.coupling:.2g} through the payload): smallest singular value "
                f"of I + L {self.modulus:.3g} at {self.modulus_hz:.3g} Hz, apart {self.modulus_apart:.3g}; disk margin "
                f"of all loops {self.disk:.3g}; swept"
            )
        for name, points in self.points.items():
            worst, left = max(points, key=lambda each: each.largest_ratio), max(points, key=lambda each: each.leaves)
            share = 100.0 * (worst.largest_ratio - 1.0)
            harder = (
                f"up to {significant(share)} % harder" if share > 0.0 else f"at least {significant(-share)} % gentler"
            )
            at = ", ".join(f"{each:.2g}" for each in worst.point_m)
            bounces = "" if left.leaves == 0.0 else f"; the payload leaves the surface up to {left.leaves:g} times"
            yield (
                f"axis {name}, touching with {len(points)} points of the payload: {harder} than in line with the "
                f"sensor, at ({at}) m{bounces}; simulated"
            )
        if self.body.missing:
            yield f"axes together: not known, and left out: {', '.join(self.body.missing)}"
