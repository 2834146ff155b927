"""What can go wrong between a log and plant parameters."""

from problems.errors import AutotuneError


class LogError(AutotuneError):
    """The log cannot be used: damaged, empty, wrong type, missing or ambiguous channel."""


class EstimateError(AutotuneError):
    """The log is sound but does not tell what was asked of it."""
