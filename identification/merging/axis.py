"""Merged estimate of one axis out of several logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..joint_fit.estimates import DAMPING_FLOOR, MASS_FLOOR, describe_robot, robot_bandwidth
from ..measured_response import join_responses
from ..result import (
    AxisEstimate,
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    RobotEstimate,
    SecondModeEstimate,
)
from ..verdicts import judged, judged_damping
from .values import ORDER, Merge, Normal, is_beyond_chance, is_stated, merge_normals, with_priors, with_verdict

Judge = Callable[[float, float], Estimate]

_ROBOT = ("omega", "zeta", "T_d")
_PLANT = ("K_s", "B_s", "B_p", "M_p", *_ROBOT)
_SURFACE = ("K_e", "B_e", "M_e")
_LABELS = {
    "K_s": "coupling stiffness K_s",
    "B_s": "coupling damping B_s",
    "B_p": "payload drag B_p",
    "M_p": "payload mass from motion",
    "omega": "robot's natural frequency [rad/s]",
    "zeta": "robot's damping ratio",
    "T_d": "delay T_d [s]",
    "K_e": "stiffness K_e",
    "B_e": "damping B_e",
    "M_e": "mass M_e",
}
_BANDWIDTH = "robot bandwidth [Hz]"


@dataclass(frozen=True, kw_only=True)
class AxisRecord:
    """What logs show of the axis `name` together: `normal` holds it all, `axes` (None where a log lacks it) the rest.

    `scattering` names what scatters beyond its deviations; `robot_axes` have a robot of the order in `normal`.
    """

    name: str
    period_s: float
    normal: Normal
    merge: Merge
    axes: tuple[AxisEstimate | None, ...]
    robot_axes: tuple[AxisEstimate, ...]
    scattering: frozenset[str] = frozenset()

    def with_priors(self, priors: Mapping[str, tuple[float, float]]) -> "AxisRecord":
        """Return the record with what is known from elsewhere, once, value and deviation by symbol."""
        normal = with_priors(self.normal, priors)
        return replace(self, normal=normal.select(_in_order(normal.names)), scattering=self.scattering - set(priors))

    def estimate(self) -> AxisEstimate:
        """Return values, verdicts and covariance, all of them out of the one record."""
        coupling = CouplingEstimate(
            stiffness_n_per_m=self._one("K_s", judged_plainly), damping_n_s_per_m=self._one("B_s", self._damping("K_s"))
        )
        there = self._there
        return AxisEstimate(
            coupling=coupling,
            drag_n_s_per_m=self._one("B_p", self._damping("K_s")),
            environments=self._environments(),
            robot=self._robot(),
            mass_kg=None if all(axis.mass_kg is None for axis in there) else self._one("M_p", judged_plainly),
            covariance=self._covariance() if any(axis.covariance is not None for axis in there) else None,
            fits=tuple(fit for axis in there for fit in axis.fits),
            held_out=tuple(
                replace(each, log=log)
                for log, axis in zip(self.merge.names, self.axes, strict=True)
                if axis is not None
                for each in axis.held_out
            ),
            frequency_response=join_responses([axis.frequency_response for axis in there]),
            second_mode=_sharpest_mode(there),
            coupling_friction_n=_sharpest([axis.coupling_friction_n for axis in there]),
        )

    @property
    def _there(self) -> tuple[AxisEstimate, ...]:
        return tuple(axis for axis in self.axes if axis is not None)

    def _one(self, symbol: str, judge: Judge) -> Estimate:
        logs = [e for axis in self._there if (e := estimate_of(axis, symbol)) is not None]
        if symbol not in self.normal.names:
            return min(logs, key=lambda e: e.ci95 is None)
        value, std = self.normal.at(symbol)
        fresh = replace(judge(value, std), method=logs[0].method if logs else "")
        return with_verdict(fresh, value, std, logs, scatters=symbol in self.scattering)

    def _damping(self, spring: str) -> Judge:
        """Return the verdict on a damping beside the critical one of a spring under the payload."""
        floor = 0.0
        if spring in self.normal.names and "M_p" in self.normal.names:
            critical = 2.0 * np.sqrt(max(self.normal.at(spring)[0] * self.normal.at("M_p")[0], 0.0))
            floor = DAMPING_FLOOR * float(critical)
        return lambda value, std: judged_damping(value, std, floor, method="")

    def _robot(self) -> RobotEstimate:
        names = [name for name in _ROBOT if name in self.normal.names]
        best = min(self.robot_axes, key=_delay_std).robot if self.robot_axes else self._there[0].robot
        if not {"omega", "T_d"} <= set(names):
            bandwidths = [None if axis is None else axis.robot.bandwidth_hz for axis in self.axes]
            return replace(
                best,
                delay_s=self._one("T_d", judged_plainly),
                bandwidth_hz=self.merge.scalars(f"{_BANDWIDTH} of axis {self.name}", bandwidths),
            )
        part = self.normal.select(names)
        fresh = describe_robot(part.values, part.matrix, self.period_s, best.delay_s.method)
        scatters = bool(self.scattering & {"omega", "zeta"})
        bandwidth, std = robot_bandwidth(part.values, part.matrix)
        statuses = [axis.robot.denominator.status for axis in self.robot_axes]
        status = min(statuses, key=ORDER.index, default=fresh.denominator.status)
        return RobotEstimate(
            numerator=replace(fresh.numerator, status=status),
            denominator=replace(fresh.denominator, status=status),
            delay_s=with_verdict(
                fresh.delay_s,
                *self.normal.at("T_d"),
                [axis.robot.delay_s for axis in self.robot_axes],
                scatters="T_d" in self.scattering,
            ),
            bandwidth_hz=with_verdict(
                fresh.bandwidth_hz,
                bandwidth,
                std,
                [axis.robot.bandwidth_hz for axis in self.robot_axes],
                scatters=scatters,
            ),
        )

    def _environments(self) -> tuple[EnvironmentEstimate, ...]:
        found = [surface for axis in self._there for surface in axis.environments]
        return tuple(self._surface(name, [s for s in found if s.name == name]) for name in surface_names(self._there))

    def _surface(self, name: str, logs: Sequence[EnvironmentEstimate]) -> EnvironmentEstimate:
        mass = self.normal.at("M_p")[0] if "M_p" in self.normal.names else 0.0
        return EnvironmentEstimate(
            name=name,
            stiffness_n_per_m=self._one(f"{name}.K_e", judged_plainly),
            secant_stiffness_n_per_m=self._secant(name, logs),
            damping_n_s_per_m=self._one(f"{name}.B_e", self._damping(f"{name}.K_e")),
            mass_kg=self._one(f"{name}.M_e", lambda v, std: judged(v, std, method="", floor=MASS_FLOOR * mass)),
            contacts=sum(surface.contacts for surface in logs),
            peak_force_n=tuple(peak for surface in logs for peak in surface.peak_force_n),
            relaxed_stiffness_n_per_m=self._shown(name, "relaxed stiffness", lambda s: s.relaxed_stiffness_n_per_m),
            impact_n_s_per_m=self._shown(name, "first blow", lambda s: s.impact_n_s_per_m),
            contact_spread=max((s.contact_spread for s in logs if s.contact_spread is not None), default=None),
        )

    def _shown(self, name: str, what: str, of: Callable[[EnvironmentEstimate], Estimate | None]) -> Estimate | None:
        """Return the mean of what the logs show of a surface beside the record, None where none does."""
        by_log = [
            None if axis is None else next((of(each) for each in axis.environments if each.name == name), None)
            for axis in self.axes
        ]
        known = any(each is not None for each in by_log)
        return self.merge.scalars(f"{what} of surface {name}", by_log, differs_by_contact=True) if known else None

    def _secant(self, name: str, logs: Sequence[EnvironmentEstimate]) -> Estimate:
        """Return K_s and K_e in series out of the record, else the mean of what contact traces show of it."""
        springs = ("K_s", f"{name}.K_e")
        stated = [surface.secant_stiffness_n_per_m for surface in logs]
        if not any(axis.covariance is not None and set(springs) <= set(axis.covariance.names) for axis in self._there):
            by_log = [None if axis is None else _secant_of(axis, name) for axis in self.axes]
            return self.merge.scalars(f"secant stiffness of surface {name}", by_log, differs_by_contact=True)
        part = self.normal.select(springs)
        secant = 1.0 / float(np.sum(1.0 / part.values))
        gradient = (secant / part.values) ** 2
        std = float(np.sqrt(gradient @ part.matrix @ gradient))
        return with_verdict(judged(secant, std, method=stated[0].method), secant, std, stated, scatters=False)

    def _covariance(self) -> Covariance:
        return Covariance(
            names=self.normal.names,
            values=tuple(self.normal.values.tolist()),
            matrix=tuple(tuple(row) for row in (0.5 * (self.normal.matrix + self.normal.matrix.T)).tolist()),
        )


def merge_axis(
    merge: Merge, name: str, axes: Sequence[AxisEstimate | None], *, period_s: float, gain_share: float
) -> AxisRecord:
    """Merge one axis of several logs (None where a log lacks it), in which a surface has one name everywhere.

    Robots of different orders do not compare parameter by parameter: the best known one counts, and is widened where
    the bandwidths disagree. `gain_share` is the share by which the force's scale may be wrong in all logs.
    """
    orders = [None if axis is None else _robot_order(axis) for axis in axes]
    stated = [(axis, order) for axis, order in zip(axes, orders, strict=True) if axis is not None and order is not None]
    chosen = min(stated, key=lambda pair: _delay_std(pair[0]))[1] if stated else None
    parts = [
        None if axis is None else _record(axis, with_robot=order is None or order == chosen)
        for axis, order in zip(axes, orders, strict=True)
    ]
    known = [
        (log, part, axis)
        for log, part, axis in zip(merge.names, parts, axes, strict=True)
        if part is not None and axis is not None and part.names
    ]
    counted = [[symbol for symbol in part.names if _counts(axis, symbol)] for _, part, axis in known]
    merged = merge_normals([part for _, part, _ in known], counted, gain_share=gain_share)
    for symbol, square in merged.square.items():
        if is_beyond_chance(square, merged.freedom[symbol]):
            seen = [
                (log, *part.at(symbol))
                for (log, part, _), symbols in zip(known, counted, strict=True)
                if symbol in symbols
            ]
            logs, values, stds = zip(*seen, strict=True)
            merge.report(_label(name, symbol), logs, values, stds)
    normal = merged.normal
    if len({order for _, order in stated}) > 1:
        normal = normal.added({"omega": _between_orders(merge, name, axes, normal, chosen)})
    return AxisRecord(
        name=name,
        period_s=period_s,
        normal=normal.select(_in_order(normal.names)),
        merge=merge,
        axes=tuple(axes),
        robot_axes=tuple(axis for axis, order in stated if order == chosen),
        scattering=frozenset(name for name, square in merged.square.items() if square > merged.freedom[name]),
    )


def estimate_of(axis: AxisEstimate, symbol: str) -> Estimate | None:
    """Return the estimate of a symbol of `Covariance`; ω and ζ are known where the bandwidth is."""
    name, _, kind = symbol.rpartition(".")
    if not name:
        return {
            "K_s": axis.coupling.stiffness_n_per_m,
            "B_s": axis.coupling.damping_n_s_per_m,
            "B_p": axis.drag_n_s_per_m,
            "M_p": axis.mass_kg,
            "T_d": axis.robot.delay_s,
            "omega": axis.robot.bandwidth_hz,
            "zeta": axis.robot.bandwidth_hz,
        }[kind]
    surface = next((each for each in axis.environments if each.name == name), None)
    if surface is None:
        return None
    return {"K_e": surface.stiffness_n_per_m, "B_e": surface.damping_n_s_per_m, "M_e": surface.mass_kg}[kind]


def surface_names(axes: Sequence[AxisEstimate]) -> tuple[str, ...]:
    """Return the names of all surfaces, x2 before x10."""
    names = {surface.name for axis in axes for surface in axis.environments}
    return tuple(sorted(names, key=lambda name: (len(name), name)))


def judged_plainly(value: float, std: float) -> Estimate:
    """Return the verdict on a number that is known to a share of itself."""
    return judged(value, std, method="")


def _record(axis: AxisEstimate, *, with_robot: bool) -> Normal:
    """Return all that a log shows of an axis: its covariance, and what is independent of it."""
    stated = axis.covariance
    names = () if stated is None else stated.names
    alone = {symbol: found for symbol in _symbols(axis) if symbol not in names and (found := _alone(axis, symbol))}
    values = np.array([*(() if stated is None else stated.values), *(value for value, _ in alone.values())])
    matrix = np.diag([*np.zeros(len(names)), *(std**2 for _, std in alone.values())])
    if stated is not None:
        matrix[: len(names), : len(names)] = stated.matrix
    whole = Normal(names=(*names, *alone), values=values, matrix=matrix)
    return whole.select([name for name in whole.names if with_robot or name not in _ROBOT])


def _symbols(axis: AxisEstimate) -> tuple[str, ...]:
    return (*_PLANT, *(f"{surface.name}.{kind}" for surface in axis.environments for kind in _SURFACE))


def _alone(axis: AxisEstimate, symbol: str) -> tuple[float, float] | None:
    """Return value and deviation of what is in the table only."""
    if symbol in ("omega", "zeta"):
        return _poles(axis).get(symbol)
    estimate = estimate_of(axis, symbol)
    if estimate is None or estimate.value is None or estimate.std is None:
        return None
    return estimate.value, estimate.std


def _poles(axis: AxisEstimate) -> dict[str, tuple[float, float]]:
    """Return ω [rad/s] and ζ with their deviations as the coefficients of r(s) have them."""
    denominator = axis.robot.denominator
    if denominator.value is None or denominator.std is None or _robot_order(axis) not in (1, 2):
        return {}
    first, *rest = denominator.value
    coefficients, stds = np.array(rest) / first, np.array(denominator.std[1:]) / first
    if len(rest) == 1:
        return {"omega": (float(coefficients[0]), float(stds[0]))}
    omega = float(np.sqrt(coefficients[1]))
    omega_std, ratio = float(stds[1]) / (2.0 * omega), float(coefficients[0]) / (2.0 * omega)
    return {
        "omega": (omega, omega_std),
        "zeta": (ratio, float(np.hypot(stds[0] / (2.0 * omega), ratio * omega_std / omega))),
    }


def _robot_order(axis: AxisEstimate) -> int | None:
    """Return how many poles r(s) has, None where it is not identified, 0 where it is of another form."""
    numerator, denominator = axis.robot.numerator.value, axis.robot.denominator.value
    if numerator is None or denominator is None:
        return None
    return len(denominator) - 1 if len(numerator) == 1 and len(denominator) in (2, 3) else 0


def _delay_std(axis: AxisEstimate) -> float:
    std = axis.robot.delay_s.std
    return float("inf") if std is None else std


def _counts(axis: AxisEstimate, symbol: str) -> bool:
    """Whether a log shows a parameter well enough to disagree on it."""
    estimate = estimate_of(axis, symbol)
    return estimate is not None and is_stated(estimate)


def _between_orders(
    merge: Merge, name: str, axes: Sequence[AxisEstimate | None], normal: Normal, order: int | None
) -> float:
    """Return the variance of ω that is added: where the bandwidths disagree, it reaches the farthest of them."""
    before = len(merge.findings)
    bandwidths = [None if axis is None else axis.robot.bandwidth_hz for axis in axes]
    merge.scalars(f"{_BANDWIDTH} of axis {name}", bandwidths)
    names = [symbol for symbol in _ROBOT if symbol in normal.names]
    if len(merge.findings) == before or not order or len(names) <= order:
        return 0.0
    part = normal.select(names)
    value, _ = robot_bandwidth(part.values, part.matrix)
    apart = max(abs(e.value - value) for e in bandwidths if e is not None and e.value is not None)
    return float((apart / value * part.at("omega")[0]) ** 2)


def _secant_of(axis: AxisEstimate, name: str) -> Estimate | None:
    return next((each.secant_stiffness_n_per_m for each in axis.environments if each.name == name), None)


def _in_order(names: Sequence[str]) -> list[str]:
    """Return the names in the order of a single log: plant, robot, then surface by surface."""
    surfaces = sorted(
        (name for name in names if "." in name),
        key=lambda n: (len(n.rpartition(".")[0]), n.rpartition(".")[0], _SURFACE.index(n.rpartition(".")[2])),
    )
    return [*(name for name in _PLANT if name in names), *surfaces]


def _label(axis: str, symbol: str) -> str:
    surface, _, kind = symbol.rpartition(".")
    return f"{_LABELS[kind]} of {f'surface {surface}' if surface else f'axis {axis}'}"


def _sharpest(estimates: Sequence[Estimate | None]) -> Estimate | None:
    """Return the estimate with the least deviation, None where no log has one."""
    known = [each for each in estimates if each is not None]
    return min(known, key=lambda e: np.inf if e.std is None else e.std, default=None)


def _sharpest_mode(axes: Sequence[AxisEstimate]) -> SecondModeEstimate | None:
    """Return the second mode whose frequency is known best."""
    known = {id(mode.frequency_hz): mode for axis in axes if (mode := axis.second_mode) is not None}
    best = _sharpest([mode.frequency_hz for mode in known.values()])
    return None if best is None else known[id(best)]
