"""What `optimize` tells of the collision response: what it saves, or why there is none."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller

_SHOWN_N = 0.005
_ENDS = {
    "free motion": "a lower one, which free motion and noise forbid, might save more",
    "lower bound": "the lower bound is active",
    "upper bound": "the upper bound is active",
}


def response_lines(controller: "Controller") -> Iterator[str]:
    """Say which threshold was chosen in `controller.provenance`, where one was asked for, and what it saves."""
    told: Mapping[str, Any] | None = controller.provenance.get("collision")
    if told is None:
        return
    where = "at the contact" if told["objective"] == "contact_force" else "at the sensor"
    without, with_it = told["worst_peak_n"]["without"], told["worst_peak_n"]["with"]
    best, (low, high), lowest = told["best_threshold_n"], told["bounds_n"], told["lowest_n"]
    if told["response"] == "reset":
        end = f"; {_ENDS[told['limited_by']]}" if told["limited_by"] in _ENDS else ""
        yield (
            f"collision response: reset at {best:g} N takes the worst peak {where} from {without:.2f} to {with_it:.2f} "
            f"N ({100.0 * (with_it / without - 1.0):+.1f} %){end}"
        )
    else:
        rises = with_it > without + _SHOWN_N
        at_best = f"the best, {best:g} N, makes it {with_it:.2f} N" if rises else "at best it stays as it is"
        yield (
            f"collision response: none. No threshold from {max(low, lowest):.4g} to {high:g} N lowers the worst peak "
            f"{where} of {without:.2f} N by 0.1 % without raising the other one; {at_best}"
        )
    if told.get("noise_is_assumed", False):
        yield (
            f"the sensor's noise was not identified: {told['noise_rms_n']:.3g} N RMS was taken; record rests, which "
            "tell it"
        )
    if low < lowest:
        yield (
            f"thresholds below {lowest:.4g} N are left out: {told['free_motion_n']:.3g} N stand against the motion as "
            f"the approach begins in free space, and the noise of {told['noise_rms_n']:.3g} N RMS comes on top"
        )
