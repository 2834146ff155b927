"""The relative error of the modelled loop, where a log's frequency response shows that the model is wrong."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from autotune.formats.units import ROTATIONAL_AXES
from identification.measured_response import MeasuredResponse
from identification.result import RESPONSE_DIFFERS, Identified
from problems.arrays import ComplexArray
from problems.design.problem import DesignProblem
from problems.design.requirements import MultiplicativeError
from problems.model.plant import FREE_SPACE
from problems.model.response import plant_response
from problems.model.sampled import build_sampled_plant

_NAME = "multiplicative_error"
# Of the circles of 95 %, and of the response: what lies within is the parameters' own uncertainty.
_CIRCLES, _SMALL_SHARE = 1.54, 0.03
_DIGITS = 3


def with_measured_error(identified: Identified, problems: Mapping[str, DesignProblem]) -> dict[str, DesignProblem]:
    """Return the problems with the modulus margin asked beside the measured error of the straight axes.

    Only where identification found that model and measurement differ, nobody says a `multiplicative_error` and a
    modulus margin is asked. Straight axes share their requirements, so each is asked for the error of all of them. One
    without points asks for nothing: so it is declined.
    """
    straight = {name: each for name, each in problems.items() if name not in ROTATIONAL_AXES}
    points = _joined([row for name, each in straight.items() for row in _error(identified, name, each)])
    changed = dict(problems)
    for name, each in straight.items():
        said, modulus = each.requirements.multiplicative_error, each.requirements.modulus_margin
        error = said
        if said is None and points and modulus is not None:
            error = MultiplicativeError(min_modulus=modulus, points=points)
        elif said is not None and not said.points:
            error = None
        if error != said:
            changed[name] = replace(each, requirements=each.requirements.with_asked(_NAME, error))
    return changed


def _error(identified: Identified, name: str, problem: DesignProblem) -> Iterator[tuple[float, float]]:
    """Yield frequency [Hz] and (|F_measured − F| + radius)/|F| where that is beyond the circle; F is of free space."""
    response = identified.axes[name].frequency_response
    measured = None if response is None else response.command_to_force
    if measured is None or not any(f.code == RESPONSE_DIFFERS and f.axis == name for f in identified.findings):
        return
    h = problem.sample_time_s
    below = measured.frequency_hz < 0.5 / h
    frequency, size = measured.frequency_hz[below], _modelled(problem, measured)[below]
    apart, radius = np.abs(measured.values[below] - size), measured.radius_95[below]
    for f, modelled, difference, circle in zip(frequency, np.abs(size), apart, radius, strict=True):
        if difference > _CIRCLES * circle + _SMALL_SHARE * modelled:
            yield float(f), float(f"{(difference + circle) / modelled:.{_DIGITS}g}")


def _modelled(problem: DesignProblem, measured: MeasuredResponse) -> ComplexArray:
    """Return command → force (k,) of the identified plant, without hold and filter as it was measured."""
    plant, h = problem.plants.nominal.in_contact_with(FREE_SPACE), problem.sample_time_s
    omega = 2.0 * np.pi * measured.frequency_hz
    hold = -np.expm1(-1j * omega * h) / (1j * omega * h)
    return np.asarray(
        plant_response(build_sampled_plant(plant, h), omega).force / (plant.wrench_filter.response(omega) * hold)
    )


def _joined(points: list[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Return the largest error of each frequency, by frequency."""
    largest: dict[float, float] = {}
    for frequency, share in points:
        largest[frequency] = max(share, largest.get(frequency, 0.0))
    return tuple(sorted(largest.items()))
