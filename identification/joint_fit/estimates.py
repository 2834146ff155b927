"""Estimates with verdicts from the joint fit of one axis."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from problems.arrays import FloatArray

from ..result import (
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    RobotEstimate,
    SecondModeEstimate,
    Status,
)
from ..robot.position_loop import find_bandwidth_hz
from ..verdicts import (
    IDENTIFIED_SHARE,
    TWO_SIDED,
    WEAK_SHARE,
    judged,
    judged_damping,
    unidentifiable,
    vector,
    weak_at_best,
)
from .model import COUPLING_NAMES, SURFACE_NAMES, robot_model
from .result import JointFit, JointSurface

# Sizes below which a value does not matter: a tenth of the critical damping, a tenth of the payload.
DAMPING_FLOOR = 0.1
MASS_FLOOR = 0.1
_DELAY_SAMPLES = 0.2
LOOSEST_DELAY = 0.6
# Of a second mode and of friction no controller is made: what shows half of them is worth reporting.
_LOOSEST, _RATIO_FLOOR = 0.5, 0.03
SYMBOLS = {
    **dict(zip(COUPLING_NAMES, ("K_s", "B_s", "B_p", "M_p"), strict=True)),
    "robot_frequency_rad_per_s": "omega",
    "robot_damping_ratio": "zeta",
    "delay_s": "T_d",
}
_SURFACE_SYMBOLS = ("K_e", "B_e", "M_e")


NO_COMMAND = "no commanded pose took part"
UNEXPLAINED = "nothing explains what the fit leaves of the force, {left:.1f} times its noise"
COARSE_COMMAND = "the log does not show that each command was held until the next one, so the command took no part"


@dataclass(frozen=True, kw_only=True)
class JointEstimates:
    """What the joint fit of axis `name` shows, parameter by parameter; `period_s` judges the delay.

    `without_command` says why no command took part, where none did, `delay_note` what the log leaves open of the delay;
    behind a command that `is_smooth` between its samples the period is none of the controller.
    """

    name: str
    fit: JointFit
    period_s: float
    without_command: str = NO_COMMAND
    delay_note: str = ""
    is_smooth: bool = False

    @cached_property
    def method(self) -> str:
        """Return how the numbers came about."""
        free, contacts = self.fit.quality.free_spans, self.fit.quality.contacts
        of = f"free motion ({free})" + (f" and contacts ({contacts})" if contacts else "")
        return f"maximum likelihood of pose and force in {of}"

    @property
    def coupling(self) -> CouplingEstimate:
        """Return K_s and B_s."""
        return CouplingEstimate(
            stiffness_n_per_m=self._explained(self._judged("stiffness_n_per_m")),
            damping_n_s_per_m=self._explained(self._judged_damping("damping_n_s_per_m", "stiffness_n_per_m")),
        )

    @property
    def drag_n_s_per_m(self) -> Estimate:
        """Return B_p."""
        return self._explained(self._judged_damping("drag_n_s_per_m", "stiffness_n_per_m"))

    @property
    def mass_kg(self) -> Estimate:
        """Return M_p."""
        return self._judged("mass_kg")

    @property
    def robot(self) -> RobotEstimate | None:
        """Return r(s) and T_d, None where no command took part."""
        names = self.fit.names
        if self.fit.robot is None:
            return None
        mine = slice(len(COUPLING_NAMES), names.index("delay_s") + 1)
        values, covariance = self.fit.values[mine], self.fit.covariance[mine, mine]
        # Half a control period that is not known leaves a delay open that the log shows well.
        weak = LOOSEST_DELAY if self.delay_note else WEAK_SHARE
        period_s = 0.0 if self.is_smooth else self.period_s
        return describe_robot(values, covariance, period_s, self.method, note=self.delay_note, weak_delay=weak)

    @property
    def second_mode(self) -> SecondModeEstimate | None:
        """Return the part that swings on the payload, None where the log does not show one."""
        part = self.fit.part
        if part is None:
            return None
        return SecondModeEstimate(
            mass_share=judged(*part.mass_share, method=self.method, weak=_LOOSEST),
            frequency_hz=judged(*part.frequency_hz, method=self.method, weak=_LOOSEST),
            damping_ratio=judged(*part.damping_ratio, method=self.method, weak=_LOOSEST, floor=_RATIO_FLOOR),
        )

    @property
    def coupling_friction_n(self) -> Estimate | None:
        """Return the dry friction in the coupling, None where the log does not show it."""
        if self.fit.friction_n is None:
            return None
        return judged(*self.fit.friction_n, method=self.method, weak=_LOOSEST)

    @property
    def environments(self) -> tuple[EnvironmentEstimate, ...]:
        """Return the surfaces, softest first on each side.

        What is known of them is weak at best where no command took part: the payload's path then rests on a pose that
        is smooth between the ticks by assumption. K_e alone has no value where K_s has none.
        """
        return tuple(self._environment(i, surface) for i, surface in enumerate(self.fit.surfaces))

    def surface_name(self, index: int) -> str:
        """Return how a surface is called, x1 for the first one on axis x."""
        return f"{self.name}{index + 1}"

    def _environment(self, index: int, surface: JointSurface) -> EnvironmentEstimate:
        prefix = f"environment{index + 1}_"
        stiffness = self._judged(f"{prefix}stiffness_n_per_m")
        secant = judged(
            surface.secant_n_per_m, surface.secant_std_n_per_m, method="K_s and K_e in series, out of the same fit"
        )
        mass_kg, _ = self.fit.value("mass_kg")
        damping = self._judged_damping(f"{prefix}damping_n_s_per_m", f"{prefix}stiffness_n_per_m")
        mass = self._judged(f"{prefix}mass_kg", floor=MASS_FLOOR * mass_kg)
        stiffness, secant, damping, mass = (
            self._explained(each, max(self.fit.unexplained)) for each in (stiffness, secant, damping, mass)
        )
        if self.fit.robot is None:
            stiffness, secant, damping, mass = (
                weak_at_best(each, self.without_command) for each in (stiffness, secant, damping, mass)
            )
        if self.coupling.stiffness_n_per_m.status is Status.UNIDENTIFIABLE:
            why = "K_s is not identified, and contacts show only K_s and K_e in series"
            stiffness = unidentifiable(method=self.method, note=why)
        return EnvironmentEstimate(
            name=self.surface_name(index),
            stiffness_n_per_m=stiffness,
            secant_stiffness_n_per_m=secant,
            damping_n_s_per_m=damping,
            mass_kg=mass,
            contacts=len(surface.onsets),
            peak_force_n=surface.peak_force_n,
        )

    @property
    def covariance(self) -> Covariance:
        """Return the covariance under short names."""
        names = [SYMBOLS.get(name, name) for name in self.fit.names]
        for index, surface in enumerate(self.fit.surfaces):
            for k in range(len(SURFACE_NAMES)):
                names[surface.first_parameter + k] = f"{self.surface_name(index)}.{_SURFACE_SYMBOLS[k]}"
        return Covariance(
            names=tuple(names),
            values=tuple(float(v) for v in self.fit.values),
            matrix=tuple(tuple(float(v) for v in row) for row in 0.5 * (self.fit.covariance + self.fit.covariance.T)),
        )

    def _explained(self, estimate: Estimate, left: float | None = None) -> Estimate:
        """Return the estimate, `weak` at best where free motion leaves, or contacts do, what nothing explains."""
        left = self.fit.unexplained[0] if left is None else left
        return weak_at_best(estimate, UNEXPLAINED.format(left=left)) if left > 0.0 else estimate

    def _judged(self, name: str, *, floor: float = 0.0) -> Estimate:
        value, std = self.fit.value(name)
        interval = self._interval(name)
        if interval is not None:
            # Whoever reads the deviation must not come to less, or more, than the interval admits.
            low, high = value - TWO_SIDED * std, value + TWO_SIDED * std
            interval = (max(min(interval[0], low), 0.0), max(interval[1], high))
        return judged(value, std, method=self.method, floor=floor, ci95=interval)

    def _judged_damping(self, name: str, stiffness: str) -> Estimate:
        value, std = self.fit.value(name)
        critical = 2.0 * float(np.sqrt(self.fit.value(stiffness)[0] * self.fit.value("mass_kg")[0]))
        return judged_damping(value, std, DAMPING_FLOOR * critical, method=self.method, ci95=self._interval(name))

    def _interval(self, name: str) -> tuple[float, float] | None:
        interval = self.fit.ci95.get(name)
        return interval if interval is not None and bool(np.all(np.isfinite(interval))) else None


def describe_robot(
    values: FloatArray,
    covariance: FloatArray,
    period_s: float,
    method: str,
    *,
    note: str = "",
    weak_delay: float = WEAK_SHARE,
) -> RobotEstimate:
    """Return r(s) and T_d of ω, (ζ,) T_d (p,) with their covariance (p, p), with verdicts; `note` is the delay's."""
    model, (here, std) = robot_model(values), _poles(values, covariance)
    delay_std = float(np.sqrt(covariance[-1, -1]))
    return RobotEstimate(
        numerator=vector(model.numerator, std[-2:-1], method=method),
        denominator=vector(model.denominator, std[:-1], method=method),
        # A delay matters beside the period: to a fifth of a sample it is identified, however short it is.
        delay_s=judged(
            model.delay_s,
            delay_std,
            method=method,
            note=note,
            identified=np.inf if delay_std < _DELAY_SAMPLES * period_s else IDENTIFIED_SHARE,
            weak=weak_delay,
        ),
        bandwidth_hz=judged(float(here[-1]), float(std[-1]), method=method),
    )


def robot_bandwidth(values: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the bandwidth [Hz] of ω, (ζ,) T_d with its deviation, whatever the verdict on it."""
    here, std = _poles(values, covariance)
    return float(here[-1]), float(std[-1])


def _poles(values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the denominator's coefficients and the bandwidth [Hz], and their deviations."""
    delay_s = float(values[-1])

    def described(parameters: FloatArray) -> FloatArray:
        moved = robot_model(np.append(parameters, delay_s))
        return np.append(moved.denominator, find_bandwidth_hz(moved))

    poles = values[:-1]
    here = described(poles)
    steps = 1e-6 * poles
    gradients = np.array([(described(poles + step) - here) / step.sum() for step in np.diag(steps)]).T
    return here, np.sqrt(np.maximum(np.diag(gradients @ covariance[:-1, :-1] @ gradients.T), 0.0))
