"""Play one contact with the paper's own difference equation and a finely stepped plant, from far away until rest."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from scipy.linalg import expm

from autotune.formats.limits import VariableDampingSettings
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.hold import hold
from problems.model.plant import FREE_SPACE, Coupling, PayloadDynamics, Plant, build_plant_matrices
from problems.model.robot import RobotModel
from problems.model.sampled import (
    build_loop,
    build_sampled_plant,
    check_wrench_delay,
    spectral_radius,
    stability_matrix,
)

from .replay_kernel import (
    SUBSTEPS,
    DampingSchedule,
    EquationGains,
    FineContact,
    RobotAlone,
    SampleStep,
    Substep,
    replay_ticks,
)

_SHORTEST_APPROACH_S = 0.8
# After so many times the shortest approach it is taken as it is.
_MOST = 4
SHORTEST_AFTER_S = 1.6
# A part of the motion has gone when it has decayed to exp(-7), a thousandth.
_DECAY_EXPONENTS = 7.0
_LONGEST_S = 10.0
_FAR_SAMPLES = 4.0


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """What a replayed law does beside its gains: at the threshold a reset, or with `stops` a full stop; its B_a.

    `followed_weight` is that of the lag behind which the command's speed is watched (`AxisLimits`).
    """

    threshold_n: float = math.inf
    stops: bool = False
    variable: VariableDampingSettings | None = None
    followed_weight: float = 1.0

    def schedule(self) -> DampingSchedule:
        """Return the variable damping as the kernel takes it; a period of 0 is none."""
        each = self.variable
        if each is None:
            return DampingSchedule(0, 0.0, 0.0, 0.0, 0.0)
        return DampingSchedule(
            int(each.update_periods),
            float(each.highest),
            float(each.lowest),
            float(each.decay_s_per_m),
            float(each.largest_change),
        )


NO_STRATEGY = Strategy()


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Peaks of one replayed contact, at the sensor (pressing positive) and at the surface.

    `detected_after_s` counts from the tick that first saw the touch, below 0 for a detection in free motion; None
    without one. `largest_speed_m_s`, `largest_acceleration_m_s2` and `largest_followed_m_s`, behind the lag, are those
    of the command, the start from rest included. `opposed_n` is the largest force against the motion before the touch.
    """

    peak_sensor_force_n: float
    peak_contact_force_n: float
    detected_after_s: float | None = None
    largest_speed_m_s: float = 0.0
    largest_acceleration_m_s2: float = 0.0
    largest_followed_m_s: float = 0.0
    opposed_n: float = 0.0


def replay_contact(
    plant: Plant,
    controller: AdmittanceController,
    sample_time_s: float,
    desired_force_n: float,
    *,
    deadband_n: float = 0.0,
    strategy: Strategy = NO_STRATEGY,
    touch_after_s: float | None = None,
) -> Replay:
    """Approach with F^d from rest, touch, and follow until rest; `deadband_n` is a threshold deadband on the force.

    With `touch_after_s` the touch comes so long after F^d does, whatever the speed is then.

    At the first tick at which the force opposes the motion by more than the threshold of the `strategy` the command and
    its predecessor become the one sent last (the paper's Algorithm 1), or at that tick and all that follow.

    The approach lasts until its speed is steady, and at least as long as the slowest part of its loop needs to decay: a
    lead starts it with a leap, and what is left of that would add to the peak. Then the payload is half a tick's way
    from the wall. The contact lasts until its loop has decayed, ten seconds at most; of a force that only creeps to its
    value at rest by then, that value counts. The plant advances in twentieths of a sample, contact begins and ends on
    that grid, and the delay is rounded to it.
    """
    # A wrench that is late makes the same loop as commands that are (for a law that reads nothing but the wrench).
    check_wrench_delay(plant, controller)
    approach = settling_samples(plant.in_contact_with(FREE_SPACE), controller, sample_time_s, _SHORTEST_APPROACH_S)
    longest = _MOST * approach
    if touch_after_s is not None:
        approach = longest = max(1, round(touch_after_s / sample_time_s))
    after = settling_samples(plant, controller, sample_time_s, SHORTEST_AFTER_S)
    found = replay_ticks(
        _fine_contact(plant, sample_time_s),
        equation_gains(controller, sample_time_s),
        approach,
        longest,
        after,
        float(desired_force_n),
        float(deadband_n),
        float(strategy.threshold_n),
        strategy.stops,
        strategy.schedule(),
        float(_FAR_SAMPLES),
        float(strategy.followed_weight),
    )
    sensor, contact, detected_after_s = found.sensor, found.contact, None
    if found.detection >= 0 and found.touch >= 0:
        detected_after_s = (found.detection - found.touch) * sample_time_s
    is_stopped = strategy.stops and found.detection >= 0
    if deadband_n == 0.0 and found.is_touching and not is_stopped and _creeps(plant, controller, sample_time_s, after):
        # The admittance integrates F^d + F: on a very soft surface the force is still on its way to F^d.
        sensor, contact = max(sensor, desired_force_n), max(contact, desired_force_n)
    return Replay(
        peak_sensor_force_n=sensor,
        peak_contact_force_n=contact,
        detected_after_s=detected_after_s,
        largest_speed_m_s=found.fastest / sample_time_s,
        largest_acceleration_m_s2=found.hardest / sample_time_s**2,
        largest_followed_m_s=found.followed / sample_time_s,
        opposed_n=found.opposed,
    )


@lru_cache(maxsize=1024)
def settling_samples(plant: Plant, controller: AdmittanceController, h: float, shortest_s: float) -> int:
    """Return how many samples the loop needs to settle, a wall that is soft or a light damping taking longer."""
    radius = spectral_radius(build_loop(build_sampled_plant(plant, h), controller))
    decay = math.ceil(_DECAY_EXPONENTS / -math.log(radius)) if radius > 0.0 else 0
    return max(round(shortest_s / h), min(decay, math.ceil(_LONGEST_S / h)))


def _creeps(plant: Plant, controller: AdmittanceController, h: float, samples: int) -> bool:
    """Say whether after so many samples one part of the motion in contact has not decayed, and that without swinging.

    What is left of the force is then one exponential, so that it does not overshoot its value at rest.
    """
    poles = np.linalg.eigvals(stability_matrix(build_loop(build_sampled_plant(plant, h), controller)))
    left = poles[np.abs(poles) ** samples > math.exp(-_DECAY_EXPONENTS)]
    return len(left) == 1 and bool(left[0].imag == 0.0 and 0.0 < left[0].real < 1.0)


def _fine_contact(plant: Plant, sample_time_s: float) -> FineContact:
    near = build_plant_matrices(plant, sample_time_s)
    far = build_plant_matrices(plant.in_contact_with(FREE_SPACE), sample_time_s)
    whole, late = divmod(round(plant.loop_delay_s / sample_time_s * SUBSTEPS), SUBSTEPS)
    stiffness, damping, moved = plant.environment.coefficients
    h = sample_time_s
    # F_e = K_e x_p + B_e v_p + M_e a_p of both as one mass; the place of the speed is the last of the states.
    pressed = moved / h**2 * near.a[-1]
    pressed[-2:] += stiffness, damping / h
    wall = np.zeros((2, 2))
    if moved > 0.0:
        wall = expm(np.array([[0.0, 1.0], [-stiffness * h * h / moved, -damping * h / moved]]) / SUBSTEPS)
    return FineContact(
        near=Substep(*hold(near.a, near.b, 1.0 / SUBSTEPS)),
        far=Substep(*hold(far.a, far.b, 1.0 / SUBSTEPS)),
        near_sample=_sample_step(near.a, near.b, late / SUBSTEPS),
        far_sample=_sample_step(far.a, far.b, late / SUBSTEPS),
        c_force=near.c_force,
        c_position=near.c_position,
        d_force=float(near.d_force),
        stiffness=float(stiffness),
        damping=damping / sample_time_s,
        whole=whole,
        late=late,
        share=plant.payload.mass_kg / (plant.payload.mass_kg + moved),
        alone=np.ascontiguousarray(wall),
        pressed=pressed,
        pressed_direct=float(moved / h**2 * near.b[-1]),
    )


def _sample_step(rate: FloatArray, drive: FloatArray, late: float) -> SampleStep:
    """Return a whole sample, during the first part of which, `late`, the older command acts."""
    return SampleStep(*hold(rate, drive, late), *hold(rate, drive, 1.0 - late))


def equation_gains(controller: AdmittanceController, sample_time_s: float) -> EquationGains:
    """Return the coefficients of the paper's eq. (discretized admittance)."""
    ratio = controller.damping_n_s_per_m * sample_time_s / (2.0 * controller.mass_kg)
    lead = 2.0 * controller.lead_s / sample_time_s
    (b_0, b_1, b_2), (a_1, a_2) = _biquad(controller, sample_time_s)
    return EquationGains(
        old=1.0 - ratio,
        new=1.0 + ratio,
        gain=sample_time_s * sample_time_s / (4.0 * controller.mass_kg),
        now_weight=1.0 + lead,
        last_weight=2.0,
        before_weight=1.0 - lead,
        feedback=float(controller.feedback_damping_s),
        compensation=float(controller.compensation_mass_kg),
        corner=float(controller.velocity_filter_rad_per_s),
        second_corner=float(controller.acceleration_filter_rad_per_s),
        h=float(sample_time_s),
        b_0=b_0,
        b_1=b_1,
        b_2=b_2,
        a_1=a_1,
        a_2=a_2,
    )


def _biquad(law: AdmittanceController, h: float) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return the coefficients of the biquad in powers of z⁻¹ by scipy's bilinear rule, 1 without one."""
    if not law.has_biquad:
        return (1.0, 0.0, 0.0), (0.0, 0.0)
    zero, pole = law.biquad_zero_s, law.biquad_pole_s
    above, below = scipy.signal.bilinear(
        [zero**2, 2.0 * law.biquad_zero_damping_ratio * zero, 1.0],
        [pole**2, 2.0 * law.biquad_pole_damping_ratio * pole, 1.0],
        fs=1.0 / h,
    )
    (b_0, b_1, b_2), (_, a_1, a_2) = map(float, above), map(float, below)
    return (b_0, b_1, b_2), (a_1, a_2)


def robot_rates(robot: RobotModel, sample_time_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return dynamics, drive and position output of the robot without payload, per sample."""
    alone = Plant(
        robot=robot,
        coupling=Coupling(stiffness_n_per_m=1.0, damping_n_s_per_m=0.0),
        payload=PayloadDynamics(mass_kg=1.0, drag_n_s_per_m=0.0),
    )
    matrices, order = build_plant_matrices(alone, sample_time_s), robot.order
    return matrices.a[:order, :order], matrices.b[:order], matrices.c_position[:order]


def robot_alone(robot: RobotModel, sample_time_s: float) -> RobotAlone:
    """Return the robot without payload, stepped exactly over samples."""
    rate, drive, output = robot_rates(robot, sample_time_s)
    late = robot.delay_s / sample_time_s
    whole = math.floor(late)
    return RobotAlone(
        sample=_sample_step(rate, drive, late - whole),
        output=output,
        whole=whole,
    )
