"""The loop's distance to instability on the measured frequency response of free motion: no model takes part."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from autotune.formats.controller_record import Controller, admittance_controller
from identification.measured_response import FrequencyResponse
from identification.result import Identified, WrenchFilterEstimate
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.response import PlantResponse, controller_response, loop_at

from .report import Check

# What the certificate's modulus may be missed by: its grid of frequencies, as among the other checks.
_MISSED = 1e-3


@dataclass(frozen=True, kw_only=True)
class MeasuredModulus:
    """The smallest |1 + L| of free motion as it was measured, at `frequency_hz`, and the 95 % interval of that value.

    It is that of both break points, `at` force or command, over the `count` frequencies of `band_hz` that were
    measured; `certified` is the certificate's, of every plant of the domain.
    """

    axis: str
    modulus: float
    interval_95: tuple[float, float]
    frequency_hz: float
    at: Literal["force", "command"]
    band_hz: tuple[float, float]
    count: int
    certified: float

    @property
    def is_refuted(self) -> bool:
        """Whether the measurement shows that the certificate's modulus is not kept."""
        return self.interval_95[1] < (1.0 - _MISSED) * self.certified

    def check(self) -> Check:
        """Return the check: what was measured beside what is certified."""
        low, high = self.interval_95
        text = (
            f"smallest |1 + L| on the measured response of free motion {self.modulus:.4f} ({low:.4f} to {high:.4f}) at "
            f"{self.frequency_hz:.3g} Hz, of {self.count} frequencies from {self.band_hz[0]:.2g} to "
            f"{self.band_hz[1]:.3g} Hz, between which nothing was measured; certified {self.certified:.4f}, of every "
            "plant and contact"
        )
        if self.is_refuted:
            text += ": this cell is none of the certified plants"
        elif low < self.certified:
            text += "; the measurement leaves open whether it is kept"
        is_open = not self.is_refuted and low < self.certified
        return Check(axis=self.axis, name="measured modulus", passed=not self.is_refuted, message=text, warns=is_open)


def measured_moduli(controller: Controller, identified: Identified) -> tuple[MeasuredModulus, ...]:
    """Return the smallest modulus of every axis of a controller whose frequency responses were measured.

    The measured responses hold neither the hold of the command nor what makes the wrench late: the former is that of
    the controller's period, the latter as identified.
    """
    found = []
    for name, margins in controller.certificate.margins.items():
        axis = identified.axes.get(name)
        if axis is None or axis.frequency_response is None:
            continue
        wrench = wrench_filter_of(identified.sensor.wrench_filter)
        law, h = admittance_controller(controller, name), controller.sample_time_s
        loop = _loop_moduli(axis.frequency_response, wrench, law, h)
        if loop is None:
            continue
        frequency, moduli, radii = loop
        place, point = np.unravel_index(int(np.argmin(moduli)), moduli.shape)
        modulus, radius = float(moduli[place, point]), float(radii[place, point])
        found.append(
            MeasuredModulus(
                axis=name,
                modulus=modulus,
                interval_95=(max(modulus - radius, 0.0), modulus + radius),
                frequency_hz=float(frequency[point]),
                at="force" if place == 0 else "command",
                band_hz=(float(frequency[0]), float(frequency[-1])),
                count=len(frequency),
                certified=margins.modulus,
            )
        )
    return tuple(found)


def measured_checks(controller: Controller, identified: Identified) -> tuple[tuple[Check, ...], dict[str, Any]]:
    """Return a check of every axis with a measured response, and the same as plain data by axis."""
    found = measured_moduli(controller, identified)
    return tuple(each.check() for each in found), {each.axis: {**vars(each)} for each in found}


def wrench_filter_of(estimate: WrenchFilterEstimate | None) -> WrenchFilter:
    """Return the filter of the wrench that was identified; none where nothing is known of it."""
    if estimate is not None and estimate.corner_hz is not None and estimate.corner_hz.value is not None:
        return WrenchFilter.from_corner(estimate.corner_hz.value)
    if estimate is not None and estimate.delay_s is not None and estimate.delay_s.value is not None:
        return WrenchFilter(delay_s=estimate.delay_s.value)
    return NO_FILTER


def _loop_moduli(
    response: FrequencyResponse, wrench: WrenchFilter, law: AdmittanceController, h: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return frequencies (k,), |1 + L| and |1 + L_x| (2, k) and the radii (2, k) of their 95 % circles.

    With A the controller from force to command, C that from position, F and X the responses to the command:
    L = −F A/(1 + C X), so that |δL| ≤ |L| (|δF|/|F| + |C δX|/|1 + C X|); L_x = C X − F A, so |δL_x| ≤ |C δX| + |A δF|.
    None where command → force was not measured below the Nyquist frequency.
    """
    force, pose = response.command_to_force, response.command_to_pose
    if force is None or pose is None:
        return None
    below = 0.5 / h
    frequency = np.intersect1d(force.frequency_hz, pose.frequency_hz)
    frequency = frequency[frequency < below]
    if not frequency.size:
        return None
    of_force, of_pose = (np.isin(each.frequency_hz, frequency) for each in (force, pose))
    omega = 2.0 * np.pi * frequency
    z = np.exp(1j * omega * h)
    hold = -np.expm1(-1j * omega * h) / (1j * omega * h)
    felt = hold * wrench.response(omega)
    f, x = force.values[of_force] * felt, pose.values[of_pose] * hold
    f_radius, x_radius = force.radius_95[of_force] * np.abs(felt), pose.radius_95[of_pose] * np.abs(hold)
    loop = loop_at(PlantResponse(frequency_rad_per_s=omega, z=z, force=f, position=x), law, h)
    forward, feedback = controller_response(law, z, h)
    damped = np.abs(1.0 + feedback * x)
    by_pose = np.abs(feedback) * x_radius
    radii = np.array(
        [
            np.abs(loop.at_force) * (f_radius / np.abs(f) + by_pose / damped),
            by_pose + np.abs(forward) * f_radius,
        ]
    )
    return frequency, np.abs(1.0 + np.array([loop.at_force, loop.at_command])), radii
