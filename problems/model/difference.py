"""The controller's difference equation in plain arithmetic, needing no library (MODEL.md, "Continuous blocks").

`problems.model.controller` and `problems.contact.nonlinear_kernel` compile these functions into their kernels; the
runtime calls them as
they are, on a machine that has no compiler. `blocks` is anything that takes `[row, column]`: an array, or a dictionary.
"""

from typing import Any

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


def write_blocks(blocks: Any, parameters: Any, h: float, theta: float, ideal: bool) -> None:
    """Write the controller's first-order blocks into `blocks` (6, 3), see `controller_step`.

    The first two add up to A(1 + C_ff) = (1/B_a)/s + (K_l − M_a/B_a)/(M_a s + B_a); the third is the velocity filter
    ω_v s/(s + ω_v), the fourth the acceleration filter ω_a s/(s + ω_a) behind it. The sampled form of a sum or of a
    series is the sum or series of the sampled forms, so this is the paper's difference equation in few states. The
    ideal compensation is A(1 + C_ff) s² = (K_l/M_a) s + κ − κ B_a/(M_a s + B_a) with κ = (1 − K_l B_a/M_a)/M_a, whose
    lag shares its pole, and so its state, with the second block; the fourth block is then the derivative.
    """
    mass, damping, lead, feedback = parameters[0], parameters[1], parameters[2], parameters[3]
    corner, acceleration, compensation = parameters[4], parameters[5], parameters[6]
    write_first_order(blocks, 0, 0.0, 1.0 / damping, 1.0, 0.0, h, theta)
    write_first_order(blocks, 1, 0.0, lead - mass / damping, mass, damping, h, theta)
    write_first_order(blocks, 2, corner, 0.0, 1.0, corner, h, theta)
    blocks[4, 0] = feedback
    if ideal:
        kappa = compensation * (1.0 - lead * damping / mass) / mass
        write_first_order(blocks, 5, 0.0, -kappa * damping, mass, damping, h, theta)
        blocks[5, 1] = kappa + blocks[5, 0]
        blocks[5, 0] = compensation * lead / mass
        write_first_order(blocks, 3, 1.0, 0.0, 0.0, 1.0, h, theta)
        blocks[4, 1] = 0.0
        blocks[4, 2] = 1.0
    else:
        write_first_order(blocks, 3, acceleration, 0.0, 1.0, acceleration, h, theta)
        blocks[4, 1] = compensation
        blocks[4, 2] = 0.0
        for i in range(3):
            blocks[5, i] = 0.0


def controller_step(blocks: Any, state: tuple[Any, Any, Any, Any], force: Any, position: Any) -> Any:
    """Return x^d_k from F^d + F and x at the tick, and the four states at the next: the difference equation.

    Rows of `blocks`: integrator, lag, velocity filter, acceleration (each direct, pole, gain); then B_fb, P̂ and
    whether the compensation is ideal; then its gain on the derivative, on x, and on x into the lag.
    """
    velocity = blocks[2, 0] * position + state[2]
    source = position * blocks[4, 2] + velocity * (1.0 - blocks[4, 2])
    acceleration = blocks[3, 0] * source + state[3]
    drive = force + blocks[4, 1] * acceleration
    command = (
        state[0]
        + state[1]
        + (blocks[0, 0] + blocks[1, 0]) * drive
        - blocks[4, 0] * velocity
        + blocks[5, 0] * acceleration
        + blocks[5, 1] * position
    )
    following = (
        blocks[0, 1] * state[0] + blocks[0, 2] * drive,
        blocks[1, 1] * state[1] + blocks[1, 2] * drive + blocks[5, 2] * position,
        blocks[2, 1] * state[2] + blocks[2, 2] * position,
        blocks[3, 1] * state[3] + blocks[3, 2] * source,
    )
    return command, following


def resume(blocks: Any, recent: Entry, older: Entry) -> tuple[float, float]:
    """Return the states of integrator and lag with which the difference equation goes on from two past entries.

    In the paper's form the memory of A(1 + C_ff) is its last two outputs and inputs: with its pole p,
    y_{k+1} = (1 + p) y_k − p y_{k−1} + direct u_{k+1} + n_1 u_k + n_2 u_{k−1}, and likewise for x, which the ideal
    compensation adds. Whatever is changed between two ticks, outputs or coefficients, the command stays continuous.
    """
    (y_1, u_1, x_1), (y_0, u_0, x_0) = recent, older
    pole, direct, gains = blocks[1, 1], blocks[0, 0] + blocks[1, 0], (blocks[0, 2], blocks[1, 2])
    n_1, n_2 = gains[0] + gains[1] - (1.0 + pole) * direct, pole * (direct - gains[0]) - gains[1]
    m_1, m_2 = blocks[5, 2] - (1.0 + pole) * blocks[5, 1], pole * blocks[5, 1] - blocks[5, 2]
    both = (1.0 + pole) * y_1 - pole * y_0 + n_1 * u_1 + n_2 * u_0 + m_1 * x_1 + m_2 * x_0
    lag = (pole * (y_1 - both) - n_2 * u_1 - m_2 * x_1) / (1.0 - pole)
    return both - lag, lag


def measured_motion(blocks: Any, control: tuple[float, float, float, float], position: float) -> tuple[float, float]:
    """Return what the controller adds to its output from the robot's motion, and to the force: P̂ times acceleration.

    The first is −C_fb x and, with the ideal compensation, its gain on the derivative; see `controller_step`.
    """
    velocity = blocks[2, 0] * position + control[2]
    source = position * blocks[4, 2] + velocity * (1.0 - blocks[4, 2])
    acceleration = blocks[3, 0] * source + control[3]
    return blocks[5, 0] * acceleration - blocks[4, 0] * velocity, blocks[4, 1] * acceleration


def through_deadband(force: float, width: float, subtractive: bool) -> float:
    """Return the force [N] that passes a deadband: beyond `width` whole, or with `subtractive` less the width."""
    if abs(force) <= width:
        return 0.0
    if not subtractive:
        return force
    return force - width if force > 0.0 else force + width


def opposes_motion(force: float, way: float, threshold: float) -> bool:
    """Tell whether a force F on the flange opposes its way over the last period by more than the threshold [N].

    The detection of the paper's Algorithm 1: −F sign(v) > threshold. A flange that stands is not opposed.
    """
    return (way > 0.0 and -force > threshold) or (way < 0.0 and force > threshold)
