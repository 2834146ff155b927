"""How well a fit explains a log: in free motion, in contact, and of contacts that took no part in it."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from problems.frozen import Rule

_NOT_NEGATIVE, _SHARE, _EXPLAINED = Rule(minimum=0), Rule(minimum=0, maximum=1), Rule(maximum=1)


@dataclass(frozen=True, kw_only=True)
class FitQuality:
    """How well one log is explained, in free motion and in contact.

    `explained_*`: share of the force's variance; `whiteness_*`: probability of a residual at least as coloured if the
    whitened one were white (Ljung-Box); `noise_ratio_*`: residual RMS over the force's noise at rest; `left_out_*`:
    residual over force of a span that is predicted by all others, None where there is no other; `widening`: the largest
    factor by which deviations were widened for what the model leaves out; `wrench_lag_s`: how late the wrench is
    stamped against pose and command. Without contacts those entries are None.
    """

    free_spans: Annotated[int, _NOT_NEGATIVE]
    explained_free: Annotated[float, _EXPLAINED]
    whiteness_free: Annotated[float, _SHARE]
    noise_ratio_free: Annotated[float, _NOT_NEGATIVE]
    left_out_free: Annotated[float | None, _NOT_NEGATIVE]
    contacts: Annotated[int, _NOT_NEGATIVE]
    explained_contact: Annotated[float | None, _EXPLAINED]
    whiteness_contact: Annotated[float | None, _SHARE]
    noise_ratio_contact: Annotated[float | None, _NOT_NEGATIVE]
    left_out_contact: Annotated[float | None, _NOT_NEGATIVE]
    widening: Annotated[float, _NOT_NEGATIVE]
    wrench_lag_s: float
    wrench_lag_std_s: Annotated[float, _NOT_NEGATIVE]


@dataclass(frozen=True, kw_only=True)
class HeldOutPeak:
    """The peak of a contact beside what everything but this contact, or but its whole log, predicts.

    `without` is `contact` (predicted from the command as it was recorded, the other contacts of the log saying what
    plant and surface are) or `log` (predicted from gains and approach). `time_s` counts from the start of the log;
    peaks are those of the sensor, in N or N·m.
    """

    without: Literal["contact", "log"]
    surface: str
    time_s: float
    measured_peak: Annotated[float, Rule(exclusiveMinimum=0)]
    predicted_peak: Annotated[float, Rule(exclusiveMinimum=0)]
    log: str = ""

    @property
    def log_ratio(self) -> float:
        """ln(predicted/measured), which is the relative error where that is small."""
        return math.log(self.predicted_peak / self.measured_peak)
