"""What counts as a contact in a log: forces, shares and times, for fit, time line, touches and validation alike."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ContactRule:
    """Thresholds on the contact force; where two uses differ, each has its entry and its reason.

    A hold is a rest (`shortest_rest_s` or more, `find_motion`) under more force than the weight leaves. It is touched,
    before and after, where the force is above `smallest_n` and `touched_share` of the hold's: what a filter spreads of
    a press over its surroundings grows with the press. `smallest_hold_n` is twice `smallest_n`, so that a hold is a
    touch too, and a contact without a hold must have as much (`restless_factor`); six deviations are not noise.
    """

    smallest_n: float = 2.0
    touched_share: float = 0.1
    smallest_hold_n: float = 4.0
    hold_residuals: float = 6.0
    """Of the RMS that the weight leaves of the force at rest."""
    touched_noises: float = 6.0
    """Of the touch's noise at rest. The time line only: the fit cuts contacts out before the payload's motion, from
    which that noise is computed, is known."""
    unweighed_residual_n: float = 1.0
    """Taken for what the weight leaves in validation, where it may be that of the file: nobody measured its error in
    this log."""

    shortest_rest_s: float = 0.4
    """The tool swings through zero speed; what stands still for so long is at rest."""
    longest_swing_s: float = 0.1
    """What is shorter is a swing of the payload, or one of the force after a blow."""

    softest_n_per_m: float = 4e3
    """Least stiffness of a surface: an arm that holds the payload is a spring too, of up to 2 or 3 N/mm."""

    furthest_s: float = 3.0
    """A touch further from the hold is not its beginning or end."""
    longest_bounce_s: float = 0.3
    """Touches no further apart are one contact."""
    shortest_bounce_s: float = 4e-3
    smallest_lead_s: float = 0.02
    """What is seen before a touch must be longer, or its instant is not shown: a period of the cutoff, 60 Hz behind
    the coupling."""
    smallest_lead_of_fit_s: float = 0.05
    """The same in the fit, which sees the force on the flange below 20 Hz."""

    restless_factor: float = 2.0
    shortest_restless_s: float = 0.1
    """A contact without a hold has no rest that confirms it; a peak of the noise is shorter."""

    smallest_trace_peak_n: float = 3.0
    trace_share: float = 0.05
    """Of the peak of a trace that is declared to be one contact; unfiltered, so a smaller force begins it."""
    peak_levels: float = 1.5
    """Of the axis' level of force, which the peak of a touch must exceed: where the payload's weight is not known."""

    def hold_threshold_n(self, residual_rms_n: float) -> float:
        """Return the least force of a hold: 4 N, or six times what the weight leaves of the force at rest."""
        return max(self.smallest_hold_n, self.hold_residuals * residual_rms_n)

    def touch_threshold_n(self, held_n: float) -> float:
        """Return the force above which what a hold presses on with `held_n` is touched."""
        return max(self.smallest_n, self.touched_share * held_n)


CONTACT = ContactRule()
