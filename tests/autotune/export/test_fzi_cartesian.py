"""FZI's Cartesian force controller: what is written of gains, links and axes."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.export import fzi_cartesian
from autotune.export.base_axes import base_axes, rotation
from autotune.export.fzi_axis import FziAxis
from autotune.export.fzi_cartesian import FziOptions
from autotune.export.ros_yaml import Quaternion, check_keys, parse_orientation
from autotune.export.third_party import Translation
from problems.contact.linear_controller_contact import force_per_speed
from problems.errors import ParameterError
from tests.autotune.export.peer_cases import CELL, EASY, PLAIN, exported, parameters, peer_controller, task_of

UPRIGHT = FziOptions(orientation=(0.0, 0.0, 0.0, 1.0))
HALF = math.sqrt(0.5)
TURNS = {
    "down": (1.0, 0.0, 0.0, 0.0),
    "quarter about z": (0.0, 0.0, HALF, HALF),
    "quarter about x": (HALF, 0.0, 0.0, HALF),
    "third about the diagonal": (0.5, 0.5, 0.5, 0.5),
    "a degree short of a quarter": (0.0, math.sin(math.radians(44.6)), 0.0, math.cos(math.radians(44.6))),
}


@pytest.fixture(scope="module")
def fzi(tmp_path_factory: pytest.TempPathFactory) -> Translation:
    return exported(tmp_path_factory.mktemp("fzi"), peer_controller({"z": PLAIN}, EASY), UPRIGHT)


def test_forward_dynamics_leads_by_its_derivative_and_drops_the_mass(fzi: Translation) -> None:
    (axis,) = fzi.axes
    gains = parameters(fzi)["pd_gains"]
    assert gains["trans_z"] == {"p": axis.written["p"], "d": axis.written["d"]}
    assert gains["trans_x"] == gains["rot_z"] == {"p": 0.0, "d": 0.0}
    assert "axis z: mass M_a = 8 kg (it is not free)" in fzi.dropped
    assert not any("lead" in line for line in fzi.dropped)
    assert axis.certificate.holds
    assert axis.certificate.admittance is not None
    # The speed per force is that of the file where the gains were translated, and as certified in any case.
    reported = re.search(r"rendered damping (\d+\.?\d*)", axis.notes[0])
    assert reported is not None
    hand = axis.certificate.admittance.hand_force_n_per_m_s
    assert float(reported[1]) == pytest.approx(hand - CELL.drag_n_s_per_m, rel=1e-3)


def test_a_translated_gain_of_forward_dynamics_moves_as_fast_as_the_file_s_damping() -> None:
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    axis = FziAxis(task, PLAIN)
    found = force_per_speed(axis.pair, axis.law(axis.translated))
    assert found == pytest.approx(PLAIN.damping + CELL.drag_n_s_per_m, rel=1e-4)


def test_a_misspelt_key_does_not_get_out() -> None:
    with pytest.raises(ParameterError, match=r"pd_gains\.trans_x\.D"):
        check_keys({"pd_gains": {"trans_x": {"p": 1.0, "D": 0.0}}}, fzi_cartesian.KNOWN_KEYS)


def test_the_mass_of_the_links_has_the_name_that_is_declared(fzi: Translation) -> None:
    found = parameters(fzi)
    assert found["solver/forward_dynamics/link_mass"] == 1e-4
    assert found["solver"] == {"error_scale": 1.0, "iterations": 1}
    with pytest.raises(ParameterError, match=r"solver\.forward_dynamics\.link_mass"):
        check_keys({"solver": {"forward_dynamics": {"link_mass": 1e-4}}}, fzi_cartesian.KNOWN_KEYS)


def gains_of(made: Translation) -> dict[str, tuple[float, float]]:
    """Return p and d by the base's axis."""
    rows = parameters(made)["pd_gains"]
    return {axis: (rows[key]["p"], rows[key]["d"]) for axis, key in fzi_cartesian.KEYS_OF.items()}


@pytest.mark.parametrize("turn", TURNS)
def test_every_axis_has_its_own_gain_in_the_orientation_of_use(tmp_path: Path, turn: str) -> None:
    """A force along the sensor's axis i moves it by R^T diag(p) R e_i: p_i along i and nothing along the others."""
    damping = {"x": 3000.0, "y": 2600.0, "z": 3300.0}
    controller = peer_controller({axis: replace(PLAIN, damping=each) for axis, each in damping.items()}, EASY)
    made = exported(tmp_path, controller, FziOptions(orientation=TURNS[turn]))
    certified = [each.written["p"] for each in made.axes]
    assert len(set(certified)) == 3
    base = np.diag([gains_of(made)[axis][0] for axis in "xyz"])
    turned = rotation(TURNS[turn])
    seen = turned.T @ base @ turned
    # The turn that is 0.8° short leaves that much of the difference between the gains beside them.
    np.testing.assert_allclose(seen, np.diag(certified), atol=0.02 * max(certified) if "short" in turn else 1e-15)
    assert f"({', '.join(f'{each:g}' for each in TURNS[turn])}) of the sensor in it" in re.sub(
        r"\n#\s*", " ", made.text
    )


def test_an_axis_that_is_not_tuned_keeps_still_and_turning_axes_turn_with_the_sensor() -> None:
    quarter = TURNS["quarter about z"]
    places = base_axes({"x": {"p": 1.0}, "rz": {"p": 2.0}, "ry": {"p": 3.0}}, quarter)
    # The sensor's x lies along the base's y, and its y along −x.
    assert places == {"x": "y", "ry": "rx", "rz": "rz"}


def test_gains_that_are_alike_hold_in_every_orientation(tmp_path: Path) -> None:
    alike = peer_controller(dict.fromkeys(("x", "y", "z"), PLAIN), EASY)
    made = exported(tmp_path, alike, FziOptions())
    assert len({gains_of(made)[axis] for axis in "xyz"}) == 1
    assert "hold in every orientation" in re.sub(r"\n#\s*", " ", made.text)
    # An odd orientation then says nothing, and asks nothing.
    assert exported(tmp_path, alike, FziOptions(orientation=(0.3, 0.0, 0.0, math.sqrt(0.91)))).text == made.text


@pytest.mark.parametrize(
    ("axes", "orientation", "message"),
    [
        ({"z": 3000.0}, None, "z must move and x, y must not: what is certified holds in one orientation only"),
        ({"x": 3000.0, "y": 3000.0}, None, "x, y must move and z must not"),
        ({"x": 3000.0, "y": 3000.0, "z": 2600.0}, None, "z has p "),
        ({"z": 3000.0}, (0.0, 0.0, 0.0999, 0.995), "the sensor's x is 11.5° off the nearest axis of the base"),
        ({"z": 3000.0}, (0.0, 0.0, 0.0, 2.0), "of length 1, found"),
    ],
)
def test_unequal_gains_without_a_turn_by_right_angles_are_refused(
    tmp_path: Path, axes: dict[str, float], orientation: Quaternion | None, message: str
) -> None:
    controller = peer_controller({axis: replace(PLAIN, damping=each) for axis, each in axes.items()}, EASY)
    with pytest.raises(UsageError, match=re.escape(message)):
        exported(tmp_path, controller, FziOptions(orientation=orientation))


@pytest.mark.parametrize("text", ["", "1,2,3", "a,b,c,d", "0 0 0 1"])
def test_an_orientation_that_is_no_quaternion_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be four numbers"):
        parse_orientation(text)
    with pytest.raises(UsageError, match="of length 1"):
        FziOptions(orientation=parse_orientation("nan,0,0,1"))
