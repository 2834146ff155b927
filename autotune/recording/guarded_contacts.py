"""Contacts by guarded moves: a command that no force feeds back into, and that rests once the tool touches."""

import math
from collections.abc import Generator

from .motions import Three, smooth_ramp

Steps = Generator[tuple[float, Three], float, None]
"""Of each period the way along the axis [m] and the rotation vector [rad]; the force along the axis [N] is sent in."""

# Of F^d: what counts as a touch, and how far the force may run on behind the command while the tool presses.
_TOUCHED_SHARE, _RUN_ON_SHARE = 0.25, 0.25
# Time constants of the force that a touch is felt by, and of what is left of it when the payload has swung out.
_TOUCH_S, _SETTLED_S = 0.01, 0.05
_STARTING_S = 0.2
_SETTLING_S = 0.25
_LONGEST_PRESS_S = 3.0
# From contact to contact the speed changes by this factor at most.
_MOST_FASTER = 3.0


class GuardedContacts:
    """Approach, press with F^d, hold and back off; positions [m] along the axis, the sensor's force [N] in return.

    The approach goes on at one speed until a quarter of F^d is felt, and the command then rests: what the robot still
    has to go makes the first force. From there it moves slowly, to and fro, until F^d is reached, and rests again.
    Nothing is fed back while it rests, so that no payload, surface or delay can make the contact unstable. The first
    contact shows how the force runs on per speed; the next one is as fast as its peak stays at F^d, `fastest_m_s` at
    most and where drag stays below an eighth of F^d.
    """

    def __init__(
        self,
        *,
        force_n: float,
        hold_s: float,
        speed_m_s: float,
        fastest_m_s: float,
        approach_m: float,
        retract_m: float,
        period_s: float,
    ) -> None:
        self._force, self._hold_s, self._h = force_n, hold_s, period_s
        self._speed, self._fastest = speed_m_s, fastest_m_s
        self._approach_m, self._retract_m = approach_m, retract_m
        self._touch = _TOUCHED_SHARE * force_n
        self._pressed = self._settled = self._peak = 0.0
        self.place = 0.0
        self.has_touched = True
        """Whether the last approach met something."""

    def contact(self) -> Steps:
        """Yield the way of one contact, from the last command on."""
        start, speed, drag = self.place, self._speed, 0.0
        self._pressed = self._settled = self._peak = 0.0
        periods = max(1, round(self._approach_m / (speed * self._h)))
        for k in range(periods):
            yield from self._go(speed * smooth_ramp(min(1.0, (k + 1) * self._h / _STARTING_S)))
            drag += (max(self._pressed, 0.0) - drag) / (k + 1)
            if self._pressed > self._touch:
                break
        self.has_touched = self._pressed > self._touch
        touched = self.place
        if self.has_touched:
            yield from self.dwell(_SETTLING_S)
            self._speed = self._next_speed(speed, drag)
            run_on = max(self._settled - self._touch, 0.1 * self._touch) / speed
            yield from self._press(min(speed, _RUN_ON_SHARE * self._force / run_on), run_on)
            yield from self.dwell(self._hold_s)
        yield from self._back(max(start, touched - self._retract_m))

    def _next_speed(self, speed: float, drag: float) -> float:
        beyond = max(self._peak - self._touch, 1e-3 * self._touch)
        factor = min(max((self._force - self._touch) / beyond, 1.0 / _MOST_FASTER), _MOST_FASTER)
        slowest_drag = 0.5 * self._touch * speed / max(drag, 1e-9)
        return min(speed * factor, self._fastest, max(slowest_drag, speed / _MOST_FASTER))

    def _press(self, speed: float, run_on: float) -> Steps:
        """Move on, or back where too much was met, until F^d lies no further ahead than the force runs on."""
        sign = 1.0 if self._pressed < self._force else -1.0
        for _ in range(round(_LONGEST_PRESS_S / self._h)):
            if sign * (self._force - self._pressed) <= run_on * speed:
                return
            yield from self._go(sign * speed)

    def _back(self, to: float) -> Steps:
        """Move to a place with minimum jerk, at 1 to 2 of the mean speed of an approach by the fastest."""
        here = self.place
        periods = max(1, math.ceil(abs(here - to) / (0.5 * self._fastest * self._h)))
        for k in range(periods):
            self.place = here + (to - here) * smooth_ramp((k + 1) / periods)
            yield from self._go(0.0)

    def dwell(self, duration_s: float) -> Steps:
        """Yield a rest at the last command [s]."""
        for _ in range(round(duration_s / self._h)):
            yield from self._go(0.0)

    def _go(self, speed_m_s: float) -> Steps:
        self.place += speed_m_s * self._h
        sensed = yield self.place, (0.0, 0.0, 0.0)
        self._pressed += (1.0 - math.exp(-self._h / _TOUCH_S)) * (-sensed - self._pressed)
        self._settled += (1.0 - math.exp(-self._h / _SETTLED_S)) * (-sensed - self._settled)
        self._peak = max(self._peak, self._pressed)
