"""Six hundred numbers changed with the checksum made anew: what the runtime still loads is possible, and stable."""

import copy
import random
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import CertificateError
from autotune.formats.canonical import checksum
from autotune.formats.controller import controller_tree, parse_controller
from autotune.formats.yaml12 import Document, dump_yaml
from autotune.runtime.load import _verified_law
from tests.autotune.tuning.cases import small_controller

EDITS = 600
PART = ("sample_time_s", "delay_samples", "axes", "filters", "compensation_mass_kg", "collision", "payload")
# What of a cell can be, wider than any that is known; beyond it a number is a slip or a forgery.
POSSIBLE = {
    "sample_time_s": (1e-5, 0.1),
    "delay_samples": (0.0, 1000.0),
    "mass": (0.01, 1e4),
    "damping": (1.0, 1e6),
    "lead_s": (0.0, 1.0),
    "feedback_damping_s": (0.0, 1.0),
    "deadband": (0.0, 100.0),
    "velocity_rad_per_s": (0.1, 1e6),
    "acceleration_rad_per_s": (0.1, 1e6),
    "compensation_mass_kg": (0.0, 1e3),
    "threshold_n": (0.1, 1e4),
    "mass_kg": (0.0, 1e3),
    "com_m": (-2.0, 2.0),
    "force_bias_n": (-300.0, 300.0),
    "torque_bias_n_m": (-50.0, 50.0),
    "environment_stiffness_n_per_m": (0.0, 1e9),
    "payload_mass_kg": (1e-3, 1e3),
    "environment_damping_n_s_per_m": (0.0, 1e7),
    "environment_mass_kg": (0.0, 1e4),
    "coupling_stiffness_n_per_m": (1.0, 1e9),
    "coupling_damping_n_s_per_m": (0.0, 1e7),
    "drag_n_s_per_m": (0.0, 1e6),
    "delay_s": (0.0, 1.0),
    "approach_force_n": (0.01, 1e4),
    "approach_speed_m_s": (1e-4, 5.0),
}
CHANGES = (1e300, 1e-300, 1e12, 1e-12, 1e3, 1e-3, 10.0, 0.1, -1.0, 0.0)


@cache
def true_tree() -> Mapping[str, Any]:
    return controller_tree(small_controller())


def leaves(value: object, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, (*place, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from leaves(item, (*place, index))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield place


def edited(place: tuple[str | int, ...], change: float) -> tuple[dict[str, Any], float]:
    tree: Any = copy.deepcopy(dict(true_tree()))
    entry = tree
    for part in place[:-1]:
        entry = entry[part]
    # A change of a number that is 0 is the change itself, as a bias would be set.
    new = float(entry[place[-1]]) * change if entry[place[-1]] else change
    entry[place[-1]] = new
    tree["checksum"] = checksum(tree)
    return tree, new


def load(tree: dict[str, Any]) -> None:
    document = Document(path=Path("c.yaml"), tree=tree, lines={(): 1}, sha256="", error=CertificateError)
    _verified_law(document)


def test_of_six_hundred_edits_with_a_new_checksum_only_possible_and_stable_ones_load() -> None:
    tree, rng = true_tree(), random.Random(16)
    places = [
        place
        for part in (*PART, "domain")
        for place in leaves(tree["certificate"]["domain"] if part == "domain" else tree[part])
        for place in [("certificate", "domain", *place) if part == "domain" else (part, *place)]
        if "robot" not in str(place)
    ]
    load(copy.deepcopy(dict(tree)))
    loaded = Counter[str]()
    for _ in range(EDITS):
        place, change = rng.choice(places), rng.choice(CHANGES)
        changed, new = edited(place, change)
        try:
            load(changed)
        except CertificateError:
            continue
        name = next(str(part) for part in reversed(place) if isinstance(part, str))
        low, high = POSSIBLE[name]
        assert low <= new <= high, (place, new)
        loaded[name] += 1
        assert abs(change) < 1e12, (place, new)
    reported = f"{sum(loaded.values())} of {EDITS} load"
    # What is left alone is what a cell may have: a tenth of a bias, a tenfold stiffness that is stable.
    assert 0 < sum(loaded.values()) < EDITS, reported


def test_no_edit_of_the_gains_that_makes_the_loop_unstable_loads() -> None:
    for factor in (0.3, 0.1, 0.03):
        tree, _ = edited(("axes", "x", "damping"), factor)
        with pytest.raises(
            CertificateError, match="the loop of axis x is unstable on a plant for which it is certified"
        ):
            load(tree)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("axes", "x", "mass"), 1e-300),
        (("axes", "x", "deadband"), 1e300),
        (("axes", "x", "deadband"), 1e6),
        (("payload", "force_bias_n", 0), 1e300),
        (("payload", "force_bias_n", 2), -500.0),
        (("payload", "com_m", 1), 9.0),
    ],
)
def test_what_no_cell_has_is_refused_by_runtime_and_library(place: tuple[str | int, ...], value: float) -> None:
    tree = copy.deepcopy(dict(true_tree()))
    entry: Any = tree
    for part in place[:-1]:
        entry = entry[part]
    entry[place[-1]] = value
    tree["checksum"] = checksum(tree)
    with pytest.raises(CertificateError, match=r"must be at (most|least)"):
        load(tree)
    with pytest.raises(CertificateError, match=r"must be at (most|least)"):
        parse_controller(dump_yaml(tree), "c.yaml")
