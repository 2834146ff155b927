import dataclasses
import shutil
from collections.abc import Sequence
from ctypes import c_char
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from autotune.errors import CertificateError, UsageError
from autotune.export.c_source import CSource, render_c
from autotune.export.export import export_controller
from autotune.formats.controller import write_controller
from autotune.formats.controller_record import ControllerStatus
from autotune.formats.limits import Biquad
from autotune.runtime import AXES, CollisionResponse, Command, Fault, RuntimeController, change, rearm, step
from autotune.runtime.load import read_law
from tests.autotune.export.c_twin import CPayload, Twin, compile_c, numbers
from tests.autotune.formats.samples import make_controller
from tests.autotune.runtime.cases import (
    PERIOD_S,
    STARTED,
    Reading,
    make_axis,
    make_runtime,
    random_readings,
    random_runtime,
    random_schedule,
    run_contact,
)

pytestmark = pytest.mark.usefixtures("unchecked_law")

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def twin_of(controller: RuntimeController, folder: Path, name: str = "cell") -> Twin:
    done = compile_c(render_c(controller, name, {}), folder, name)
    assert (done.returncode, done.stderr) == (0, "")
    return Twin(folder / f"{name}.so", name)


def row(command: Command) -> NDArray[np.float64]:
    reported = (command.missing_mass_kg, command.is_started, command.phase, command.fault)
    return np.array([*command.increment_S, *command.twist_S, *command.wrench_S, *reported])


def both(controller: RuntimeController, twin: Twin, readings: Sequence[Reading]) -> tuple[NDArray[np.float64], ...]:
    """Step Python and C through the same readings, both rearmed every 500 periods."""
    state, rows, twins = STARTED, [], []
    for k, reading in enumerate(readings):
        if k % 500 == 499:
            state = rearm(state)
            twin.rearm()
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]  # lists of numbers
        rows.append(row(command))
        twins.append(numbers(twin.step(reading)))
    return np.array(rows), np.array(twins)


@needs_gcc
@pytest.mark.parametrize("response", CollisionResponse)
def test_c_is_the_python_step_over_long_random_sequences(response: CollisionResponse, tmp_path: Path) -> None:
    for case in range(3):
        rng = np.random.default_rng(10 * list(CollisionResponse).index(response) + case)
        controller = random_runtime(rng, response)
        python, c = both(controller, twin_of(controller, tmp_path, f"cell{case}"), random_readings(rng, 3000))
        assert np.all(python[:, -1] == 0.0)
        assert (np.max(python[:, -2]) > 0.0) == (response is not CollisionResponse.NONE)
        # The same operations in the same order, and none of them contracted: the same bits, far inside of 1e-12.
        np.testing.assert_allclose(c, python, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(c, python)


def with_biquads(controller: RuntimeController, rng: np.random.Generator) -> RuntimeController:
    """Return the controller with another biquad on every axis."""
    axes = tuple(
        dataclasses.replace(
            each,
            biquad=Biquad(
                zero_s=float(rng.uniform(2e-3, 2e-2)),
                zero_damping_ratio=float(rng.uniform(0.1, 1.0)),
                pole_s=float(rng.uniform(2e-3, 2e-2)),
                pole_damping_ratio=float(rng.uniform(0.4, 1.0)),
            ),
        )
        for each in controller.axes
    )
    return dataclasses.replace(controller, axes=axes)


@needs_gcc
@pytest.mark.parametrize("response", CollisionResponse)
def test_c_is_the_python_step_with_a_biquad(response: CollisionResponse, tmp_path: Path) -> None:
    rng = np.random.default_rng(31)
    plain = random_runtime(rng, response)
    controller, readings = with_biquads(plain, rng), random_readings(rng, 2000)
    python, c = both(controller, twin_of(controller, tmp_path), readings)
    assert np.all(python[:, -1] == 0.0)
    np.testing.assert_array_equal(c, python)
    without, _ = both(plain, twin_of(plain, tmp_path, "plain"), readings)
    assert np.max(np.abs(python[:, :6] - without[:, :6])) > 1e-4


@needs_gcc
@pytest.mark.parametrize("response", [CollisionResponse.NONE, CollisionResponse.RESET])
def test_c_is_the_python_step_in_contact_with_the_cell_in_the_loop(response: CollisionResponse, tmp_path: Path) -> None:
    threshold = np.inf if response is CollisionResponse.NONE else 50.0
    controller = make_runtime(*map(make_axis, AXES), response=response, threshold_n=threshold)
    twin, state, readings, commands = twin_of(controller, tmp_path), STARTED, [], []

    def by_python(reading: Reading) -> NDArray[np.float64]:
        nonlocal state
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]
        readings.append(reading)
        commands.append(row(command))
        return np.array(command.increment_S)

    def by_c(reading: Reading) -> NDArray[np.float64]:
        return np.array(twin.step(reading).increment_S)

    python = run_contact(by_python, 0, force_n=60.0, distance_m=5e-3, duration_s=0.5)
    c = run_contact(by_c, 0, force_n=60.0, distance_m=5e-3, duration_s=0.5)
    assert np.max(python.contact_n) > 60.0
    assert (np.max(np.array(commands)[:, -2]) == 1.0) == (response is CollisionResponse.RESET)
    np.testing.assert_allclose(c.command_m, python.command_m, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(c.sensor_n, python.sensor_n, rtol=0.0, atol=1e-7)  # 1e-12 m times the stiffness 1e5 N/m


@needs_gcc
def test_both_hold_at_the_same_speed_behind_the_lag(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    free, readings = random_runtime(rng, CollisionResponse.NONE), random_readings(rng, 2000)
    python, _ = both(free, twin_of(free, tmp_path, "free"), readings)
    name, index = free.axes[0].name, free.axes[0].index
    # Reached once, late: of a first-order lag of 20 periods.
    behind, last = [], 0.0
    for speed in python[:, 6 + index]:
        last += -np.expm1(-1.0 / 20.0) * (speed - last)
        behind.append(abs(last))
    reached = np.maximum.accumulate(behind)
    late = int(np.flatnonzero(reached > reached[1000])[0])
    limit = 0.5 * (reached[late - 1] + reached[late])
    lagging = dataclasses.replace(free.limits.axes[name], followed_speed=limit, followed_lag_s=20.0 * PERIOD_S)
    limits = dataclasses.replace(free.limits, axes={**free.limits.axes, name: lagging})
    controller = dataclasses.replace(free, limits=limits)
    python, c = both(controller, twin_of(controller, tmp_path), readings)
    assert np.flatnonzero(python[:, -1] == float(Fault.SPEED))[0] == late
    np.testing.assert_array_equal(c, python)


@needs_gcc
def test_both_hold_on_the_same_faults(tmp_path: Path) -> None:
    controller = make_runtime(*map(make_axis, AXES))
    twin, good = twin_of(controller, tmp_path), random_readings(np.random.default_rng(0), 3)
    spoiled = [
        dataclasses.replace(good[2], wrench_S=np.full(6, np.nan)),
        dataclasses.replace(good[2], wrench_S=np.full(6, 1e308), desired_S=np.full(6, 1e308)),
        dataclasses.replace(good[2], position_W_m=np.array([0.0, np.inf, 0.0])),
        dataclasses.replace(good[2], R_WS=-good[2].R_WS),
        dataclasses.replace(good[2], R_WS=1.001 * good[2].R_WS),
        dataclasses.replace(good[2], R_WS=good[2].R_WS[:, [1, 2, 0]]),
        dataclasses.replace(good[2], position_W_m=good[2].position_W_m + 1.0),
    ]
    found = []
    for each in spoiled:
        twin.start()
        python, c = both(controller, twin, [good[0], good[1], each, good[2]])
        np.testing.assert_array_equal(c, python)
        assert np.all(c[2:, :18] == 0.0)
        found.append(int(c[3, -1]))
    assert found == [1, 1, 1, 2, 2, 3, 3]


@needs_gcc
def test_c_accepts_the_cells_that_the_certificate_holds_for(tmp_path: Path) -> None:
    twin = twin_of(make_runtime(make_axis("x"), make_axis("ry")), tmp_path)

    def reported(mass: float, h: float, inertia: float) -> int:
        return twin.check(CPayload(mass_kg=mass), h, (np.nan, inertia, np.nan))

    assert reported(14.0, PERIOD_S, 18.0) == reported(18.0, PERIOD_S, 14.0) == 0
    assert reported(16.0, 1e-3, 16.0) == reported(16.0, np.nan, 16.0) == 1
    assert reported(13.9, PERIOD_S, 16.0) == reported(18.1, PERIOD_S, 16.0) == reported(np.nan, PERIOD_S, 16.0) == 2
    assert reported(16.0, PERIOD_S, 18.1) == reported(16.0, PERIOD_S, np.nan) == 3


@needs_gcc
def test_an_exported_file_compiles_and_holds_its_checksum(tmp_path: Path) -> None:
    """Whatever the provenance says: the end of a comment, trigraphs, a line that goes on."""
    source = tmp_path / "controller.yaml"
    nasty = {"tool": "autotune", "log": "*/ #error /* ??/ é \\", "\n??/\n": ["\x7f", "\u2028"], "when": {"a": None}}
    write_controller(source, dataclasses.replace(make_controller(), provenance=nasty))
    digest = export_controller(source, "c", tmp_path / "my_cell2.c").checksum
    texts = [(tmp_path / f"my_cell2.{end}").read_text(encoding="ascii") for end in ("h", "c")]
    assert compile_c(CSource(header=texts[0], source=texts[1]), tmp_path, "my_cell2").returncode == 0
    library = Twin(tmp_path / "my_cell2.so", "my_cell2").library
    assert bytes((c_char * 65).in_dll(library, "my_cell2_checksum")) == digest.encode() + b"\0"
    assert digest in texts[0]
    export_controller(source, "c", tmp_path / "my_cell2.c")
    assert texts == [(tmp_path / f"my_cell2.{end}").read_text(encoding="ascii") for end in ("h", "c")]


@needs_gcc
def test_two_halves_of_different_controllers_do_not_compile(tmp_path: Path) -> None:
    one, other = make_runtime(make_axis("x")), dataclasses.replace(make_runtime(make_axis("x")), checksum="cd" * 32)
    mixed = CSource(header=render_c(one, "cell", {}).header, source=render_c(other, "cell", {}).source)
    assert "of different controllers" in compile_c(mixed, tmp_path, "cell").stderr
    assert "compile without it" in compile_c(render_c(one, "cell", {}), tmp_path, "cell", "-ffast-math").stderr


@pytest.mark.parametrize("out", ["cell", "cell.h", "2cell.c", "my-cell.c", "_cell.c", "é.c", f"{'a' * 41}.c"])
def test_a_name_that_c_cannot_have_is_refused(tmp_path: Path, out: str) -> None:
    source = tmp_path / "controller.yaml"
    write_controller(source, make_controller())
    with pytest.raises(UsageError, match=r"must be a name for C functions followed by \.c"):
        export_controller(source, "c", tmp_path / out)


def test_a_file_of_somebody_else_is_not_replaced(tmp_path: Path) -> None:
    source = tmp_path / "controller.yaml"
    write_controller(source, make_controller())
    (tmp_path / "cell.h").write_text("int mine;\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"cell\.h exists and is no export to c"):
        export_controller(source, "c", tmp_path / "cell.c")
    assert not (tmp_path / "cell.c").exists()


def test_what_cannot_be_trusted_leaves_the_old_pair(tmp_path: Path) -> None:
    source = tmp_path / "controller.yaml"
    write_controller(source, make_controller())
    export_controller(source, "c", tmp_path / "cell.c")
    old = [(tmp_path / name).read_bytes() for name in ("cell.c", "cell.h")]
    write_controller(source, dataclasses.replace(make_controller(), status=ControllerStatus.UNVALIDATED))
    with pytest.raises(CertificateError, match="not validated"):
        export_controller(source, "c", tmp_path / "cell.c")
    assert [(tmp_path / name).read_bytes() for name in ("cell.c", "cell.h")] == old


def test_every_number_is_the_exact_double(tmp_path: Path) -> None:
    source = tmp_path / "controller.yaml"
    write_controller(source, make_controller())
    law = read_law(source)
    text = render_c(law, "cell", {}).source
    for axis in law.axes:
        for value in (*axis.blocks.values(), axis.deadband, *axis.payload_range):
            assert value.hex() in text


@needs_gcc
@pytest.mark.parametrize("has_biquad", [False, True])
def test_c_takes_over_as_python_does_and_only_after_the_dwell_time(tmp_path: Path, has_biquad: bool) -> None:
    rng = np.random.default_rng(7)
    first = random_runtime(rng, CollisionResponse.NONE)
    second = dataclasses.replace(
        first,
        axes=tuple(
            dataclasses.replace(
                each,
                mass=2.0 * each.mass,
                damping=0.6 * each.damping,
                lead_s=0.01,
                feedback_damping_s=0.5 * each.feedback_damping_s,
                velocity_filter_rad_per_s=90.0,
                variable_damping=None if each.turns else random_schedule(rng),
            )
            for each in first.axes
        ),
    )
    second = with_biquads(second, rng) if has_biquad else second
    twins = [twin_of(first, tmp_path, "one"), twin_of(second, tmp_path, "two")]
    state, running, laws, refused = STARTED, 0, (first, second), 0
    for k, reading in enumerate(random_readings(rng, 1500)):
        if k % 40 == 39:
            now, law = change(laws[running], laws[1 - running], state, dwell_time_s=60 * PERIOD_S)
            did = twins[1 - running].take_over(twins[running].state, 60 * PERIOD_S)
            assert did == (law is laws[1 - running])
            refused += not did
            state, running = now, laws.index(law)
        state, command = step(laws[running], state, **reading.arguments())  # type: ignore[arg-type]
        np.testing.assert_array_equal(numbers(twins[running].step(reading)), row(command))
    assert refused > 10
