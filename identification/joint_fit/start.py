"""Start values of the joint fit: the coupling from free motion, each surface from its contacts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray

from ..signals.segments import low_pass
from .model import ParameterLayout
from .segments import ContactCandidate, FoundContact, Segment
from .solve import Point, Problem, information, linearise, minimise

_SLOW_HZ = 6.0
_RESONANCES_HZ = np.geomspace(6.0, 220.0, 7)
_HIGHEST_SHARE = 0.45  # of the sampling rate
_START_DAMPING_RATIO = 0.05
_STEPS_HELD, _STEPS_ALONE, _STEPS_POLISH, _STEPS_GROUP = 2, 10, 30, 6
_MASS_STARTS = (0.0, 0.1, 0.4)
_MORE_MASSES = (0.05, 0.2, 0.4, 0.7)
_CHANCES = 4.0
_HOPELESS = 100.0
_ALIKE = 1.1


def start_coupling(
    problem: Problem, values: FloatArray, segment: Segment, mass_kg: float | None
) -> tuple[FloatArray, float]:
    """Return shared parameters whose K_s, B_s, B_p, M_p fit one span of free motion, and the sum of squares left.

    `values` is one start. Others have the drag and mass that slow motion shows (or `mass_kg`) and a resonance at
    several frequencies: where the sweep ends below it, the linear estimates of the stages may be far off.
    """
    robot = tuple(range(4, len(problem.layout)))
    alone = replace(problem, segments=(segment,), pose_spans=(), fixed=robot, known_path=problem.path(values))
    drag, slow_mass = _slow_payload(problem, values, segment)
    mass = slow_mass if mass_kg is None else mass_kg
    starts = [values]
    highest = _HIGHEST_SHARE / problem.signals.period_s
    for frequency in (f for f in _RESONANCES_HZ if f < highest):
        omega = 2.0 * np.pi * frequency
        start = values.copy()
        start[:4] = mass * omega**2, 2.0 * _START_DAMPING_RATIO * mass * omega, drag, mass
        starts.append(start)
    held = replace(alone, fixed=(0, *robot))
    first = [minimise(held, Point(values=s, nuisances=(np.zeros(3),)), _STEPS_HELD) for s in starts]
    nearest, *others = sorted(first, key=lambda fit: fit[1])
    promising = [nearest, *(fit for fit in others[:1] if fit[1] < _HOPELESS * nearest[1])]
    best, left = min((minimise(alone, fit[0], _STEPS_ALONE) for fit in promising), key=lambda fit: fit[1])
    return best.values, left


def _slow_payload(problem: Problem, values: FloatArray, segment: Segment) -> tuple[float, float]:
    """Return B_p and M_p from F = −B_p v − M_p a + offset of the flange below a few hertz."""
    h, path = problem.signals.period_s, problem.path(values)
    speed = low_pass(path.cut(segment.slice).velocity / h, h, _SLOW_HZ)
    force = low_pass(problem.signals.force_n[segment.slice], h, _SLOW_HZ)
    columns = np.column_stack([-speed, -np.gradient(speed, h), np.ones(len(speed))])
    drag, mass, _ = np.linalg.lstsq(columns, force, rcond=None)[0]
    return max(float(drag), 0.0), max(float(mass), 0.05)


def fit_alone(problem: Problem, point: Point, contact: ContactCandidate) -> FoundContact:
    """Fit one contact with everything else as it is: from massless starts and from some with mass; the best counts."""
    single = _contacts_only(problem, point, (contact.segment,))
    layout = single.layout
    heavier = [np.array([0.0, 0.0, share * point.values[3]]) for share in _MASS_STARTS]
    starts = [(contact.surface + mass, contact.nuisance) for mass in heavier] + [contact.softer]
    fits: list[tuple[Point, float]] = []
    for surface, nuisance in starts:
        start = Point(values=np.concatenate([point.values, surface]), nuisances=(nuisance,))
        fits.append(minimise(single, start, _STEPS_ALONE))
        if fits[-1][1] <= _most_of_noise(len(contact.segment)):
            break  # nothing is left that another start could explain
    # The onset's sample makes a descent creep: the best goes on until it converges.
    best, _ = minimise(single, min(fits, key=lambda fit: fit[1])[0], _STEPS_POLISH)
    block = linearise(single, best)[0]
    force = problem.signals.force_n[contact.segment.slice]
    whitened = single.contact_noise.apply(force - np.mean(force))
    matrix, _ = information([block], len(layout))
    k_s, k_e = float(best.values[0]), float(best.values[layout.surface(0).start])
    noise = max(float(np.mean(block.residual**2)), 1.0)
    first = layout.surface(0).start
    spread = noise * np.linalg.pinv(matrix[first:, first:], hermitian=True)
    secant = k_s * k_e / (k_s + k_e)
    return FoundContact(
        start=contact,
        surface=best.values[layout.surface(0)],
        nuisance=best.nuisances[0],
        secant_n_per_m=secant,
        secant_std_n_per_m=secant**2 / k_e * float(np.sqrt(max(spread[0, 0], 0.0))),
        misfit_share=float(np.sqrt(float(block.residual @ block.residual) / max(float(whitened @ whitened), 1e-300))),
    )


def _most_of_noise(samples: int) -> float:
    """Return the largest sum of squares that whitened noise alone leaves."""
    return samples + _CHANCES * float(np.sqrt(2.0 * samples))


def start_surface(
    problem: Problem, point: Point, contacts: Sequence[FoundContact]
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return K_e, B_e, M_e of one surface and the own parameters of its contacts.

    Every contact proposes what it found alone; proposals that differ are fitted to all contacts, the best one counts.
    Where that leaves more than noise, several masses are tried.
    """
    group = _contacts_only(problem, point, tuple(replace(c.start.segment, surface=0) for c in contacts))
    proposals: list[FloatArray] = []
    mass = float(point.values[3])
    for contact in sorted(contacts, key=lambda c: c.misfit_share):
        moving = contact.surface[2] + 0.1 * mass
        known = [
            max(contact.surface[0] / p[0], p[0] / contact.surface[0]) < _ALIKE
            and max(moving / (p[2] + 0.1 * mass), (p[2] + 0.1 * mass) / moving) < _ALIKE
            for p in proposals
        ]
        if not any(known):
            proposals.append(contact.surface)
    own = tuple(c.nuisance for c in contacts)

    def fitted(surface: FloatArray) -> tuple[Point, float]:
        start = Point(values=np.concatenate([point.values, surface]), nuisances=own)
        return minimise(group, start, _STEPS_GROUP)

    best = min((fitted(p) for p in proposals), key=lambda fit: fit[1])
    samples = sum(len(s) for s in group.segments)
    if best[1] > _most_of_noise(samples):
        # More is left than noise: a bounce that the fit has not found, which another mass may bring.
        k_e = float(best[0].values[group.layout.surface(0).start])
        damping = 2.0 * _START_DAMPING_RATIO * np.sqrt(k_e * mass)
        others = [fitted(np.array([k_e, damping, share * mass])) for share in _MORE_MASSES]
        best = min([best, *others], key=lambda fit: fit[1])
    return best[0].values[group.layout.surface(0)], best[0].nuisances


def _contacts_only(problem: Problem, point: Point, segments: tuple[Segment, ...]) -> Problem:
    layout = ParameterLayout(robot_order=problem.layout.robot_order, surfaces=1)
    return replace(
        problem,
        layout=layout,
        segments=segments,
        pose_spans=(),
        fixed=tuple(range(layout.robot.stop)),
        known_path=problem.path(point.values),
    )
