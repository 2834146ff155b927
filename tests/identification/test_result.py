"""Results pass from process to process."""

import pickle

import pytest

from identification.result import Estimate, Identified, Status, WrenchFilterEstimate
from problems.errors import ParameterError
from problems.frozen import FrozenDict
from tests.autotune.formats.samples import make_identified


def test_a_result_is_the_same_after_pickling_and_as_closed_to_changes() -> None:
    reported = make_identified()
    found = pickle.loads(pickle.dumps(reported))
    assert isinstance(found, Identified)
    assert found == reported
    assert isinstance(found.axes, FrozenDict)
    with pytest.raises(TypeError):
        found.axes["z"] = reported.axes["x"]


def test_a_wrench_filter_is_one_of_two_and_no_lead() -> None:
    known = Estimate(value=50.0, std=1.0, status=Status.IDENTIFIED)
    lead = Estimate(value=-1e-3, std=1e-5, status=Status.IDENTIFIED)
    with pytest.raises(ParameterError, match="found 'neither'"):
        WrenchFilterEstimate()
    with pytest.raises(ParameterError, match="found 'both'"):
        WrenchFilterEstimate(corner_hz=known, delay_s=known)
    with pytest.raises(ParameterError, match="at least 0"):
        WrenchFilterEstimate(delay_s=lead)
    with pytest.raises(ParameterError, match="greater than 0"):
        WrenchFilterEstimate(corner_hz=lead)
