"""What was verified of a controller, check by check."""

from dataclasses import dataclass
from typing import Any

from autotune.errors import CertificateError
from autotune.shown import Shown
from problems.design.uncertainty import ALWAYS_UNCERTAIN, Scenario

from .bouncing import RefutedError


@dataclass(frozen=True, kw_only=True, repr=False)
class Check(Shown):
    """One thing that was verified on one axis, in words; `passed` is the verdict.

    `warns`: nothing is wrong, but nothing was shown either, or somebody should look at it. `refuted_at` is the plant
    on which a requirement is missed, None where no plant is to blame.
    """

    axis: str
    name: str
    passed: bool
    message: str
    warns: bool = False
    refuted_at: Scenario | None = None

    @property
    def verdict(self) -> str:
        """Return the verdict in a word: ok, note or FAILED."""
        return ("note" if self.warns else "ok") if self.passed else "FAILED"

    def _headline(self) -> str:
        return f"Check of axis {self.axis}, {self.name}: {self.verdict}, {self.message}"

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data; parameters of the plant that are nominal are left out of `refuted_at`."""
        at = self.refuted_at
        always = {} if at is None else {name: getattr(at, name) for name in ALWAYS_UNCERTAIN}
        return {**vars(self), "refuted_at": None if at is None else {**always, **at.further()}}


@dataclass(frozen=True, kw_only=True)
class ValidationReport:
    """All checks of a controller, in the order in which they ran."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def require(self) -> None:
        """Raise CertificateError with the first check that failed, RefutedError where a plant refutes it."""
        failed = [check for check in self.checks if not check.passed]
        if failed:
            more = f" ({len(failed) - 1} more checks failed)" if len(failed) > 1 else ""
            message = f"Axis {failed[0].axis}, {failed[0].name}: {failed[0].message}{more}"
            if failed[0].refuted_at is not None:
                raise RefutedError(message, axis=failed[0].axis, scenario=failed[0].refuted_at)
            raise CertificateError(message)
