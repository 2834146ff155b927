"""Ranking of the conventions (signs, frames, orders) in which a log may have been written."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray

from ..errors import EstimateError
from ..payload.static_poses import SAY_COMPENSATED, SMALL_SWING_N, StaticPose, group_by_orientation
from ..result import Finding
from ..signals.recording import Frames, PoseSignal, Recording
from .weight_misfit import (
    HYPOTHESES,
    ConventionHypothesis,
    FreeMounting,
    GravityDirection,
    Scores,
    find_gravity_direction,
    score_hypotheses,
)

_ALIKE_LOG_LIKELIHOOD = float(np.log(1000.0))
_ALIKE_RATIO = 1.2
_FEWEST_ORIENTATIONS = 4
_FEWEST_CERTAIN = 7
_UNEXPLAINED = 0.1
_MOST_LISTED = 6
_SMALLEST_ANGLE_RAD = np.radians(10.0)
_FAR_BETTER = 3.0
# What leans further shows in the sign of the force, if at all.
_LARGEST_LEAN_RAD = np.radians(135.0)


class SignOrigin(StrEnum):
    """What a force of the opposite sign comes from; rests alone cannot distinguish the latter two."""

    AS_DECLARED = "as declared"
    WRENCH = "the wrench is the other body's"
    GRAVITY = "gravity points the other way"


@dataclass(frozen=True, kw_only=True)
class Convention:
    """One way to read the log, relative to the declared one, and how well the weight fits it.

    `hypothesis` says how the orientation's numbers are taken and by which quarter turn the sensor's axes are turned;
    the residuals are over the orientations that fit the best one; `short_by` is the log likelihood that this one is
    short of it, `ratio` the larger of its residuals over those of the best one.
    """

    hypothesis: ConventionHypothesis
    sign_origin: SignOrigin
    mass_kg: float
    residual_rms_n: float
    torque_residual_rms_n_m: float
    short_by: float
    ratio: float

    @property
    def changes(self) -> int:
        """The number of entries of cell.yaml that differ from what is declared; 0 for the declared hypothesis."""
        hypothesis = self.hypothesis
        return sum(
            (
                hypothesis.order != "xyzw",
                hypothesis.inverted,
                self.sign_origin is not SignOrigin.AS_DECLARED,
                hypothesis.is_turned,
            )
        )

    @property
    def fits_best(self) -> bool:
        """Whether it is the best one, or as likely within 1 : 1000, or its residuals are no 20 % larger."""
        return self.short_by < _ALIKE_LOG_LIKELIHOOD or self.ratio < _ALIKE_RATIO

    def entries(self, frames: Frames | None = None) -> tuple[str, ...]:
        """Return what cell.yaml would have to say, given the frames that it declares now."""
        shown, declared = [], Frames.plain() if frames is None else frames
        if self.hypothesis.order != "xyzw":
            shown.append("pose: {orientation_as: quaternion_wxyz}")
        if self.hypothesis.inverted:
            shown.append(
                "pose: {parent: …, child: …} swapped (what is logged is flange from base), or of a matrix its order: "
                "pose: {orientation_as: matrix_row_major} (matrix_column_major where it is row_major now)"
            )
        if self.sign_origin is SignOrigin.WRENCH:
            shown.append("wrench: {exerted_by: sensor} (payload where it is sensor now)")
        if self.sign_origin is SignOrigin.GRAVITY:
            shown.append(f"gravity_direction: {numbers_text(declared.R_WB.inv().apply([0.0, 0.0, 1.0]))}")
        if self.hypothesis.is_turned:
            shown.append(
                f"sensor: {{orientation: {numbers_text((declared.R_FS * self.hypothesis.quarter_turn).as_quat())}}}"
            )
        return tuple(shown) or ("as declared",)

    def apply(self, recording: Recording, frames: Frames | None = None) -> Recording:
        """Return the recording read this way: poses base from sensor with gravity along −z, the payload's wrench.

        A twist is left out where it is not known in which frame it is (an inverted pose, gravity reversed).
        """
        declared = Frames.plain() if frames is None else frames
        sign = -1.0 if self.sign_origin is SignOrigin.WRENCH else 1.0
        wrench = recording.wrench
        keeps_base = not self.hypothesis.inverted and self.sign_origin is not SignOrigin.GRAVITY
        return replace(
            recording,
            wrench=replace(wrench, force_n=sign * wrench.force_n, torque_n_m=sign * wrench.torque_n_m),
            pose=self._read(recording.pose, declared),
            command=None if recording.command is None else self._read(recording.command, declared),
            twist=recording.twist if keeps_base else None,
        )

    def _read(self, pose: PoseSignal, frames: Frames) -> PoseSignal:
        logged = Rotation.from_quat(pose.quaternion_xyzw)
        turned = self.hypothesis.orientation(logged, frames)
        position = np.array(pose.position_m)
        if self.hypothesis.inverted:
            # p_BF = −R_BF p_FB, in our base on both sides.
            flange = frames.R_WB.inv() * turned * self.hypothesis.quarter_turn.inv() * frames.R_FS.inv()
            position = -frames.R_WB.apply(flange.apply(frames.R_WB.inv().apply(position)))
        if self.sign_origin is SignOrigin.GRAVITY:
            over = Rotation.from_rotvec([np.pi, 0.0, 0.0])
            turned, position = over * turned, over.apply(position)
        return replace(pose, position_m=position, quaternion_xyzw=turned.as_quat(canonical=True))


def residuals_text(convention: Convention) -> str:
    """Say what a convention leaves of force and torque."""
    return f"{convention.residual_rms_n:.3g} N and {convention.torque_residual_rms_n_m:.3g} N·m"


def numbers_text(values: FloatArray) -> str:
    """Write numbers as a YAML list."""
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:g}" for value in np.asarray(values)) + "]"


class ConventionVerdict(StrEnum):
    """What the weight says about the declared conventions; each value says what follows."""

    DECLARED = "the declared conventions fit"
    FOUND = "only other conventions than the declared ones fit"
    ASK = "several conventions other than the declared ones fit alike, so cell.yaml has to say"
    NONE = "no convention fits: the wrench does not follow the pose"
    UNDECIDED = "the rests are too few or too alike to decide"


@dataclass(frozen=True, kw_only=True)
class ConventionRanking:
    """All hypotheses, best first, and what follows; `declared` is the one in cell.yaml or assumed.

    `orientations` distinct ones took part; `swing_rms_n` is how much the force changed between them. `mounting` is the
    flange-from-sensor rotation that fits far better than any quarter turn, where there is one; `gravity_direction` that
    of gravity, where another one does.
    """

    verdict: ConventionVerdict
    candidates: tuple[Convention, ...]
    declared: Convention | None
    orientations: int
    swing_rms_n: float
    frames: Frames
    mounting: Rotation | None = None
    gravity_direction: GravityDirection | None = None

    @property
    def alike(self) -> tuple[Convention, ...]:
        """The hypotheses that fit as well as the best one, those of fewest changes first."""
        return tuple(sorted((c for c in self.candidates if c.fits_best), key=lambda c: (c.changes, c.short_by)))

    def chosen(self) -> Convention | None:
        """Return the hypothesis to use, None where the rests do not decide and the declared one is kept unchecked.

        Raises EstimateError where several hypotheses fit alike or none does.
        """
        if self.verdict is ConventionVerdict.DECLARED:
            return self.declared
        if self.verdict is ConventionVerdict.FOUND:
            return self.alike[0]
        if self.verdict is ConventionVerdict.UNDECIDED:
            return None
        raise EstimateError(self._question())

    def _question(self) -> str:
        best = self.candidates[0]
        alternative = ""
        if self.verdict is ConventionVerdict.NONE and self.swing_rms_n < SMALL_SWING_N:
            return (
                "At rest the force does not follow the tool's turning: it differs by no more than "
                f"{self.swing_rms_n:.2f} N rms between {self.orientations} orientations, of which "
                f"{best.residual_rms_n:.2f} N are no weight under the best of {len(self.candidates)} conventions. "
                f"Gravity seems to have been taken off before recording; {SAY_COMPENSATED}. If the wrench is raw, look "
                "for what touched the payload, and for a sensor that is mounted at an angle (`sensor.orientation`)."
            )
        if self.orientations < _FEWEST_CERTAIN:
            alternative = f" If gravity was taken off before recording, {SAY_COMPENSATED} instead."
        if self.mounting is not None:
            shown = numbers_text(np.round(self.mounting.as_quat(), 4))
            return (
                f"No quarter turn of the sensor fits the weight: {best.residual_rms_n:.2f} N of a swing of "
                f"{self.swing_rms_n:.2f} N are left under the best of {len(self.candidates)} conventions. The sensor "
                f"seems mounted at an angle: declare `sensor: {{orientation: {shown}}}` in cell.yaml "
                "(xyzw, flange from sensor) after checking it against the drawing, or `gravity_direction` if the base "
                f"is tilted.{alternative}"
            )
        if self.gravity_direction is not None:
            direction, lean = self.gravity_direction, np.degrees(self.gravity_direction.angle_rad)
            components = ", ".join(f"{each:.5f}" for each in self.frames.R_WB.inv().apply(direction.direction_W))
            return (
                f"Gravity leans by {lean:.1f} degrees from where it is assumed: that "
                f"leaves {direction.left_n:.2f} N, the best of {len(self.candidates)} conventions "
                f"{best.residual_rms_n:.2f} N of a swing of {self.swing_rms_n:.2f} N. If the base is mounted that way, "
                f"declare `gravity_direction: [{components}]` in cell.yaml; else level it.{alternative}"
            )
        if self.verdict is ConventionVerdict.NONE:
            return (
                f"The force must follow gravity as the tool turns, found {best.residual_rms_n:.2f} N left of a swing "
                f"of {self.swing_rms_n:.2f} N under the best of {len(self.candidates)} conventions; check that wrench "
                "and pose are of the same robot and clock, and that nothing touched the payload. Where three numbers "
                "are the orientation, as rx, ry and rz, only the declared `orientation_as` of the pose was tried: "
                "rotation_vector, euler_xyz (roll, pitch, yaw) or euler_ZYX, see the robot's manual. Declare "
                "`sensor.orientation` in cell.yaml if the sensor is mounted at an angle that is no multiple of 90°, "
                f"`gravity_direction` if the base leans. If gravity was taken off before recording, {SAY_COMPENSATED}."
            )
        alike = self.alike
        advice = "Poses that also turn about the vertical distinguish more of them."
        if len({each.hypothesis for each in alike}) == 1:
            advice = (
                "A reversed wrench and reversed gravity are the same to a tool at rest, however it is turned, so that "
                "only you can say: gravity points up in the base frame of a robot that hangs from the ceiling; else it "
                "is the wrench. A log with positions of quick moves that turn the tool could show it."
            )
        shown = "; ".join(self._text(each) for each in alike[:_MOST_LISTED])
        more = f"; and {len(alike) - _MOST_LISTED} more" if len(alike) > _MOST_LISTED else ""
        return (
            f"The declared conventions {self._declared()}, and {len(alike)} others fit it alike. Say in "
            f"cell.yaml which it is: {shown}{more}. {advice}"
        )

    def _text(self, convention: Convention) -> str:
        return f"`{', '.join(convention.entries(self.frames))}` ({residuals_text(convention)} left)"

    def _declared(self) -> str:
        if self.declared is None:
            return "make the payload's mass negative"
        return f"leave {residuals_text(self.declared)} of the weight unexplained"

    def findings(self) -> tuple[Finding, ...]:
        """Return what the user should know: a convention that was found, or that nothing could be checked."""
        if self.verdict is ConventionVerdict.FOUND:
            best = self.alike[0]
            return (
                Finding(
                    code="convention-found",
                    severity="warning",
                    message=f"The declared conventions {self._declared()}; the log was read as {self._text(best)} "
                    f"instead, the only one of {len(self.candidates)} that fits.",
                    advice="Declare it in cell.yaml.",
                ),
            )
        if self.verdict is ConventionVerdict.UNDECIDED:
            return (
                Finding(
                    code="conventions-unchecked",
                    severity="info",
                    message="The rests are too few or too alike to check signs, frames and orders by the weight.",
                    advice="Record 6 to 12 poses of 1 s each, tilted 30 to 70 degrees about two axes.",
                ),
            )
        return ()


def rank_conventions(poses: Sequence[StaticPose], frames: Frames | None = None) -> ConventionRanking:
    """Rank 192 hypotheses of the rests by what the payload's weight leaves unexplained.

    Quaternion order, inverse, sensor axes by quarter turns, and the sign of the force, which is the wrench's or
    gravity's: rests cannot show which, so that both are candidates. The declared hypothesis holds unless it is
    significantly worse than the best one: less likely than 1 : 1000 (the noise's size left open, but no less than that
    within the rests) and 20 % more residual. `frames` are those that the cell declares and that are in the poses.
    """
    declared = Frames.plain() if frames is None else frames
    groups = group_by_orientation(poses)
    unclear = ConventionRanking(
        verdict=ConventionVerdict.UNDECIDED,
        candidates=(),
        declared=None,
        orientations=len(np.unique(groups)),
        swing_rms_n=0.0,
        frames=declared,
    )
    if len(np.unique(groups)) < _FEWEST_ORIENTATIONS:
        return unclear
    scores = score_hypotheses(poses, groups, declared)
    if scores.orientations < _FEWEST_ORIENTATIONS:
        return unclear
    candidates = _candidates(scores)
    ranked = replace(
        unclear,
        candidates=candidates,
        declared=next((each for each in candidates if each.changes == 0), None),
        orientations=scores.orientations,
        swing_rms_n=float(np.sqrt(scores.swing_n2 / (3.0 * scores.orientations))),
    )
    judged = _judged(ranked, scores)
    if judged.verdict is not ConventionVerdict.NONE or judged.mounting is not None:
        return judged
    return replace(judged, gravity_direction=_leaning(judged, poses))


def _judged(ranked: ConventionRanking, scores: Scores) -> ConventionRanking:
    """Return the ranking with its verdict."""
    free = scores.free_mounting
    if not _is_far_better(free, ranked, scores):
        return replace(ranked, verdict=_verdict(ranked, scores))
    if free.angle_rad > _SMALLEST_ANGLE_RAD or not free.is_as_declared:
        mounting = ranked.frames.R_FS * free.turn if free.is_as_declared else None
        return replace(ranked, verdict=ConventionVerdict.NONE, mounting=mounting)
    # A little off the declared axes is for the mounting's estimate to say.
    nearly = free.turn.magnitude() < _SMALLEST_ANGLE_RAD and ranked.declared is not None
    return replace(ranked, verdict=ConventionVerdict.DECLARED if nearly else _verdict(ranked, scores))


def _leaning(ranking: ConventionRanking, poses: Sequence[StaticPose]) -> GravityDirection | None:
    """Return where gravity points, if that explains the force far better than any convention."""
    found = find_gravity_direction(poses)
    if found is None or found.angle_rad > _LARGEST_LEAN_RAD:
        return None
    explains = found.left_n < np.sqrt(_UNEXPLAINED) * ranking.swing_rms_n
    return found if explains and found.left_n * _FAR_BETTER < ranking.candidates[0].residual_rms_n else None


def _is_far_better(free: FreeMounting, ranking: ConventionRanking, scores: Scores) -> bool:
    """Return whether the sensor's axes, turned at will, leave far less than the best quarter turn."""
    left = float(np.sqrt(max(free.force_n2 / (3.0 * scores.orientations), scores.force_floor_n2)))
    explains = left < np.sqrt(_UNEXPLAINED) * ranking.swing_rms_n
    return explains and ranking.candidates[0].residual_rms_n > _FAR_BETTER * left


def _verdict(ranking: ConventionRanking, scores: Scores) -> ConventionVerdict:
    alike, best = ranking.alike, ranking.candidates[0]
    noise = float(np.sqrt(scores.force_floor_n2))
    if ranking.declared in alike:
        if best.residual_rms_n < np.sqrt(_UNEXPLAINED) * ranking.swing_rms_n:
            return ConventionVerdict.DECLARED
        # Nothing swings with the orientation: gravity may have been removed, which is for the estimate of mass to say.
        return ConventionVerdict.UNDECIDED if ranking.swing_rms_n < 10.0 * noise else ConventionVerdict.NONE
    if best.residual_rms_n >= np.sqrt(_UNEXPLAINED) * ranking.swing_rms_n:
        return ConventionVerdict.NONE
    return ConventionVerdict.FOUND if len(alike) == 1 else ConventionVerdict.ASK


def _candidates(scores: Scores) -> tuple[Convention, ...]:
    """Return the hypotheses, best first: of either sign of the force the one that makes the mass positive."""
    short = scores.log_likelihood_short()
    best = int(np.argmin(short))
    count = 3.0 * scores.orientations
    found = []
    for i, hypothesis in enumerate(HYPOTHESES):
        pulls = (SignOrigin.AS_DECLARED,) if scores.mass_kg[i] > 0.0 else (SignOrigin.WRENCH, SignOrigin.GRAVITY)
        found += [
            Convention(
                hypothesis=hypothesis,
                sign_origin=sign_origin,
                mass_kg=abs(float(scores.mass_kg[i])),
                residual_rms_n=float(np.sqrt(scores.force_n2[i] / count)),
                torque_residual_rms_n_m=float(np.sqrt(scores.torque_n2_m2[i] / count)),
                short_by=float(short[i]),
                ratio=scores.ratio(i, best),
            )
            for sign_origin in pulls
        ]
    return tuple(sorted(found, key=lambda each: (each.short_by, each.changes)))
