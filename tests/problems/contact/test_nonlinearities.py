import math
from collections.abc import Callable

import pytest

from problems.contact.nonlinearities import Collision, CommandLimits, Deadband, Nonlinearities, VariableDamping
from problems.errors import ParameterError


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Deadband(width_n=-1.0), "width_n"),
        (lambda: Deadband(width_n=1.0, kind="soft"), "kind"),  # type: ignore[arg-type]
        (lambda: CommandLimits(speed_m_s=0.0), "speed_m_s"),
        (lambda: CommandLimits(acceleration_m_s2=math.nan), "acceleration_m_s2"),
        (lambda: Collision(threshold_n=0.0), "threshold_n"),
        (lambda: Collision(threshold_n=1.0, response="halt"), "response"),  # type: ignore[arg-type]
        (lambda: VariableDamping(floor_n_s_per_m=0.0), "floor"),
        (lambda: VariableDamping(decay_s_per_m=-1.0), "decay"),
        (lambda: Nonlinearities(force_limit_n=0.0), "force_limit_n"),
        (lambda: Nonlinearities(force_noise_rms_n=-0.1), "force_noise_rms_n"),
        (lambda: Nonlinearities(late_share=1.0), "late_share"),
    ],
)
def test_values_that_cannot_be_are_refused(make: Callable[[], object], text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        make()
