"""A claim that a plant refutes: the plant is part of the error, so that a search can take it in."""

from autotune.errors import CertificateError
from problems.design.uncertainty import Scenario

from .bouncing import Impact


class RefutedError(CertificateError):
    """A claim about `axis` is false, or cannot be proved, at the plant `scenario`.

    `impact` is the contact on it that bounces for ever, None where it is something else.
    """

    def __init__(self, message: str, *, axis: str, scenario: Scenario, impact: Impact | None = None) -> None:
        super().__init__(message)
        self.axis, self.scenario, self.impact = axis, scenario, impact
