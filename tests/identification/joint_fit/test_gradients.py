"""The derivatives in the joint fit: against differences, and against those of the symbolic model of `problems`."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from identification.joint_fit.force_kernel import TURNS
from identification.joint_fit.gradients import force_jacobian, step_derivatives
from identification.joint_fit.model import ParameterLayout
from identification.joint_fit.noise import Smoother
from identification.joint_fit.path import FlangePath, commanded_path, measured_path, path_slope, smooth_path
from identification.joint_fit.segments import FREE, OFFSET, Segment, predict_force, run, segment_model, shared_indices
from identification.joint_fit.solve import sizes_of
from problems.arrays import FloatArray
from problems.design.symbolic import Structure, build_symbolic_form
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from tests.identification.synthetic import ramp, sweep

H_S = 1e-3
LOAD = [2.4e5, 120.0, 280.0, 14.0]
ONE_POLE, TWO_POLES = [20.0, 2.35e-3], [35.0, 0.7, 1.6e-3]
KEEP_ALL = Smoother(taps=np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.abs(np.arange(-24, 25)))
NOTHING = Smoother(taps=None)
WALL_M = 8e-3


@dataclass(frozen=True, kw_only=True)
class Case:
    """A span of a second, on a sweep or onto a wall; without `robot` the pose is all there is."""

    robot: tuple[float, ...] = ()
    surface: tuple[float, ...] = ()
    smoother: Smoother = NOTHING
    own: tuple[float, ...] = (5.0, -2.0, 0.3)
    sign: int = 1
    command_m: FloatArray
    start: int = 0

    @property
    def layout(self) -> ParameterLayout:
        order = len(self.robot) - 1 if self.robot else 0
        return ParameterLayout(robot_order=order, surfaces=1 if self.surface else 0)

    @property
    def values(self) -> FloatArray:
        return np.array([*LOAD, *self.robot, *self.surface])

    @property
    def segment(self) -> Segment:
        stop = len(self.command_m) - 5
        return Segment(start=self.start, stop=stop, surface=0 if self.surface else FREE, sign=self.sign)

    def path(self, values: FloatArray) -> FlangePath:
        ticks = np.arange(len(self.command_m))
        pose = self.command_m + 2e-5 * np.sin(0.05 * ticks)
        if not self.robot:
            return measured_path(pose, KEEP_ALL)
        return commanded_path(values[self.layout.robot], self.command_m, pose, self.smoother, H_S)

    def force(self, values: FloatArray, own: FloatArray) -> FloatArray:
        return predict_force(values, own, self.segment, self.path(values), self.layout, H_S)

    def jacobian(self) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives, and the sizes of their parameters."""
        values, layout = self.values, self.layout
        path = self.path(values)
        indices = shared_indices(self.segment, layout, through_robot=bool(self.robot))

        def slope(index: int) -> FlangePath:
            return path_slope(path, values[layout.robot], index - layout.robot.start, H_S)

        _, rows = force_jacobian(values, np.array(self.own), self.segment, path, slope, indices, layout, H_S)
        sizes = sizes_of(values, layout, H_S)
        return rows, np.concatenate([sizes[indices], [1.0, 1.0, 1.0, 1e-3][: len(self.own)]])


def onto_wall(depth_m: float, duration: int = 500) -> FloatArray:
    return np.concatenate([np.zeros(200), (WALL_M + depth_m) * ramp(duration), np.full(400, WALL_M + depth_m)])


SWEEP = sweep(1.0, 1.0 / H_S)
TOUCH = Case(command_m=onto_wall(1.5e-3), own=(-3.0, 0.5, 0.1, WALL_M), start=250)
HARD = replace(TOUCH, command_m=onto_wall(1.5e-3, 150))
CASES = {
    "pose alone": Case(command_m=SWEEP),
    "one pole": Case(command_m=SWEEP, robot=(*ONE_POLE,)),
    "two poles": Case(command_m=SWEEP, robot=(*TWO_POLES,), start=90),
    "beside the robot": Case(command_m=SWEEP, robot=(*ONE_POLE,), smoother=KEEP_ALL),
    "tap": Case(command_m=1e-9 * SWEEP, robot=(*ONE_POLE,), own=(40.0, 300.0, 0.0)),
    "whole delay": Case(command_m=SWEEP, robot=(35.0, 0.7, 2e-3)),
    "contact": replace(TOUCH, robot=(*ONE_POLE,), surface=(5.0e4, 60.0, 0.0)),
    "contact by pose": replace(TOUCH, surface=(5.0e4, 60.0, 2.0)),
    "moving wall": replace(TOUCH, robot=(*TWO_POLES,), surface=(5.0e4, 60.0, 2.0), smoother=KEEP_ALL),
    "bounces": replace(HARD, robot=(60.0, 2.35e-3), surface=(3.0e6, 20.0, 0.0)),
    "bounces of a moving wall": replace(HARD, robot=(60.0, 2.35e-3), surface=(3.0e6, 20.0, 1.0)),
    "the other side": replace(
        TOUCH,
        command_m=-TOUCH.command_m,
        own=(-3.0, 0.5, 0.1, -WALL_M),
        sign=-1,
        robot=(*ONE_POLE,),
        surface=(5.0e4, 60.0, 0.5),
    ),
}

# A delay of whole samples, and walls without a mass.
CORNERS = [("whole delay", 6), ("contact", 8), ("bounces", 8)]


def differences(case: Case, which: int, step: float) -> FloatArray:
    """Central differences of fourth order by parameter `which`, shared or own."""
    forces = []
    for steps in (2.0, 1.0, -1.0, -2.0):
        values, own = case.values, np.array(case.own)
        if which < len(values):
            values[which] += steps * step
        else:
            own[which - len(values)] += steps * step
        forces.append(case.force(values, own))
    return (8.0 * (forces[1] - forces[2]) - (forces[0] - forces[3])) / (12.0 * step)


@pytest.mark.parametrize("name", CASES)
def test_the_derivatives_are_those_of_differences(name: str) -> None:
    case = CASES[name]
    rows, sizes = case.jacobian()
    assert len(rows) == len(case.values) + len(case.own)
    for which, (row, size) in enumerate(zip(rows, sizes, strict=True)):
        if (name, which) in CORNERS:
            continue
        expected = differences(case, which, 1e-3 * size)
        # Rounding leaves 1e-13 of the force, over the step.
        largest = 1e-6 * float(np.max(np.abs(expected))) + 3e-9 / size
        np.testing.assert_allclose(row, expected, rtol=0.0, atol=largest)


@pytest.mark.parametrize(("name", "index"), CORNERS)
def test_at_a_corner_the_derivative_is_that_of_a_larger_value(name: str, index: int) -> None:
    case = CASES[name]
    rows, sizes = case.jacobian()
    step = 1e-4 * sizes[index]
    forces = []
    for steps in range(4):
        values = case.values
        values[index] += steps * step
        forces.append(case.force(values, np.array(case.own)))
    # One-sided, of third order.
    expected = (-11.0 * forces[0] + 18.0 * forces[1] - 9.0 * forces[2] + 2.0 * forces[3]) / (6.0 * step)
    np.testing.assert_allclose(rows[index], expected, rtol=0.0, atol=1e-5 * np.max(np.abs(expected)))


@pytest.mark.parametrize(("name", "least"), [("contact", 1), ("bounces", 5), ("bounces of a moving wall", 3)])
def test_the_cases_touch_and_leave_as_they_say(name: str, least: int) -> None:
    case = CASES[name]
    path = case.path(case.values)
    law = segment_model(case.values, np.array(case.own), case.segment, path, case.layout, H_S)
    modes = run(law, path.cut(case.segment.slice), case.segment).modes
    assert np.sum(modes >= TURNS) >= least


def symbolic(robot: list[float], surface: list[float]) -> tuple[ca.Function, FloatArray]:
    """Return the matrices of `problems` by K_s, B_s, B_p, M_p, the robot's, K_e, B_e, M_e, and these numbers."""
    omega, zeta, delay = robot[0], robot[-2], robot[-1]
    two = len(robot) == 3
    denominator = [1.0, 2.0 * zeta * omega, omega**2] if two else [1.0, omega]
    model = RobotModel(numerator=np.array([denominator[-1]]), denominator=np.array(denominator), delay_s=delay)
    plant = Plant(
        robot=model,
        coupling=Coupling(stiffness_n_per_m=LOAD[0], damping_n_s_per_m=LOAD[1]),
        payload=PayloadDynamics(mass_kg=LOAD[3], drag_n_s_per_m=LOAD[2]),
        environment=Environment(stiffness_n_per_m=surface[0], damping_n_s_per_m=surface[1], mass_kg=surface[2]),
    )
    sampled = build_sampled_plant(plant, H_S)
    controller = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1000.0, lead_s=0.0)
    form = build_symbolic_form(Structure.like(sampled, controller))
    z = ca.MX.sym("z", 4 + len(robot) + 3)
    squared = z[4] ** 2
    monic = ca.vertcat(squared, 2.0 * z[4] * z[5], 1.0) if two else ca.vertcat(z[4], 1.0)
    numerator = ca.vertcat(squared, 0.0) if two else z[4]
    of_plant = ca.vertcat(z[0], z[1], z[3], z[2], z[-3:])
    found = form.plant.call([of_plant, numerator, monic, z[3 + len(robot)] / H_S - sampled.whole_delay])
    return ca.Function("matrices", [z], found, ["z"], form.plant.name_out()), np.array([*LOAD, *robot, *surface])


@pytest.mark.parametrize("robot", [ONE_POLE, TWO_POLES])
@pytest.mark.parametrize("surface", [[0.0, 0.0, 0.0], [5.0e4, 60.0, 2.0]])
def test_the_derivatives_of_a_sample_are_those_of_the_symbolic_model(robot: list[float], surface: list[float]) -> None:
    matrices, values = symbolic(robot, surface)
    z = ca.MX.sym("z", len(values))
    found = dict(zip(matrices.name_out(), matrices.call([z]), strict=True))
    n = len(robot) - 1
    # Payload's rows over (payload, robot, older and newer command), the order of phi and gamma.
    sample = ca.horzcat(found["phi"][n:, n:], found["phi"][n:, :n], found["gamma_old"][n:], found["gamma"][n:])
    exact = ca.Function("exact", [z], [ca.jacobian(ca.vec(sample), z)])(values).full()
    expected = exact.reshape(-1, 2, len(values))
    touches = surface[0] > 0.0
    layout = ParameterLayout(robot_order=n, surfaces=1)
    path = commanded_path(values[4 : 4 + len(robot)], np.zeros(2), np.zeros(2), NOTHING, H_S)
    segment = Segment(start=0, stop=2, surface=0 if touches else FREE)
    ours = step_derivatives(values, segment, path, layout, H_S, moves_robot=True).steps[1 if touches else 0]
    shared = len(values) if touches else len(values) - 3
    for i in range(shared):
        size = np.max(np.abs(expected[:, :, i]))
        np.testing.assert_allclose(ours[: len(expected), :, i], expected[:, :, i], rtol=0.0, atol=1e-9 * size)


@pytest.mark.parametrize("robot", [ONE_POLE, TWO_POLES])
def test_the_derivatives_of_a_span_are_those_of_the_symbolic_model(robot: list[float]) -> None:
    """A sweep in free motion, from rest: the model of `problems` run over its ticks, and differentiated."""
    case = Case(command_m=SWEEP[200:700] - SWEEP[200], robot=(*robot,), own=(0.0, 0.0, 0.0))
    matrices, values = symbolic(robot, [0.0, 0.0, 0.0])
    count, whole = len(case.segment), int(robot[-1] / H_S)
    acting = [np.concatenate([np.zeros(late), case.command_m])[:count] for late in (whole, whole + 1)]
    z = ca.MX.sym("z", len(values))
    found = dict(zip(matrices.name_out(), matrices.call([z]), strict=True))
    state, newer, older = ca.MX.sym("s", found["phi"].shape[0]), ca.MX.sym("u"), ca.MX.sym("o")
    following = found["phi"] @ state + found["gamma"] * newer + found["gamma_old"] * older
    # Right after a tick the older command still acts.
    force = ca.dot(found["c_force"], state) + found["d_force"] * older
    step = ca.Function("step", [state, newer, older, z], [following, force])
    _, forces = step.mapaccum(count)(ca.DM.zeros(state.shape[0]), *[ca.DM(each).T for each in acting], z)
    exact = ca.Function("exact", [z], [forces, ca.jacobian(ca.vec(forces), z)])
    predicted, slopes = exact(values)
    np.testing.assert_allclose(case.force(case.values, np.zeros(3)), predicted.full().ravel(), rtol=0.0, atol=1e-8)
    rows, _ = case.jacobian()
    shared = 4 + len(robot)
    for row, expected in zip(rows[:shared], slopes.full().T[:shared], strict=True):
        np.testing.assert_allclose(row, expected, rtol=0.0, atol=1e-9 * np.max(np.abs(expected)))
    assert np.all(rows[shared + OFFSET] == 1.0)


def test_a_robot_answers_to_a_smooth_command_between_its_samples_as_to_one_that_is_fast() -> None:
    """A sine of 20 Hz logged six times per swing, behind two poles and a delay, against the closed form."""
    period, values, omega = 8e-3, np.array([25.0, 0.8, 5.3e-3]), 2.0 * np.pi * 20.0
    ticks = np.arange(400) * period
    ease = np.clip(ticks / 0.5, 0.0, 1.0) ** 2
    path = smooth_path(values, 1e-3 * ease * np.sin(omega * ticks), np.zeros(400), Smoother(taps=None), period)
    assert path.yielded is not None
    s = 1j * omega
    gain = values[0] ** 2 / (s**2 + 2.0 * values[1] * values[0] * s + values[0] ** 2) * np.exp(-s * values[2])
    late = slice(300, 390)
    answer = 1e-3 * gain * np.exp(s * ticks[late])
    # The start has died away to a thousandth; of a spline through six points of a swing 3 % are left.
    assert path.yielded[late, 0] == pytest.approx(answer.imag, abs=0.03 * 1e-3 * abs(gain))
    assert path.yielded[late, 1] / period == pytest.approx((s * answer).imag, abs=0.03 * 1e-3 * abs(s * gain))


@pytest.mark.parametrize("index", [0, 1, 2])
def test_the_derivatives_of_a_smooth_path_are_those_of_differences(index: int) -> None:
    period, values = 8e-3, np.array([25.0, 0.8, 5.3e-3])
    ticks = np.arange(400) * period
    command = 5e-3 * np.sin(4.0 * ticks**2)

    def path(step: float) -> FlangePath:
        moved = values + np.eye(3)[index] * step
        return smooth_path(moved, command, np.zeros(400), Smoother(taps=None), period)

    step = 1e-3 * float(values[index])
    between = (path(step).cut(slice(50, 350)).drive - path(-step).cut(slice(50, 350)).drive) / (2.0 * step)
    slope = path_slope(path(0.0), values, index, period).cut(slice(50, 350)).drive
    assert slope == pytest.approx(between, abs=1e-3 * float(np.max(np.abs(between))))
