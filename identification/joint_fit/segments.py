"""Spans of the log that one payload on one spring explains, and the force that the model predicts there."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .force_kernel import ModeArray, RealBody, run_contact, run_free
from .kernel import Body, returns_at_once
from .model import Array, Layout, body, payload_step, swing_step
from .path import Cut, FlangePath

FloatArray = NDArray[np.float64]

_NO_SURFACE = np.zeros(3)
OFFSET = 2
FREE = -1


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Samples `start` up to `stop`; `surface` is what is touched on the way, `FREE` for nothing.

    `sign` is +1 when pressing towards +axis. Nuisance parameters: the payload's offset and speed against the flange
    at the start, counted in N of the coupling, the force's offset [N], and the wall's place x_w [m] in a contact.
    """

    start: int
    stop: int
    surface: int = FREE
    sign: int = 1

    @property
    def slice(self) -> slice:
        """The samples as an index."""
        return slice(self.start, self.stop)

    @property
    def is_contact(self) -> bool:
        """Whether something is touched."""
        return self.surface != FREE

    @property
    def nuisance_count(self) -> int:
        """Parameters that only this span has."""
        return 4 if self.is_contact else 3

    def __len__(self) -> int:
        return self.stop - self.start


def predict_force(
    values: FloatArray, nuisance: FloatArray, segment: Segment, path: FlangePath, layout: Layout, period_s: float
) -> FloatArray:
    """Return F (n,) of a segment; `values` as `Layout` orders them, `nuisance` as `Segment` does.

    F = K_s (x_p − x) + B_s (v_p − v) + offset, with F_e = M_e dv_p/dt + B_e v_p + K_e (x_p − x_w) ≥ 0 in contact.
    """
    cut = path.cut(segment.slice)
    law = law_of(values, nuisance, segment, path, layout, period_s)
    return np.asarray(segment.sign * run(law, cut, segment).force + nuisance[OFFSET])


class Law(NamedTuple):
    """What a span's motion follows.

    `phi` (2, 2, 2) and `gamma` (2, 2, m) of free motion and contact, `swing` (2, 2) of a freed environment; `wall` is
    where all is counted from in the direction of pressing, `start` the payload's place and velocity at first.
    """

    phi: FloatArray
    gamma: FloatArray
    swing: FloatArray
    body: Body
    wall: float
    start: tuple[float, float]


def law_of(
    values: FloatArray, nuisance: FloatArray, segment: Segment, path: FlangePath, layout: Layout, period_s: float
) -> Law:
    """Return what a span's motion follows, for what `predict_force` takes."""
    of = body(values[:4], surface_of(values, segment, layout), period_s)
    x, v = (segment.sign * float(end) for end in path.cut(segment.slice).ends[0, :2])
    wall = segment.sign * float(nuisance[3]) if segment.is_contact else x
    start = x - wall + float(nuisance[0]) / of[0].real, v + float(nuisance[1]) / of[0].real
    phi, gamma, swing = steps_of(of, path.robot, path.hold.fraction, touches=segment.is_contact)
    return Law(phi=phi, gamma=gamma, swing=swing, body=of, wall=wall, start=start)


def surface_of(values: FloatArray, segment: Segment, layout: Layout) -> FloatArray:
    """Return K_e, B_e, M_e of what a segment touches, zeros for nothing."""
    return values[layout.surface(segment.surface)] if segment.is_contact else _NO_SURFACE


def steps_of(of: Body, robot: Array | None, fraction: complex, *, touches: bool) -> tuple[Array, Array, Array]:
    """Return phi, gamma and swing as `Law` has them; those of a contact are of use only if it `touches`."""
    free = payload_step(of, robot, fraction, touching=False)
    touched = payload_step(of, robot, fraction, touching=True) if touches else free
    swing = swing_step(of, back_at_once=not touches or returns_at_once(plain(of)))
    return np.stack([free[0], touched[0]]), np.stack([free[1], touched[1]]), swing


def plain(of: Body) -> RealBody:
    """Return the real parts."""
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = (value.real for value in of)
    return k_s, b_s, b_p, m_p, k_e, b_e, m_e


class Run(NamedTuple):
    """A span's motion: the coupling's force (n,), states (n, 2), or (n, 4) with a wall, and `run_contact`'s modes."""

    force: FloatArray
    states: FloatArray
    modes: ModeArray


def run(law: Law, cut: Cut, segment: Segment) -> Run:
    """Return a span's motion in the direction of pressing."""
    count = len(segment)
    states, modes = np.empty((count, 4 if segment.is_contact else 2)), np.zeros(count, dtype=np.int8)
    of, start, place = plain(law.body), law.start, (float(segment.sign), law.wall)
    if segment.is_contact:
        force = run_contact(law.phi, law.gamma, law.swing, cut.drive, cut.ends, of, place, start, states, modes)
    else:
        force = run_free(law.phi[0], law.gamma[0], cut.drive, cut.ends, of, place, start, states)
    return Run(force, states, modes)


def shared_indices(segment: Segment, layout: Layout, *, through_robot: bool) -> NDArray[np.intp]:
    """Return which shared parameters a segment's force depends on."""
    robot = np.arange(layout.robot.start, layout.robot.stop if through_robot else layout.robot.start)
    surface = np.arange(*layout.surface(segment.surface).indices(len(layout))) if segment.is_contact else np.empty(0)
    return np.concatenate([np.arange(4), robot, surface]).astype(np.intp)
