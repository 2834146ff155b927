"""What identification found beside what is true, parameter by parameter."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from autotune.formats.units import AXES
from benchmarks.cell_logs import TURN
from benchmarks.cells import DrawnCell
from identification.result import AxisEstimate, EnvironmentEstimate, Estimate, Identified
from problems.model.plant import Environment
from problems.model.robot import RobotModel


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One parameter of one cell; `value` and `std` are None where the log does not show it.

    `size` is what errors are counted in: the truth for shares, 1 mm for a centre of mass, a period for a delay.
    """

    seed: int
    name: str
    truth: float
    size: float
    status: str
    value: float | None = None
    std: float | None = None
    ci95: tuple[float, float] | None = None

    @property
    def error(self) -> float | None:
        """(value − truth)/size."""
        return None if self.value is None else (self.value - self.truth) / self.size

    @property
    def deviations(self) -> float | None:
        """|value − truth|/std."""
        if self.value is None or self.std is None:
            return None
        return abs(self.value - self.truth) / max(self.std, 1e-300)

    @property
    def is_covered(self) -> bool | None:
        """Whether the stated 95 % interval holds the truth."""
        if self.value is None or self.std is None:
            return None
        low, high = (self.value - 1.96 * self.std, self.value + 1.96 * self.std) if self.ci95 is None else self.ci95
        return bool(low <= self.truth <= high)


def bandwidth_hz(robot: RobotModel) -> float:
    """Return where |r| falls to 1/√2, in closed form for one pole and for two without a zero."""
    if robot.order == 1:
        return float(robot.denominator[1]) / (2.0 * np.pi)
    square = float(robot.denominator[2])
    middle = 0.5 * float(robot.denominator[1]) ** 2 - square
    return float(np.sqrt(np.hypot(middle, square) - middle)) / (2.0 * np.pi)


def compare(drawn: DrawnCell, found: Identified) -> tuple[Outcome, ...]:
    """Put all that was found beside the truth; surfaces are paired by their stiffness."""
    cell = drawn.cell
    outcomes = [_outcome(drawn, "mass", cell.payload_mass_kg, found.payload.mass_kg)]
    com_S = TURN.inv().apply(cell.com_S_m) if drawn.writing.turned_sensor else np.array(cell.com_S_m)
    com = found.payload.com_m
    for i, true in enumerate(com_S.tolist()):
        value = None if com.value is None else com.value[i]
        std = None if com.std is None else com.std[i]
        outcomes.append(
            Outcome(
                seed=drawn.seed,
                name="centre of mass",
                truth=true,
                size=1e-3,
                status=com.status.value,
                value=value,
                std=std,
            )
        )
    axis = found.axes.get(approach_axis(drawn))
    return (*outcomes, *_axis_outcomes(drawn, axis))


def approach_axis(drawn: DrawnCell) -> str:
    """Return the axis of the logged sensor frame along which the cell moves."""
    if not drawn.writing.turned_sensor:
        return drawn.cell.approach_axis
    return AXES[int(np.argmax(np.abs(TURN.inv().apply(np.eye(3)[drawn.cell.axis_index]))))]


def _axis_outcomes(drawn: DrawnCell, axis: AxisEstimate | None) -> Iterator[Outcome]:
    cell = drawn.cell
    mass_from_motion: Estimate | None = getattr(axis, "mass_kg", None)
    rows = (
        ("mass from motion", cell.payload_mass_kg, mass_from_motion),
        ("K_s", cell.coupling.stiffness_n_per_m, None if axis is None else axis.coupling.stiffness_n_per_m),
        ("B_s", cell.coupling.damping_n_s_per_m, None if axis is None else axis.coupling.damping_n_s_per_m),
        ("B_p", cell.drag_n_s_per_m, None if axis is None else axis.drag_n_s_per_m),
        ("bandwidth", bandwidth_hz(cell.robot), None if axis is None else axis.robot.bandwidth_hz),
    )
    for name, truth, estimate in rows:
        yield _outcome(drawn, name, truth, estimate)
    delay = None if axis is None else axis.robot.delay_s
    yield _outcome(drawn, "delay", cell.robot.delay_s, delay, size=cell.sample_time_s)
    yield from surface_outcomes(drawn, () if axis is None else axis.environments)


def surface_outcomes(drawn: DrawnCell, found: Sequence[EnvironmentEstimate]) -> Iterator[Outcome]:
    """Pair surfaces by their secants, as a whole; what is found beyond the true ones is an outcome of its own."""
    coupling = drawn.cell.coupling.stiffness_n_per_m
    valued = [e for e in found if e.secant_stiffness_n_per_m.value is not None]
    secants = [_series(coupling, surface.stiffness_n_per_m) for surface in drawn.surfaces]
    apart = np.array(
        [[abs(np.log(float(e.secant_stiffness_n_per_m.value or np.nan) / s)) for e in valued] for s in secants]
    ).reshape(len(secants), len(valued))
    pairs = {int(i): int(j) for i, j in zip(*linear_sum_assignment(apart), strict=True)} if valued else {}
    for i, surface in enumerate(drawn.surfaces):
        yield from _one_surface(drawn, surface, secants[i], valued[pairs[i]] if i in pairs else None)
    taken = set(pairs.values())
    for j, extra in enumerate(valued):
        if j not in taken and extra.stiffness_n_per_m.value is not None:
            # A surface that is not there: nothing true stands beside it.
            yield Outcome(
                seed=drawn.seed,
                name="surfaces beside the true ones",
                truth=0.0,
                size=1.0,
                status=extra.stiffness_n_per_m.status.value,
            )


def _one_surface(
    drawn: DrawnCell, surface: Environment, secant: float, found: EnvironmentEstimate | None
) -> Iterator[Outcome]:
    rows = (
        ("K_e", surface.stiffness_n_per_m, None if found is None else found.stiffness_n_per_m),
        ("secant", secant, None if found is None else found.secant_stiffness_n_per_m),
        ("B_e", surface.damping_n_s_per_m, None if found is None else found.damping_n_s_per_m),
    )
    for name, truth, estimate in rows:
        yield _outcome(drawn, name, truth, estimate)
    yield _outcome(drawn, "M_e", surface.mass_kg, None if found is None else found.mass_kg, size=1.0)


def _series(a: float, b: float) -> float:
    return a * b / (a + b)


def _outcome(
    drawn: DrawnCell, name: str, truth: float, estimate: Estimate | None, *, size: float | None = None
) -> Outcome:
    return Outcome(
        seed=drawn.seed,
        name=name,
        truth=truth,
        size=truth if size is None else size,
        status="unidentifiable" if estimate is None else estimate.status.value,
        value=None if estimate is None else estimate.value,
        std=None if estimate is None else estimate.std,
        ci95=None if estimate is None else estimate.ci95,
    )
