"""The recording under the best-fitting conventions: kept, read anew, or refused with a question."""

from dataclasses import dataclass

from ..errors import EstimateError
from ..payload.gravity import identify_gravity
from ..payload.inertia import inertial_sign
from ..payload.static_poses import StaticPose, collect_static_poses
from ..result import Finding
from ..signals.aligned import AlignedLog, align
from ..signals.recording import Frames, Recording
from ..signals.segments import MotionSpans, find_motion
from .search import Convention, ConventionRanking, ConventionVerdict, SignOrigin, rank_conventions

_SIGNIFICANT = 5.0


@dataclass(frozen=True, kw_only=True)
class ReadLog:
    """A log under the conventions that its weight agrees with.

    `convention` is the one that replaced the declared ones, None where those hold; log, motion and rests are those of
    `recording`.
    """

    recording: Recording
    log: AlignedLog
    motion: MotionSpans
    poses: tuple[StaticPose, ...]
    convention: Convention | None
    findings: tuple[Finding, ...]


def read_by_weight(recording: Recording, log: AlignedLog, motion: MotionSpans, frames: Frames | None = None) -> ReadLog:
    """Check the declared conventions by the payload's weight and read the log anew where only others fit.

    `log` and `motion` are those of `recording`, `frames` what the cell declares. A force of the wrong sign is the
    wrench's or gravity's; moves that turn the tool show which. Raises EstimateError, naming the entries of cell.yaml,
    where several conventions fit alike or none does.
    """
    poses = collect_static_poses(log, motion.still)
    ranking = rank_conventions(poses, frames)
    findings = ranking.findings()
    hypotheses = [each.hypothesis for each in ranking.alike]
    moves = recording.pose.has_position
    if moves and ranking.verdict is ConventionVerdict.ASK and len(hypotheses) == 2 and hypotheses[0] == hypotheses[1]:
        decided = _decided_by_moves(recording, ranking, frames)
        if decided is not None:
            chosen, sign = decided
            finding = Finding(
                code="convention-found",
                severity="warning",
                message="The weight has the wrong sign as declared; the forces of acceleration show that "
                f"{chosen.sign_origin.value} ({abs(sign):.0f} standard deviations): read as "
                f"`{', '.join(chosen.entries(frames))}`.",
                advice="Declare it in cell.yaml.",
            )
            return read_as(recording, chosen, frames, (finding,))
    chosen_by_weight = ranking.chosen()
    if chosen_by_weight is None or chosen_by_weight.changes == 0:
        return ReadLog(recording=recording, log=log, motion=motion, poses=poses, convention=None, findings=findings)
    return read_as(recording, chosen_by_weight, frames, findings)


def read_as(
    recording: Recording, convention: Convention, frames: Frames | None, findings: tuple[Finding, ...] = ()
) -> ReadLog:
    """Return a log under a convention other than the declared one."""
    read = convention.apply(recording, frames)
    log = align(read)
    motion = find_motion(log)
    return ReadLog(
        recording=read,
        log=log,
        motion=motion,
        poses=collect_static_poses(log, motion.still),
        convention=convention,
        findings=findings,
    )


def _decided_by_moves(
    recording: Recording, ranking: ConventionRanking, frames: Frames | None
) -> tuple[Convention, float] | None:
    """Read the wrench as the other body's: the inertia comes out positive if it is, negative if gravity is reversed."""
    by_pull = {each.sign_origin: each for each in ranking.alike}
    tried = read_as(recording, by_pull[SignOrigin.WRENCH], frames)
    try:
        sign = inertial_sign(tried.log, tried.motion, tried.poses, identify_gravity(tried.poses))
    except EstimateError:
        return None
    if abs(sign) < _SIGNIFICANT:
        return None
    return (by_pull[SignOrigin.WRENCH] if sign > 0.0 else by_pull[SignOrigin.GRAVITY]), sign
