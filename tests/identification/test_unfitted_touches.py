"""Contacts of a log with its weight whose motion shows no coupling: force over the flange's way gives the surface."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from identification.identify import identify_cell
from identification.result import CONTACT_UNEXPLAINED, Status, TouchCause
from identification.signals.recording import PoseSignal, Recording, WrenchSignal

MASS_KG, SERIES_N_PER_M, RATE_HZ, SPEED_M_S, DEPTH_M = 8.0, 4.0e4, 500.0, 0.016, 1.6e-3
COM_M = np.array([0.01, -0.02, 0.09])


def pressed(presses: int) -> tuple[Recording, list[float]]:
    """Seven tilts, then presses on a spring without a hold, a robot's speed turning within 0.1 s; and their onsets."""
    rng = np.random.default_rng(11)
    tilts = Rotation.from_euler(
        "xyz",
        [[180, 0, 0], [150, 0, 20], [200, 25, -10], [180, -35, 40], [165, 30, 90], [215, -15, -60], [180, 0, 0]],
        degrees=True,
    )
    at = np.arange(7) * 2.7
    between = Slerp(np.sort([*at, *(at + 1.5)]), tilts[np.repeat(np.arange(7), 2)])
    still_until, every = float(at[-1] + 2.0), 4.0
    time = np.arange(round((still_until + every * presses) * RATE_HZ)) / RATE_HZ
    turned = between(np.clip(time, 0.0, at[-1] + 1.5))
    # Each press goes 10 mm to the wall and into it, back at once, and waits.
    within = np.where(time > still_until, (time - still_until) % every, 0.0)
    way = (0.01 + DEPTH_M) / SPEED_M_S
    depth = np.interp(within, [0.5, 0.5 + way, 0.5 + 2.0 * way], [0.0, 0.01 + DEPTH_M, 0.0])
    smooth = np.hanning(51) / np.sum(np.hanning(51))
    depth = np.convolve(np.pad(depth, 25, mode="edge"), smooth, mode="valid")
    wall = SERIES_N_PER_M * np.maximum(depth - 0.01, 0.0)
    inertia = -MASS_KG * np.gradient(np.gradient(depth, 1.0 / RATE_HZ), 1.0 / RATE_HZ)
    down = np.array([0.0, 0.0, -1.0])
    base = MASS_KG * 9.80665 * down + (inertia - wall)[:, None] * down
    force = turned.inv().apply(base) + np.array([3.0, -2.0, 5.0]) + 0.15 * rng.standard_normal(base.shape)
    torque = np.cross(COM_M, turned.inv().apply(MASS_KG * 9.80665 * np.tile(down, (len(time), 1))))
    torque += np.array([0.2, -0.1, 0.05]) + 0.01 * rng.standard_normal(base.shape)
    stamps = np.round(1e9 * time).astype(np.int64)
    place = np.array([0.5, 0.1, 0.4]) + depth[:, None] * down + 4e-6 * rng.standard_normal(base.shape)
    recording = Recording(
        wrench=WrenchSignal(topic="w", frame_id="", stamp_ns=stamps, force_n=force, torque_n_m=torque),
        pose=PoseSignal(topic="p", frame_id="", stamp_ns=stamps, position_m=place, quaternion_xyzw=turned.as_quat()),
        command=None,
    )
    return recording, [still_until + every * i + 0.5 + 0.01 / SPEED_M_S for i in range(presses)]


def test_contacts_without_a_sweep_give_the_surface_in_series_with_the_coupling() -> None:
    recording, onsets = pressed(4)
    found = identify_cell(recording)
    axis = found.axes["z"]
    assert found.payload.mass_kg.value is not None
    assert abs(found.payload.mass_kg.value - MASS_KG) < 0.05
    assert axis.coupling.stiffness_n_per_m.value is None
    [surface] = axis.environments
    assert surface.contacts == 4
    assert surface.stiffness_n_per_m.status is Status.UNIDENTIFIABLE
    secant = surface.secant_stiffness_n_per_m
    assert secant.value is not None
    assert secant.std is not None
    assert abs(secant.value - SERIES_N_PER_M) < 2.0 * secant.std
    assert secant.std < 0.2 * SERIES_N_PER_M
    touches = [touch for touch in found.timelines[0].touches if touch.surface == surface.name]
    assert [touch.cause for touch in touches] == [TouchCause.WALL] * 4
    assert [touch.onset_s for touch in touches] == pytest.approx(onsets, abs=0.05)
    assert not any(each.code in {CONTACT_UNEXPLAINED, "no-contact"} for each in found.findings)
