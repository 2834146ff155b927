"""At which frequencies a part of the payload that swings is looked for."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from identification.joint_fit import payload_search
from identification.joint_fit.extended_problem import PayloadKind


@pytest.mark.parametrize(("period_s", "highest_hz"), [(8e-4, 120.0), (2e-3, 120.0), (4e-3, 100.0), (8e-3, 50.0)])
def test_a_part_is_looked_for_up_to_120_hz_where_there_are_five_samples_to_two_swings(
    monkeypatch: pytest.MonkeyPatch, period_s: float, highest_hz: float
) -> None:
    begun: list[tuple[float, float]] = []
    monkeypatch.setattr(payload_search, "_begun", lambda *given: begun.append((given[-2], given[-1])))
    monkeypatch.setattr(payload_search, "scorer", lambda *_: lambda *_: len(begun))
    of = SimpleNamespace(problem=SimpleNamespace(signals=SimpleNamespace(period_s=period_s)))
    found = payload_search.look_for_part(cast(Any, of), cast(Any, SimpleNamespace(kind=PayloadKind())))
    frequencies = np.array([f for _, f in found])
    assert (frequencies[0], frequencies[-1]) == pytest.approx((6.0, highest_hz))
    # By equal ratios, each without a part and with a thousandth of the mass.
    assert np.log(frequencies[1:] / frequencies[:-1]) == pytest.approx(np.full(23, np.log(highest_hz / 6.0) / 23.0))
    assert begun == [(share, f) for f in frequencies.tolist() for share in (0.0, 1e-3)]
