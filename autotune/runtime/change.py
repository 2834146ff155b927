"""Let another controller of a schedule take over while the cell runs: the command goes on, at the speed that it had."""

from autotune.formats.limits import VariableDampingSettings
from problems.errors import ParameterError
from problems.model.difference import (
    ACCELERATION_DIRECT,
    ACCELERATION_POLE,
    BIQUAD_0,
    BIQUAD_2,
    BIQUAD_POLE_2,
    FEEDBACK_DAMPING,
    VELOCITY_DIRECT,
    VELOCITY_POLE,
    resume,
)

from .controller import SAME_SAMPLE_TIME, RuntimeController
from .law import AxisLaw, Blocks
from .step import AxisState, State

# A filter with less memory than this from tick to tick does not say what it put out: the way itself does then.
LEAST_MEMORY = 1e-3


def change(
    before: RuntimeController, after: RuntimeController, state: State, *, dwell_time_s: float
) -> tuple[State, RuntimeController]:
    """Return the state from which `after` goes on, and who runs from now on: `before`, too early after the last change.

    Call it between two calls of `step`, with the same state; where it returns `before`, call it again in a later
    period. x^d and its speed go on: the last two commands stay as they were sent, the difference equation of the new
    gains starts from them and from the same drives, positions, speeds and accelerations. Without B_fb the next command
    is x^d_k + p (x^d_k − x^d_{k−1}) + what the forces add in one period, p the new law's pole. A B_a that varies starts
    where it was, inside of its new range.

    Parameters
    ----------
    before
        The controller that made the state.
    after
        The one that takes over. Its payload is compensated from the next period on, so call it as the payload changes.
    state
        What the last period left.
    dwell_time_s
        How long each controller runs at least [s], `dwell_time_s` of schedule.yaml.

    Returns
    -------
    tuple of State and RuntimeController
        What the next `step` takes.

    Raises
    ------
    ParameterError
        For a controller of another sample time or of other axes, and a dwell time that is none.
    """
    names = tuple(axis.name for axis in before.axes), tuple(axis.name for axis in after.axes)
    if names[0] != names[1]:
        raise ParameterError("after", ", ".join(names[1]), f"a controller of the same axes, {', '.join(names[0])}")
    h = before.sample_time_s
    if abs(after.sample_time_s - h) > SAME_SAMPLE_TIME * h:
        raise ParameterError("after", after.sample_time_s, f"a controller of the same sample time, {h:g} s")
    if not 0.0 <= dwell_time_s < float("inf"):
        raise ParameterError("dwell_time_s", dwell_time_s, "at least 0")
    if state.since_change * h < dwell_time_s:
        return state, before
    axes = list(state.axes)
    for old, new in zip(before.axes, after.axes, strict=True):
        axes[new.index] = _taken_over(old, new, axes[new.index], h)
    # What was weighed belongs to the payload before.
    watch = state.watch._replace(missing_kg=0.0, weight_kg=0.0, weight_since=0, weight_work=0.0)
    return state._replace(axes=tuple(axes), watch=watch, since_change=0), after


def _taken_over(old: AxisLaw, new: AxisLaw, before: AxisState, h: float) -> AxisState:
    """Return the axis with the memory of the new law."""
    was, damping, blocks = before.blocks or old.blocks, None, None
    if new.variable_damping is not None:
        damping = _kept(old.start_damping if before.damping is None else before.damping, new.variable_damping)
        blocks = new.blocks_at(damping)
    law = blocks or new.blocks
    position, (older_output, older_drive, older_position) = before.position, before.older
    speed, older_speed, rate = _filtered(was, before, h)
    sent, older_sent = before.command, older_output - was[FEEDBACK_DAMPING] * older_speed
    output, older = sent + law[FEEDBACK_DAMPING] * speed, older_sent + law[FEEDBACK_DAMPING] * older_speed
    integral, lag = resume(law, (output, before.drive, position), (older, older_drive, older_position))
    of_velocity = law[VELOCITY_POLE] * speed - law[VELOCITY_DIRECT] * position
    of_acceleration = law[ACCELERATION_POLE] * rate - law[ACCELERATION_DIRECT] * speed
    # A biquad begins as if the last drive had been there for ever.
    at_rest = (1.0 - law[BIQUAD_0]) * before.drive, (law[BIQUAD_2] - law[BIQUAD_POLE_2]) * before.drive
    return before._replace(
        control=(integral, lag, of_velocity, of_acceleration, *at_rest),
        output=output,
        older=(older, older_drive, older_position),
        damping=damping,
        blocks=blocks,
        periods=0,
    )


def _kept(damping: float, variable: VariableDampingSettings) -> float:
    damping = max(damping, variable.lowest)
    return min(damping, variable.highest)


def _filtered(was: Blocks, before: AxisState, h: float) -> tuple[float, float, float]:
    """Return what the filters put out: the last two speeds and the last acceleration, from their states.

    Of s_{k+1} = p v_k − d x_k it is v_k = (s_{k+1} + d x_k)/p, and v_{k−1} = (v_k − d (x_k − x_{k−1}))/p.
    """
    pole, direct = was[VELOCITY_POLE], was[VELOCITY_DIRECT]
    way = before.position - before.older[2]
    if -LEAST_MEMORY < pole < LEAST_MEMORY:
        speed = older = way / h
    else:
        speed = (before.control[2] + direct * before.position) / pole
        older = (speed - direct * way) / pole
    pole = was[ACCELERATION_POLE]
    if -LEAST_MEMORY < pole < LEAST_MEMORY:
        return speed, older, (speed - older) / h
    return speed, older, (before.control[3] + was[ACCELERATION_DIRECT] * speed) / pole
