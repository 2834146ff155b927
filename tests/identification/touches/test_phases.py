"""What counts as a phase of a log without the payload's mass: nothing that lasts less than 0.2 s."""

import numpy as np
import pytest

from identification.result import PhaseKind
from identification.touches.find import find_touches
from identification.touches.phases import build_phases
from identification.touches.signals import axis_signals
from tests.identification.touches.test_find import logged

PERIOD_S, SPEED_M_S = 1e-3, 0.05


@pytest.mark.parametrize(("pause_s", "rests"), [(0.4, 3), (0.25, 2)])
def test_a_pause_between_two_moves_is_a_rest_where_it_lasts(pause_s: float, rests: int) -> None:
    move, stand = np.ones(1000), np.zeros(1000)
    moving = np.concatenate([stand, move, np.zeros(round(pause_s / PERIOD_S)), move, stand])
    found = find_touches(axis_signals(logged(np.cumsum(moving) * SPEED_M_S * PERIOD_S, 0.0 * moving, PERIOD_S, 0.0)))
    kinds = [phase.kind for phase in build_phases(found, ())]
    # The speed is a mean over 0.1 s: what stands still is that much shorter.
    assert kinds.count(PhaseKind.REST) == rests
    assert kinds.count(PhaseKind.FREE_MOTION) == 2
