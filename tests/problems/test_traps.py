"""One test or more for every numerical trap that this problem is known to hold."""

import ast
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from problems.arrays import FloatArray
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.maps.loops import build_chunk, designs_around, peaks_of
from problems.maps.parameters import MapQuantity
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics
from problems.model.response import loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop, spectral_radius, stability_matrix
from problems.stability.margins import UnstableLoopError, find_margins, frequency_grid, margins_on_grid, prepare_margins
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import are_stable, radius_of, random_controller, random_plant, sampled_of, stable_loops
from tests.problems.reference import closed_loop

BAD = (math.nan, math.inf, -math.inf)
FORCE = Approach(force_n=30.0)


def smallest_distance(sampled: SampledPlant, controller: AdmittanceController, grid: FloatArray) -> float:
    """Return min |1 + L| on a grid, at both break points, stable or not."""
    response = loop_response(sampled, controller, grid)
    return float(min(np.min(np.abs(1.0 + response.at_force)), np.min(np.abs(1.0 + response.at_command))))


# Trap: a modulus margin can be fine for an unstable loop.


def test_the_fine_modulus_of_an_unstable_loop_is_never_reported() -> None:
    rng, unstable, fine = np.random.default_rng(81), 0, 0
    while unstable < 150:
        sampled, controller = sampled_of(random_plant(rng)), random_controller(rng)
        if radius_of(sampled, controller) < 1.0:
            continue
        unstable += 1
        fine += smallest_distance(sampled, controller, frequency_grid(sampled, 1000)) > 0.5
        with pytest.raises(UnstableLoopError) as refusal:
            find_margins(sampled, controller)
        assert refusal.value.spectral_radius >= 1.0
        assert not are_stable([sampled], [controller])[0, 0]
        if sampled.plant.environment.is_anchored:
            pair = build_sampled_contact(sampled)
            _, peaks = peaks_of(
                [sampled.plant], PERIOD_S, designs_around(controller, {}), FORCE, MapQuantity.PEAK_CONTACT
            )
            assert math.isnan(peaks[0, 0])
            with pytest.raises(UnstableLoopError):
                simulate_contact(pair, controller, FORCE)
    # The trap is there: many of them would pass a sensitivity below 2.
    assert fine >= 10


# Trap: a frequency grid errs on the unsafe side.


def test_a_grid_errs_on_the_unsafe_side_and_the_refined_margin_does_not() -> None:
    nyquist, errors = (1.0 - 1e-9) * math.pi / PERIOD_S, []
    for sampled, controller in stable_loops(np.random.default_rng(82), 60):
        refined = find_margins(sampled, controller).modulus
        coarse, fine = (
            smallest_distance(sampled, controller, np.geomspace(0.5, nyquist, points)) for points in (100, 20_000)
        )
        # 5e-5 is how well a minimum is searched; the fine grid has steps of 0.045 %.
        assert refined <= coarse * (1.0 + 5e-5)
        assert refined <= fine * (1.0 + 5e-5)
        errors.append(coarse / refined - 1.0)
    assert max(errors) > 0.1


# Trap: what is not a number passes for an infinite margin, or takes a whole batch with it.


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize(
    "build",
    [
        pytest.param(lambda v: PayloadDynamics(mass_kg=v, drag_n_s_per_m=1.0), id="M_p"),
        pytest.param(lambda v: PayloadDynamics(mass_kg=1.0, drag_n_s_per_m=v), id="B_p"),
        pytest.param(lambda v: Coupling(stiffness_n_per_m=v, damping_n_s_per_m=0.0), id="K_s"),
        pytest.param(lambda v: Coupling(stiffness_n_per_m=1.0, damping_n_s_per_m=v), id="B_s"),
        pytest.param(lambda v: Environment(stiffness_n_per_m=v), id="K_e"),
        pytest.param(lambda v: Environment(stiffness_n_per_m=1.0, damping_n_s_per_m=v), id="B_e"),
        pytest.param(lambda v: Environment(stiffness_n_per_m=1.0, mass_kg=v), id="M_e"),
        pytest.param(one_pole, id="T_d"),
        pytest.param(lambda v: one_pole(0.0, v), id="bandwidth"),
        pytest.param(
            lambda v: RobotModel(numerator=np.array([1.0, v]), denominator=np.ones(3), delay_s=0.0), id="r(s)"
        ),
        pytest.param(lambda v: admittance(mass=v), id="M_a"),
        pytest.param(lambda v: admittance(damping=v), id="B_a"),
        pytest.param(lambda v: admittance(lead=v), id="K_l"),
        pytest.param(lambda v: admittance(feedback=v), id="B_fb"),
        pytest.param(lambda v: replace(admittance(), velocity_filter_rad_per_s=v), id="ω_v"),
        pytest.param(lambda v: replace(admittance(), acceleration_filter_rad_per_s=v), id="ω_a"),
        pytest.param(lambda v: replace(admittance(), compensation_mass_kg=v), id="P̂"),
        pytest.param(lambda v: Approach(force_n=v), id="force"),
        pytest.param(lambda v: Approach(speed_m_s=v), id="speed"),
        pytest.param(lambda v: Approach(force_n=1.0, after_impact_n=v), id="force after the impact"),
    ],
)
def test_what_is_not_a_number_is_refused_on_entry(build: Callable[[float], object], value: float) -> None:
    with pytest.raises(ParameterError):
        build(value)


@pytest.mark.parametrize("value", [math.nan, math.inf, complex(0.0, math.nan)])
@pytest.mark.parametrize("place", [0, 25, 49])
def test_a_response_that_is_not_finite_has_no_margins(value: complex, place: int) -> None:
    grid = np.linspace(0.1, 1.0, 50)
    loop = np.asarray(0.5 / (1.0 + 1j * grid))
    assert math.isinf(margins_on_grid(grid, loop).gain_db)
    loop[place] = value
    with pytest.raises(ParameterError, match="finite"):
        margins_on_grid(grid, loop)


def overflowing() -> SampledPlant:
    """Return a plant of finite numbers whose motion over one sample is not: K_s far beyond any material."""
    return sampled_of(paper_plant(stiffness=3e4, coupling=1e60))


def test_a_plant_that_is_not_finite_is_refused_in_words() -> None:
    broken, law = overflowing(), admittance(damping=3000.0)
    assert not np.all(np.isfinite(broken.phi))
    good = sampled_of(paper_plant(stiffness=3e4))
    for refused in (
        lambda: find_margins(broken, law),
        lambda: prepare_margins(broken),
        lambda: are_stable([good, broken], [law]),
        lambda: find_margins(replace(good, gamma=good.gamma * math.nan), law),
        lambda: find_margins(replace(good, d_force=math.inf), law),
    ):
        with pytest.raises(ParameterError, match="finite"):
            refused()


def test_a_loop_that_is_not_a_number_is_not_infinitely_robust() -> None:
    """The response is not a number at every frequency, nothing is smaller than that, and the smallest is none."""
    sampled = sampled_of(paper_plant(stiffness=3e4))
    extreme = AdmittanceController(mass_kg=1e-300, damping_n_s_per_m=1e300)
    with pytest.raises(ParameterError, match="finite response"):
        prepare_margins(sampled).find(extreme, 0.5)
    usual, chunk = admittance(damping=3000.0), build_chunk([sampled.plant], PERIOD_S, "contact")
    found = [
        chunk.margins(designs_around(law, {}), np.array([[True]]), MapQuantity.MODULUS)[0, 0]
        for law in (extreme, usual)
    ]
    assert not found[0] > 0.0
    assert found[1] == find_margins(sampled, usual).modulus


def test_one_bad_plant_does_not_spoil_a_batch() -> None:
    """Finite, and so far out that its loop grows by sixty decades per sample."""
    good = [sampled_of(paper_plant(stiffness=k)) for k in (3e4, 3e5)]
    bad = [
        sampled_of(paper_plant(coupling_damping=1e200)),
        sampled_of(paper_plant(mass=1e-300)),
        sampled_of(paper_plant(drag=1e300)),
    ]
    designs = [admittance(damping=damping, lead=0.0) for damping in (700.0, 3000.0)]
    alone = are_stable(good, designs)
    assert {True, False} == set(alone.ravel().tolist())
    mixed = are_stable([good[0], *bad, good[1]], designs)
    np.testing.assert_array_equal(mixed[:, [0, -1]], alone)
    assert not np.any(mixed[:, 1:-1])


# Trap: transfer-function arithmetic gives loops of order 42 to 62 and wrong verdicts.


def test_the_loop_has_no_more_states_than_its_parts_and_python_controls_verdict() -> None:
    rng, verdicts = np.random.default_rng(84), set()
    for _ in range(60):
        plant = random_plant(rng, delay_s=PERIOD_S * int(rng.integers(0, 6)), contact=True)
        sampled, controller = sampled_of(plant), random_controller(rng)
        loop = build_loop(sampled, controller)
        # Robot, payload, past commands, and at most the integrator, the lag and two filters.
        assert len(loop.a) <= plant.robot.order + 2 + sampled.whole_delay + 4
        poles = np.abs(closed_loop(plant, controller, PERIOD_S, sampled.whole_delay).poles())
        radius = spectral_radius(loop)
        if abs(radius - 1.0) > 1e-6:
            # The reference has poles more, which cancel in its controller; those of ω_v and Tustin are on the circle.
            assert (np.max(poles) < 1.0 + 1e-7) == (radius < 1.0)
            verdicts.add(radius < 1.0)
    assert verdicts == {True, False}


# Trap: free space has an integrator at z = 1.


def test_no_verdict_in_free_space_is_decided_by_rounding() -> None:
    rng, plain_flips, stable = np.random.default_rng(85), 0, 0
    for _ in range(250):
        sampled, controller = sampled_of(random_plant(rng, contact=False)), random_controller(rng)
        loop = build_loop(sampled, controller)
        verdict, plain = spectral_radius(loop) < 1.0, set()
        stable += verdict
        for _ in range(4):
            shaken = replace(loop, a=loop.a * (1.0 + 1e-14 * rng.uniform(-1.0, 1.0, loop.a.shape)))
            assert (spectral_radius(shaken) < 1.0) == verdict
            plain.add(bool(np.max(np.abs(np.linalg.eigvals(shaken.a))) < 1.0))
        plain_flips += len(plain) > 1
        shaken_plant = replace(sampled, phi=sampled.phi * (1.0 + 1e-14 * rng.uniform(-1.0, 1.0, sampled.phi.shape)))
        assert are_stable([sampled, shaken_plant], [controller])[0].tolist() == [verdict, verdict]
    assert 50 < stable < 240
    # The trap is there: with the integrator left in, rounding decides most stable loops.
    assert plain_flips > 0.5 * stable


def test_the_integrator_is_taken_out_whole_and_alone() -> None:
    rng = np.random.default_rng(86)
    for _ in range(60):
        loop = build_loop(sampled_of(random_plant(rng, contact=False)), random_controller(rng))
        whole, rest = np.linalg.eigvals(loop.a), np.linalg.eigvals(stability_matrix(loop))
        assert len(rest) == len(whole) - 1
        # det(z − a) = (z − 1) det(z − rest), at points away from every root.
        for z in (-1.7, 1.3 + 0.4j, 2.5j):
            assert np.prod(z - whole) == pytest.approx((z - 1.0) * np.prod(z - rest), rel=1e-9)


# Trap: the stable set is not a half-line, not one interval, and not held by its corners (errata 4, 5, 7).


def stable_leads(drag: float, leads: FloatArray) -> FloatArray:
    free = sampled_of(paper_plant(stiffness=0.0, drag=drag))
    designs = [admittance(mass=10.0, damping=1000.0, lead=float(lead)) for lead in leads]
    return leads[are_stable([free], designs)[:, 0]]


def test_the_stable_leads_of_erratum_7() -> None:
    leads = np.linspace(0.0, 0.08, 801)
    wide, narrow, none = (stable_leads(drag, leads) for drag in (630.0, 300.0, 100.0))
    # The erratum's numbers are rounded to a thousandth ("near", "about").
    assert wide[0] == 0.0
    assert wide[-1] == pytest.approx(0.047, abs=1.1e-3)
    assert narrow[0] == pytest.approx(0.006, abs=6e-4)
    assert narrow[-1] == pytest.approx(0.033, abs=6e-4)
    assert len(none) == 0
    # Each is one interval.
    assert all(np.allclose(np.diff(found), 1e-4) for found in (wide, narrow))


def test_erratum_4_the_printed_example_is_unstable_on_its_wall() -> None:
    sampled, law = sampled_of(paper_plant()), admittance(mass=10.0, damping=1000.0, lead=0.0)
    assert radius_of(sampled, law) > 1.0
    assert not are_stable([sampled], [law])[0, 0]


def test_stable_leads_may_be_two_intervals() -> None:
    """A robot of third order, a light payload and little damping: too little lead, enough, too much, enough again."""
    robot = RobotModel(
        numerator=np.array([23298.0]), denominator=np.array([1.0, 73.978, 1469.4, 23298.0]), delay_s=1.6186e-3
    )
    plant = paper_plant(
        stiffness=6872.8,
        environment_damping=1.8312,
        mass=7.2032,
        drag=107.72,
        coupling=79337.0,
        coupling_damping=12.244,
        robot=robot,
    )
    leads = np.geomspace(0.01, 1.0, 400)
    designs = [admittance(mass=32.308, damping=131.02, lead=float(lead)) for lead in leads]
    found = are_stable([sampled_of(plant)], designs)[:, 0]
    expected = [radius_of(sampled_of(plant), design) < 1.0 for design in designs]
    np.testing.assert_array_equal(found, expected)
    assert np.sum(np.diff(found.astype(int)) == 1) == np.sum(np.diff(found.astype(int)) == -1) == 2


def test_a_range_of_stiffness_may_be_stable_at_nine_points_and_not_between_them() -> None:
    law = admittance(mass=6.0, damping=6500.0, lead=0.0)

    def verdicts(count: int) -> list[bool]:
        walls = np.geomspace(2e3, 2e7, count)
        plants = [
            sampled_of(paper_plant(stiffness=float(wall), mass=48.0, drag=12.0, coupling=1.5e5)) for wall in walls
        ]
        return [bool(verdict) for verdict in are_stable(plants, [law])[0]]

    assert all(verdicts(9))
    assert not all(verdicts(33))


# Trap: functions of other packages that are wrong, or answer wrongly to what is not a number.

FORBIDDEN = frozenset({"slycot", "linfnorm", "ab13dd", "stability_margins", "margin"})
# The benchmarks measure them; the tests of this file name them.
PRODUCT = ("autotune", "problems", "identification", "examples", "tools")


def forbidden_names(source: str) -> set[str]:
    """Return which of the forbidden functions a module imports, or calls on python-control."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {part for alias in node.names for part in alias.name.split(".")}
        elif isinstance(node, ast.ImportFrom):
            found |= {*(node.module or "").split("."), *(alias.name for alias in node.names)}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "control":
            found.add(node.attr)
    return found & FORBIDDEN


def test_no_module_relies_on_what_was_found_wrong(repository: Path) -> None:
    files = [path for folder in PRODUCT for path in (repository / folder).rglob("*.py")]
    assert len(files) > 100
    used = {str(path): forbidden_names(path.read_text(encoding="utf-8")) for path in files}
    assert {path: names for path, names in used.items() if names} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import slycot",
        "from slycot import ab13dd",
        "from control import stability_margins as sm",
        "import control\ncontrol.linfnorm(1)",
        "import control\ncontrol.margin(1)",
    ],
)
def test_the_search_would_see_it(source: str) -> None:
    assert forbidden_names(source)
