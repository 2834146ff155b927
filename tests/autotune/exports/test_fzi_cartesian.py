"""FZI's Cartesian force controller: what is written of gains, links and axes."""

import re

import pytest

from autotune.exports import fzi_cartesian
from autotune.exports.fzi_cartesian import FziOptions
from autotune.exports.peers import PeerExport
from autotune.exports.ros_yaml import check_keys
from problems.errors import ParameterError
from problems.law_contact import force_per_speed
from tests.autotune.exports.peer_cases import CELL, EASY, PLAIN, exported, parameters, peer_controller, task_of


@pytest.fixture(scope="module")
def fzi(tmp_path_factory: pytest.TempPathFactory) -> PeerExport:
    return exported(tmp_path_factory.mktemp("fzi"), peer_controller({"z": PLAIN}, EASY), FziOptions())


def test_forward_dynamics_leads_by_its_derivative_and_drops_the_mass(fzi: PeerExport) -> None:
    (axis,) = fzi.axes
    gains = parameters(fzi)["pd_gains"]
    assert gains["trans_z"] == {"p": axis.written["p"], "d": axis.written["d"]}
    assert gains["trans_x"] == gains["rot_z"] == {"p": 0.0, "d": 0.0}
    assert "axis z: mass M_a = 8 kg (it is not free)" in fzi.dropped
    assert not any("lead" in line for line in fzi.dropped)
    assert axis.certificate.holds
    assert axis.certificate.admittance is not None
    # The speed per force is that of the file where the gains were translated, and as certified in any case.
    told = re.search(r"rendered damping (\d+\.?\d*)", axis.notes[0])
    assert told is not None
    hand = axis.certificate.admittance.hand_force_n_per_m_s
    assert float(told[1]) == pytest.approx(hand - CELL.drag_n_s_per_m, rel=1e-3)


def test_a_translated_gain_of_forward_dynamics_moves_as_fast_as_the_file_s_damping() -> None:
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    axis = fzi_cartesian.FziAxis(task, PLAIN, FziOptions())
    found = force_per_speed(axis.pair, axis.law(axis.translated))
    assert found == pytest.approx(PLAIN.damping + CELL.drag_n_s_per_m, rel=1e-4)


def test_a_misspelt_key_does_not_get_out() -> None:
    with pytest.raises(ParameterError, match=r"pd_gains\.trans_x\.D"):
        check_keys({"pd_gains": {"trans_x": {"p": 1.0, "D": 0.0}}}, fzi_cartesian.KNOWN_KEYS)
