"""What the rests of a log say of the noise of the measured pose."""

import numpy as np
import pytest

from identification.sensor import position_noise
from identification.signals.recording import PoseSignal

PERIOD_NS = 2_000_000
COUNT = 4000


def pose(position_m: np.ndarray) -> PoseSignal:
    return PoseSignal(
        topic="/pose",
        frame_id="base",
        stamp_ns=np.arange(len(position_m), dtype=np.int64) * PERIOD_NS,
        position_m=position_m,
        quaternion_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (len(position_m), 1)),
    )


@pytest.mark.parametrize("noise_m", [2e-6, 2e-5])
def test_the_noise_of_the_pose_is_reported_beside_drift_and_sway_and_outside_of_motion(noise_m: float) -> None:
    rng = np.random.default_rng(7)
    t = np.arange(COUNT) * PERIOD_NS * 1e-9
    # A drift of 0.1 mm/s and a sway of 50 µm at 1 Hz; in the middle a motion that is no rest.
    slow = 1e-4 * t + 5e-5 * np.sin(2.0 * np.pi * t)
    slow[1500:2500] += 0.1 * np.sin(2.0 * np.pi * 30.0 * t[1500:2500])
    signal = pose(slow[:, None] + noise_m * rng.standard_normal((COUNT, 3)))
    found = position_noise(signal, [(0, 1500 * PERIOD_NS), (2500 * PERIOD_NS, COUNT * PERIOD_NS)])
    assert found is not None
    assert found.value is not None
    assert found.std is not None
    # 9,000 samples tell a deviation to 1 %; four of those.
    assert found.value == pytest.approx(noise_m, rel=0.04)
    assert found.std == pytest.approx(0.0104 * noise_m, rel=0.1)  # sqrt(35/18/(2 * 8988))


def test_a_pose_that_stands_still_to_the_last_bit_or_hardly_rests_shows_no_noise() -> None:
    still = pose(np.ones((COUNT, 3)))
    assert position_noise(still, [(0, COUNT * PERIOD_NS)]) is None
    loud = pose(np.random.default_rng(1).standard_normal((COUNT, 3)))
    assert position_noise(loud, [(0, 20 * PERIOD_NS)]) is None
    assert position_noise(loud, []) is None
