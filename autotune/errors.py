"""Errors of the tool itself; the exit code of each branch is chosen in `autotune.cli`."""

import math
from collections.abc import Mapping
from typing import Any

from problems.errors import AutotuneError


class UsageError(AutotuneError):
    """The request contradicts itself or names something that does not exist."""

    def __init__(self, message: str, *, to_paste: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.to_paste = to_paste


class InfeasibleError(AutotuneError):
    """No controller within the bounds meets the requirements.

    `relaxations` are the single requirements that would be enough to ease, and by how much: name, asked, possible.
    `bare` is the message without what some design misses, for where the relaxations are listed instead. `missed` is the
    share of a requirement that the closest design found misses, infinite where nothing was found to be stable.
    `suggestion` is a part of `problem.yaml` with which a search found a controller.
    """

    def __init__(
        self,
        message: str,
        relaxations: tuple[tuple[str, float, float], ...] = (),
        *,
        bare: str | None = None,
        missed: float = math.inf,
        suggestion: Mapping[str, Any] | None = None,
        to_paste: tuple[str, ...] = (),
    ) -> None:
        super().__init__(message)
        self.relaxations, self.missed, self.suggestion = relaxations, missed, dict(suggestion or {})
        self.to_paste = to_paste
        self.bare = message.removesuffix(".") if bare is None else bare


class CertificateError(AutotuneError):
    """A file is altered, not validated, out of its domain, or its claim does not hold."""


__all__ = ["AutotuneError", "CertificateError", "InfeasibleError", "UsageError"]
