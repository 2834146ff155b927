"""How far the loops stay from instability: the least modulus margin."""

from typing import Any, ClassVar

from ..requirements import Requirement, Requirements
from ..requirements.margins import ModulusMargin
from .base import BatchColumn, Direction, RequirementObjective

_MODULUS = ModulusMargin()


class Robustness(RequirementObjective):
    """min |1 + L| over frequency, both break points and all plants, in contact and in free space."""

    name: ClassVar[str] = "robustness"
    title: ClassVar[str] = "least modulus margin"
    unit: ClassVar[str] = ""
    direction: ClassVar[Direction] = "maximize"
    batch_column: ClassVar[BatchColumn | None] = "modulus"

    def limited(self, asked: Requirements) -> tuple[Requirement[Any], Any]:
        """Return the modulus margin, whose number depends on nothing that is asked."""
        del asked
        return _MODULUS, 0.5
