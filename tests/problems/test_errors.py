import pickle
from copy import deepcopy

import numpy as np
import pytest

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.records import EntryError
from problems.errors import AutotuneError, MissingExtraError, ParameterError, shown
from problems.stability.margins import UnstableLoopError


@pytest.mark.parametrize(
    "error",
    [
        ParameterError("mass_kg", -3.0, "above 0"),
        MissingExtraError("limit", "cvxpy", "limit"),
        UnstableLoopError(1.5),
        EntryError(("axes", 0), ParameterError("mass_kg", -3.0, "above 0")),
        UsageError("Say a.", to_paste=("a",)),
        InfeasibleError("None.", (("modulus_margin", 0.5, 0.4),), suggestion={"structure": "biquad"}, missed=0.2),
    ],
)
def test_errors_cross_processes_with_their_sentence_and_all_that_they_carry(error: AutotuneError) -> None:
    for again in (pickle.loads(pickle.dumps(error)), deepcopy(error)):
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert vars(again) == vars(error)


def test_a_parameter_error_carries_its_numbers_and_says_them_in_one_sentence() -> None:
    error = ParameterError("mass_kg", -3.0, "finite and above 0")
    assert (error.name, error.value, error.must) == ("mass_kg", -3.0, "finite and above 0")
    assert str(error) == "mass_kg must be finite and above 0, found -3.0."


def test_what_was_found_is_named_by_its_type_where_it_is_long() -> None:
    error = ParameterError("robot", list(range(100)), "a Robot")
    assert (str(error), len(error.value)) == ("robot must be a Robot, found a list.", 100)  # type: ignore[arg-type]
    assert [shown(each) for each in (np.zeros((40, 2)), "a" * 99)] == ["a ndarray", f"'{'a' * 97} …"]
    assert [shown(each) for each in (3, None, (1.0, 2.0), "a" * 98)] == ["3", "None", "(1.0, 2.0)", f"'{'a' * 98}'"]


def test_a_parameter_error_is_caught_by_the_tree_and_as_a_value_error() -> None:
    assert issubclass(ParameterError, AutotuneError)
    assert issubclass(ParameterError, ValueError)
