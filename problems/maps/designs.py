"""Many controllers as rows of numbers, for the compiled loops of maps."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model.controller import SMALLEST_FEEDBACK_DAMPING_S, AdmittanceController
from .parameters import CONTROLLER_FIELDS

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Designs:
    """Controllers of one discretisation: `parameters` (m, 7) as `AdmittanceController.parameters` orders them."""

    kind: AdmittanceController
    parameters: FloatArray

    @property
    def count(self) -> int:
        """How many controllers there are."""
        return len(self.parameters)

    def controller(self, index: int) -> AdmittanceController:
        """Return one of the controllers."""
        names = CONTROLLER_FIELDS.values()
        return replace(self.kind, **dict(zip(names, map(float, self.parameters[index]), strict=True)))  # type: ignore[arg-type]

    def alike(self) -> Iterator[tuple[NDArray[np.int64], bool]]:
        """Yield the indices of controllers with and without ideal compensation, and whether it is ideal."""
        ideal = (self.parameters[:, -1] > 0.0) & (self.kind.compensation == "ideal")
        for value in (False, True):
            chosen = np.flatnonzero(ideal == value)
            if len(chosen):
                yield chosen, value


def designs_around(controller: AdmittanceController, varied: dict[str, FloatArray]) -> Designs:
    """Return the controllers that differ from one by values (m,) of each of the parameters in `varied`.

    The ranges are the caller's to check. A feedback damping too small to be a value in seconds is none at all
    (MODEL.md, erratum 2), so that a range may begin at 0.
    """
    count = max((len(values) for values in varied.values()), default=1)
    parameters = np.tile(controller.parameters(), (count, 1))
    for name, values in varied.items():
        column = list(CONTROLLER_FIELDS).index(name)
        parameters[:, column] = values
        if name == "feedback_damping_s":
            parameters[:, column] *= values >= SMALLEST_FEEDBACK_DAMPING_S
    return Designs(kind=controller, parameters=parameters)
