"""Save what was chosen by hand: the ordinary proof, the ordinary validation, and only then the ordinary file."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autotune.errors import InfeasibleError
from autotune.formats.controller_record import Controller
from autotune.tuning.manual_design import judge_design
from autotune.tuning.optimize import certify
from autotune.tuning.search import SearchResult
from autotune.validation.axis_proof import ProofOptions

from .source import Exploration, keep_deadband
from .target import Target

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Saved:
    """What was written: the file, the short form of its checksum, the worst peak of each axis [N], checks passed.

    `replaced` says which file stood there before, "" for none.
    """

    path: Path
    checksum: str
    replaced: str
    peak_n: Mapping[str, float]
    checks: int


def save_controller(
    exploration: Exploration, designs: Mapping[str, FloatArray], target: Target, expected: str | None = None
) -> Saved:
    """Judge a design (n,) of every axis over the whole uncertainty, prove, validate, and write `controller.yaml`.

    `expected` is what the page says to stand there (`Target.standing`). Raises InfeasibleError for a design that misses
    something, CertificateError for a claim that cannot be proved or verified, UsageError where the file cannot be
    written or is no longer the expected one, SaveInterruptedError once the target has ended; nothing is written then.
    """
    searches: dict[str, SearchResult] = {}
    checks = 0

    def make(progress: Callable[[float], None]) -> Controller:
        nonlocal checks
        for name, start in exploration.axes.items():
            try:
                searches[name] = judge_design(start.problem, designs[name])
            except InfeasibleError as error:
                raise InfeasibleError(f"Axis {name}: {error}") from error
            progress(0.0)
        controller, report = certify(
            searches, exploration.payload, exploration.provenance, ProofOptions(), progress, exploration.threshold
        )
        checks = len(report.checks)
        return keep_deadband(exploration, controller)

    written = target.save(make, expected)
    return Saved(
        path=target.path,
        checksum=written.checksum,
        replaced=written.replaced,
        peak_n={name: search.evaluation.peak_n for name, search in searches.items()},
        checks=checks,
    )
