"""The shares that a long computation reports add up to one, however its parts report them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.progress import ProgressSlice


@given(st.lists(st.floats(0.0, 1.0), max_size=20), st.floats(0.01, 1.0))
def test_a_part_never_reports_more_than_its_share_and_all_of_it_at_the_end(steps: list[float], share: float) -> None:
    reported: list[float] = []
    part = ProgressSlice(reported.append, share)
    for step in steps:
        part(step)
        assert sum(reported) <= share * (1.0 + 1e-12)
    part.finish()
    assert sum(reported) == pytest.approx(share)
    assert all(step > 0.0 for step in reported)


def test_what_was_reported_is_not_taken_back_nor_reported_twice() -> None:
    reported: list[float] = []
    whole = ProgressSlice(reported.append)
    whole.advance_to(0.5)
    whole.advance_to(0.3)
    inner = whole.part(0.5)
    inner.advance_to(0.5)
    assert reported == pytest.approx([0.5, 0.25])
