"""How long each controller of a schedule must run before the next one takes over."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from autotune.certificate.dwelling import DwellLoop, prove_dwell
from autotune.certificate.family import build_families
from autotune.formats.controller_record import Controller, admittance_controller
from problems.arrays import FloatArray
from problems.design.uncertainty import PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.dwell import common_loop, dwell_samples, without_translation

# Of each class: the ends and the middle of K_e, and the ends of M_p.
_STIFFNESS, _MASS = 3, 2
# Cells of plants that a proof makes at most, of one axis in one place: some seconds.
_MOST_CELLS = 1000
# So many times the least dwell time is tried, until all of it is proved.
_LONGER = (1, 2, 3)


def dwell_time_s(controllers: Sequence[Controller]) -> float | None:
    """Return a dwell time [s] from which changes between these controllers are safe in free space and in contact.

    After each change the plant is any of those of the class that then runs: the corners of M_p × K_e and the middles
    between, everything else nominal; the loops of a B_a that varies are those of its ends. Whatever comes and goes
    while nothing is touched, or while the contact lasts, decays; of a contact that is made or left nothing is said.
    None where the classes differ in axes or sample time, or a loop has no such coordinates.
    """
    first = controllers[0]
    if any(set(each.axes) != set(first.axes) or each.sample_time_s != first.sample_time_s for each in controllers):
        return None
    longest = 0
    try:
        for name, is_free in product(first.axes, (True, False)):
            longest = max(longest, dwell_samples([list(_modes(each, name, is_free)) for each in controllers]))
    except ParameterError:
        return None
    return longest * first.sample_time_s


def provable_dwell_time(controllers: Sequence[Controller]) -> tuple[float | None, float | None]:
    """Return a dwell time [s], and for which share of K_e × M_p it is proved.

    That of `dwell_time_s`, or twice or thrice that where only that is proved for all; None where nothing is known or
    nobody takes over.
    """
    shortest = dwell_time_s(controllers)
    if shortest is None or len(controllers) < 2:
        return shortest, None
    tried: dict[float, float] = {}
    for factor in _LONGER:
        waits = math.ceil(factor * shortest / controllers[0].sample_time_s - 1e-6) * controllers[0].sample_time_s
        tried[waits] = proved_share(controllers, waits)
        if tried[waits] == 1.0:
            return waits, 1.0
    waits = next(iter(tried))
    return waits, tried[waits]


def proved_share(controllers: Sequence[Controller], dwell_time_s: float) -> float:
    """Return for which share of the certified K_e × M_p, the rest nominal, changes after this dwell time are proved.

    0 where nothing is: for plants or laws that the proof does not cover, too.
    """
    first, shares = controllers[0], [1.0]
    samples = max(1, round(dwell_time_s / first.sample_time_s))
    try:
        for name, is_free in product(first.axes, (True, False)):
            loops = [_loops(each, name, is_free) for each in controllers]
            shares.append(prove_dwell(loops, samples, most_cells=_MOST_CELLS).share)
    except ParameterError:
        return 0.0
    return min(shares)


def _loops(controller: Controller, name: str, is_free: bool) -> list[DwellLoop]:
    box = controller.certificate.domain[name].plants.only()
    (family,) = build_families(box.nominal, box.ranges, controller.sample_time_s)
    family = family.in_free_space() if is_free else family
    return [DwellLoop(family=family, law=law) for law in _laws(controller, name)]


def _modes(controller: Controller, name: str, is_free: bool) -> Iterator[FloatArray]:
    for plant, law in product(_plants(controller.certificate.domain[name].plants, is_free), _laws(controller, name)):
        sampled = build_sampled_plant(plant, controller.sample_time_s)
        loop = common_loop(sampled, law)
        yield without_translation(loop, sampled) if is_free else loop


def _plants(plants: PlantSet, is_free: bool) -> Iterator[Plant]:
    low, high = plants.environment_stiffness_n_per_m
    for mass in np.unique(np.linspace(*plants.payload_mass_kg, _MASS)).tolist():
        if is_free:
            yield plants.at(mass, 0.0)
            continue
        for stiffness in np.unique(np.clip(np.geomspace(low, high, _STIFFNESS), low, high)).tolist():
            yield plants.at(mass, stiffness)


def _laws(controller: Controller, name: str) -> list[AdmittanceController]:
    law, variable = admittance_controller(controller, name), controller.damping_of(name)
    if variable is None:
        return [law]
    return [replace(law, damping_n_s_per_m=each) for each in (variable.lowest, variable.highest)]
