"""The signals that identification works on, free of any log format."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import LogError

FloatArray = NDArray[np.float64]
StampArray = NDArray[np.int64]


def _frozen_array(values: NDArray[np.generic], dtype: type, width: int | None, name: str) -> NDArray[np.generic]:
    array: NDArray[Any] = np.array(values, dtype=dtype, order="C")
    expected = 1 if width is None else 2
    if array.ndim != expected or (width is not None and array.shape[1] != width):
        raise LogError(f"{name} must have {expected} dimension(s) of width {width}, found shape {array.shape}.")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, kw_only=True)
class WrenchSignal:
    """A wrench as the sensor shows it, in the sensor frame, gravity and bias still in.

    `stamp_ns` (n,) header stamps, strictly increasing; `force_n` (n, 3); `torque_n_m` (n, 3).
    """

    topic: str
    frame_id: str
    stamp_ns: StampArray
    force_n: FloatArray
    torque_n_m: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamp_ns", _frozen_array(self.stamp_ns, np.int64, None, "stamp_ns"))
        object.__setattr__(self, "force_n", _frozen_array(self.force_n, np.float64, 3, "force_n"))
        object.__setattr__(self, "torque_n_m", _frozen_array(self.torque_n_m, np.float64, 3, "torque_n_m"))


@dataclass(frozen=True, kw_only=True)
class PoseSignal:
    """A flange pose in the base frame: `position_m` (n, 3), `quaternion_xyzw` (n, 4) of base from flange."""

    topic: str
    frame_id: str
    stamp_ns: StampArray
    position_m: FloatArray
    quaternion_xyzw: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamp_ns", _frozen_array(self.stamp_ns, np.int64, None, "stamp_ns"))
        object.__setattr__(self, "position_m", _frozen_array(self.position_m, np.float64, 3, "position_m"))
        object.__setattr__(
            self, "quaternion_xyzw", _frozen_array(self.quaternion_xyzw, np.float64, 4, "quaternion_xyzw")
        )


@dataclass(frozen=True, kw_only=True)
class Recording:
    """The channels of one or more logs that `identify` needs, each on its own clock.

    `sha256` maps every log path to the digest of its bytes.
    """

    wrench: WrenchSignal
    pose: PoseSignal
    command: PoseSignal | None
    sha256: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sha256", MappingProxyType(dict(self.sha256)))
