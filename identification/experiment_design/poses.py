"""D-optimal orientations at rest for mass and centre of mass, under a limit on the tilt."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from problems.arrays import BoolArray, FloatArray

from ..merging.values import WEIGHED_MASS
from ..payload.gravity import COM_TILT_STD_RAD, LOCAL_GRAVITY_STD
from ..payload.static_poses import GRAVITY_B_M_S2, cross_matrix
from .values import PlanValues

FEWEST_POSES = 4
LARGEST_CONDITION = 25.0
"""Normalised equations that are conditioned worse are refused by `identify_gravity`."""

_RING_STEP_DEG = 15.0
_AZIMUTHS = 24
_APART_RAD = np.radians(3.0)  # identification takes orientations within 2 degrees for one
_MOST_ROUNDS = 50
_GRAVITY_M_S2 = float(np.linalg.norm(GRAVITY_B_M_S2))


@dataclass(frozen=True, kw_only=True)
class PosePlan:
    """Orientations in the order of short turns, and what they would show together with what is known already.

    `tilt_deg`, `azimuth_deg` (n,): turned by the tilt about the horizontal axis at that azimuth from x of the base;
    `quaternion_xyzw` (n, 4) the same turn, in the base frame, to be applied to the reference orientation (R = q R_ref).
    Each is held for `hold_s`. `mass_std_kg`, `com_std_m` (worst component) are predicted deviations, `naive_*` those of
    as many poses in equal steps about two axes; `condition` is the worse one of the normalised force and torque
    equations.
    """

    tilt_deg: FloatArray
    azimuth_deg: FloatArray
    quaternion_xyzw: FloatArray
    hold_s: float
    mass_std_kg: float
    com_std_m: float
    naive_mass_std_kg: float
    naive_com_std_m: float
    condition: float

    @property
    def is_excited(self) -> bool:
        """Whether identification would accept the poses as separating weight from bias."""
        return self.condition <= LARGEST_CONDITION


def plan_poses(values: PlanValues, *, count: int, max_tilt_deg: float, hold_s: float = 1.0) -> PosePlan | None:
    """Choose `count` tilts of at most `max_tilt_deg` by Fedorov's exchange (1972) on det of the information.

    Unknown are m, m c, b_f and b_τ of f = m g + b_f, τ = c × m g + b_τ. Neither the information nor the deviations
    depend on the reference orientation, since noise is taken alike on all axes. None where the limit leaves no room for
    so many orientations 3 degrees apart.
    """
    grid = _grid(max_tilt_deg)
    information = pose_information(_turns(grid), values, hold_s)
    chosen = _exchange(information, _too_close(_turns(grid)), count, _prior(values))
    if chosen is None:
        return None
    tilts = _in_short_turns(grid[chosen])
    mass_std, com_std = predicted_std(_turns(tilts), values, hold_s)
    naive = naive_turns(count, max_tilt_deg)
    naive_mass, naive_com = predicted_std(naive, values, hold_s)
    return PosePlan(
        tilt_deg=np.degrees(tilts[:, 0]),
        azimuth_deg=np.degrees(tilts[:, 1]),
        quaternion_xyzw=_turns(tilts).as_quat(canonical=True),
        hold_s=hold_s,
        mass_std_kg=mass_std,
        com_std_m=com_std,
        naive_mass_std_kg=naive_mass,
        naive_com_std_m=naive_com,
        condition=design_condition(_turns(tilts)),
    )


def smallest_tilt_deg(values: PlanValues, *, count: int, mass_std_kg: float, com_std_m: float) -> float | None:
    """Return the smallest limit, in steps of 5 degrees, under which a plan meets both deviations; None up to 90."""
    for tilt in np.arange(5.0, 91.0, 5.0):
        plan = plan_poses(values, count=count, max_tilt_deg=float(tilt))
        if plan is not None and plan.is_excited and plan.mass_std_kg <= mass_std_kg and plan.com_std_m <= com_std_m:
            return float(tilt)
    return None


def pose_rows(turns: Rotation) -> tuple[FloatArray, FloatArray]:
    """Return force rows (n, 3, 4) for m, b_f and torque rows (n, 3, 6) for m c, b_τ: τ = −[g]× m c + b_τ."""
    gravity = np.atleast_2d(turns.inv().apply(GRAVITY_B_M_S2))
    one = np.broadcast_to(np.eye(3), (len(gravity), 3, 3))
    return np.concatenate([gravity[:, :, None], one], axis=2), np.concatenate([-cross_matrix(gravity), one], axis=2)


def pose_information(turns: Rotation, values: PlanValues, hold_s: float) -> FloatArray:
    """Return the information (n, 10, 10) of each pose about m, m c, b_f, b_τ in the order m, b_f, m c, b_τ."""
    force_std, torque_std = _pose_std(values, hold_s)
    force, torque = pose_rows(turns)
    information = np.zeros((len(force), 10, 10))
    information[:, :4, :4] = np.swapaxes(force, 1, 2) @ force / force_std**2
    information[:, 4:, 4:] = np.swapaxes(torque, 1, 2) @ torque / torque_std**2
    return information


def predicted_std(turns: Rotation, values: PlanValues, hold_s: float = 1.0) -> tuple[float, float]:
    """Return the deviations of mass [kg] and of the worst component of c [m] after these poses and what is known."""
    information = pose_information(turns, values, hold_s).sum(axis=0)
    covariance = np.linalg.pinv(information, rcond=1e-14, hermitian=True)
    identifies = np.linalg.cond(information[:4, :4]) < 1e12, np.linalg.cond(information[4:, 4:]) < 1e12
    mass, com = values.mass_kg.value, values.com_m.value
    mass_std = float(np.sqrt(covariance[0, 0])) if identifies[0] else np.inf
    moment = float(np.max(np.diag(covariance)[4:7])) if identifies[1] else np.inf
    com_std = float(np.hypot(np.hypot(np.sqrt(moment), com * mass_std) / mass, COM_TILT_STD_RAD * com))
    # Local gravity scales mass and first moment alike: it stays in the mass and cancels in c.
    weighed = float(np.hypot(mass_std, LOCAL_GRAVITY_STD * mass))
    return values.mass_kg.std_after(weighed, WEIGHED_MASS), values.com_m.std_after(com_std)


def naive_turns(count: int, max_tilt_deg: float) -> Rotation:
    """Return what one would do without a plan: equal steps through zero about x, then about y."""
    half = count // 2
    about_x, about_y = (np.linspace(-max_tilt_deg, max_tilt_deg, n) for n in (count - half, half))
    zeros = np.zeros(count)
    return Rotation.from_rotvec(
        np.radians(np.column_stack([np.append(about_x, zeros[:half]), np.append(zeros[half:], about_y), zeros]))
    )


def design_condition(turns: Rotation) -> float:
    """Return the worse condition number of the force and torque equations, gravity's columns divided by g."""
    force, torque = pose_rows(turns)
    force_scale, torque_scale = np.array([_GRAVITY_M_S2, 1, 1, 1]), np.repeat([_GRAVITY_M_S2, 1.0], 3)
    return float(
        max(
            np.linalg.cond((force / force_scale).reshape(-1, 4)),
            np.linalg.cond((torque / torque_scale).reshape(-1, 6)),
        )
    )


def _pose_std(values: PlanValues, hold_s: float) -> tuple[float, float]:
    shrink = float(np.sqrt(min(1.0, values.sample_time_s.value / hold_s)))
    return (
        float(np.hypot(values.pose_force_std_n.value, shrink * values.force_noise_rms_n.value)),
        float(np.hypot(values.pose_torque_std_n_m.value, shrink * values.torque_noise_rms_n_m.value)),
    )


def _prior(values: PlanValues) -> FloatArray:
    """Return what is known already; the biases of another day say nothing."""
    mass = values.mass_kg.value
    prior = np.zeros((10, 10))
    prior[0, 0] = values.mass_kg.information(LOCAL_GRAVITY_STD * mass)
    prior[4:7, 4:7] = np.eye(3) * values.com_m.information() / mass**2
    return prior


def _grid(max_tilt_deg: float) -> FloatArray:
    """Return candidates (n, 2) of tilt and azimuth [rad]: the reference orientation and rings up to the limit."""
    rings = np.linspace(max_tilt_deg, 0.0, int(np.ceil(max_tilt_deg / _RING_STEP_DEG)) + 1)[:-1]
    azimuths = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    tilt, azimuth = np.meshgrid(np.radians(rings), azimuths, indexing="ij")
    return np.vstack([[0.0, 0.0], np.column_stack([tilt.ravel(), azimuth.ravel()])])


def _turns(tilts: FloatArray) -> Rotation:
    tilt, azimuth = tilts.T
    axis = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(tilt))])
    return Rotation.from_rotvec(tilt[:, None] * axis)


def _too_close(turns: Rotation) -> BoolArray:
    """Return which pairs (n, n) of orientations hold gravity alike."""
    down = turns.inv().apply(GRAVITY_B_M_S2) / _GRAVITY_M_S2
    return np.asarray(down @ down.T > np.cos(_APART_RAD))


def _exchange(information: FloatArray, too_close: BoolArray, count: int, prior: FloatArray) -> list[int] | None:
    """Swap one pose at a time for the candidate that raises det most, until none does; the start is spread widely."""
    chosen = _spread(too_close, count)
    if chosen is None:
        return None
    # A trace of information on everything keeps the determinant above 0 while poses are still missing.
    size = np.einsum("nii->i", information)
    total = prior + np.diag(1e-12 * size) + information[chosen].sum(axis=0)
    best = float(np.linalg.slogdet(total)[1])
    for _ in range(_MOST_ROUNDS):
        before = best
        for place in range(count):
            others = [pose for i, pose in enumerate(chosen) if i != place]
            without = total - information[chosen[place]]
            gain = np.linalg.slogdet(without + information)[1]
            gain[np.any(too_close[:, others], axis=1)] = -np.inf
            candidate = int(np.argmax(gain))
            if gain[candidate] > best + 1e-9:
                chosen[place], total, best = candidate, without + information[candidate], float(gain[candidate])
        if best <= before:
            break
    return chosen


def _spread(too_close: BoolArray, count: int) -> list[int] | None:
    """Return `count` candidates of the outer rings first, spread by the golden angle, none near another."""
    ring = np.arange(1, len(too_close))
    order = [0, *ring[np.argsort((ring - 1) // _AZIMUTHS * _AZIMUTHS + (ring - 1) * 7 % _AZIMUTHS, kind="stable")]]
    chosen: list[int] = []
    for candidate in order:
        if not np.any(too_close[candidate, chosen]):
            chosen.append(int(candidate))
        if len(chosen) == count:
            return chosen
    return None


def _in_short_turns(tilts: FloatArray) -> FloatArray:
    """Order poses (n, 2) into a short path from the reference orientation: nearest first, then untangled (2-opt)."""
    turns = _turns(np.vstack([[0.0, 0.0], tilts]))
    distance = np.array([(turn.inv() * turns).magnitude() for turn in turns])
    path, left = [0], set(range(1, len(distance)))
    while left:
        nearest = min(left, key=lambda pose: (distance[path[-1], pose], pose))
        path.append(nearest)
        left.remove(nearest)

    def length(order: list[int]) -> float:
        return float(np.sum(distance[order[:-1], order[1:]]))

    improved = True
    while improved:
        improved = False
        for i in range(1, len(path) - 1):
            for j in range(i + 1, len(path)):
                turned = path[:i] + path[i : j + 1][::-1] + path[j + 1 :]
                if length(turned) < length(path) - 1e-9:
                    path, improved = turned, True
    return np.asarray(tilts[np.array(path[1:]) - 1], dtype=np.float64)
