"""What lies between the coupling's force and the controller: the filter or delay of the plant, and its range."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from autotune.errors import UsageError
from autotune.formats.problem import Interval, Uncertain
from identification.errors import EstimateError
from identification.result import Estimate, Identified, Status, WrenchFilterEstimate
from problems.model.plant import WrenchFilter

LAG, LATE = "wrench_time_constant_s", "wrench_delay_s"
# Standard deviations on either side of a value: 95 % and a little more.
_STDS = 2.0
_DIGITS = 5
# What reads the position, which is not late: beside a late wrench it stays 0.
_READS_POSITION = ("feedback_damping_s", "compensation_mass_kg")


@dataclass(frozen=True, kw_only=True)
class Wrench:
    """The nominal filter, and the ranges [s] of what of it must be safe, by the names of `problem.yaml`."""

    nominal: WrenchFilter
    ranges: Mapping[str, Interval]

    @property
    def is_late(self) -> bool:
        """Whether a pure delay is part of it."""
        return max(self.nominal.delay_s, self.ranges.get(LATE, (0.0, 0.0))[1]) > 0.0


def build_wrench(estimate: WrenchFilterEstimate | None, said: Uncertain) -> Wrench:
    """Return what the log says of the wrench's filter or delay, and what `problem.yaml` says of it instead.

    By default it is the identified value with its 95 % range, or the interval of a weak one. Raises EstimateError for
    an entry without a number, UsageError for `identified` where nothing was.
    """
    corner = None if estimate is None else estimate.corner_hz
    delay = None if estimate is None else estimate.delay_s
    lag, late = _lag(corner, said.get(LAG)), _late(delay, said.get(LATE))
    ranges = {name: span for name, (_, span) in ((LAG, lag), (LATE, late)) if span[0] < span[1]}
    return Wrench(nominal=WrenchFilter(time_constant_s=lag[0], delay_s=late[0]), ranges=ranges)


def check_wrench(identified: Identified, said: Uncertain) -> None:
    """Raise UsageError where a file says that its wrench was found late, and no longer says by what filter or delay.

    Its other numbers were fitted with that filter, and a loop without it looks safer than it is.
    """
    is_missing = identified.sensor.wrench_filter is None and not {LAG, LATE} & said.keys()
    finding = next((each for each in identified.findings if each.code == "wrench-filter"), None)
    if is_missing and finding is not None:
        raise UsageError(
            f"The identified file has no sensor.wrench_filter, and its findings say: {finding.message} Identify it "
            f"again, or say {LAG} or {LATE} in problem.yaml ([0, 0] for a sensor that was changed since)."
        )


def without_position(bounds: Mapping[str, Interval], wrench: Wrench) -> dict[str, Interval]:
    """Return the bounds of a controller that reads nothing but the wrench where that comes with a pure delay.

    Raises UsageError for bounds that ask for more.
    """
    found = dict(bounds)
    if not wrench.is_late:
        return found
    for name in _READS_POSITION:
        if found.get(name, (0.0, 0.0))[1] > 0.0:
            raise UsageError(
                f"The wrench is late by a pure delay, and {name} reads the position, which is not: the loop of both is "
                f"not computed by this release. Set bounds of {name} to [0, 0], or leave it out."
            )
    return {**found, "feedback_damping_s": (0.0, 0.0)}


def _lag(corner: Estimate | None, said: Interval | str | None) -> tuple[float, Interval]:
    """Return the nominal time constant and its range; 0 is none."""
    if isinstance(said, tuple):
        if said[0] == 0.0 < said[1]:
            raise UsageError(
                f"{LAG} must be above 0 at both ends, or [0, 0] for none; found [0, {said[1]:g}]: a filter of the "
                "wrench is a state of the plant, which does not vanish within a range."
            )
        return _middle(said, None if corner is None or corner.value is None else _constant(corner.value)), said
    if corner is None:
        _refuse_identified(LAG, said)
        return 0.0, (0.0, 0.0)
    value, (low, high) = _known(corner, "sensor.wrench_filter.corner_hz")
    if not low > 0.0:
        raise EstimateError(
            f"sensor.wrench_filter.corner_hz is {value:.4g} Hz with a range that reaches 0; record a faster motion, or "
            f"say {LAG}: [low, high] in problem.yaml."
        )
    nominal = _constant(value)
    if said == "nominal" or low == high:
        return nominal, (nominal, nominal)
    return nominal, (_digits(_constant(high), math.floor), _digits(_constant(low), math.ceil))


def _late(delay: Estimate | None, said: Interval | str | None) -> tuple[float, Interval]:
    """Return the nominal delay and its range."""
    if isinstance(said, tuple):
        return _middle(said, None if delay is None else delay.value), said
    if delay is None:
        _refuse_identified(LATE, said)
        return 0.0, (0.0, 0.0)
    value, (low, high) = _known(delay, "sensor.wrench_filter.delay_s")
    if said == "nominal" or low == high:
        return value, (value, value)
    return value, (_digits(max(low, 0.0), math.floor), _digits(high, math.ceil))


def _known(estimate: Estimate, where: str) -> tuple[float, Interval]:
    """Return the value and its 95 % range; the middle of the interval where that is all that the log shows."""
    if estimate.status is Status.UNIDENTIFIABLE or (estimate.value is None and estimate.ci95 is None):
        note = f" ({estimate.note})" if estimate.note else ""
        raise EstimateError(
            f"{where} is not identified{note}, and no controller is tuned on a guess; record what is missing, or say "
            f"{LAG} or {LATE} in problem.yaml."
        )
    if estimate.value is None:
        low, high = estimate.ci95 or (0.0, 0.0)
        return 0.5 * (low + high), (low, high)
    margin = _STDS * (estimate.std or 0.0)
    low, high = estimate.value - margin, estimate.value + margin
    if estimate.ci95 is not None:
        low, high = min(low, estimate.ci95[0]), max(high, estimate.ci95[1])
    return estimate.value, (low, high)


def _middle(span: Interval, value: float | None) -> float:
    """Return the value where the range holds it, else the nearer end; the middle where there is none."""
    return 0.5 * (span[0] + span[1]) if value is None else min(max(value, span[0]), span[1])


def _constant(corner_hz: float) -> float:
    return WrenchFilter.from_corner(corner_hz).time_constant_s


def _refuse_identified(name: str, said: str | None) -> None:
    if said == "identified":
        raise UsageError(
            f"problem.yaml takes {name} from the identified file, and its sensor.wrench_filter says nothing of it; "
            "give a range [low, high]."
        )


def _digits(value: float, towards: Callable[[float], int]) -> float:
    """Return a number with five digits, rounded down or up."""
    if value == 0.0:
        return 0.0
    exponent = math.floor(math.log10(value)) - _DIGITS + 1
    # Six digits more decide what is already round.
    whole = round(value / 10.0**exponent, 6)
    return float(f"{towards(whole)}e{exponent}")
