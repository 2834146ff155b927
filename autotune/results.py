"""What `identify` and `Design.validate` return: the plant of a log, and the checks of a controller."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from autotune.arguments import file_path, in_arguments
from autotune.formats.atomic import check_target
from autotune.formats.identified import IN_MEMORY, IdentifiedFile, identified_tree, write_identified
from autotune.formats.yaml12 import dump_yaml
from autotune.shown import ResultTable, Shown, data_frame
from autotune.text import parameter_rows, si_parameters
from autotune.validation.report import Check, ValidationReport
from identification.errors import EstimateError
from identification.evidence import Evidence
from identification.result import Finding, Identified
from problems.frozen import freeze

_CONTRADICTIONS = frozenset({"given-contradicts", "logs-disagree"})
_ALL_THE_SAME = " With --allow-partial what was found is written all the same."
_EXPLAINING = frozenset(
    {"clock-offset", "hand-in-contact", "rests-without-spring", "mass-disagreement", "salvaged", "salvaged-span"}
)


def finding_notes(findings: Sequence[Finding]) -> list[str]:
    """Return what should not be overlooked of findings, a sentence or two each."""
    shown = [each for each in findings if each.severity != "info"]
    return [in_arguments(f"{each.severity}: {each.message} {each.advice}".rstrip()) for each in shown]


@dataclass(frozen=True, kw_only=True, repr=False)
class Identification(Shown):
    """Plant parameters with deviations and verdicts, and where they come from.

    Attributes
    ----------
    result
        Payload, sensor and axes, every parameter as an `Estimate` with value, std and status.
    provenance
        Logs, digests, channels, clocks and options: the `provenance` of `identified.yaml`.
    evidence
        The signals of each recording where they were kept, in the order of `result.timelines`.
    names
        Names of the logs.
    path
        The file that it was loaded from; None where it was identified here.
    sha256
        Digest of that file.

    """

    result: Identified
    provenance: Mapping[str, Any]
    evidence: tuple[Evidence, ...] = field(default=(), compare=False)
    names: tuple[str, ...] = ()
    path: Path | None = None
    sha256: str | None = None

    def __post_init__(self) -> None:
        freeze(self, "provenance")

    def require(self) -> None:
        """Raise EstimateError where a parameter that a controller needs is missing, or logs disagree on one."""
        if any(finding.severity == "error" for finding in self.result.findings):
            raise EstimateError(_refusal(self.names, self.result.findings))

    def _headline(self) -> str:
        axes = ", ".join(self.result.axes) or "none"
        return f"Identification of {', '.join(self.names) or 'a plant'}: axes {axes}"

    def _tables(self) -> Iterator[ResultTable]:
        yield ResultTable(
            title="parameters",
            columns=("parameter", "value", "± std", "unit", "verdict"),
            rows=tuple((row.name, row.value, row.std, row.unit, row.verdict) for row in parameter_rows(self.result)),
        )

    def _notes(self) -> Sequence[str]:
        return finding_notes(self.result.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the tree of `identified.yaml`."""
        return identified_tree(self.result, self.provenance)

    def to_pandas(self) -> Any:
        """Return the parameters as a pandas.DataFrame of SI numbers, NaN where there is none.

        Columns are `value`, `std` (one standard deviation), `status` and `unit`; the index are the places in
        `identified.yaml`, as in `payload.mass_kg` and `axes.x.coupling.stiffness_n_per_m`, `.x` behind that for a
        component of a vector and `.0` for a coefficient.

        Raises
        ------
        UsageError
            pandas is not installed.

        """
        rows = list(si_parameters(self.to_dict()))
        columns = {name: [getattr(row, name) for row in rows] for name in ("value", "std", "status", "unit")}
        return data_frame(columns, [row.name for row in rows])

    def save(self, path: Path | str) -> str:
        """Write `identified.yaml` in one step and return its sha256.

        Raises UsageError where it cannot be written, or a file of another kind would be lost.
        """
        target = file_path("path", path)
        check_target(target, kind="identified", option="path")
        return write_identified(target, self.result, self.provenance)

    def file(self) -> IdentifiedFile:
        """Return it as a file is handed on: with the digest of the bytes that `save` would write."""
        path = self.path or IN_MEMORY
        digest = self.sha256 or sha256(dump_yaml(self.to_dict()).encode()).hexdigest()
        return IdentifiedFile(result=self.result, provenance=self.provenance, path=path, sha256=digest)


@dataclass(frozen=True, kw_only=True, repr=False)
class Validation(Shown):
    """What was verified of a controller, check by check.

    Attributes
    ----------
    checks
        Each with `axis`, `name`, `passed`, `message` and `verdict` (ok, note or FAILED).

    """

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def require(self) -> None:
        """Raise CertificateError with the first check that failed."""
        ValidationReport(checks=self.checks).require()

    def _headline(self) -> str:
        failed = sum(not check.passed for check in self.checks)
        return f"Validation: {len(self.checks)} checks, " + (f"{failed} FAILED" if failed else "all passed")

    def _tables(self) -> Iterator[ResultTable]:
        rows = tuple((each.axis, each.name, each.verdict, each.message) for each in self.checks)
        yield ResultTable(title="checks", columns=("axis", "check", "verdict", "what was found"), rows=rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the checks as plain data."""
        return {"passed": self.passed, "checks": [each.to_dict() for each in self.checks]}

    def to_pandas(self) -> Any:
        """Return the checks as a pandas.DataFrame; raises UsageError without pandas."""
        return data_frame({name: [getattr(each, name) for each in self.checks] for name in _CHECK_COLUMNS})


_CHECK_COLUMNS = ("axis", "name", "verdict", "message")


def _refusal(names: Sequence[str], findings: Sequence[Finding]) -> str:
    """Return one sentence: a contradiction first, since what is missing may follow from it; then what explains it."""
    missing = [finding for finding in findings if finding.severity == "error"]
    missing = sorted(missing, key=lambda finding: finding.code not in _CONTRADICTIONS)
    first = missing[0]
    others = f" Also: {' '.join(finding.message for finding in missing[1:])}" if missing[1:] else ""
    noticed = [finding.message for finding in findings if finding.code in _EXPLAINING and finding.severity != "info"]
    others += f" Noticed: {' '.join(noticed)}" if noticed else ""
    return f"{', '.join(names)}: {first.message} {first.advice}".rstrip() + others + _ALL_THE_SAME
