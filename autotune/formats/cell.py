"""`cell.yaml`: what the logs of a cell cannot say of themselves; reading one, and writing one to start from."""

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from autotune.errors import UsageError
from identification.logs.guess import CellGuess
from identification.logs.guess_trace import Entry
from identification.logs.roles.cell import Cell
from identification.logs.roles.registry import Role
from identification.logs.summary import Candidate, LogSummary, RoleSummary
from problems.frozen import FrozenDict

from .atomic import write_atomic
from .kinds import name_of
from .records import EntryError, read_record
from .schema import Violation, check_format, violations
from .yaml12 import Document, load_document, parse_document

_NAME = "cell"
FORMAT = f"autotune/{_NAME}"
_BARE = re.compile(r"[A-Za-z_][\w./·-]*")


@dataclass(frozen=True, kw_only=True)
class CellFile:
    """A cell as a file declares it, with the path and the sha256 of the file's bytes."""

    cell: Cell
    path: Path
    sha256: str


def read_cell(path: Path) -> CellFile:
    """Read `cell.yaml`; raises UsageError with file, line and reason for anything unknown or contradictory."""
    document = load_document(path, error=UsageError)
    cell = _cell(document)
    if cell.joints is not None:
        cell = replace(cell, joints=replace(cell.joints, urdf=path.parent / cell.joints.urdf))
    return CellFile(cell=cell, path=path, sha256=document.sha256)


def check_cell_text(text: str, path: Path) -> Cell:
    """Read a text as if it were in `path`; raises UsageError as `read_cell` does."""
    return _cell(parse_document(text.encode(), path, error=UsageError, exact=False))


def _cell(document: Document) -> Cell:
    check_format(document, _NAME)
    found = min(
        violations(document.tree, _NAME),
        key=lambda violation: (document.line(violation.place), len(violation.place)),
        default=None,
    )
    if found is not None:
        document.refuse(found.place, f"{found.entry} must be {found.must}, found {found.found}{_order(found)}.")
    tree = {key: value for key, value in document.tree.items() if key not in ("format", "version")}
    try:
        return read_record(Cell, tree)
    except EntryError as error:
        document.refuse(error.place, str(error).rstrip(".") + ".")


def _order(violation: Violation) -> str:
    """Say what the entries of six signs are, where there are fewer."""
    if violation.place[-1:] == ("signs",) and violation.rule == "minItems" and violation.place[0] != "pose":
        return ": force x y z, then torque x y z"
    return ""


_THREE, _SIX = '["…", "…", "…"]', '["…", "…", "…", "…", "…", "…"]'
_FIELDS: Mapping[Role, str] = FrozenDict(
    {
        Role.WRENCH: f"fields: {{force: {_THREE}, torque: {_THREE}}}",
        Role.POSE: f"fields: {{position: {_THREE}, orientation: {_THREE}}}",
        Role.COMMAND: f"fields: {{position: {_THREE}, orientation: {_THREE}}}",
        Role.TWIST: f"fields: {{linear: {_THREE}, angular: {_THREE}}}",
        Role.GAINS: f"fields: {{mass: {_SIX}, damping: {_SIX}}}",
        Role.DESIRED_FORCE: f"fields: {{force: {_THREE}, torque: {_THREE}}}",
    }
)
_QUESTIONS: Mapping[Role, Sequence[tuple[str, str]]] = FrozenDict(
    {
        Role.WRENCH: (
            ("units: {force: N, torque: N·m}", "or kN, lbf, kgf; N·mm, kN·m, lbf·in, lbf·ft"),
            ("expressed_in: sensor", "in whose axes: sensor, flange or base"),
            ("exerted_by: payload", "payload: its weight shows along gravity; sensor: against gravity"),
            ("signs: [1, 1, 1, 1, 1, 1]", "of force x y z and torque x y z"),
            ("gravity_compensated: false", "true if the payload's weight was removed before recording"),
            ("deadband: {type: subtractive, force_n: 2.0, torque_n_m: 0.2}", "or threshold; leave out without one"),
            ("saturation: {force_n: [500.0, 500.0, 1500.0]}", "the sensor's range; torque_n_m likewise"),
        ),
        Role.POSE: (
            ("units: {position: m, angle: rad}", "or mm, cm, in; deg"),
            ("orientation_as: quaternion_xyzw", "or quaternion_wxyz, rotation_vector, euler_ZYZ, euler_xyz, …"),
        ),
        Role.COMMAND: (
            ("units: {position: m, angle: rad}", "or mm, cm, in; deg"),
            ("orientation_as: quaternion_xyzw", "as of the pose"),
            ("clock_offset_s: 0.0", "added to the stamps to bring them to the wrench's clock, if known"),
        ),
        Role.TWIST: (("expressed_in: base", "in whose axes: sensor, flange or base"),),
        Role.GAINS: (),
        Role.DESIRED_FORCE: (("units: {force: N, torque: N·m}", "or kN, lbf, kgf; N·mm, kN·m, lbf·in, lbf·ft"),),
    }
)
_TABLE = """
# CSV or Parquet: the time column and its unit (s, ms, us, ns), the rate of a table without one, or that each row is the
# mean of a rest; of several tables `tables: {force.csv: {…}, pose.csv: {…}}`.
# table: {time: t, time_unit: s}
# table: {sample_rate_hz: 1000.0}
# table: {rows: poses}
"""
_END = """
# The sensor's orientation on the flange (flange from sensor); no turn if left out.
# sensor: {orientation: [0.0, 0.0, 0.0, 1.0], orientation_as: quaternion_xyzw}

# Where gravity points in the base frame.
# gravity_direction: [0.0, 0.0, -1.0]

# The controller's period in s, if it holds each command until the next one.
"""


def check_new(path: Path, *, force: bool) -> None:
    """Raise UsageError if a file exists where a cell.yaml is to begin, unless `force`."""
    if path.exists() and not force:
        raise UsageError(f"{path} exists; name another file, or use --force to replace it.")


def write_cell_start(path: Path, summary: LogSummary, guess: CellGuess | None = None, *, force: bool = False) -> None:
    """Write a cell.yaml to start from; raises UsageError if `path` exists (unless `force`) or cannot be written."""
    check_new(path, force=force)
    text = cell_text(summary, guess)
    check_cell_text(text, path)
    write_atomic(path, text)


def cell_text(summary: LogSummary, guess: CellGuess | None = None) -> str:
    """Return the text of a cell.yaml to start from.

    Every line that is not a comment was found in the log, or guessed from names and values with the evidence beside it.
    """
    guess = guess or CellGuess()
    lines = [
        f"# Begun by `autotune inspect` from {_plain(name_of(summary.path))}. Lines without # were found in the log,",
        "# or guessed where evidence follows them: check those. The others are questions: answer those that",
        "# matter and take the # away. docs/cell.md says what they mean.",
        "format: autotune/cell",
        "version: 1",
    ]
    if summary.numbers:
        lines += ["", "# Numbers whose meaning the log does not show:"]
        lines += [f"#   {_plain(found.topic)}: {_plain(found.short)}" for found in summary.numbers]
    for topic, ranges in guess.others.items():
        lines += [f"# Neither names nor values say what these of {_plain(topic)} are:"]
        lines += [f"#   {_plain(each)}" for each in ranges]
    for topic, (paths, evidence) in guess.joints.items():
        lines += [
            f"# {_plain(paths[0])} to {_plain(paths[-1])} of {_plain(topic)} are joint angles ({_plain(evidence)}).",
            "# Where there is no pose, the robot's URDF makes one of them:",
            f"# joints: {{urdf: robot.urdf, tip: tool0, topic: {_flow(topic)}, positions: {_flow(list(paths))}}}",
        ]
    for role in summary.roles:
        entry = "displacement" if guess.is_displacement and role.role is Role.POSE else role.entry
        of_type = guess.wrenches.get(role.topic or "", ()) if role.role is Role.WRENCH else ()
        lines += ["", *_role_lines(replace(role, entry=entry), guess.roles.get(role.role, of_type))]
    tables = [channel.topic for channel in summary.channels if channel.encoding == "table"]
    return "\n".join(lines) + "\n" + "\n".join(_table_lines(tables, guess)) + _END + _period(summary)


def _period(summary: LogSummary) -> str:
    """Return the question for the controller's period in s, beside which the log's own is no answer."""
    topics = {each.topic for each in summary.roles if each.role is Role.COMMAND}
    gaps = [each.median_gap_s for each in summary.channels if each.topic in topics]
    if gaps and gaps[0]:
        return f"# sample_time_s: {gaps[0]:.6g}  # as far as the logged commands are apart; is it the controller's?\n"
    return "# sample_time_s: 0.001  # an example\n"


def _table_lines(topics: Sequence[str], guess: CellGuess) -> Iterator[str]:
    """Yield how the tables are timed: as guessed, else as a question."""
    if not topics:
        return
    if any(topic not in guess.tables for topic in topics):
        yield _TABLE.rstrip("\n")
    if len(topics) == 1 and topics[0] in guess.tables:
        yield ""
        yield _entry_line(guess.tables[topics[0]], "")
    elif guess.tables:
        yield ""
        yield "tables:"
        yield from (_entry_line(replace(entry, key=topic), "  ") for topic, entry in guess.tables.items())
    yield ""


def _entry_line(entry: Entry, start: str) -> str:
    """Write an entry as a line of YAML with its evidence behind it."""
    remark = f"  # {_plain(entry.evidence)}" if entry.evidence else ""
    return f"{start}{_flow(entry.key)}: {_flow(entry.value)}{remark}"


def _flow(value: object) -> str:
    """Write plain data in YAML's flow style; JSON is that, only with more quotes."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    is_plain = isinstance(value, str) and _BARE.fullmatch(value) and value.lower() not in ("true", "false", "null")
    return str(value) if is_plain else json.dumps(value, ensure_ascii=False)


def _role_lines(role: RoleSummary, guessed: Sequence[Entry]) -> Iterator[str]:
    if role.topic is not None:
        yield f"# {_plain(role.reason)}"
        yield f"{role.entry}:"
        yield f"  topic: {_quoted(role.topic)}"
        if role.parent is not None and role.child is not None:
            yield f"  parent: {_quoted(role.parent)}"
            yield f"  child: {_quoted(role.child)}"
        yield from (_entry_line(entry, "  ") for entry in guessed)
        yield from _questions(role, "  # ", answered={entry.key for entry in guessed})
        return
    if guessed:
        yield f"{role.entry}:"
        yield from (_entry_line(entry, "  ") for entry in guessed)
        yield from _questions(role, "  # ", answered={entry.key for entry in guessed})
        return
    if not role.candidates:
        yield f"# The log has no channel for `{role.entry}`."
        return
    yield f"# Which of these is `{role.entry}`?"
    yield from (f"#   {_plain(_candidate_text(candidate))}" for candidate in role.candidates)
    yield f"# {role.entry}:"
    yield f"#   topic: {_quoted(role.candidates[0].topic if len(role.candidates) == 1 else '…')}"
    if role.needs_fields:
        yield f"#   {_FIELDS[role.role]}"
    yield from _questions(role, "#   ")


def _questions(role: RoleSummary, start: str, answered: Collection[str] = ()) -> Iterator[str]:
    questions = [each for each in _QUESTIONS[role.role] if each[0].partition(":")[0] not in answered]
    width = max((len(entry) for entry, _ in questions), default=0)
    yield from (f"{start}{entry:{width}}  # {choices}" for entry, choices in questions)


def _candidate_text(candidate: Candidate) -> str:
    rate = "" if candidate.rate_hz is None else f", {candidate.rate_hz:.1f} Hz"
    frame = f", frame {candidate.frame}" if candidate.frame else ""
    return f"{candidate.topic} ({candidate.type or 'no type'}, {candidate.count} messages{rate}{frame})"


def _quoted(text: str) -> str:
    """Return a text as YAML: double quotes with the escapes of JSON mean the same to both."""
    return '"…"' if text == "…" else json.dumps(text)


def _plain(text: str) -> str:
    """Return a text for a comment: one line, nothing that a reader of YAML would refuse."""
    return "".join(character if character.isprintable() else "?" for character in text)
