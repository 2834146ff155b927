"""How the command line's priors are read."""

import pytest

from autotune.errors import UsageError
from autotune.given import parse_given
from identification.given import Given


@pytest.mark.parametrize(
    "text", ["mass_kg=16.2±0.1", "mass_kg=16.2+-0.1", "mass_kg=16.2+/-0.1", " mass_kg=1.62e1 ± 1e-1"]
)
def test_the_usual_ways_to_write_a_deviation(text: str) -> None:
    assert parse_given([text]) == {"mass_kg": Given(value=16.2, std=0.1)}


def test_without_deviation_it_is_exact_and_exponents_are_no_deviations() -> None:
    assert parse_given(["x.delay_s=2.4e-3", "sample_time_s=8e+0"]) == {
        "x.delay_s": Given(value=2.4e-3, std=0.0),
        "sample_time_s": Given(value=8.0, std=0.0),
    }


@pytest.mark.parametrize(
    ("texts", "told"),
    [
        (["mass_kg"], "must be NAME=VALUE±STD"),
        (["mass_kg="], "must be NAME=VALUE±STD"),
        (["mass_kg=16,2±0.1"], "must hold numbers, found '16,2'"),
        (["mass_kg=nan"], "finite"),
        (["mass_kg=16±-0.1"], "must not be negative"),
        (["mass_kg=16±inf"], "finite"),
        (["mass_kg=16", "mass_kg=17"], "twice"),
    ],
)
def test_what_is_no_prior_is_refused(texts: list[str], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        parse_given(texts)


@pytest.mark.parametrize("text", ["mass_kg=-3", "mass_kg=0±1", "x.coupling_stiffness_n_per_m=-1e5", "x.delay_s=-1e-3"])
def test_what_no_payload_has_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be"):
        parse_given([text])


def test_a_damping_or_delay_may_be_none() -> None:
    assert parse_given(["x.drag_n_s_per_m=0±10", "x.delay_s=0"])["x.delay_s"].value == 0.0
