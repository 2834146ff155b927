"""Compile an exported controller with gcc and step it through ctypes."""

import ctypes
import subprocess
from ctypes import CDLL, POINTER, Structure, byref, c_double, c_int, c_uint32
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autotune.export.c_source import CSource
from tests.autotune.runtime.cases import Reading

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O2", "-ffp-contract=off")


class CPayload(Structure):
    _fields_ = (
        ("mass_kg", c_double),
        ("com_S_m", c_double * 3),
        ("force_bias_S_n", c_double * 3),
        ("torque_bias_S_n_m", c_double * 3),
        ("gravity_W_m_s2", c_double * 3),
    )


class CReading(Structure):
    _fields_ = (
        ("wrench_S", c_double * 6),
        ("position_W_m", c_double * 3),
        ("R_WS", c_double * 9),
        ("desired_S", c_double * 6),
        ("tick", c_uint32),
        ("has_tick", c_int),
    )


class CCommand(Structure):
    _fields_ = (
        ("increment_S", c_double * 6),
        ("twist_S", c_double * 6),
        ("wrench_S", c_double * 6),
        ("missing_mass_kg", c_double),
        ("phase", c_int),
        ("fault", c_int),
        ("is_started", c_int),
    )


class CState(Structure):
    _fields_ = (
        ("control", c_double * 36),
        ("drive", c_double * 6),
        ("position", c_double * 6),
        ("command", c_double * 6),
        ("output", c_double * 6),
        ("older", c_double * 18),
        ("damping", c_double * 6),
        ("b", c_double * 144),
        ("position_W_m", c_double * 3),
        ("R_WS", c_double * 9),
        ("twist", c_double * 6),
        ("followed", c_double * 6),
        ("wrench", c_double * 6),
        ("sums", c_double * 6),
        ("wrench_way", c_double),
        ("pose_way", c_double),
        ("missing_kg", c_double),
        ("weight_kg", c_double),
        ("weight_work", c_double),
        ("periods", c_int * 6),
        ("since_change", c_int),
        ("wrench_same", c_int),
        ("pose_same", c_int),
        ("resting", c_int),
        ("weight_since", c_int),
        ("has_pose", c_int),
        ("phase", c_int),
        ("fault", c_int),
        ("has_tick", c_int),
        ("tick", c_uint32),
    )


def compile_c(text: CSource, folder: Path, name: str, *flags: str) -> "subprocess.CompletedProcess[str]":
    """Write both files and compile them without the mathematical library; the linker must find nothing missing."""
    (folder / f"{name}.h").write_text(text.header, encoding="ascii")
    (folder / f"{name}.c").write_text(text.source, encoding="ascii")
    # What a sanitizer calls is found when it is loaded.
    bare = () if any("sanitize" in flag for flag in flags) else ("-nostdlib", "-Wl,--no-undefined")
    alone = ("-shared", "-fPIC", *bare, "-o", f"{name}.so", f"{name}.c")
    return subprocess.run(["gcc", *FLAGS, *flags, *alone], cwd=folder, capture_output=True, text=True, check=False)


class Twin:
    """A compiled controller and its state."""

    def __init__(self, library: Path, name: str) -> None:
        self.library, self.name, self.state = CDLL(str(library)), name, CState()
        self.payload = CPayload.in_dll(self.library, f"{name}_file_payload")
        self._step = self.function("step")
        self._step.argtypes = [POINTER(CState), POINTER(CPayload), POINTER(CReading), POINTER(CCommand)]
        self.start()

    def function(self, what: str) -> "ctypes._NamedFuncPointer":
        return self.library[f"{self.name}_{what}"]

    def start(self, *, at_rest: bool = True) -> None:
        """Begin; `at_rest` as if the first readings had been found at rest."""
        self.function("start")(byref(self.state))
        self.state.resting = 10**6 if at_rest else 0

    def take_over(self, state: CState, dwell_time_s: float) -> bool:
        """Go on from another twin's state, if the dwell time has passed."""
        ctypes.pointer(self.state)[0] = state
        return bool(self.function("take_over")(byref(self.state), c_double(dwell_time_s)))

    def rearm(self) -> None:
        self.function("rearm")(byref(self.state))

    def check(self, payload: CPayload, sample_time_s: float, inertia: tuple[float, float, float]) -> int:
        reported = self.function("check")(byref(payload), c_double(sample_time_s), (c_double * 3)(*inertia))
        return int(reported)

    def step(self, reading: Reading) -> CCommand:
        command, values = CCommand(), (reading.wrench_S, reading.position_W_m, reading.R_WS.ravel(), reading.desired_S)
        given = CReading(*(tuple(map(float, value)) for value in values))
        given.tick, given.has_tick = (0, 0) if reading.tick is None else (reading.tick % 2**32, 1)
        reported = self._step(byref(self.state), byref(self.payload), byref(given), byref(command))
        assert reported == command.fault
        return command


def numbers(command: CCommand) -> NDArray[np.float64]:
    """Everything in a command as one row."""
    reported = (command.missing_mass_kg, command.is_started, command.phase, command.fault)
    return np.array([*command.increment_S, *command.twist_S, *command.wrench_S, *reported])
