"""Frequency responses as a log shows them without any model: values with the circles that hold the truth to 95 %."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.errors import ParameterError
from problems.frozen import Rule

_DEVIATIONS_95 = float(np.sqrt(np.log(20.0)))


@dataclass(frozen=True, kw_only=True)
class MeasuredResponse:
    """One frequency response out of `records` stretches of motion.

    `points` are rows of frequency [Hz], ascending, real part, imaginary part, `radius_95`, that of the circle around
    the value which holds the response with a probability of 95 %, and `noise_radius_95`, what noise alone would leave
    of it, as the scatter within each stretch shows it. The former is wider where several stretches differ by more: of
    what is not linear, another amplitude or course has another best linear approximation.
    """

    points: Annotated[tuple[tuple[float, float, float, float, float], ...], Rule(minItems=1)]
    records: Annotated[int, Rule(minimum=1)] = 1

    def __post_init__(self) -> None:
        if not self.points:
            raise ParameterError("points", "none", "one row or more")
        for before, after in pairwise([0.0, *(point[0] for point in self.points)]):
            if after <= before:
                must = "rows of ascending frequencies above 0; write the file anew with identify"
                raise ParameterError("points", f"{after:g} Hz after {before:g} Hz", must)
        if any(radius < noise or noise < 0.0 for *_, radius, noise in self.points):
            raise ParameterError(
                "points", "a radius below that of noise alone", "rows with a radius no smaller than that"
            )

    @property
    def frequency_hz(self) -> FloatArray:
        """Frequencies (k,) [Hz]."""
        return self._column(0)

    @property
    def values(self) -> ComplexArray:
        """The response (k,)."""
        return np.asarray(self._column(1) + 1j * self._column(2))

    @property
    def radius_95(self) -> FloatArray:
        """Radius (k,) of the 95 % circles."""
        return self._column(3)

    @property
    def noise_radius_95(self) -> FloatArray:
        """What noise alone would leave (k,) of the radius."""
        return self._column(4)

    def _column(self, index: int) -> FloatArray:
        return np.array([point[index] for point in self.points])

    def times(self, factor: ComplexArray | float) -> "MeasuredResponse":
        """Return the response times a known one (k,), or in another unit."""
        size = np.abs(factor)
        radii = size * self.radius_95, size * self.noise_radius_95
        return measured_response(self.frequency_hz, np.asarray(factor * self.values), *radii, self.records)


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse:
    """What sweeps and taps of an axis show of its free motion without a model.

    From the position command to the measured pose [1], from the command to the force [N/m, about an axis N·m/rad], and
    from the pose to the force; None where the log does not show one. The hold that turns the command's samples into a
    motion is taken out, `1/(h s) (1 − e^(−h s))`, and so is what makes the wrench late (`sensor.wrench_filter`, or a
    clock): the robot's response to a command is r(s) e^(−s T_d).
    """

    command_to_pose: MeasuredResponse | None = None
    command_to_force: MeasuredResponse | None = None
    pose_to_force: MeasuredResponse | None = None

    def on_time(
        self, *, command_s: float, force_s: float, time_constant_s: float, force_scale: float
    ) -> "FrequencyResponse":
        """Return the responses without what the log adds, and the force in the unit of the axis.

        The command was issued `command_s` after its tick and the force logged `force_s` late [s], behind a low-pass of
        `time_constant_s` [s].
        """

        def corrected(response: MeasuredResponse | None, *, command: bool, force: bool) -> MeasuredResponse | None:
            if response is None:
                return None
            s = 2j * np.pi * response.frequency_hz
            factor = np.exp(s * (command_s * command + force_s * force))
            return response.times(factor * (force_scale * (1.0 + time_constant_s * s) if force else 1.0))

        return FrequencyResponse(
            command_to_pose=corrected(self.command_to_pose, command=True, force=False),
            command_to_force=corrected(self.command_to_force, command=True, force=True),
            pose_to_force=corrected(self.pose_to_force, command=False, force=True),
        )


def measured_response(
    frequency_hz: FloatArray, values: ComplexArray, radius: FloatArray, noise_radius: FloatArray, records: int
) -> MeasuredResponse:
    """Return a response (k,) to six digits, of which the last ones are noise."""
    columns = frequency_hz, values.real, values.imag, radius, noise_radius
    rows = np.column_stack(columns).tolist()
    points = tuple((f, re, im, r, n) for f, re, im, r, n in ([float(f"{x:.6g}") for x in row] for row in rows))
    return MeasuredResponse(points=points, records=records)


def join_responses(responses: Sequence[FrequencyResponse | None]) -> FrequencyResponse | None:
    """Return what several logs show together, None where none shows anything.

    At each frequency of any log the mean, weighted by the circles. Where the logs differ by more than these say, its
    circle is so much wider (Birge 1932).
    """
    known = [each for each in responses if each is not None]
    if not known:
        return None

    def joined(parts: Sequence[MeasuredResponse | None]) -> MeasuredResponse | None:
        return _joined([part for part in parts if part is not None])

    return FrequencyResponse(
        command_to_pose=joined([each.command_to_pose for each in known]),
        command_to_force=joined([each.command_to_force for each in known]),
        pose_to_force=joined([each.pose_to_force for each in known]),
    )


def _joined(responses: Sequence[MeasuredResponse]) -> MeasuredResponse | None:
    if not responses:
        return None
    grid = np.unique(np.concatenate([each.frequency_hz for each in responses]))
    rows = []
    for f in grid:
        at = np.array([point[1:] for each in responses for point in each.points if point[0] == f])
        values, weights = at[:, 0] + 1j * at[:, 1], at[:, 2] ** -2.0
        mean = weights @ values / np.sum(weights)
        # Of a complex normal error the 95 % circle has the radius sqrt(ln 20) deviations.
        squares = _DEVIATIONS_95**2 * float(weights @ np.abs(values - mean) ** 2) / max(len(values) - 1, 1)
        radius = np.sqrt(max(squares, 1.0) / np.sum(weights))
        rows.append((mean, radius, min(np.sum(at[:, 3] ** -2.0) ** -0.5, radius)))
    mean, radius, noise = (np.array(column) for column in zip(*rows, strict=True))
    return measured_response(grid, mean, radius.real, noise.real, sum(each.records for each in responses))
