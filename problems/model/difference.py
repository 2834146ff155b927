"""The controller's difference equation in plain arithmetic, needing no library (docs/method.md, "The loop").

`problems.model.controller`, `problems.model.response` and `problems.contact.nonlinear_kernel` compile these functions
into their kernels; the runtime calls them as they are, on a machine that has no compiler. `blocks` is anything that
takes `[row, column]`: an array, or a dictionary.
"""

from typing import Any

# Entries of `blocks`: of each first-order block what acts at once, its pole, and the gain into its state.
INTEGRATOR_DIRECT, INTEGRATOR_POLE, INTEGRATOR_GAIN = (0, 0), (0, 1), (0, 2)
LAG_DIRECT, LAG_POLE, LAG_GAIN = (1, 0), (1, 1), (1, 2)
VELOCITY_DIRECT, VELOCITY_POLE, VELOCITY_GAIN = (2, 0), (2, 1), (2, 2)
ACCELERATION_DIRECT, ACCELERATION_POLE, ACCELERATION_GAIN = (3, 0), (3, 1), (3, 2)
# Then B_fb, P̂ and whether the compensation is ideal; then its gain on the derivative, on x, and on x into the lag.
FEEDBACK_DAMPING, COMPENSATION, IS_IDEAL = (4, 0), (4, 1), (4, 2)
DERIVATIVE_GAIN, POSITION_GAIN, POSITION_TO_LAG = (5, 0), (5, 1), (5, 2)
# The biquad's numerator and denominator in z^-1, without the leading 1 of the latter.
BIQUAD_0, BIQUAD_1, BIQUAD_2 = (6, 0), (6, 1), (6, 2)
BIQUAD_POLE_1, BIQUAD_POLE_2, _UNUSED = (7, 0), (7, 1), (7, 2)
BLOCK_ROWS = 8

# Place of B_a among the parameters of a controller.
DAMPING = 1
# Parameters of a controller without a biquad, and with one.
PLAIN_PARAMETERS, ALL_PARAMETERS = 7, 11

# Integrator, lag, velocity filter, acceleration filter, and two of the biquad.
ControlState = tuple[float, float, float, float, float, float]
# Output of the admittance without what it adds from the robot's motion, the force that drives it, and x, at one tick.
Entry = tuple[float, float, float]


def write_first_order(block: Any, row: int, n1: Any, n0: Any, d1: Any, d0: Any, h: float, theta: float) -> None:
    """Write (direct, pole, gain) of (n1 s + n0)/(d1 s + d0) under s = (z − 1)/(h (θ z + 1 − θ)) into a row.

    y_k = direct·e_k + s_k, s_{k+1} = pole·s_k + gain·e_k.
    """
    lead = d1 + d0 * h * theta
    direct = (n1 + n0 * h * theta) / lead
    pole = (d1 - d0 * h * (1.0 - theta)) / lead
    block[row, 0] = direct
    block[row, 1] = pole
    block[row, 2] = (n0 * h * (1.0 - theta) - n1) / lead + pole * direct


def forward_in_s(parameters: Any) -> Any:
    """Return A(1 + C_ff) = (1 + K_l s)/(B_a s + M_a s²): numerator and denominator in ascending powers of s."""
    return (1.0, parameters[2]), (0.0, parameters[1], parameters[0])


def filters_in_s(parameters: Any, ideal: bool) -> Any:
    """Return C_fb = B_fb ω_v s/(ω_v + s) and O_a = ω_v ω_a s²/((ω_v + s)(ω_a + s)), ideal s², as `forward_in_s`."""
    feedback, corner, acceleration = parameters[3], parameters[4], parameters[5]
    both = corner * acceleration
    observer = ((0.0, 0.0, 1.0), (1.0,)) if ideal else ((0.0, 0.0, both), (both, corner + acceleration, 1.0))
    return ((0.0, feedback * corner), (corner, 1.0)), observer


def biquad_in_s(parameters: Any) -> Any:
    """Return N = (1 + 2 ζ_z τ_z s + τ_z² s²)/(1 + 2 ζ_p τ_p s + τ_p² s²) as `forward_in_s`."""
    zero, zero_damping, pole, pole_damping = parameters[7], parameters[8], parameters[9], parameters[10]
    return (1.0, 2.0 * zero_damping * zero, zero * zero), (1.0, 2.0 * pole_damping * pole, pole * pole)


def write_biquad(blocks: Any, parameters: Any, h: float, theta: float) -> None:
    """Write the sampled form of `biquad_in_s`, 1 for parameters without one, into its two rows."""
    blocks[BIQUAD_0] = 1.0
    for entry in (BIQUAD_1, BIQUAD_2, BIQUAD_POLE_1, BIQUAD_POLE_2, _UNUSED):
        blocks[entry] = 0.0
    if len(parameters) == PLAIN_PARAMETERS:
        return
    (_, n_1, n_2), (_, d_1, d_2) = biquad_in_s(parameters)
    new, old = h * theta, h * (1.0 - theta)
    # s² and s times (θ z + 1 − θ)², so that everything is a polynomial in z.
    lead = d_2 + new * (d_1 + new)
    blocks[BIQUAD_0] = (n_2 + new * (n_1 + new)) / lead
    blocks[BIQUAD_1] = (old * (n_1 + new) - new * (n_1 - old) - 2.0 * n_2) / lead
    blocks[BIQUAD_2] = (n_2 - old * (n_1 - old)) / lead
    blocks[BIQUAD_POLE_1] = (old * (d_1 + new) - new * (d_1 - old) - 2.0 * d_2) / lead
    blocks[BIQUAD_POLE_2] = (d_2 - old * (d_1 - old)) / lead


def write_blocks(blocks: Any, parameters: Any, h: float, theta: float, ideal: bool) -> None:
    """Write the controller's blocks into `blocks` (BLOCK_ROWS, 3), see `controller_step`.

    The first two add up to A(1 + C_ff) = (1/B_a)/s + (K_l − M_a/B_a)/(M_a s + B_a); the third is the velocity filter
    ω_v s/(s + ω_v), the fourth the acceleration filter ω_a s/(s + ω_a) behind it. The sampled form of a sum or of a
    series is the sum or series of the sampled forms, so this is the paper's difference equation in few states. The
    ideal compensation is A(1 + C_ff) s² = (K_l/M_a) s + κ − κ B_a/(M_a s + B_a) with κ = (1 − K_l B_a/M_a)/M_a, whose
    lag shares its pole, and so its state, with the second block; the fourth block is then the derivative.
    """
    (one, lead), (_, damping, mass) = forward_in_s(parameters)
    feedback, corner, acceleration, compensation = parameters[3], parameters[4], parameters[5], parameters[6]
    write_first_order(blocks, 0, 0.0, one / damping, 1.0, 0.0, h, theta)
    write_first_order(blocks, 1, 0.0, lead - mass / damping, mass, damping, h, theta)
    write_first_order(blocks, 2, corner, 0.0, 1.0, corner, h, theta)
    write_biquad(blocks, parameters, h, theta)
    blocks[FEEDBACK_DAMPING] = feedback
    if ideal:
        kappa = compensation * (1.0 - lead * damping / mass) / mass
        write_first_order(blocks, 5, 0.0, -kappa * damping, mass, damping, h, theta)
        blocks[POSITION_GAIN] = kappa + blocks[DERIVATIVE_GAIN]
        blocks[DERIVATIVE_GAIN] = compensation * lead / mass
        write_first_order(blocks, 3, 1.0, 0.0, 0.0, 1.0, h, theta)
        blocks[COMPENSATION] = 0.0
        blocks[IS_IDEAL] = 1.0
    else:
        write_first_order(blocks, 3, acceleration, 0.0, 1.0, acceleration, h, theta)
        blocks[COMPENSATION] = compensation
        blocks[IS_IDEAL] = 0.0
        for entry in (DERIVATIVE_GAIN, POSITION_GAIN, POSITION_TO_LAG):
            blocks[entry] = 0.0


def controller_step(blocks: Any, state: tuple[Any, Any, Any, Any, Any, Any], force: Any, position: Any) -> Any:
    """Return x^d_k from F^d + F and x at the tick, and the six states at the next: the difference equation.

    `blocks` are those of `write_blocks`.
    """
    integral, lag, of_velocity, of_acceleration, newer, older = state
    velocity = blocks[VELOCITY_DIRECT] * position + of_velocity
    source = position * blocks[IS_IDEAL] + velocity * (1.0 - blocks[IS_IDEAL])
    acceleration = blocks[ACCELERATION_DIRECT] * source + of_acceleration
    pushed = force + blocks[COMPENSATION] * acceleration
    drive = blocks[BIQUAD_0] * pushed + newer
    command = (
        integral
        + lag
        + (blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT]) * drive
        - blocks[FEEDBACK_DAMPING] * velocity
        + blocks[DERIVATIVE_GAIN] * acceleration
        + blocks[POSITION_GAIN] * position
    )
    following = (
        blocks[INTEGRATOR_POLE] * integral + blocks[INTEGRATOR_GAIN] * drive,
        blocks[LAG_POLE] * lag + blocks[LAG_GAIN] * drive + blocks[POSITION_TO_LAG] * position,
        blocks[VELOCITY_POLE] * of_velocity + blocks[VELOCITY_GAIN] * position,
        blocks[ACCELERATION_POLE] * of_acceleration + blocks[ACCELERATION_GAIN] * source,
        blocks[BIQUAD_1] * pushed - blocks[BIQUAD_POLE_1] * drive + older,
        blocks[BIQUAD_2] * pushed - blocks[BIQUAD_POLE_2] * drive,
    )
    return command, following


def resume(blocks: Any, recent: Entry, older: Entry) -> tuple[float, float]:
    """Return the states of integrator and lag with which the difference equation goes on from two past entries.

    In the paper's form the memory of A(1 + C_ff) is its last two outputs and inputs: with its pole p,
    y_{k+1} = (1 + p) y_k − p y_{k−1} + direct u_{k+1} + n_1 u_k + n_2 u_{k−1}, and likewise for x, which the ideal
    compensation adds. Whatever is changed between two ticks, outputs or coefficients, the command stays continuous.
    """
    (y_1, u_1, x_1), (y_0, u_0, x_0) = recent, older
    pole, direct = blocks[LAG_POLE], blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT]
    integral_gain, lag_gain = blocks[INTEGRATOR_GAIN], blocks[LAG_GAIN]
    n_1, n_2 = integral_gain + lag_gain - (1.0 + pole) * direct, pole * (direct - integral_gain) - lag_gain
    gain, into_lag = blocks[POSITION_GAIN], blocks[POSITION_TO_LAG]
    m_1, m_2 = into_lag - (1.0 + pole) * gain, pole * gain - into_lag
    both = (1.0 + pole) * y_1 - pole * y_0 + n_1 * u_1 + n_2 * u_0 + m_1 * x_1 + m_2 * x_0
    lag = (pole * (y_1 - both) - n_2 * u_1 - m_2 * x_1) / (1.0 - pole)
    return both - lag, lag


def rest_states(blocks: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return the controller's states at rest at one metre: the filters see no motion, the command is one metre."""
    lag = blocks[POSITION_TO_LAG] / (1.0 - blocks[LAG_POLE])
    derivative = -blocks[ACCELERATION_DIRECT] * blocks[IS_IDEAL]
    # No force has passed the biquad.
    nothing = 0.0 * lag
    return 1.0 - lag - blocks[POSITION_GAIN], lag, -blocks[VELOCITY_DIRECT], derivative, nothing, nothing


def steady_states(blocks: Any, command: float, position: float, speed: float, h: float, force: float) -> ControlState:
    """Return the states of a steady motion at `speed` [m/s] under a constant e = F^d + F, at the tick with x, x^d.

    The filters see a steady speed, the lag a steady force (and, with ideal compensation, a ramp).
    """
    ideal = blocks[IS_IDEAL]
    acceleration = ideal * speed
    share = 1.0 / (1.0 - blocks[LAG_POLE])
    slope = blocks[POSITION_TO_LAG] * share
    lag = (blocks[LAG_GAIN] * force - slope * speed * h) * share + slope * position
    direct = (blocks[INTEGRATOR_DIRECT] + blocks[LAG_DIRECT]) * force - blocks[FEEDBACK_DAMPING] * speed
    return (
        command - lag - direct - blocks[DERIVATIVE_GAIN] * acceleration - blocks[POSITION_GAIN] * position,
        lag,
        speed - blocks[VELOCITY_DIRECT] * position,
        acceleration - blocks[ACCELERATION_DIRECT] * (ideal * position + (1.0 - ideal) * speed),
        (1.0 - blocks[BIQUAD_0]) * force,
        (blocks[BIQUAD_2] - blocks[BIQUAD_POLE_2]) * force,
    )


def controller_gains(blocks: Any, z: Any) -> Any:
    """Return x^d per force e, and −x^d per position x, of the sampled controller at `z`, see `controller_step`."""
    lag = 1.0 / (z - blocks[LAG_POLE])
    integrator = blocks[INTEGRATOR_DIRECT] + blocks[INTEGRATOR_GAIN] / (z - blocks[INTEGRATOR_POLE])
    # Without a biquad exactly 1.
    first = blocks[BIQUAD_1] - blocks[BIQUAD_0] * blocks[BIQUAD_POLE_1]
    second = blocks[BIQUAD_2] - blocks[BIQUAD_0] * blocks[BIQUAD_POLE_2]
    shaped = blocks[BIQUAD_0] + (z * first + second) / ((z + blocks[BIQUAD_POLE_1]) * z + blocks[BIQUAD_POLE_2])
    forward = (integrator + blocks[LAG_DIRECT] + blocks[LAG_GAIN] * lag) * shaped
    velocity = blocks[VELOCITY_DIRECT] + blocks[VELOCITY_GAIN] / (z - blocks[VELOCITY_POLE])
    source = blocks[IS_IDEAL] + velocity * (1.0 - blocks[IS_IDEAL])
    derivative = blocks[ACCELERATION_DIRECT] + blocks[ACCELERATION_GAIN] / (z - blocks[ACCELERATION_POLE])
    acceleration = derivative * source
    compensation = (forward * blocks[COMPENSATION] + blocks[DERIVATIVE_GAIN]) * acceleration
    compensation = compensation + blocks[POSITION_GAIN] + blocks[POSITION_TO_LAG] * lag
    return forward, blocks[FEEDBACK_DAMPING] * velocity - compensation


def measured_motion(blocks: Any, control: ControlState, position: float) -> tuple[float, float]:
    """Return what the controller adds to its output from the robot's motion, and to the force: P̂ times acceleration.

    The first is −C_fb x and, with the ideal compensation, its gain on the derivative; see `controller_step`.
    """
    _, _, of_velocity, of_acceleration, _, _ = control
    velocity = blocks[VELOCITY_DIRECT] * position + of_velocity
    source = position * blocks[IS_IDEAL] + velocity * (1.0 - blocks[IS_IDEAL])
    acceleration = blocks[ACCELERATION_DIRECT] * source + of_acceleration
    return blocks[DERIVATIVE_GAIN] * acceleration - blocks[FEEDBACK_DAMPING] * velocity, blocks[
        COMPENSATION
    ] * acceleration


def shaped_drive(blocks: Any, control: ControlState, pushed: float) -> float:
    """Return what drives the admittance of F^d + F + P̂ O_a x at this tick: it has passed the biquad."""
    _, _, _, _, newer, _ = control
    return float(blocks[BIQUAD_0] * pushed + newer)


def through_deadband(force: float, width: float, subtractive: bool) -> float:
    """Return the force [N] that passes a deadband: beyond `width` whole, or with `subtractive` less the width."""
    if abs(force) <= width:
        return 0.0
    if not subtractive:
        return force
    return force - width if force > 0.0 else force + width


def decayed(exponent: float) -> float:
    """Return e^{−x} for x ≥ 0 by a series and squares, the same bits wherever doubles are IEEE; 0 above 32.

    x/1024 leaves 8 terms of the series an error below rounding, which ten squares make 1e-13 of the result.
    """
    if exponent > 32.0:
        return 0.0
    small, value = exponent / 1024.0, 1.0
    for k in range(7, 0, -1):
        value = 1.0 - small / k * value
    for _ in range(10):
        value = value * value
    return value


def varied_damping(
    damping: float, speed: float, highest: float, lowest: float, decay_s_per_m: float, largest_change: float
) -> float:
    """Return the next B_a: max(highest e^{−decay |v|}, lowest), no farther from `damping` than the largest change."""
    scheduled = highest * decayed(decay_s_per_m * abs(speed))
    scheduled = max(scheduled, lowest)
    if scheduled > damping + largest_change:
        return damping + largest_change
    return max(scheduled, damping - largest_change)


def opposes_motion(force: float, way: float, threshold: float) -> bool:
    """Return whether a force F on the flange opposes its way over the last period by more than the threshold [N].

    The detection of the paper's Algorithm 1: −F sign(v) > threshold. A flange at rest is not opposed.
    """
    return (way > 0.0 and -force > threshold) or (way < 0.0 and force > threshold)
