"""The CasADi form of the sampled loop: the same equations written on symbols, for exact derivatives.

The equations are those of `problems.model.plant`, `problems.model.sampled`, `problems.model.controller` and
`problems.model.response`, called
with CasADi's SX; only what those modules leave to numpy's linear algebra is spelled out here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._checks import positive
from ..arrays import FloatArray
from ..contact.transient import Approach
from ..errors import ParameterError
from ..model.controller import CONTROLLER_STATES, AdmittanceController, controller_step, write_blocks
from ..model.difference import ALL_PARAMETERS, BLOCK_ROWS, PLAIN_PARAMETERS
from ..model.hold import exponential, squarings_for
from ..model.plant import PLANT_PARAMETERS, Plant, build_plant_matrices, write_plant
from ..model.response import controller_gains
from ..model.sampled import SampledPlant, close_loop, write_open_loop
from .complex_pairs import Pair, pair, solve_resolvent

Arguments = tuple[FloatArray, FloatArray, FloatArray, float, FloatArray]

# Two squarings more than a nominal plant needs: its rates may then grow fourfold at full precision.
_SPARE_SQUARINGS = 2
_INPUTS = ("plant", "numerator", "denominator", "fraction", "controller")
_BIQUAD_STATES = (4, 5)


@dataclass(frozen=True, kw_only=True)
class Structure:
    """What fixes the shape of the equations; everything else is a symbol.

    T_d = (`whole_delay` + fraction)·h; the fraction is a symbol in [0, 1] if `has_fraction`. Derivatives by it are
    those inside the sample: at a whole delay they are one-sided. A state missing in `controller_states` belongs to a
    parameter that is zero: 2 for B_fb, 3 for P̂ (with the ideal compensation for K_l); those of the biquad, 4 and 5,
    are `has_biquad`'s. `squarings` is how often the
    arguments of the matrix exponentials are halved, see `covers`. With `has_filter` the wrench has passed a filter, τ
    being the last of the plant's parameters.
    """

    sample_time_s: float
    robot_order: int
    whole_delay: int
    has_fraction: bool
    theta: float
    is_ideal: bool
    controller_states: tuple[int, ...]
    squarings: int
    has_filter: bool = False
    has_biquad: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))
        states, filtered = self.controller_states, (0, 1, 3) if self.is_ideal else (0, 1, 2, 3)
        if states not in {(0, 1), (0, 1, 2), filtered, (0, 1, 2, 3)}:
            raise ParameterError("controller_states", states, f"(0, 1), (0, 1, 2), {filtered} or (0, 1, 2, 3)")
        if self.is_ideal and self.theta == 0.0:
            raise ParameterError("theta", self.theta, "above 0 (a derivative ahead of time is none)")

    @classmethod
    def like(
        cls,
        sampled: SampledPlant,
        controller: AdmittanceController,
        *,
        controller_states: Sequence[int] | None = None,
        spare_squarings: int = _SPARE_SQUARINGS,
    ) -> "Structure":
        """Take the structure of a plant and a controller.

        By default B_fb is a parameter, zero or not, and P̂ if it is not zero.
        """
        if controller_states is None:
            controller_states = (0, 1, 2, 3) if controller.compensates else (0, 1, 2)
        return cls(
            sample_time_s=sampled.sample_time_s,
            robot_order=sampled.plant.robot.order,
            whole_delay=sampled.whole_delay,
            has_fraction=sampled.fraction > 0.0,
            theta=controller.theta,
            is_ideal=controller.is_ideal,
            controller_states=tuple(controller_states),
            squarings=_needed_squarings(sampled.plant, sampled.sample_time_s) + spare_squarings,
            has_filter=sampled.plant.wrench_filter.time_constant_s > 0.0,
            has_biquad=controller.has_biquad,
        )

    def covers(self, plant: Plant) -> bool:
        """Return whether the exponentials of this plant are exact to rounding (one squaring short: to 1e-12)."""
        return _needed_squarings(plant, self.sample_time_s) <= self.squarings

    @property
    def chain_length(self) -> int:
        """Past commands that the plant still has to see."""
        return self.whole_delay + (1 if self.has_fraction else 0)

    @property
    def law_states(self) -> tuple[int, ...]:
        """All states of the controller that count."""
        return (*self.controller_states, *(_BIQUAD_STATES if self.has_biquad else ()))

    @property
    def plant_states(self) -> int:
        """States of the continuous plant."""
        return self.robot_order + 2 + self.has_filter

    @property
    def state_count(self) -> int:
        """States of plant, delay chain and controller."""
        return self.plant_states + self.chain_length + len(self.law_states)


def _needed_squarings(plant: Plant, h: float) -> int:
    m = build_plant_matrices(plant, h)
    return int(squarings_for(np.column_stack([m.a, m.b, m.push])))


def arguments_of(sampled: SampledPlant, controller: AdmittanceController) -> Arguments:
    """Return the numbers that the functions of a `SymbolicForm` take first: plant, r(s), fraction, controller."""
    numerator, denominator = sampled.plant.robot.ascending()
    return sampled.plant.parameters(), numerator, denominator, sampled.fraction, controller.parameters()


@dataclass(frozen=True, kw_only=True)
class _Symbols:
    """The symbolic inputs, in the order of `_INPUTS`."""

    plant: ca.SX
    numerator: ca.SX
    denominator: ca.SX
    fraction: ca.SX
    controller: ca.SX

    def all(self) -> list[ca.SX]:
        return [self.plant, self.numerator, self.denominator, self.fraction, self.controller]


def _symbols(structure: Structure) -> _Symbols:
    return _Symbols(
        plant=ca.SX.sym("plant", PLANT_PARAMETERS + structure.has_filter),
        numerator=ca.SX.sym("numerator", structure.robot_order),
        denominator=ca.SX.sym("denominator", structure.robot_order + 1),
        fraction=ca.SX.sym("fraction"),
        controller=ca.SX.sym("controller", ALL_PARAMETERS if structure.has_biquad else PLAIN_PARAMETERS),
    )


@dataclass(frozen=True, kw_only=True)
class _Plant:
    """`problems.model.sampled.SampledPlant` on symbols; outputs are columns as well."""

    phi: ca.SX
    gamma: ca.SX
    gamma_old: ca.SX
    gamma_push: ca.SX
    c_position: ca.SX
    c_force: ca.SX
    d_force: ca.SX
    c_contact: ca.SX
    d_contact: ca.SX
    push_contact: ca.SX


def _plant(structure: Structure, symbols: _Symbols, parameters: ca.SX) -> _Plant:
    n = structure.plant_states
    a, direct = ca.SX(n, n), ca.SX(3, 1)
    b, push, c_position, c_force, c_contact = (ca.SX(n, 1) for _ in range(5))
    robot = (symbols.numerator, symbols.denominator)
    write_plant(a, b, push, c_position, c_force, c_contact, direct, *robot, parameters, structure.sample_time_s)

    def hold(columns: ca.SX, duration: Any) -> tuple[ca.SX, ca.SX]:
        size = n + columns.shape[1]
        augmented = ca.SX(size, size)
        augmented[:n, :n] = a * duration
        augmented[:n, n:] = columns * duration
        whole = exponential(augmented, ca.SX.eye(size), structure.squarings)
        return whole[:n, :n], whole[:n, n:]

    phi, held = hold(ca.horzcat(b, push), 1.0)
    gamma, gamma_old = held[:, 0], ca.SX(n, 1)
    if structure.has_fraction:
        _, newer = hold(b, 1.0 - symbols.fraction)
        gamma, gamma_old = newer, gamma - newer
    return _Plant(
        phi=phi,
        gamma=gamma,
        gamma_old=gamma_old,
        gamma_push=held[:, 1],
        c_position=c_position,
        c_force=c_force,
        d_force=direct[0],
        c_contact=c_contact,
        d_contact=direct[1],
        push_contact=direct[2],
    )


def _blocks(structure: Structure, controller: ca.SX) -> ca.SX:
    values, states = list(ca.vertsplit(controller)), structure.controller_states
    if 2 not in states:
        values[3] = ca.SX(0.0)
    if 3 not in states:
        values[2 if structure.is_ideal else 6] = ca.SX(0.0)
    blocks = ca.SX(BLOCK_ROWS, 3)
    write_blocks(blocks, values, structure.sample_time_s, structure.theta, structure.is_ideal)
    return blocks


def _controller_rows(blocks: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return rows (x^d, the next states) over columns (the states) and over (e, x)."""
    states, inputs = ca.SX.sym("states", CONTROLLER_STATES), ca.SX.sym("inputs", 2)
    state = (states[0], states[1], states[2], states[3], states[4], states[5])
    command, following = controller_step(blocks, state, inputs[0], inputs[1])
    rows = ca.vertcat(command, *following)
    return ca.jacobian(rows, states), ca.jacobian(rows, inputs)


@dataclass(frozen=True, kw_only=True)
class _Loop:
    """`problems.model.sampled.SampledLoop` on symbols, and F_e while in contact."""

    a: ca.SX
    b: ca.SX
    b_push: ca.SX
    c_force: ca.SX
    d_force: ca.SX
    c_command: ca.SX
    d_command: ca.SX
    c_contact: ca.SX
    d_contact: ca.SX
    push_contact: ca.SX


def _loop(structure: Structure, plant: _Plant, blocks: ca.SX) -> _Loop:
    of_states, of_inputs = _controller_rows(blocks)
    kept, chain, n, size = (
        structure.law_states,
        structure.chain_length,
        plant.phi.shape[0],
        structure.state_count,
    )
    rows = [*(1 + i for i in kept), 0]
    controller = ca.horzcat(of_states[rows, list(kept)], of_inputs[rows, :])
    m = ca.SX(size + 2, size + 3)
    parts = (plant.phi, plant.gamma, plant.gamma_old, plant.gamma_push, plant.c_position, plant.c_force, plant.d_force)
    write_open_loop(m, parts, structure.whole_delay, chain, controller)
    for signal in (size + 1, size):
        close_loop(m, signal, signal, size + 2, size + 3)
    # The elimination has touched every entry; those that are zero for any number go again.
    m = ca.sparsify(m)
    command, c_contact, d_contact = m[size + 1, :], ca.SX(1, size), ca.SX(0.0)
    c_contact[:n] = plant.c_contact
    if chain > 0:
        c_contact[n + chain - 1] = plant.d_contact
    else:
        c_contact, d_contact = c_contact + plant.d_contact * command[:size], plant.d_contact * command[size]
    return _Loop(
        a=m[:size, :size],
        b=m[:size, size],
        b_push=m[:size, size + 2],
        c_force=m[size, :size],
        d_force=m[size, size],
        c_command=command[:size],
        d_command=command[size],
        c_contact=c_contact,
        d_contact=d_contact,
        push_contact=plant.push_contact,
    )


def _plant_response(structure: Structure, plant: _Plant, turn: ca.SX) -> tuple[Pair, Pair, Pair]:
    """Return z, F/x^d and X/x^d at the angle ωh, as `model.response.plant_response` does; the robot ignores F."""
    n, d, count = structure.robot_order, structure.whole_delay, structure.plant_states
    z, late = Pair(re=ca.cos(turn), im=ca.sin(turn)), Pair(re=ca.cos(turn * d), im=-ca.sin(turn * d))
    drive = [plant.gamma[i] + plant.gamma_old[i] * z.conjugate for i in range(count)]
    states = solve_resolvent(plant.phi[:n, :n], z, drive[:n])
    pushed = [drive[i] + sum(plant.phi[i, j] * states[j] for j in range(n)) for i in range(n, count)]
    states += solve_resolvent(plant.phi[n:, n:], z, pushed)
    force = plant.d_force * (z.conjugate if structure.has_fraction else pair(1.0))
    force += sum(plant.c_force[i] * state for i, state in enumerate(states))
    position = sum((plant.c_position[i] * state for i, state in enumerate(states)), start=pair(0.0))
    return z, late * force, late * position


def _response(structure: Structure, plant: _Plant, parameters: ca.SX, blocks: ca.SX, omega: ca.SX) -> dict[str, ca.SX]:
    """Return `problems.model.response.loop_response` and `rendered_admittance` in real arithmetic."""
    z, force, position = _plant_response(structure, plant, omega * structure.sample_time_s)
    forward, feedback = controller_gains(blocks, z)
    damped, pressed = feedback * position, force * forward
    at_force, at_command = -pressed / (1.0 + damped), damped - pressed
    admittance = forward * position * Pair(re=0.0, im=omega) / (1.0 + damped)
    if structure.has_filter:
        admittance = admittance / Pair(re=1.0, im=omega * parameters[PLANT_PARAMETERS])
    return {
        "at_force": _column(at_force),
        "at_command": _column(at_command),
        "squared_distance_at_force": ca.SX((1.0 + at_force).squared),
        "squared_distance_at_command": ca.SX((1.0 + at_command).squared),
        "admittance": _column(admittance),
    }


def _column(value: Pair) -> ca.SX:
    column: ca.SX = ca.vertcat(value.re, value.im)
    return column


@dataclass(frozen=True, kw_only=True, eq=False)
class SymbolicForm:
    """The sampled loop of one structure as CasADi functions of numbers or of further symbols.

    All take `plant` (7,), or (8,) with a filter of the wrench, as in `Plant.parameters`, `numerator` (n,) and
    `denominator` (n + 1,) as in `RobotModel.ascending` (r(0) = 1 is the caller's to keep), `fraction`, and all but
    `plant` take `controller` (7,), or (11,) with a biquad, as in
    `AdmittanceController.parameters`.

    `plant`: the matrices of `SampledPlant`. `loop`: those of `SampledLoop`, and F_e = c_contact s + d_contact F^d +
    push_contact f while in contact. `response` (with `frequency_rad_per_s`): L and L_x as (Re, Im), |1 + L|² and
    |1 + L_x|², and the rendered admittance G as (Re, Im).
    """

    plant: ca.Function
    loop: ca.Function
    response: ca.Function


def build_symbolic_form(structure: Structure) -> SymbolicForm:
    """Write the equations of one structure on symbols."""
    symbols, omega = _symbols(structure), ca.SX.sym("frequency_rad_per_s")
    plant, blocks = _plant(structure, symbols, symbols.plant), _blocks(structure, symbols.controller)
    loop = _loop(structure, plant, blocks)
    response = _response(structure, plant, symbols.plant, blocks, omega)
    inputs = symbols.all()
    return SymbolicForm(
        plant=ca.Function("plant", inputs[:4], list(vars(plant).values()), list(_INPUTS[:4]), list(vars(plant))),
        loop=ca.Function("loop", inputs, list(vars(loop).values()), list(_INPUTS), list(vars(loop))),
        response=ca.Function(
            "response", [*inputs, omega], list(response.values()), [*_INPUTS, "frequency_rad_per_s"], list(response)
        ),
    )


def build_contact_forces(structure: Structure, approach: Approach, samples: int) -> ca.Function:
    """Build the forces at the first ticks of a contact, for as long as the payload stays on the environment.

    Takes what `SymbolicForm.loop` takes; returns `sensor_force` (−F) and `contact_force` (F_e), both (samples,), and
    the speed `speed` of the impact. The approach is steady (see `problems.contact.transient`) and follows the
    parameters: more damping is a slower impact where the approach is driven by a force. Neither stability nor what
    happens between the ticks is computed.
    """
    symbols, h = _symbols(structure), structure.sample_time_s
    blocks = _blocks(structure, symbols.controller)
    free = _plant(structure, symbols, ca.vertcat(symbols.plant[:4], ca.SX(3, 1), symbols.plant[PLANT_PARAMETERS:]))
    loop = _loop(structure, _plant(structure, symbols, symbols.plant), blocks)

    # Plant state and command of a steady motion by one metre per sample, and of rest under a push of one newton.
    ramp, command = _ramp(structure, free)
    moving = free.c_force.T @ ramp[:, 0] + free.d_force * (command[0] - structure.chain_length)
    damping = symbols.controller[1]
    speed, push, desired, push_after = _drive(approach, damping - moving * h)
    scale = ca.vertcat(speed * h, push)
    state, newest = ramp @ scale, command @ scale
    # Without a biquad its states are none of those that are solved for.
    solved = CONTROLLER_STATES - (0 if structure.has_biquad else len(_BIQUAD_STATES))
    rest = _controller_state(blocks, 1.0, ca.SX(solved, 1), 0.0, 1.0)
    control = _controller_state(blocks, newest, rest * speed * h, damping * speed, free.c_position.T @ state)
    # The environment's mass takes its part of the payload's momentum.
    state[-1] = state[-1] * symbols.plant[2] / (symbols.plant[2] + symbols.plant[6])
    past = [newest - (i + 1) * speed * h for i in range(structure.chain_length)]
    s = ca.vertcat(state, *past, control[list(structure.law_states)])

    parts = [loop.a, loop.b * desired + loop.b_push * push_after, loop.c_force, loop.c_contact]
    direct = ca.vertcat(loop.d_force * desired, loop.d_contact * desired + loop.push_contact * push_after)
    prepared = ca.Function("prepared", symbols.all(), [s, *parts, direct, ca.SX(speed)])
    inputs = [ca.MX.sym(name, value.shape) for name, value in zip(_INPUTS, symbols.all(), strict=True)]
    start, *matrices, impact_speed = prepared.call(inputs)
    walked = (
        _walk(structure.state_count, [part.sparsity() for part in parts])
        .mapaccum(samples)
        .call([start, *(ca.repmat(matrix, 1, samples) for matrix in (*matrices,))])
    )
    outputs = [-walked[1].T, walked[2].T, impact_speed]
    return ca.Function("contact_forces", inputs, outputs, list(_INPUTS), ["sensor_force", "contact_force", "speed"])


def _walk(states: int, sparsities: Sequence[Any]) -> ca.Function:
    """Return one tick of a run under constant forces: the next state, F and F_e."""
    state, direct = ca.SX.sym("state", states), ca.SX.sym("direct", 2)
    a, b, c_force, c_contact = (ca.SX.sym(f"part_{i}", sparsity) for i, sparsity in enumerate(sparsities))
    outputs = [a @ state + b, c_force @ state + direct[0], c_contact @ state + direct[1]]
    return ca.Function("tick", [state, a, b, c_force, c_contact, direct], outputs)


def _drive(approach: Approach, resistance: ca.SX) -> tuple[Any, Any, Any, Any]:
    """Return speed and hand force before the impact, F^d and hand force after it; `resistance` is force per speed."""
    speed: Any = approach.speed_m_s if approach.force_n is None else approach.force_n / resistance
    force: Any = speed * resistance if approach.force_n is None else approach.force_n
    after = force if approach.after_impact_n is None else approach.after_impact_n
    return (speed, force, 0.0, after) if approach.driven_by == "hand" else (speed, 0.0, after, 0.0)


def _ramp(structure: Structure, free: _Plant) -> tuple[ca.SX, ca.SX]:
    """Solve for plant state and command, x_p = 0, that repeat themselves one metre further on, or rest under a push."""
    r, n = structure.robot_order, structure.plant_states
    moved = ca.SX(n, 1)
    moved[0] = moved[n - 2] = 1.0
    # Free space does not know where it is: first with the command that acts at 0, then moved to where x_p is 0.
    rate, right = free.phi - ca.SX.eye(n), ca.horzcat(moved + free.gamma_old, -free.gamma_push)
    robot = _solve_chain(rate[:r, :r], right[:r, :])
    payload = ca.solve(rate[r:, r:], right[r:, :] - rate[r:, :r] @ robot)
    shift = -payload[n - 2 - r, :]
    return ca.vertcat(robot, payload) + moved @ shift, shift + ca.horzcat(structure.whole_delay, 0.0)


def _solve_chain(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Eliminate with pivots above the diagonal, where a chain of integrators has its ones.

    CasADi's own solution by Gram-Schmidt loses every digit with a robot of five slow poles.
    """
    n = matrix.shape[0]
    order = [*range(1, n), 0]
    rows = ca.horzcat(matrix[:, order], right)
    for k in range(n):
        rows[k, :] = rows[k, :] / rows[k, k]
        for i in range(n):
            if i != k:
                rows[i, :] = rows[i, :] - rows[i, k] * rows[k, :]
    found: ca.SX = rows[:, n:]
    return found[[order.index(j) for j in range(n)], :]


def _controller_state(blocks: ca.SX, command: Any, drift: ca.SX, force: Any, position: Any) -> ca.SX:
    """Solve for the first states that give this command and move on by `drift` (but for the integrator's)."""
    of_states, of_inputs = _controller_rows(blocks)
    count = drift.shape[0]
    rows, moving = [0, *range(2, count + 1)], ca.diag(ca.SX([0.0, *[1.0] * (count - 1)]))
    right = ca.vertcat(command, drift[1:]) - of_inputs[rows, :] @ ca.vertcat(force, position)
    return ca.solve(of_states[rows, :count] - moving, right)
