"""What was verified of a controller, check by check."""

from dataclasses import dataclass

from autotune.errors import CertificateError


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was verified on one axis, in words; `passed` is the verdict.

    `warns`: nothing is wrong, but nothing was shown either, or somebody should look at it.
    """

    axis: str
    name: str
    passed: bool
    message: str
    warns: bool = False

    @property
    def verdict(self) -> str:
        """Return the verdict in a word: ok, note or FAILED."""
        return ("note" if self.warns else "ok") if self.passed else "FAILED"


@dataclass(frozen=True, kw_only=True)
class ValidationReport:
    """All checks of a controller, in the order in which they ran."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def require(self) -> None:
        """Raise CertificateError with the first check that failed."""
        failed = [check for check in self.checks if not check.passed]
        if failed:
            more = f" ({len(failed) - 1} more checks failed)" if len(failed) > 1 else ""
            raise CertificateError(f"Axis {failed[0].axis}, {failed[0].name}: {failed[0].message}{more}")
