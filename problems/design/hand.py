"""The hand of a person who holds the payload, as a mass, a damper and a spring to ground."""

from dataclasses import dataclass, field, replace
from typing import Self

from .._checks import non_negative
from ..model.axis_kind import STRAIGHT, TURNING
from ..model.plant import FREE_SPACE, Environment, Plant
from ..model.plant_parameters import PARAMETERS, with_values
from .uncertainty import MASS, STIFFNESS, Interval, PlantSet

DRAG = "drag_n_s_per_m"


@dataclass(frozen=True, kw_only=True)
class HandImpedance:
    """Every hand with up to M_h, B_h and K_h, each from 0: M_h s + B_h + K_h/s on the payload.

    An arm has some 3.5 kg in two segments, of which a part moves with the hand, and a damping of about 0.05 s times its
    stiffness (Selen, Franklin and Wolpert, *Journal of Neuroscience* 29(40), 2009, Table 1). A relaxed hand has a few
    hundred N/m (Tsuji, Morasso, Goto and Ito, *Biological Cybernetics* 72, 1995), a stiffened one some times that. The
    default is above all of that. As the payload's mass and damper and the environment's spring are to ground too, a
    hand adds its numbers to theirs.
    """

    # Made, not plain, defaults: files leave a field out that has its plain default, and these belong to what is proved.
    mass_kg: float = field(default_factory=lambda: 5.0)
    damping_n_s_per_m: float = field(default_factory=lambda: 50.0)
    stiffness_n_per_m: float = field(default_factory=lambda: 3000.0)

    def __post_init__(self) -> None:
        for name in ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m"):
            object.__setattr__(self, name, non_negative(f"hand.{name}", getattr(self, name)))

    def describe(self, *, turning: bool = False) -> str:
        """Return what hands these are in words."""
        kind = TURNING if turning else STRAIGHT
        scale, unit = kind.shown_stiffness
        return (
            f"a hand of up to {self.mass_kg:g} {kind.mass}, {self.damping_n_s_per_m:g} {kind.damping} and "
            f"{scale * self.stiffness_n_per_m:g} {unit}"
        )

    def turned(self, lever_m: float) -> Self:
        """Return the same hand about an axis of rotation, at a lever [m], with nine digits."""
        names = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
        return replace(self, **{name: float(f"{getattr(self, name) * lever_m**2:.9g}") for name in names})

    def on_payload(self, plants: PlantSet) -> dict[str, Interval]:
        """Return the ranges of a set with M_p and B_p widened by what the hand adds."""
        added = {MASS: self.mass_kg, DRAG: self.damping_n_s_per_m}
        spans = {name: plants.range_of(name) for name in added}
        return {**plants.ranges, **{name: (low, high + added[name]) for name, (low, high) in spans.items()}}

    def on_contact(self, plants: PlantSet) -> PlantSet:
        """Return the set of a held payload on its surfaces: K_e widened too, without an ellipsoid."""
        low, high = plants.environment_stiffness_n_per_m
        ranges = {**self.on_payload(plants), STIFFNESS: (low, high + self.stiffness_n_per_m)}
        return PlantSet(nominal=plants.nominal, ranges=ranges)

    def holding(self, plant: Plant) -> Plant:
        """Return a plant that the stiffest, most damped and heaviest of these hands holds."""
        stiffness, damping, mass = plant.environment.coefficients
        surface = Environment(
            stiffness_n_per_m=stiffness + self.stiffness_n_per_m, damping_n_s_per_m=damping, mass_kg=mass
        )
        held = {MASS: self.mass_kg, DRAG: self.damping_n_s_per_m}
        values = {name: PARAMETERS[name].value(plant) + added for name, added in held.items()}
        return with_values(plant.in_contact_with(FREE_SPACE if surface.is_free_space else surface), values)
