"""What the operator and the program do with the cell: poses, hand-led jogging, a commanded sweep, contacts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from autotune.recording.motions import FreeMotions, smooth_ramp
from problems.arrays import BoolArray, FloatArray
from problems.errors import ParameterError

_GUIDED_BAND_HZ = 1.5
_HOMING_S = 2.5
_TAP_S, _SWINGING_S = 0.012, 1.2


@dataclass(frozen=True, kw_only=True)
class Script:
    """Inputs per controller period, (n,) each unless given otherwise.

    `rotation_rad` (n, 3) rotation vector of the tool from its working orientation; `admittance` whether the
    admittance controller runs, and `command_m` the position command relative to the phase's start where it does not;
    `desired_force_n` F^d; `hand_force_n`; `homing_n_per_m` a gentle spring in the operator's hand towards the start,
    so that jogging stays away from the wall.
    """

    rotation_rad: FloatArray
    admittance: BoolArray
    command_m: FloatArray
    desired_force_n: FloatArray
    hand_force_n: FloatArray
    homing_n_per_m: FloatArray

    def __len__(self) -> int:
        return len(self.admittance)


@dataclass(frozen=True, kw_only=True)
class Program(FreeMotions):
    """The program of a log of the simulated cell; on a rotational axis in rad and N·m, see `turning`.

    Poses and sweep are those of a first log, livelier, since this cell is known. A hand leads the payload for
    `jogging_s` and knocks on it `tap_count` times; contacts are made by the cell's own admittance under F^d.
    """

    rest_s: float = 0.8
    pose_count: int = 9
    tilts_rad: tuple[float, float] = (0.55, 1.2)
    pose_move_s: float = 0.8
    sweep_hz: tuple[float, float] = (0.4, 55.0)
    sweep_speed_m_s: float = 0.012
    jogging_s: float = 11.0
    jogging_force_n: float = 35.0
    home_n_per_m: float = 1200.0
    return_n_per_m: float = 3000.0
    tap_count: int = 0
    tap_force_n: float = 60.0
    contact_count: int = 4
    contact_force_n: float = 30.0
    contact_hold_s: float = 1.2
    retract_s: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pose_count < 1 or self.contact_count < 0:
            raise ParameterError("program", (self.pose_count, self.contact_count), "at least one pose, no fewer than 0")

    @classmethod
    def turning(cls, **changes: Any) -> "Program":
        """Return a program for `Cell.turning`, with `changes` of fields."""
        usual = {
            "jogging_force_n": 6.0,
            "home_n_per_m": 40.0,
            "return_n_per_m": 100.0,
            "sweep_speed_m_s": 0.065,
            "tap_force_n": 8.0,
            "contact_force_n": 5.5,
        }
        return cls(**{**usual, **changes})


def build_script(program: Program, sample_time_s: float, rng: np.random.Generator) -> Script:
    """Lay the phases one after the other, with a rest between them."""
    h = sample_time_s
    rest = _quiet(round(program.rest_s / h))
    parts = [rest, _poses(program, h), rest]
    if program.jogging_s > 0.0:
        parts += [_jogging(program, h, rng), rest]
    if program.sweep_s > 0.0:
        parts += [_sweep(program, h), rest]
    parts += [_tap(program, h) for _ in range(program.tap_count)]
    for _ in range(program.contact_count):
        parts.append(_contact(program, h))
    parts.append(rest)
    return _joined(parts)


def _quiet(samples: int) -> Script:
    zeros = np.zeros(samples)
    return Script(
        rotation_rad=np.zeros((samples, 3)),
        admittance=np.zeros(samples, dtype=bool),
        command_m=zeros,
        desired_force_n=zeros,
        hand_force_n=zeros,
        homing_n_per_m=zeros,
    )


def _joined(parts: list[Script]) -> Script:
    names = ("rotation_rad", "admittance", "command_m", "desired_force_n", "hand_force_n", "homing_n_per_m")
    return Script(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _replaced(script: Script, **arrays: FloatArray | BoolArray) -> Script:
    return Script(**{**script.__dict__, **arrays})


def _smooth(samples: int) -> FloatArray:
    """Return a minimum-jerk ramp from 0 to 1."""
    return np.array([smooth_ramp(t) for t in np.linspace(0.0, 1.0, samples)])


def _poses(program: Program, h: float) -> Script:
    """Tilt the tool to its poses and rest at each; one pose alone is the working orientation."""
    rotation = np.array(list(program.rotations(h))) * (program.pose_count > 1)
    return _replaced(_quiet(len(rotation)), rotation_rad=rotation)


def _jogging(program: Program, h: float, rng: np.random.Generator) -> Script:
    """Lead the payload by hand: slow pushes of random strength, homed softly, silent at both ends."""
    samples = round(program.jogging_s / h)
    sections = scipy.signal.butter(2, _GUIDED_BAND_HZ, fs=1.0 / h, output="sos")
    force = scipy.signal.sosfilt(sections, rng.standard_normal(samples))
    force *= program.jogging_force_n / max(float(np.std(force)), 1e-12)
    edge, homing = max(2, round(0.5 / h)), min(round(_HOMING_S / h), samples // 2)
    push, hold = np.ones(samples), np.ones(samples)
    push[:edge], push[-homing:] = _smooth(edge), 0.0
    push[-homing - edge : -homing] = _smooth(edge)[::-1]
    hold[:edge], hold[-edge:] = _smooth(edge), _smooth(edge)[::-1]
    gain = np.where(np.arange(samples) < samples - homing, program.home_n_per_m, program.return_n_per_m)
    return _replaced(
        _quiet(samples),
        admittance=np.ones(samples, dtype=bool),
        hand_force_n=np.asarray(force * push),
        homing_n_per_m=np.asarray(gain * hold),
    )


def _sweep(program: Program, h: float) -> Script:
    command = np.array(list(program.sweep(h)))
    return _replaced(_quiet(len(command)), command_m=command)


def _tap(program: Program, h: float) -> Script:
    """Knock on the payload while the robot is at rest: half a sine of 12 ms, then time to swing out."""
    before, knock, after = round(0.3 / h), max(2, round(_TAP_S / h)), round(_SWINGING_S / h)
    force = np.zeros(before + knock + after)
    force[before : before + knock] = program.tap_force_n * np.sin(np.pi * (np.arange(knock) + 0.5) / knock)
    return _replaced(_quiet(len(force)), hand_force_n=force)


def _contact(program: Program, h: float) -> Script:
    """Press with F^d until the payload rests on the wall, then back off and rest."""
    pressing = round((program.contact_hold_s + 1.8) / h)
    retracting, resting = round(program.retract_s / h), round(program.rest_s / h)
    desired = np.concatenate(
        [
            np.full(pressing, program.contact_force_n),
            np.full(retracting, -0.55 * program.contact_force_n),
            np.zeros(resting),
        ]
    )
    samples = len(desired)
    return _replaced(_quiet(samples), admittance=np.ones(samples, dtype=bool), desired_force_n=desired)
