"""The shared cell seen through a lever: the same loop about an axis, every number of it in rad, N·m and kg·m²."""

from dataclasses import replace
from functools import cache
from pathlib import Path

from autotune.formats.identified import IdentifiedFile, write_identified
from autotune.formats.problem import RotationalSpec
from autotune.tuning.optimize import Optimized, optimize
from identification.result import AxisEstimate, CouplingEstimate, Estimate, Identified
from tests.autotune.tuning.cases import FAST_SPEC, identified_axis, identified_plant

LEVER_M = 0.2
SQUARE = LEVER_M**2


def _scaled(estimate: Estimate) -> Estimate:
    if estimate.value is None:
        return estimate
    std = None if estimate.std is None else estimate.std * SQUARE
    return replace(estimate, value=estimate.value * SQUARE, std=std)


def turned_axis() -> AxisEstimate:
    """Return the axis of `identified_axis` that turns `identified_plant`'s payload at the end of the lever."""
    axis = identified_axis()
    surface = axis.environments[0]
    return replace(
        axis,
        coupling=CouplingEstimate(
            stiffness_n_per_m=_scaled(axis.coupling.stiffness_n_per_m),
            damping_n_s_per_m=_scaled(axis.coupling.damping_n_s_per_m),
        ),
        drag_n_s_per_m=_scaled(axis.drag_n_s_per_m),
        environments=(
            replace(
                surface,
                name="ry1",
                stiffness_n_per_m=_scaled(surface.stiffness_n_per_m),
                secant_stiffness_n_per_m=_scaled(surface.secant_stiffness_n_per_m),
                damping_n_s_per_m=_scaled(surface.damping_n_s_per_m),
            ),
        ),
        mass_kg=_scaled(identified_plant().payload.mass_kg),
    )


def two_axes() -> Identified:
    """Return the plant with x, and ry which is x through the lever."""
    return replace(identified_plant(), axes={"x": identified_axis(), "ry": turned_axis()})


FAST_TURNING_SPEC = replace(
    FAST_SPEC,
    rotational=RotationalSpec(
        environment_stiffness=(1e5 * SQUARE, 1.2e5 * SQUARE), payload_mass=(16.0 * SQUARE, 16.0 * SQUARE)
    ),
)


def write_two_axes(path: Path) -> None:
    write_identified(path, two_axes(), {"tool": "by hand"})


@cache
def both_optimized() -> Optimized:
    """Both axes of the small problem, taken to a validated controller in one call."""
    plant = IdentifiedFile(result=two_axes(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    return optimize(plant, FAST_TURNING_SPEC, seed=1)
