"""One MuJoCo cell through the whole chain: record, identify, optimize, press; predicted beside measured.

Usage: python examples/mujoco/chain.py [FOLDER]   (needs mujoco: pip install 'robot-autotune[mujoco]')
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import autotune as at
from autotune.recording import FirstLog, Recorder
from autotune.runtime import START, Fault, Payload, load_controller, step
from examples.mujoco.cell import Hand, MujocoCell, Running, Wall

FORCE_N, PRESSED_S, LONGEST_S = 30.0, 1.2, 8.0
# A servo of second order lags more than the robots that the usual 7e-4 m/s/N are meant for.
EASED = at.Problem(requirements=at.Requirements(free_space_admittance=at.AdmittanceTarget(min_m_s_per_n=3e-4)))


FIRST_LOG = FirstLog(axis="z", pose_count=6, sweep_s=10.0)


def record(cell: MujocoCell, wall: Wall, program: FirstLog, path: Path, *, seed: int = 0) -> float:
    """Run the program of a first log on the cell, write what its computer saw, and return the largest contact force."""
    running = Running(cell, wall, seed=seed)
    commands = program.commands(period_s=cell.period_s)
    command, peak = next(commands), 0.0
    with Recorder(path, start_ns=1_700_000_000_000_000_000, period_s=cell.period_s) as log:
        while True:
            seen = running.read()
            peak = max(peak, seen.contact_n)
            log.write(
                running.ticks * cell.period_s,
                wrench=seen.wrench_S,
                pose=(*seen.position_m, *seen.quaternion_xyzw),
                command=running.command_pose(command.displacement_m, command.rotation_rad),
            )
            running.send(command.displacement_m, command.rotation_rad)
            try:
                command = commands.send(seen.wrench_S)
            except StopIteration:
                return peak


@dataclass(frozen=True, kw_only=True)
class Press:
    """One contact under the controller that runs: largest forces [N] at wall and sensor, and why it ended early."""

    contact_n: float
    sensor_n: float
    fault: str


def press(cell: MujocoCell, wall: Wall, controller: Path, *, hand: Hand | None = None, seed: int = 0) -> Press:
    """Load the file as the cell's computer does, give F^d, and press until well after the impact."""
    law = load_controller(
        controller,
        sample_time_s=cell.period_s,
        payload_mass_kg=cell.mass_kg,
        payload=Payload(
            mass_kg=cell.mass_kg, com_S_m=cell.com_S_m, force_bias_S_n=cell.bias[:3], torque_bias_S_n_m=cell.bias[3:]
        ),
    )
    running, state = Running(cell, wall, hand=hand, seed=seed), START
    way, touched = 0.0, None
    contact_n = sensor_n = 0.0
    while touched is None or running.ticks - touched < PRESSED_S / cell.period_s:
        if running.ticks > LONGEST_S / cell.period_s:
            return Press(contact_n=contact_n, sensor_n=sensor_n, fault="no contact")
        seen = running.read()
        state, command = step(
            law,
            state,
            wrench_S=seen.wrench_S,
            position_W_m=seen.position_m,
            R_WS=_matrix(seen.quaternion_xyzw),
            desired_S=(0.0, 0.0, FORCE_N, 0.0, 0.0, 0.0),
            tick=running.ticks,
        )
        if command.fault is not Fault.NONE:
            return Press(contact_n=contact_n, sensor_n=sensor_n, fault=command.fault.name)
        touched = running.ticks if touched is None and seen.contact_n > 0.0 else touched
        contact_n = max(contact_n, seen.contact_n)
        sensor_n = max(sensor_n, -command.wrench_S[2] if touched is not None else 0.0)
        way += command.increment_S[2]
        running.send((0.0, 0.0, way))
    return Press(contact_n=contact_n, sensor_n=sensor_n, fault="")


def _matrix(quaternion_xyzw: tuple[float, ...]) -> list[list[float]]:
    x, y, z, w = quaternion_xyzw
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def truths(cell: MujocoCell, wall: Wall) -> dict[str, float]:
    """Return the true parameters by the names of `estimates`."""
    return {
        "mass": cell.mass_kg,
        **dict(zip(("com x", "com y", "com z"), cell.com_S_m, strict=True)),
        "K_s": cell.stiffness_n_per_m,
        "B_s": cell.damping_n_s_per_m,
        "B_p": cell.drag_n_s_per_m,
        "K_e": wall.stiffness_n_per_m,
        "B_e": wall.damping_n_s_per_m,
        "T_d": cell.delay_s,
        "bandwidth": cell.bandwidth_hz(),
    }


def estimates(found: at.Identification) -> dict[str, at.Estimate]:
    """Return what was identified along z, by name."""
    payload = found.result.payload
    found_values = {"mass": payload.mass_kg}
    if payload.com_m.value is not None and payload.com_m.std is not None:
        for name, value, std in zip(("com x", "com y", "com z"), payload.com_m.value, payload.com_m.std, strict=True):
            found_values[name] = at.Estimate(value=value, std=std, status=payload.com_m.status)
    axis = found.result.axes.get("z")
    if axis is None:
        return found_values
    found_values |= {"K_s": axis.coupling.stiffness_n_per_m, "B_s": axis.coupling.damping_n_s_per_m}
    found_values |= {"B_p": axis.drag_n_s_per_m, "T_d": axis.robot.delay_s, "bandwidth": axis.robot.bandwidth_hz}
    if axis.environments:
        found_values |= {"K_e": axis.environments[0].stiffness_n_per_m, "B_e": axis.environments[0].damping_n_s_per_m}
    return found_values


def main(arguments: list[str]) -> int:
    folder = Path(arguments[0] if arguments else "mujoco-cell")
    folder.mkdir(parents=True, exist_ok=True)
    cell, wall = MujocoCell(), Wall()
    log, file = folder / "cell.mcap", folder / "controller.yaml"
    for old in (log, log.with_suffix(".cell.yaml")):
        old.unlink(missing_ok=True)
    record(cell, wall, FIRST_LOG, log)
    found = at.identify(log, cell=log.with_suffix(".cell.yaml"))
    found_values = estimates(found)
    for name, truth in truths(cell, wall).items():
        value = found_values[name]
        print(f"{name:10} true {truth:11.5g}  identified {value.value or math.nan:11.5g} ± {value.std or math.nan:.2g}")
    design = at.optimize(found, environment_stiffness=(2.9e4, 1.25e5), problem=EASED)
    design.save(file)
    print(f"certified worst {design.peak_force:.1f} N over walls of 29 to 125 N/mm")
    for stiffness in (3e4, 6e4, 1.2e5):
        predicted = at.predict(design, environment_stiffness=stiffness, approach_force=FORCE_N)
        measured = press(cell, Wall(stiffness_n_per_m=stiffness), file)
        print(
            f"wall of {stiffness / 1e3:.0f} N/mm: predicted {predicted.peak_force:.1f} N, "
            f"measured {measured.contact_n:.1f} N {measured.fault}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
