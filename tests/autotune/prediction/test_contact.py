"""A predicted contact against scipy's integrator, and its interval against what it says of itself."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import autotune as at
from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from autotune.prediction import certified as certified_module
from autotune.prediction.against_touches import (
    ComparedTouch,
    Running,
    compared_touch,
    other_surface,
    sampled_shares,
)
from autotune.prediction.certified import predict_certified
from autotune.prediction.contact import Law, nominal_contact, peak_interval, simulate_on, simulate_others
from autotune.prediction.law import law_notes
from autotune.prediction.plants import PlantEnsemble, Surface, build_plants
from autotune.prediction.result import PredictedContact, predict_contact
from autotune.prediction.series_plant import series_plant
from identification.result import (
    CouplingEstimate,
    Covariance,
    Estimate,
    RobotEstimate,
    Status,
    Touch,
    TouchCause,
    VectorEstimate,
)
from problems.contact.nonlinearities import Deadband
from problems.contact.transient import Approach, build_sampled_contact
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.autotune.formats.samples import make_controller, make_identified
from tests.autotune.prediction.pressing import Cell, contact_peak
from tests.problems.axes import DELAY_S, PERIOD_S
from tests.problems.contact.test_bumper import bumped, stepped

GAINS = {"mass": 13.0, "damping": 1000.0, "lead": 0.02}
PLAIN = AdmittanceController(mass_kg=13.0, damping_n_s_per_m=1000.0, lead_s=0.02)
# The integrator knows neither sampling nor hold: half a sample of 0.2 ms.
FAST_S = 2e-4


def plant_of(cell: Cell, **changes: object) -> at.Plant:
    values: dict[str, object] = {
        "mass": cell.mass,
        "coupling_stiffness": cell.coupling,
        "coupling_damping": cell.coupling_damping,
        "drag": cell.drag,
        "robot": at.Robot(bandwidth=cell.robot / (2.0 * np.pi), delay=0.0),
        "environment_stiffness": cell.wall,
        "sample_time": FAST_S,
    }
    return at.Plant(**values | changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("wall", [8e3, 5e4, 2e5])
@pytest.mark.parametrize("force", [15.0, 40.0])
def test_a_peak_is_that_of_another_integrator(wall: float, force: float) -> None:
    cell = Cell(wall=wall)
    found = at.predict(plant_of(cell), gains=GAINS, approach_force=force)
    expected = contact_peak(cell, mass=13.0, damping=1000.0, lead=0.02, force=force)
    assert found.peak_sensor_force == pytest.approx(expected, rel=0.01)


def test_a_contact_with_a_bumper_is_that_of_two_masses_in_fine_steps() -> None:
    soft = bumped(2.0, 1e5, 90.0, 1e5)
    plant = at.Plant(
        mass=16,
        coupling_stiffness=3e5,
        drag=630,
        robot=at.Robot(numerator=(20.0,), denominator=(1.0, 20.0), delay=DELAY_S),
        environment_stiffness=1e5,
        sample_time=PERIOD_S,
    )
    gains, bumper = {"mass": 10, "damping": 1600, "lead": 0.02, "feedback_damping": 0.01}, soft.bumper
    found = at.predict(plant, gains=gains, approach_force=30.0, bumper=bumper)
    at_wall, at_sensor = stepped(soft, 40)
    assert found.peak_force == pytest.approx(at_wall, rel=5e-3)
    assert found.peak_sensor_force == pytest.approx(at_sensor, rel=5e-3)
    assert "the payload touches with a bumper of 2 kg on 100 N/mm and 90 N·s/m" in found.neglected
    with pytest.raises(at.ParameterError, match="none beside a deadband"):
        at.predict(plant, gains={**gains, "deadband": 5.0}, approach_force=30.0, bumper=bumper)
    heavy = at.Bumper(mass_kg=16.0, stiffness_n_per_m=1e5)
    with pytest.raises(at.ParameterError, match="below the payload's 16 kg"):
        at.predict(plant, gains=gains, approach_force=30.0, bumper=heavy)
    with pytest.raises(at.ParameterError, match=r"must be at\.Bumper"):
        at.predict(plant, gains=gains, approach_force=30.0, bumper=(0.5, 1e5))  # type: ignore[arg-type]


def test_a_speed_with_another_force_after_the_touch() -> None:
    cell = Cell(wall=3e4)
    found = at.predict(plant_of(cell), gains=GAINS, approach_speed=0.04, approach_force=10.0)
    expected = contact_peak(cell, mass=13.0, damping=1000.0, lead=0.02, force=0.04 * 1630.0, speed=0.04, after=10.0)
    assert found.peak_sensor_force == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("shown", "std", "is_other"), [(3.25e3, 700.0, True), (1.2e4, 500.0, False), (7e3, 6e3, False), (None, None, False)]
)
def test_a_log_with_another_surface_is_named(shown: float | None, std: float | None, is_other: bool) -> None:
    """K_s and K_e in series are 13.6 N/mm: a third off and three deviations off, both, is another surface."""
    wall, coupling = 1.5e4, 1.5e5
    predicted = at.predict(plant_of(Cell(wall=wall, coupling=coupling)), gains=GAINS, approach_force=30.0)
    touch = Touch(axis="z", sign=1, cause=TouchCause.WALL, peak_s=2.0, peak_force=30.0)
    status = Status.UNIDENTIFIABLE if shown is None else Status.WEAK
    found = other_surface(
        ComparedTouch(touch=touch, log="a.bag", predicted=predicted), Estimate(value=shown, std=std, status=status)
    )
    assert bool(found) is is_other
    if is_other:
        assert found.startswith("a.bag itself shows 3.25 N/mm over robot travel on axis z, predicted is with 13.6 N/mm")


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_touch_from_which_the_desired_force_points_away_is_not_predicted(sign: int) -> None:
    running = Running(law=Law(controller=PLAIN))
    met = Touch(axis="z", sign=sign, cause=TouchCause.WALL, peak_s=2.0, peak_force=50.0, approach_speed=0.03)
    assert running.approach_at(replace(met, desired_force=30.0 * sign)).after_impact_n == 30.0
    with pytest.raises(at.UsageError, match=r"points away from what is touched in [+-]z: correct its sign"):
        running.approach_at(replace(met, desired_force=-30.0 * sign))
    # What a person says is along the approach.
    said = replace(running, desired_force=20.0)
    assert said.approach_at(replace(met, desired_force=-30.0 * sign)).after_impact_n == 20.0
    with pytest.raises(at.UsageError, match="a hand led the payload into it"):
        said.approach_at(replace(met, is_led=True))


@pytest.mark.parametrize(("stiffness", "period_s"), [(2.6e3, 1e-3), (1.75e4, 1e-3), (1.75e4, 1e-2)])
def test_without_payload_robot_and_spring_are_left(stiffness: float, period_s: float) -> None:
    """The small mass between both halves of the spring changes nothing; the rest is half a sample of delay."""
    plant = series_plant(RobotModel.from_bandwidth(bandwidth_rad_per_s=6.3, delay_s=0.0), stiffness, period_s)
    found = simulate_on(plant, Law(controller=PLAIN), Approach(force_n=30.0), period_s)
    cell = Cell(robot=6.3, wall=stiffness, payload=False)
    expected = contact_peak(cell, mass=13.0, damping=1000.0, lead=0.02, force=30.0)
    assert found.peak_sensor_force_n == pytest.approx(expected, rel=0.005 if period_s < 5e-3 else 0.05)


@pytest.mark.parametrize("delay_s", [0.0, 1.5e-3])
@pytest.mark.parametrize("bandwidth_rad_per_s", [4.0, 12.0, 25.0])
def test_without_payload_free_motion_has_the_modes_of_law_and_robot_alone(
    bandwidth_rad_per_s: float, delay_s: float
) -> None:
    """Nothing feeds back where there is no payload: the slowest mode is the robot's pole or the admittance's."""
    h = 1e-3
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=bandwidth_rad_per_s, delay_s=delay_s)
    pair = build_sampled_contact(build_sampled_plant(series_plant(robot, 1.75e4, h), h))
    admittance = (2.0 * PLAIN.mass_kg / h - PLAIN.damping_n_s_per_m) / (
        2.0 * PLAIN.mass_kg / h + PLAIN.damping_n_s_per_m
    )
    slowest = max(admittance, np.exp(-bandwidth_rad_per_s * h))
    # The small mass is a gram.
    assert spectral_radius(build_loop(pair.free, PLAIN)) == pytest.approx(slowest, abs=1e-4)


@pytest.mark.parametrize("delay", [0.0, 0.06])
def test_poles_and_delay_that_trade_keep_the_lag_that_is_known(delay: float) -> None:
    """A led robot of 2.3 ± 2 Hz whose lag is known to 5 %: every draw has that lag, whatever its poles."""
    whole = make_identified()
    lost = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    omega, lag = 16.0, delay + 1.5 / 16.0
    error = np.array([[0.8 * omega, 0.0], [0.8 * 1.5 / omega, 0.05 * lag]])
    matrix = tuple(tuple(row) for row in (error @ error.T).tolist())
    robot = RobotEstimate(
        numerator=VectorEstimate(value=(omega**2,), std=(200.0,), status=Status.WEAK),
        denominator=VectorEstimate(value=(1.0, 1.5 * omega, omega**2), std=(0.0, 20.0, 200.0), status=Status.WEAK),
        delay_s=Estimate(value=delay, std=0.08, status=Status.WEAK),
        bandwidth_hz=lost,
    )
    axis = replace(
        whole.axes["x"],
        robot=robot,
        coupling=CouplingEstimate(stiffness_n_per_m=lost, damping_n_s_per_m=lost),
        covariance=Covariance(names=("omega", "T_d"), values=(omega, delay), matrix=matrix),
    )
    found = IdentifiedFile(result=replace(whole, axes={"x": axis}), provenance={}, path=IN_MEMORY, sha256="")
    plants = build_plants(found, Surface(stiffness=2e4), axis="x").others

    def poles(model: RobotModel) -> float:
        return float(model.denominator[-2] / model.denominator[-1])

    lags = np.array([each.robot.delay_s + poles(each.robot) for each in plants])
    assert np.median(lags) == pytest.approx(lag, rel=0.02)
    assert np.std(lags) == pytest.approx(0.05 * lag, rel=0.15)
    slowest = max(poles(each.robot) for each in plants)
    assert min(poles(each.robot) for each in plants) < 0.5 * 1.5 / omega < slowest <= np.max(lags) * (1.0 + 1e-9)


def test_a_range_gives_the_extremes_and_a_stiffness_with_its_deviation_counts() -> None:
    cell = Cell()
    plant = plant_of(cell, environment_stiffness=(2e4, 8e4))
    found = at.predict(plant, gains=GAINS, approach_force=30.0)
    assert found.interval.level is None
    low, high = found.interval.sensor
    ends = [at.predict(plant, gains=GAINS, approach_force=30.0, environment_stiffness=k) for k in (2e4, 8e4)]
    assert low == pytest.approx(min(each.peak_sensor_force for each in ends))
    assert high == pytest.approx(max(each.peak_sensor_force for each in ends))
    wide = at.predict(
        plant, gains=GAINS, approach_force=30.0, environment_stiffness=at.Uncertain(4e4, 4e3)
    ).interval.sensor
    narrow = at.predict(plant, gains=GAINS, approach_force=30.0, environment_stiffness=4e4).interval.sensor
    assert wide[0] < narrow[0] == narrow[1]
    assert wide[1] is not None
    assert wide[1] > narrow[0]


def test_an_interval_holds_other_cells_as_often_as_it_says() -> None:
    """Cells drawn from the stated deviations, each pressed by the other integrator: 95 % of 40 is 38 ± 1.4."""
    stds = {"wall": 5e3, "robot": 1.5, "drag": 60.0, "mass": 0.5}
    cell = Cell(coupling_damping=100.0)
    identified = plant_of(cell).file()
    result = identified.result
    (name, axis) = next(iter(result.axes.items()))
    reported = replace(
        axis,
        drag_n_s_per_m=replace(axis.drag_n_s_per_m, std=stds["drag"]),
        environments=tuple(
            replace(each, stiffness_n_per_m=replace(each.stiffness_n_per_m, std=stds["wall"]))
            for each in axis.environments
        ),
        robot=replace(axis.robot, bandwidth_hz=replace(axis.robot.bandwidth_hz, std=stds["robot"] / (2.0 * np.pi))),
    )
    payload = replace(result.payload, mass_kg=replace(result.payload.mass_kg, std=stds["mass"]))
    file = replace(identified, result=replace(result, axes={name: reported}, payload=payload), domain={})
    plants = replace(build_plants(file, Surface()), model_error=None)
    law, approach = Law(controller=PLAIN), Approach(force_n=30.0)
    nominal = nominal_contact(plants, law, approach)
    low, high = peak_interval(plants, nominal, simulate_others(plants, law, approach)).sensor
    assert high is not None
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(40):
        drawn = replace(cell, **{key: getattr(cell, key) + std * rng.standard_normal() for key, std in stds.items()})
        peak = contact_peak(drawn, mass=13.0, damping=1000.0, lead=0.02, force=30.0)
        inside += low <= peak <= high
    assert 34 <= inside <= 40
    # And it is no wider than it must be: six deviations of the wall alone move the peak further.
    assert high - low < 0.4 * nominal.peak_sensor_force_n


def test_the_band_is_the_interval_at_the_peak_and_the_desired_force_at_rest() -> None:
    plants = build_plants(replace(plant_of(Cell()).file(), domain={}), Surface())
    assert plants.model_error is not None
    found = predict_contact(plants, Law(controller=PLAIN), Approach(force_n=30.0))
    low, high = found.interval.sensor
    assert high is not None
    peak = int(np.argmax(found.contact.sensor_force_n))
    # The band takes fewer factors of the model's error than the interval.
    assert found.band.low[peak] == pytest.approx(low, rel=0.05)
    assert found.band.high[peak] == pytest.approx(high, rel=0.05)
    assert high - low > 0.3 * found.peak_sensor_force
    assert found.band.low[-1] == pytest.approx(30.0, rel=2e-3)
    assert found.band.high[-1] == pytest.approx(30.0, rel=2e-3)
    assert np.all(found.band.low <= found.contact.sensor_force_n + 1e-9)
    assert np.all(found.contact.sensor_force_n <= found.band.high + 1e-9)


@pytest.mark.parametrize(
    ("status", "expected_s"), [(Status.WEAK, 1.5e-3), (Status.IDENTIFIED, 25e-3), (Status.GIVEN, 25e-3)]
)
def test_the_period_of_a_slow_log_without_a_command_is_not_the_controllers(status: Status, expected_s: float) -> None:
    """Half a control period is in the delay of such a log; 25 ms of hold would add half of that once more."""
    file = plant_of(Cell(wall=2e3)).file()
    logged = replace(file.result, sample_time_s=replace(file.result.sample_time_s, value=25e-3, status=status))
    assert build_plants(replace(file, result=logged), Surface()).sample_time_s == expected_s


def test_the_interval_of_a_design_is_over_all_its_payloads_unless_one_is_said() -> None:
    controller = make_controller(("x",))
    light, heavy = controller.certificate.domain["x"].payload_mass_kg
    every = predict_certified(controller, "x", 1e5)
    low, high = every.interval.contact
    peaks = [predict_certified(controller, "x", 1e5, payload_mass=mass).peak_force for mass in (light, heavy)]
    assert every.peak_force == max(peaks)
    assert low == pytest.approx(min(peaks))
    assert high == pytest.approx(max(peaks))
    said = predict_certified(controller, "x", 1e5, payload_mass=light).interval.contact
    assert said == pytest.approx((peaks[0], peaks[0]))


def test_the_payload_of_the_hardest_contact_in_the_file_is_looked_at_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The peak over the payload may be highest between the ends of its range."""
    controller = make_controller(("x",))
    light, heavy = controller.certificate.domain["x"].payload_mass_kg
    between, predicted = 0.5 * (light + heavy), controller.predicted["x"]
    hardest = replace(predicted.scenarios[0], payload_mass_kg=between, peak_contact_force_n=1e3)
    file = replace(controller, predicted={"x": replace(predicted, scenarios=(*predicted.scenarios, hardest))})
    looked_at: list[float] = []
    real = predict_contact

    def noted(plants: PlantEnsemble, *arguments: Any) -> PredictedContact:
        found = real(plants, *arguments)
        assert found.plant is not None
        looked_at.append(found.plant.payload.mass_kg)
        return found

    monkeypatch.setattr(certified_module, "predict_contact", noted)
    peak = predict_certified(file, "x", 1e5).peak_force
    assert looked_at == [light, between, heavy]
    assert peak == max(predict_certified(file, "x", 1e5, payload_mass=mass).peak_force for mass in looked_at[:3])


def test_a_peak_above_all_of_the_file_says_so() -> None:
    controller = make_controller(("x",))
    low = [replace(each, peak_contact_force_n=2.0) for each in controller.predicted["x"].scenarios]
    file = replace(controller, predicted={"x": replace(controller.predicted["x"], scenarios=tuple(low))})
    found = predict_certified(file, "x", 1e5)
    assert not found.certified
    said = "; above the 2 N that the controller file predicts at most, so the file does not speak of this contact>"
    assert repr(found).endswith(said)
    assert "note: this peak is above that, so the file does not speak of this contact" in str(found)
    assert ";" not in repr(
        predict_certified(controller, "x", controller.certificate.domain["x"].environment_stiffness_n_per_m[0])
    )


def test_a_biquad_that_is_simulated_is_named() -> None:
    law = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=900.0, lead_s=0.02)
    shaped = replace(
        law, biquad_zero_s=0.01, biquad_zero_damping_ratio=0.2, biquad_pole_s=0.01, biquad_pole_damping_ratio=0.4
    )
    plain, named = (next(law_notes(Law(controller=each), "x")) for each in (law, shaped))
    assert plain.startswith("simulated with M_a 10 kg, B_a 900 N·s/m, K_l 20 ms, B_fb 0 ms and no deadband")
    assert named == plain.replace("B_fb 0 ms", "B_fb 0 ms, a biquad in the path of the force")


def test_what_lies_outside_of_the_certificate_is_said_of_a_design_and_of_its_gains_on_another_plant() -> None:
    controller = make_controller(("x",))
    design, domain = at.Design(controller=controller), controller.certificate.domain["x"]
    stiff, heavy = domain.environment_stiffness_n_per_m[1], domain.payload_mass_kg[1]
    assert at.predict(design, environment_stiffness=stiff, payload_mass=heavy).outside == ()
    found = at.predict(design, environment_stiffness=1.5 * stiff, payload_mass=1.1 * heavy)
    assert [each.partition(" ")[0] for each in found.outside] == ["K_e", "M_p"]
    assert f"note: outside of what the certificate holds: {found.outside[0]}" in str(found)
    assert not found.certified
    assert at.predict(design, environment_stiffness=stiff, approach_force=30.0).outside == ()
    faster = at.predict(design, environment_stiffness=stiff, approach_speed=0.02)
    bumped = at.predict(design, environment_stiffness=stiff, bumper=at.Bumper(mass_kg=0.5, stiffness_n_per_m=2e4))
    for each, why in ((faster, "approach 30 N, here 0.02 m/s"), (bumped, "payload in one piece, here with a bumper")):
        assert (each.certified, each.outside) == (False, (why,))
        assert f"outside of what the certificate holds: {why}" in repr(each)
    robot = at.Robot(bandwidth=3.2, delay=2.4e-3)
    plant = plant_of(Cell(wall=1.5 * stiff), mass=heavy, robot=robot, sample_time=controller.sample_time_s)
    assert at.predict(plant, gains=design, approach_force=30.0).outside[0] == found.outside[0]
    assert at.predict(plant, gains=GAINS, approach_force=30.0).outside == ()


def test_a_surface_in_a_mistaken_unit_and_what_a_design_brings_are_refused() -> None:
    design, plant = at.Design(controller=make_controller(("x",))), plant_of(Cell())
    for source, gains in ((design, None), (plant, GAINS)):
        with pytest.raises(at.ParameterError, match=r"did you mean 20000\?"):
            at.predict(source, gains=gains, environment_stiffness=20, approach_force=30.0)
    for wrong in ({"gains": GAINS}, {"surface": "x1"}, {"sample_time": 1e-3}):
        with pytest.raises(at.UsageError, match=f"{next(iter(wrong))}= does not go with a Design"):
            at.predict(design, **wrong)


def test_a_force_that_rises_until_the_run_ends_has_no_time_of_its_peak() -> None:
    found = at.predict(plant_of(Cell(wall=50.0)), gains=GAINS, approach_force=30.0)
    assert not found.contact.is_settled
    assert found.time_of_peak is None
    assert found.peak_force == pytest.approx(30.0)
    assert "still rises to 30 N at the surface when the run ends" in str(found)
    assert "ms after touching" not in str(found)
    assert all(row[-1] == "still rises" for table in found.parts()[1] for row in table.rows)


def test_loops_that_are_unstable_inside_the_uncertainty_leave_no_upper_end() -> None:
    robot = at.Robot(bandwidth=3.2, delay=2.4e-3)
    plant = plant_of(Cell(coupling_damping=0.0), robot=robot, sample_time=8e-4)
    low_gains = {"mass": 10.0, "damping": 1000.0}
    found = at.predict(plant, gains=low_gains, approach_force=30.0, environment_stiffness=at.Uncertain(2e5, 5e4))
    assert found.interval.unstable_share > 0.0
    assert found.interval.sensor[1] is None
    (note,) = (note for note in found.parts()[2] if "unstable" in note)
    assert "no upper end; it holds the others" in note
    assert "and more" in str(found)
    with pytest.raises(at.UnstableLoopError):
        at.predict(plant, gains=low_gains, approach_force=30.0, environment_stiffness=2e6)


def test_a_subtractive_deadband_raises_the_peak_by_about_its_width() -> None:
    """The law sees the force less the deadband, so at rest it holds F^d and the width."""
    robot = at.Robot(bandwidth=3.2, delay=2.4e-3)
    plants = build_plants(plant_of(Cell(wall=1e4), robot=robot).file(), Surface())
    law, approach = Law(controller=PLAIN, deadband=Deadband(width_n=5.0, kind="subtractive")), Approach(force_n=30.0)  # type: ignore[arg-type]
    with_it = predict_contact(plants, law, approach).contact
    assert with_it.sensor_force_n[-1] == pytest.approx(35.0, rel=0.02)
    without = predict_contact(plants, Law(controller=PLAIN), approach).contact
    assert without.sensor_force_n[-1] == pytest.approx(30.0, rel=0.02)
    # What drives is what acts after the impact, whatever led to it.
    replayed = predict_contact(plants, law, Approach(speed_m_s=0.01, after_impact_n=30.0)).contact
    assert replayed.driving_force_n == 30.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gains": None, "approach_force": 30.0}, "needs gains"),
        ({"gains": GAINS}, "how the contact begins"),
        ({"gains": {"mass": 13.0}, "approach_force": 30.0}, "no damping"),
        ({"gains": {"mass": 13.0, "damping": "much"}, "approach_force": 30.0}, "must be a number"),
        ({"gains": {**GAINS, "stiffness": 1.0}, "approach_force": 30.0}, "found stiffness"),
        ({"gains": GAINS, "approach_force": 30.0, "surface": "x7"}, "not x7"),
        ({"gains": GAINS, "approach_force": 30.0, "axis": "y"}, "not y"),
        ({"gains": GAINS, "approach_force": 30.0, "surface": "surface", "environment_stiffness": 1e4}, "not both"),
    ],
)
def test_what_is_not_said_is_asked_for(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(at.UsageError, match=message):
        at.predict(plant_of(Cell()), **arguments)  # type: ignore[arg-type]
    with pytest.raises(at.UsageError, match="found int"):
        at.predict(3, gains=GAINS, approach_force=30.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("width", [0.9, 2.5, 20.0])
def test_the_largest_sample_of_a_half_sine_by_its_closed_form(width: float) -> None:
    """Samples one apart lie at most half of a step off the peak: cos(π u/width) with u even in (-1/2, 1/2)."""
    time = np.linspace(-2.0, width + 2.0, 20001)
    force = np.where((time > 0.0) & (time < width), np.sin(np.pi * np.clip(time, 0.0, width) / width), 0.0)
    least, mean = sampled_shares(time, force, 1.0)
    half = min(0.5, 0.5 * width)
    # The phases are the middles of fiftieths of a step, so that the farthest is up to a hundredth off the half.
    assert least == pytest.approx(np.cos(np.pi * half / width), abs=0.04 if width < 1.0 else 0.01)
    assert mean == pytest.approx(2.0 * width / np.pi * np.sin(np.pi * half / width), abs=2e-3)
    assert sampled_shares(time, force, None) == (1.0, 1.0)


def test_a_touch_of_a_slow_log_is_held_against_the_largest_sample() -> None:
    predicted = at.predict(plant_of(Cell(wall=3e4)), gains=GAINS, approach_speed=0.03)
    touch = Touch(axis="z", sign=1, cause=TouchCause.WALL, peak_s=2.0, peak_force=predicted.peak_sensor_force)
    fast, slow = (compared_touch(replace(touch, sample_period_s=period), "", predicted) for period in (None, 0.1))
    assert (fast.error_share, fast.interval) == (0.0, predicted.interval.sensor)
    assert slow.error_share < -0.005
    assert slow.interval[0] < fast.interval[0]
    assert slow.interval[1] == fast.interval[1]
