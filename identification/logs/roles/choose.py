"""Decide which channel serves as what, from type, name, frame and rate. Never guess."""

from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

from ...errors import LogError, listed
from ...result import Finding
from ...signals.recording import AXES
from ..containers.channel import ChannelInfo, Infos
from .cell import Cell, DesiredForceSource, GainsSource, JointsSource, PoseSource, Source, WrenchSource
from .registry import (
    JOINT_STATE,
    ROBOT_STATES,
    ROLES,
    TRANSFORMS,
    FieldPaths,
    Role,
    ambiguous_sentence,
    is_command_name,
    is_processed_name,
    is_undeclared,
    layout_of,
    missing_sentence,
    roles_of,
)

_TABLE, _TABLE_ENDINGS = "table", (".csv", ".tsv", ".txt", ".parquet")

FramesOf = Callable[[ChannelInfo], tuple[tuple[str, str], ...]]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A channel that serves a role: the paths of its numbers (None for those it lacks) and of its header.

    `frames` is the pair (parent, child) where a transform is read; `layout` is that of the type, None where the cell
    declares the paths; `of_joints` says that its numbers are joint positions, of the messages that hold `only`;
    `reason` says why it was taken.
    """

    role: Role
    info: ChannelInfo
    fields: tuple[str | None, ...]
    header: str
    frames: tuple[str, str] | None = None
    of_joints: bool = False
    only: bytes = b""
    layout: FieldPaths | None = None
    reason: str


def choose_all(infos: Infos, cell: Cell, log: str, frames_of: FramesOf) -> dict[Role, Choice]:
    """Return the channel of each role that the log or the cell determines.

    Raises LogError for a wrench, pose or command that is missing or ambiguous (a missing command is none, as is a
    wrench beside pose and command), and for anything declared that the log does not have.
    """
    chosen = {}
    for role in ROLES:
        if role is Role.WRENCH and _is_without_wrench(infos, cell, log, frames_of):
            continue
        found = choose(role, infos, cell, log, frames_of)
        if found is not None:
            chosen[role] = found
    return chosen


def _is_without_wrench(infos: Infos, cell: Cell, log: str, frames_of: FramesOf) -> bool:
    """Return whether nothing can be a wrench, and command and pose are there, which show the robot by themselves."""
    if cell.wrench is not None or _candidates(Role.WRENCH, None, infos, set()):
        return False
    try:
        return all(choose(role, infos, cell, log, frames_of) is not None for role in (Role.POSE, Role.COMMAND))
    except LogError:
        return False


def choose(role: Role, infos: Infos, cell: Cell, log: str, frames_of: FramesOf) -> Choice | None:
    """Return the channel of one role, None where an optional one is not there; see `choose_all`.

    Joints serve as pose or command where nothing else does.
    """
    joints = cell.joints if role in (Role.POSE, Role.COMMAND) else None
    try:
        found = _choose(role, infos, cell, log, frames_of)
    except LogError:
        if joints is None or source_of(cell, role) is not None:
            raise
        found = None
    return choose_joints(role, joints, infos, log) if found is None and joints is not None else found


def choose_joints(role: Role, joints: JointsSource, infos: Infos, log: str) -> Choice | None:
    """Return the channel of the measured or commanded joints; there need be none of the latter."""
    is_command = role is Role.COMMAND
    topic = joints.command_topic if is_command else joints.topic
    if topic is not None:
        found = [info for info in infos if info.count and info.channel.topic == topic]
    else:
        columns = set(joints.command_positions if is_command else joints.positions)
        states = [info for info in infos if info.count and info.channel.type_name == JOINT_STATE]
        found = [info for info in states if is_command_name(info.channel.topic) == is_command]
        found += [info for info in infos if info.columns and columns and _has_columns(info, columns)]
    if not found and is_command and topic is None:
        return None
    if len(found) != 1:
        entry = "command_topic" if is_command else "topic"
        there = listed([str(info) for info in found or infos], empty="nothing")
        raise LogError(
            f"{log} must have one channel of {'commanded' if is_command else 'measured'} joint positions, found "
            f"{len(found)}{f' called {topic}' if topic else ''}; name it with `joints: {{{entry}: …}}` in cell.yaml: "
            f"{there}."
        )
    header = joints.header if joints.header is not None else ("header" if found[0].has_header else "")
    why = f"joint positions through {joints.urdf.name} up to {joints.tip}"
    return Choice(role=role, info=found[0], fields=(), header=header, of_joints=True, reason=why)


def _choose(role: Role, infos: Infos, cell: Cell, log: str, frames_of: FramesOf) -> Choice | None:
    source = source_of(cell, role)
    if isinstance(source, DesiredForceSource | GainsSource) and source.is_known:
        return None
    fields = declared_fields(source)
    if source is not None and fields is not None:
        return _declared(role, source, fields, infos, log, cell)
    if isinstance(source, PoseSource) and source.parent is not None and source.child is not None:
        return _transform(role, source, (source.parent, source.child), infos, log, frames_of)
    if source is not None and source.topic is not None:
        _check_distinct(role, cell, infos)
        found = _named(role, source.topic, infos, log, cell)
    else:
        candidates = _candidates(role, source, infos, _taken(cell, role))
        if not candidates and not ROLES[role].is_required and source is None:
            return None
        if len(candidates) > 1 and not ROLES[role].option and source is None:
            return None
        found = _only(role, candidates, infos, log, source)
    return _by_type(role, found, source, log, frames_of)


def spelled_as_in(cell: Cell, infos: Infos) -> Cell:
    """Return the cell with its topics as the log spells them: with or without a slash in front.

    Where the log is one table, it is meant whatever the table was called for which the cell was written.
    """
    topics = {info.channel.topic for info in infos}
    is_table = len(infos) == 1 and infos[0].channel.encoding == _TABLE
    for name in (*(kind.entry for kind in ROLES.values()), "displacement"):
        source = getattr(cell, name, None)
        if source is None or source.topic is None or source.topic in topics:
            continue
        same = [topic for topic in topics if topic.strip("/") == source.topic.strip("/")]
        if is_table and source.topic.lower().endswith(_TABLE_ENDINGS):
            same = [*topics]
        if len(same) == 1:
            cell = replace(cell, **{name: replace(source, topic=same[0])})
    return cell


def with_meanings(cell: Cell, choices: Iterable[Choice]) -> tuple[Cell, tuple[Finding, ...]]:
    """Return the cell with what the types of the chosen channels say where it declares nothing, and cautions."""
    cautions = []
    for choice in choices:
        meaning = None if choice.layout is None else choice.layout.meaning
        if choice.layout is None or meaning is None:
            continue
        is_relative = choice.role is Role.POSE and cell.displacement is not None
        name = "displacement" if is_relative else ROLES[choice.role].entry
        declared = getattr(cell, name) or type(meaning)()
        said = {each.name: each.default for each in fields(meaning) if each.default is not MISSING}
        left = {key: getattr(meaning, key) for key, usual in said.items() if getattr(declared, key) == usual}
        is_declared = all(getattr(meaning, key) == said[key] for key in left)
        change: dict[str, Any] = {name: replace(declared, **left)}
        cell = replace(cell, **change)
        if choice.layout.caution is not None and not is_declared:
            caution = choice.layout.caution
            cautions.append(replace(caution, message=caution.message.format(topic=choice.info.channel.topic)))
    return cell, tuple(cautions)


def candidates_of(role: Role, infos: Infos, cell: Cell) -> list[ChannelInfo]:
    """Return the channels that could serve a role by type and name, else those whose numbers could if declared."""
    by_type = _candidates(role, None, infos, _taken(cell, role))
    return by_type or [info for info in infos if info.count and is_undeclared(info)]


def open_questions(infos: Infos, cell: Cell, log: str) -> tuple[Finding, ...]:
    """List which roles that `identify` can do without were left empty because several channels could serve them."""
    found = []
    for role in (role for role, kind in ROLES.items() if not kind.option):
        candidates = _candidates(role, None, infos, set())
        if source_of(cell, role) is None and len(candidates) > 1:
            sentence = ambiguous_sentence(role, candidates, log)
            found.append(Finding.info("role-open", sentence, "None is used."))
    return tuple(found)


def source_of(cell: Cell, role: Role) -> Source | None:
    """Return what the cell declares of a role."""
    return (cell.pose or cell.displacement) if role is Role.POSE else getattr(cell, ROLES[role].entry, None)


def declared_fields(source: Source | None) -> tuple[str | None, ...] | None:
    """Return the declared paths of a role's numbers in the order that the role has them, None without any."""
    fields = getattr(source, "fields", None)
    if fields is None:
        return None
    return tuple(path for vector in vars(fields).values() for path in vector)


def _taken(cell: Cell, role: Role) -> set[str]:
    """Return topics that the cell gives to the other of measured and commanded pose."""
    others = {Role.POSE: (cell.command,), Role.COMMAND: (cell.pose, cell.displacement)}.get(role, ())
    return {source.topic for source in others if source is not None and source.topic is not None}


def _candidates(role: Role, source: Source | None, infos: Infos, taken: set[str]) -> list[ChannelInfo]:
    """Return the channels that are plausible by type and name, of the first tier that has any."""
    frame = None if source is None else source.frame
    for types in ROLES[role].tiers:
        found = [
            info
            for info in infos
            if info.count
            and info.channel.type_name in types
            and role in roles_of(info.channel)
            and (info.channel.topic not in taken or info.channel.type_name in ROBOT_STATES)
            and frame in (None, info.frame)
        ]
        if role is Role.WRENCH:
            raw = [info for info in found if not is_processed_name(info.channel.topic)]
            # What a robot publishes beside its state is a part of it, of which the type says less.
            has_state = any(info.count and info.channel.type_name in ROBOT_STATES for info in infos)
            found = raw or ([] if has_state else found)
        lasting = [info for info in found if info.count > 1]
        if found:
            return lasting or found
    return []


def _only(role: Role, found: Infos, infos: Infos, log: str, source: Source | None) -> ChannelInfo:
    if len(found) == 1:
        return found[0]
    if not found:
        raise LogError(missing_sentence(role, log, infos, source))
    raise LogError(ambiguous_sentence(role, found, log))


def _named(role: Role, topic: str, infos: Infos, log: str, cell: Cell) -> ChannelInfo:
    kinds = [name for types in ROLES[role].tiers for name in types]
    fitting = [
        info
        for info in infos
        if info.count and info.channel.type_name in kinds and info.channel.encoding in ("cdr", "ros1")
    ]
    found = [info for info in fitting if info.channel.topic == topic]
    if len(found) == 1:
        return found[0]
    others = listed(info.channel.topic for info in fitting)
    same_name = [info for info in infos if info.channel.topic == topic]
    if found:
        reason = f"Topic `{topic}` is in {log} more than once: {listed(found)}"
    elif not same_name:
        reason = f"Topic `{topic}` is not in {log}"
    elif not any(info.count for info in same_name):
        reason = f"Topic `{topic}` holds no message in {log}"
    else:
        is_type = same_name[0].channel.type_name or "of no known type"
        reason = f"Topic `{topic}` in {log} is {is_type}, the {ROLES[role].label} must be {kinds[0]}"
        if is_undeclared(same_name[0]):
            entry = f"{ROLES[role].entry}: {{topic: {topic}, fields: …}}"
            reason += f" or have its layout declared with `{entry}` in cell.yaml"
    remedy = "" if ROLES[role].option else f" {_remedy(topic, cell)}"
    raise LogError(f"{reason}; topics of that type: {others}.{remedy}")


def _remedy(topic: str, cell: Cell) -> str:
    """Return which entries of the cell name a topic, and what to do with them."""
    roles = [role for role in ROLES if getattr(source_of(cell, role), "topic", None) == topic]
    entries = {role: "displacement" if _is_displacement(role, cell) else ROLES[role].entry for role in roles}
    needed = [entry for role, entry in entries.items() if ROLES[role].is_required]
    spare = [entry for role, entry in entries.items() if not ROLES[role].is_required]
    named = ", ".join(f"`{entry}`" for entry in (*needed, *spare))
    delete = f", or delete {', '.join(f'`{entry}`' for entry in spare)} with all that is below" if spare else ""
    return f"Correct the `topic` of {named} in cell.yaml{delete}."


def _is_displacement(role: Role, cell: Cell) -> bool:
    return role is Role.POSE and cell.pose is None and cell.displacement is not None


def _check_distinct(role: Role, cell: Cell, infos: Infos) -> None:
    measured = source_of(cell, Role.POSE)
    if (
        role is Role.COMMAND
        and measured is not None
        and cell.command is not None
        and measured.topic == cell.command.topic
        and declared_fields(measured) is None
        and not any(i.channel.topic == measured.topic and i.channel.type_name in ROBOT_STATES for i in infos)
    ):
        raise LogError(f"Topic `{measured.topic}` cannot be the measured and the commanded pose at once.")


def _by_type(role: Role, info: ChannelInfo, source: Source | None, log: str, frames_of: FramesOf) -> Choice:
    layout = layout_of(role, info.channel)
    pair = None
    if info.channel.type_name in TRANSFORMS:
        pairs = frames_of(info)
        if len(pairs) != 1:
            found = ", ".join(f"{child} in {parent}" for parent, child in pairs) or "none"
            raise LogError(
                f"Topic {info.channel.topic} of {log} holds {len(pairs)} transforms, of which one may be the "
                f"{ROLES[role].label}: {found}; say which with `{ROLES[role].entry}: {{parent: …, child: …}}` in "
                "cell.yaml."
            )
        pair = pairs[0]
    header = layout.header
    if source is not None and source.header is not None:
        header = source.header
    named = source is not None and source.topic is not None
    why = "named by you" if named else f"the only plausible {info.channel.type_name}"
    paths = _measured(layout.fields, source)
    return Choice(role=role, info=info, fields=paths, header=header, frames=pair, layout=layout, reason=why)


def _declared(role: Role, source: Source, fields: tuple[str | None, ...], infos: Infos, log: str, cell: Cell) -> Choice:
    wanted = {path for path in fields if path is not None}
    filled = [info for info in infos if info.count]
    if source.topic is not None:
        found = [info for info in filled if info.channel.topic == source.topic]
        if not found:
            topics = ", ".join(info.channel.topic for info in filled) or "none"
            raise LogError(
                f"Topic `{source.topic}` is not in {log} or holds no message; topics with messages: {topics}. "
                f"{_remedy(source.topic, cell)}"
            )
    else:
        undeclared = [info for info in filled if is_undeclared(info)]
        found = [info for info in undeclared if _has_columns(info, wanted)]
        if undeclared and not found:
            raise LogError(_without_columns(role, undeclared, fields, log))
    info = _only(role, found, infos, log, source)
    header = source.header if source.header is not None else ("header" if info.has_header else "")
    paths = _measured(fields, source)
    return Choice(role=role, info=info, fields=paths, header=header, reason="declared with its fields")


def _measured(paths: tuple[str | None, ...], source: Source | None) -> tuple[str | None, ...]:
    """Return the paths of a wrench without those of axes that the cell leaves out."""
    left_out = source.left_out if isinstance(source, WrenchSource) else ()
    return (
        tuple(None if axis in left_out else path for axis, path in zip(AXES, paths, strict=True)) if left_out else paths
    )


def _without_columns(role: Role, tables: Infos, fields: tuple[str | None, ...], log: str) -> str:
    """Say which columns that the cell declares no table has, by the table that lacks the fewest."""
    wanted = [path for path in dict.fromkeys(fields) if path is not None]
    lacks = [[path for path in wanted if not _has_columns(info, {path})] for info in tables]
    best, lacking = min(zip(tables, lacks, strict=True), key=lambda pair: len(pair[1]))
    entry = ROLES[role].entry
    delete = "" if ROLES[role].is_required else f", or delete `{entry}` with all that is below from cell.yaml"
    return (
        f"{best.channel.topic if len(tables) == 1 else f'One table of {log}'} must have the columns {listed(lacking)}, "
        f"which cell.yaml declares for the {ROLES[role].label}, found {listed(best.columns)}"
        f"{'' if len(tables) == 1 else f' in {best.channel.topic}'}; correct `{entry}: {{fields: …}}`{delete}."
    )


def _has_columns(info: ChannelInfo, wanted: set[str]) -> bool:
    """Return whether a table has the wanted columns, by name or number; of messages that is not known yet."""
    numbers = {str(index) for index in range(len(info.columns))}
    return not info.columns or wanted <= {*info.columns} | numbers


def _transform(
    role: Role, source: PoseSource, pair: tuple[str, str], infos: Infos, log: str, frames_of: FramesOf
) -> Choice:
    trees = [
        info
        for info in infos
        if info.count and info.channel.type_name in TRANSFORMS and source.topic in (None, info.channel.topic)
    ]
    having = {info.channel: frames_of(info) for info in trees}
    found = [info for info in trees if pair in having[info.channel]]
    if not found:
        known = sorted({f"{child} in {parent}" for pairs in having.values() for parent, child in pairs})
        raise LogError(
            f"No transform of {pair[1]} in {pair[0]} is in {log}, which holds: {listed(known, empty='no transforms')}."
        )
    info = _only(role, found, infos, log, source)
    layout = layout_of(role, info.channel)
    return Choice(
        role=role, info=info, fields=layout.fields, header="header", frames=pair, reason="declared by its frames"
    )
