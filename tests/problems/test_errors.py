from problems.errors import AutotuneError, ParameterError


def test_a_parameter_error_carries_its_numbers_and_says_them_in_one_sentence() -> None:
    error = ParameterError("mass_kg", -3.0, "finite and above 0")
    assert (error.name, error.value, error.must) == ("mass_kg", -3.0, "finite and above 0")
    assert str(error) == "mass_kg must be finite and above 0, found -3.0."


def test_a_parameter_error_is_caught_by_the_tree_and_as_a_value_error() -> None:
    assert issubclass(ParameterError, AutotuneError)
    assert issubclass(ParameterError, ValueError)
