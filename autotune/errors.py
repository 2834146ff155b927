"""Errors of the tool itself; the exit code of each branch is chosen in `autotune.cli`."""

from problems.errors import AutotuneError


class UsageError(AutotuneError):
    """The request contradicts itself or names something that does not exist."""


class InfeasibleError(AutotuneError):
    """No controller within the bounds meets the requirements."""


class CertificateError(AutotuneError):
    """A file is altered, not validated, out of its domain, or its claim does not hold."""


__all__ = ["AutotuneError", "CertificateError", "InfeasibleError", "UsageError"]
