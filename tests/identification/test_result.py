"""Results pass from process to process."""

import pickle
from types import MappingProxyType

import pytest

from identification.result import Identified
from tests.autotune.files.samples import make_identified


def test_a_result_is_the_same_after_pickling_and_as_closed_to_changes() -> None:
    told = make_identified()
    found = pickle.loads(pickle.dumps(told))
    assert isinstance(found, Identified)
    assert found == told
    assert isinstance(found.axes, MappingProxyType)
    with pytest.raises(TypeError):
        found.axes["z"] = told.axes["x"]  # type: ignore[index]
