"""Save what was chosen by hand: the ordinary proof, the ordinary validation, and only then the ordinary file."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autotune.errors import InfeasibleError
from autotune.files.canonical import short
from autotune.files.controller import write_controller
from autotune.tuning.chosen import judge_design
from autotune.tuning.optimize import certify
from autotune.validation.continuous import ProofWishes

from .source import Exploration, keep_deadband

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Saved:
    """What was written: the file, the short form of its checksum, the worst peak of each axis [N], checks passed."""

    path: Path
    checksum: str
    peak_n: Mapping[str, float]
    checks: int


def save_controller(
    exploration: Exploration,
    designs: Mapping[str, FloatArray],
    path: Path,
    progress: Callable[[float], None] | None = None,
) -> Saved:
    """Judge a design (n,) of every axis over the whole uncertainty, prove, validate, and write `controller.yaml`.

    Raises InfeasibleError for a design that misses something, CertificateError for a claim that cannot be proved or
    verified, UsageError where the file cannot be written; nothing is written then.
    """
    searches = {}
    for name, start in exploration.axes.items():
        try:
            searches[name] = judge_design(start.problem, designs[name])
        except InfeasibleError as error:
            raise InfeasibleError(f"Axis {name}: {error}") from error
    told = progress if progress is not None else _silent
    controller, report = certify(
        searches, exploration.payload, exploration.provenance, ProofWishes(), told, exploration.threshold
    )
    checksum = write_controller(path, keep_deadband(exploration, controller))
    return Saved(
        path=path,
        checksum=short(checksum),
        peak_n={name: search.evaluation.peak_n for name, search in searches.items()},
        checks=len(report.checks),
    )


def _silent(_: float) -> None:
    return None
