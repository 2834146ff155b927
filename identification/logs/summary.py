"""The summary of logs that `inspect` prints."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..result import Finding
from .numbers import NumberFields
from .roles.registry import Role


@dataclass(frozen=True, kw_only=True)
class ChannelSummary:
    """One channel; times in s. Rate, gaps and steps are those of the header stamps if there are any (`clock`).

    `header_minus_log_s` is the median offset of the header clock from the recording clock.
    """

    topic: str
    type: str
    encoding: str
    count: int
    clock: str
    rate_hz: float | None
    median_gap_s: float | None
    max_gap_s: float | None
    backwards_steps: int
    duplicates: int
    header_minus_log_s: float | None
    frame_ids: tuple[str, ...]
    roles: tuple[Role, ...]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A channel that could serve a role; `frame` is that of the first header."""

    topic: str
    type: str
    count: int
    frame: str | None
    rate_hz: float | None = None


@dataclass(frozen=True, kw_only=True)
class RoleSummary:
    """Which channel serves a role and why, or why none does; `candidates` could serve it.

    `needs_fields` says that their numbers would have to be declared. `parent` and `child` are the frames where a
    transform is read.
    """

    role: Role
    entry: str
    topic: str | None
    reason: str
    candidates: tuple[Candidate, ...]
    needs_fields: bool
    parent: str | None = None
    child: str | None = None


@dataclass(frozen=True, kw_only=True)
class LogSummary:
    """The summary of logs; `missing` holds one sentence for each thing `identify` lacks.

    `path`, `container` and `sha256` are those of the first log, `size_bytes` is the size of all; `sha256s` holds the
    digest of every log.
    """

    path: Path
    container: str
    sha256: str
    size_bytes: int
    start_ns: int
    end_ns: int
    channels: tuple[ChannelSummary, ...]
    roles: tuple[RoleSummary, ...]
    numbers: tuple[NumberFields, ...]
    findings: tuple[Finding, ...]
    missing: tuple[str, ...]
    sha256s: Mapping[str, str]
