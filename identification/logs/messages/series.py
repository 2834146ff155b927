"""Numbers of one channel over time."""

from dataclasses import dataclass

from problems.arrays import FloatArray

from ...signals.recording import StampArray
from ..containers.channel import Channel


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What is wanted of each message: numbers by path, and the path of the header that stamps it.

    A path is written with dots and indices: `wrench.force.x`, `effort[3]`, `mass.data[0]`. `header` is empty for
    messages without one.
    """

    fields: tuple[str, ...]
    header: str = "header"


@dataclass(frozen=True, kw_only=True)
class Series:
    """The wanted numbers of a channel in order of recording.

    `log_ns` (n,) recording clock; `stamp_ns` (n,) header stamps or None; `frame_ids` the different frame names in the
    headers, sorted; `values` (n, len(fields)) as the messages hold them (no unit is converted), NaN and infinities too.
    """

    channel: Channel
    fields: tuple[str, ...]
    log_ns: StampArray
    stamp_ns: StampArray | None
    frame_ids: tuple[str, ...]
    values: FloatArray
