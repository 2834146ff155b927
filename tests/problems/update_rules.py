"""Controllers played sample by sample: from force and measured position to the position that they command."""

from collections.abc import Callable

import numpy as np

from problems.model.linear_controllers import LinearController

Rule = Callable[[float, float], float]


def stepped(law: LinearController) -> Rule:
    state, r = np.zeros(law.state_count), law.state_count

    def update(force: float, measured: float) -> float:
        seen = np.concatenate([state, [force, measured]])
        state[:] = law.matrix[:r] @ seen
        return float(law.matrix[r] @ seen)

    return update
