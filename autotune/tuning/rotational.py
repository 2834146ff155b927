"""What a rotational axis is asked: the wishes for a translational one through a lever of 0.2 m, unless said otherwise.

A force F at the lever l turns with the torque l F, and a speed v there is the rate v/l. Masses and dampings go with l²,
admittances with 1/l²; margins, times and bands stay. The lever is the one at which the paper's deadbands, 5 N and
1 N·m, are the same. Only wishes go through it: what the cell is (payload, surface) is never derived this way.
"""

from dataclasses import replace

from autotune.formats.problem import Interval, ProblemSpec, RotationalSpec
from autotune.plugins import build_requirements
from identification.axes.turning import LEVER_M
from problems.contact.transient import Approach
from problems.design.problem import DEFAULT_BOUNDS, Requirements

_GO_WITH_THE_LEVER = ("mass", "damping")


def through_lever(spec: ProblemSpec, approach: Approach) -> ProblemSpec:
    """Return the same wishes for a rotational axis, in rad, N·m and kg·m²; `approach` is the one of x, y, z.

    What `spec.rotational` says counts as it stands. Ranges of payload and surface are taken from there alone.
    """
    said = spec.rotational
    bounds = {**DEFAULT_BOUNDS, **spec.bounds}
    turned = {name: _interval(bounds[name], LEVER_M**2) for name in _GO_WITH_THE_LEVER}
    return replace(
        spec,
        bounds={**bounds, **turned, **said.bounds},
        approach=said.approach or _approach(approach),
        environment_stiffness_n_per_m=said.environment_stiffness_n_per_m,
        payload_mass_kg=said.payload_mass_kg,
        # A range has a unit and stays where it was said; where it is to come from holds for every axis.
        uncertain={**{name: told for name, told in spec.uncertain.items() if isinstance(told, str)}, **said.uncertain},
        requirements=_requirements(spec.requirements, said),
    )


def _approach(approach: Approach) -> Approach:
    force, speed = approach.force_n, approach.speed_m_s
    return replace(
        approach,
        force_n=None if force is None else _rounded(force * LEVER_M),
        speed_m_s=None if speed is None else _rounded(speed / LEVER_M),
    )


def _requirements(asked: Requirements, said: RotationalSpec) -> Requirements:
    # Prices of what the rotational axes are asked otherwise are said there too, or nowhere.
    kept = {name: _rounded(price * LEVER_M) for name, price in asked.soft_n.items() if name not in said.requirements}
    turned = {name: asked.kind(name).turned(value, LEVER_M) for name, value in asked.asked().items()}
    prices = {**kept, **said.soft_n}
    return build_requirements({**turned, **said.requirements}, prices, without_defaults=True, plugins=asked.plugins)


def _interval(values: Interval, factor: float) -> Interval:
    return _rounded(values[0] * factor), _rounded(values[1] * factor)


def _rounded(value: float) -> float:
    """Return the value with nine digits: 0.2² is not 0.04 in binary, and people read these numbers."""
    return float(f"{value:.9g}")
