"""What a plan promises of a second recording is what merging both recordings then states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.experiment_design.poses import naive_turns, predicted_std
from identification.experiment_design.sweep import Sweep, _std_after
from identification.experiment_design.values import Known, PlanValues, values_of
from identification.merging.combine import NamedResult, combine_identified
from identification.payload.gravity import LOCAL_GRAVITY_STD
from identification.result import Identified
from tests.autotune.formats.samples import make_identified
from tests.identification.merging.test_combine import known as estimate
from tests.identification.merging.test_combine import reported

SWEEP = Sweep(low_hz=1.0, high_hz=35.0, flange_speed_m_s=3e-3, duration_s=8.0)
SWEPT = ("stiffness_n_per_m", "damping_n_s_per_m", "drag_n_s_per_m", "delay_s")


def with_stds(values: PlanValues, stds: dict[str, float | None]) -> PlanValues:
    changed = {name: replace(values.known()[name], std=std) for name, std in stds.items()}
    return replace(values, **changed)  # type: ignore[arg-type]  # every field but the robot is of this kind


def record(values: PlanValues, stds: dict[str, float]) -> Identified:
    """A log that states the values with these deviations."""
    found = reported(
        estimate(values.mass_kg.value, stds["mass_kg"]), delay=estimate(values.delay_s.value, stds["delay_s"])
    )
    axis = found.axes["x"]
    coupling = replace(
        axis.coupling,
        stiffness_n_per_m=estimate(values.stiffness_n_per_m.value, stds["stiffness_n_per_m"]),
        damping_n_s_per_m=estimate(values.damping_n_s_per_m.value, stds["damping_n_s_per_m"]),
    )
    drag = estimate(values.drag_n_s_per_m.value, stds["drag_n_s_per_m"])
    return replace(found, axes={"x": replace(axis, coupling=coupling, drag_n_s_per_m=drag)})


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
def test_a_plan_adds_knowledge_as_the_merging_of_logs_does(ratio: float) -> None:
    """One recording is known, `ratio` times as well as the sweep and the poses tell by themselves."""
    _, values = values_of(reported())
    values = replace(values, pose_force_std_n=Known(value=1.0))
    turns = naive_turns(9, 60.0)
    unclear = with_stds(values, dict.fromkeys((*SWEPT, "mass_kg", "motion_mass_kg", "bandwidth_hz", "com_m")))
    alone = _std_after(unclear, SWEEP) | {"mass_kg": predicted_std(turns, unclear)[0]}
    now = {name: ratio * alone[name] for name in (*SWEPT, "mass_kg")}
    knowing = with_stds(unclear, dict(now))
    planned = _std_after(knowing, SWEEP) | {"mass_kg": predicted_std(turns, knowing)[0]}
    logs = [NamedResult(name=str(i), result=record(values, stds)) for i, stds in enumerate((now, alone))]
    merged = combine_identified(logs)
    axis = merged.axes["x"]
    stated = {
        "stiffness_n_per_m": axis.coupling.stiffness_n_per_m,
        "damping_n_s_per_m": axis.coupling.damping_n_s_per_m,
        "drag_n_s_per_m": axis.drag_n_s_per_m,
        "delay_s": axis.robot.delay_s,
        "mass_kg": merged.payload.mass_kg,
    }
    for name, each in stated.items():
        # The same rule twice: rounding, and the compliances in which springs are merged, to first order.
        assert each.std == pytest.approx(planned[name], rel=1e-3), name
        assert planned[name] < min(now[name], alone[name])


def test_local_gravity_is_in_both_recordings_and_stays() -> None:
    _, values = values_of(make_identified())
    mass = values.mass_kg.value
    shared = LOCAL_GRAVITY_STD * mass
    exact = replace(values, mass_kg=Known(value=mass, std=shared), pose_force_std_n=Known(value=1e-9))
    turns: Rotation = naive_turns(9, 60.0)
    # Nothing but gravity is left in either: twice as many recordings tell the mass no better.
    assert predicted_std(turns, exact)[0] == pytest.approx(shared, rel=0.01)
    assert np.isfinite(predicted_std(turns, exact)[1])
