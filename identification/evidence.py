"""Signals and fitted spans on which an identification result rests, for pictures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from problems.arrays import FloatArray
from problems.frozen import freeze

from .joint_fit.result import FittedSpan
from .known_payload import KnownPayload
from .result import Finding


@dataclass(frozen=True, kw_only=True)
class AxisEvidence:
    """One axis: the `spans` that its joint fit used, measured against model."""

    spans: tuple[FittedSpan, ...]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """The wrench in the sensor frame S, as logged and without weight and bias, and the axes.

    Force (n, 3) in N, torque (n, 3) about the sensor's origin in N·m. Sample k was taken k `period_s` after the start
    of the log, the first moment `start_ns` that wrench and pose share, from which all its times count; what a hole
    swallowed is NaN. `log` names the recording, `reading` is what was found when it was read. `gain_error_share` is the
    share by which the force's scale may be wrong, as the rests show it. Of a log whose weight was removed before
    recording there is the wrench as logged alone: what would be without weight and bias is None. `payload` is that of
    the rests, or the known one that was taken.
    """

    start_ns: int
    period_s: float
    raw_S_n: FloatArray
    compensated_S_n: FloatArray | None
    raw_torque_S_n_m: FloatArray
    compensated_torque_S_n_m: FloatArray | None
    axes: Mapping[str, AxisEvidence]
    log: str = ""
    reading: tuple[Finding, ...] = ()
    gain_error_share: float = 0.0
    payload: KnownPayload | None = None

    def __post_init__(self) -> None:
        freeze(self, "axes")

    def __reduce__(self) -> tuple[Callable[[], "Evidence"], tuple[()]]:
        """Pickle by what the constructor takes: a view of a mapping has no copy of its own."""
        return partial(Evidence, **{**vars(self), "axes": dict(self.axes)}), ()
