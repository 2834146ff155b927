"""A log's peaks as another one predicts them, with surfaces of which the first blow alone is known."""

from dataclasses import replace

import pytest

from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from autotune.prediction.against_touches import Running, compare_touches
from autotune.prediction.left_out_logs import with_left_out_logs
from autotune.text import held_out_lines
from identification.errors import EstimateError
from identification.merging.combine import NamedResult
from identification.result import EnvironmentEstimate, Estimate, Identified, Status, Timeline, Touch, TouchCause
from tests.autotune.formats.samples import make_identified

LOST = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)


def log(blow: float, peak: float, *, cause: TouchCause = TouchCause.WALL, damping: float | None = 500.0) -> Identified:
    """A surface known by its blow [N·s/m] alone, and a touch of 20 mm/s with a peak [N]."""
    whole = make_identified()
    surface = EnvironmentEstimate(
        name="x1",
        stiffness_n_per_m=LOST,
        secant_stiffness_n_per_m=LOST,
        damping_n_s_per_m=LOST,
        mass_kg=LOST,
        contacts=1,
        peak_force_n=(peak,),
        impact_n_s_per_m=Estimate(value=blow, std=0.1 * blow, status=Status.WEAK),
    )
    touch = Touch(
        axis="x", sign=1, cause=cause, peak_s=2.0, peak_force=peak, approach_speed=0.02, mass=7.0, damping=damping
    )
    axis = replace(whole.axes["x"], environments=(surface,))
    return replace(whole, axes={"x": axis}, timelines=(Timeline(phases=(), touches=(touch,)),))


def first(parts: list[NamedResult]) -> Identified:
    return parts[0].result


def test_each_log_is_predicted_by_the_others() -> None:
    parts = [NamedResult(name=name, result=log(*each)) for name, each in (("a", (4e3, 90.0)), ("b", (3e3, 70.0)))]
    found = with_left_out_logs(first(parts), parts, lambda rest: first([*rest])).axes["x"]
    assert [(each.log, each.without) for each in found.held_out] == [("a", "log"), ("b", "log")]
    # c v of the other log.
    assert [each.predicted_peak for each in found.held_out] == pytest.approx([60.0, 80.0])
    (line,) = held_out_lines("x", found)
    # -33 % and +14 %.
    assert "2 peaks predicted from the other logs, RMS error 26 %, largest 33 %" in line


@pytest.mark.parametrize("changes", [{"cause": TouchCause.HAND}, {"damping": None}])
def test_a_hand_and_a_touch_without_gains_are_not_predicted(changes: dict[str, object]) -> None:
    parts = [NamedResult(name=name, result=log(4e3, 90.0, **changes)) for name in "ab"]  # type: ignore[arg-type]
    found = with_left_out_logs(first(parts), parts, lambda rest: first([*rest]))
    assert found.axes["x"].held_out == ()
    alone = with_left_out_logs(first(parts), parts[:1], lambda rest: first([*rest]))
    assert alone.axes["x"].held_out == ()


@pytest.mark.parametrize(("cause", "why"), [(TouchCause.HAND, "a hand"), (TouchCause.UNDETERMINED, "is undetermined")])
def test_what_may_be_no_wall_is_held_against_no_prediction(cause: TouchCause, why: str) -> None:
    known = log(4e3, 90.0, cause=cause)
    source = IdentifiedFile(result=known, provenance={}, path=IN_MEMORY, sha256="")

    def unasked(_axis: str) -> Running:
        raise AssertionError

    with pytest.raises(EstimateError, match=f"No contact of the log can be predicted: x at 2.00 s: .*{why}"):
        compare_touches(source, [("", touch) for touch in known.timelines[0].touches], unasked)
    # What holds of several is said once.
    later = [replace(touch, peak_s=touch.peak_s + 3.0) for touch in known.timelines[0].touches]
    with pytest.raises(EstimateError, match=f"predicted: x at 2.00 s, x at 5.00 s: [^:]*{why}[^:]*$"):
        compare_touches(source, [("", touch) for touch in (*known.timelines[0].touches, *later)], unasked)
