"""Three ways through a contact: scalars for three states, loops for any number, and sample by sample with care."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import problems.contact.transient
from problems.arrays import FloatArray
from problems.contact.event_free_steps import step_three_states, step_without_events
from problems.contact.kernel import run_contact, steady_start
from problems.contact.kernel_types import FLAGS, FOUND, Contact, Forces, Moment, RunResults, Start, TickRange, Traces
from problems.contact.transient import build_sampled_contact
from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.plant import Environment, Plant
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import (
    BOUNCING,
    LAW,
    PERIOD_S,
    STRUCTURES,
    any_controllers,
    between,
    one_pole,
    or_zero,
    paper_plant,
    plants,
)

SAMPLES = 250
# A light payload on a soft coupling against a hard wall leaves it several times.


@st.composite
def walls(draw: st.DrawFn) -> Environment:
    """Draw what the stretches are for: anchored, without mass, and not so stiff that the ticks are too few."""
    return Environment(stiffness_n_per_m=draw(between(1e3, 3e5)), damping_n_s_per_m=draw(or_zero(between(1.0, 300.0))))


@st.composite
def touching_plants(draw: st.DrawFn, *, poles: int | None = None) -> Plant:
    """Draw plants with a delay; `poles` 1 is the robot that the scalar form is for."""
    plant = draw(plants(st.floats(0.05, 5.0).map(lambda samples: samples * PERIOD_S), contact=False))
    if poles == 1:
        plant = replace(plant, robot=one_pole(plant.robot.delay_s, draw(between(10.0, 80.0))))
    return plant.in_contact_with(draw(walls()))


def started(plant: Plant, controller: AdmittanceController, speed: float) -> tuple[Contact, FloatArray, Start]:
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    blocks = controller_blocks(controller, PERIOD_S)
    effort = controller.damping_n_s_per_m * speed
    chain = pair.free.chain_length
    start = steady_start(pair.ramp, pair.free.c_position, blocks, chain, PERIOD_S, speed, 3.0, effort)
    return pair.arguments, blocks, start


def walk(
    function: object, plant: Contact, blocks: FloatArray, start: Start, span: tuple[int, int], *, touching: bool = True
) -> tuple[int, Moment, list[int], FloatArray, FloatArray]:
    """Run one of the two stretches and return tick, moment, flags, traces and peaks."""
    now = Moment(start.state.copy(), start.past.copy(), start.control.copy(), np.zeros(2))
    flags, traces, found = np.array([0, int(touching), 0]), np.zeros((2, SAMPLES)), np.zeros(FOUND)
    assert len(flags) == FLAGS
    both, forces = Traces(traces[0], traces[1]), Forces(30.0, 3.0)
    crest, ends = np.full((2, len(now.state) + 3), -1.0), TickRange(*span, span[1])
    tick, aim = function(  # type: ignore[operator]
        plant, blocks, now, flags, forces, ends, RunResults(both, found, crest)
    )
    assert aim == span[1]
    return tick, now, flags.tolist(), traces, found


@LAW
@given(touching_plants(poles=1), any_controllers(), st.booleans())
def test_the_scalar_form_is_the_general_one(plant: Plant, controller: AdmittanceController, touching: bool) -> None:
    arguments, blocks, start = started(plant, controller, 0.01)
    # Apart, the walk begins a little in front of the wall.
    start.state[-2] -= 0.0 if touching else 1e-4
    results = [
        walk(f, arguments, blocks, start, (0, SAMPLES), touching=touching)
        for f in (step_without_events, step_three_states)
    ]
    (tick, now, flags, traces, found), (tick_3, now_3, flags_3, traces_3, found_3) = results
    assert (tick, flags) == (tick_3, flags_3)
    assert tick > 0
    # The same sums in another order, 250 times; F is a difference of terms up to 1e3 times as large. Some of the random
    # loops are unstable: rounding grows with the force itself.
    np.testing.assert_allclose(traces_3, traces, rtol=0.0, atol=1e-12 * max(1.0, np.max(np.abs(traces))) * 1e3)
    seen = needed_states(blocks)  # the scalar form leaves the others alone
    for ours, theirs in ((now_3[0], now[0]), (now_3[1], now[1]), (now_3[2][seen], now[2][seen])):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * max(1e-3, np.max(np.abs(theirs))))
    np.testing.assert_allclose(found_3[[0, 2]], found[[0, 2]], rtol=1e-9, atol=1e-9)


# With lead the ideal compensation by Tustin's rule oscillates at the Nyquist frequency, and grows.
UNSTABLE = {"ideal, lead", "ideal, lead, feedback"}


@pytest.mark.parametrize("name", sorted(STRUCTURES.keys() - UNSTABLE))
def test_a_stable_walk_is_the_same_to_rounding(name: str) -> None:
    """Nothing grows there, and nothing but rounding differs."""
    plant = paper_plant(stiffness=1e5)
    assert spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), stable(name))) < 1.0
    arguments, blocks, start = started(plant, stable(name), 0.01)
    (tick, now, _, traces, _), (tick_3, now_3, _, traces_3, _) = (
        walk(f, arguments, blocks, start, (0, SAMPLES)) for f in (step_without_events, step_three_states)
    )
    assert tick == tick_3
    np.testing.assert_allclose(traces_3, traces, rtol=0.0, atol=1e-12 * np.max(np.abs(traces)))
    np.testing.assert_allclose(now_3[0], now[0], rtol=0.0, atol=1e-12 * np.max(np.abs(now[0])))


def stable(name: str) -> AdmittanceController:
    return replace(STRUCTURES[name], damping_n_s_per_m=4000.0)


def peaks(plant: Contact, blocks: FloatArray, start: Start, samples: int = SAMPLES) -> tuple[FloatArray, FloatArray]:
    traces, found = np.empty((2, samples)), np.zeros(FOUND)
    run_contact(plant, blocks, start, Forces(30.0, 3.0), Traces(traces[0], traces[1]), found, False)
    return traces, found


def with_care(plant: Contact, monkeypatch: pytest.MonkeyPatch, model: Plant) -> Contact:
    """Return the same contact with looks between the ticks, which no stretch is made for."""
    monkeypatch.setattr(problems.contact.transient, "SUBSTEPS_PER_RADIAN", 40.0)
    # Anew: the contact of this plant is kept.
    careful = build_sampled_contact.__wrapped__(build_sampled_plant(model, PERIOD_S)).arguments
    assert len(plant.inside) == 0 < len(careful.inside)
    return careful


@pytest.mark.parametrize(
    ("plant", "name"),
    [
        (paper_plant(stiffness=1e5), "lead"),
        (paper_plant(stiffness=3e5, robot=one_pole(2.2e-3), coupling_damping=200.0), "filtered, feedback"),
        (paper_plant(stiffness=2e4, environment_damping=80.0, robot=one_pole(3e-4)), "ideal, backward Euler"),
        (BOUNCING, "lead"),
        (replace(BOUNCING, robot=one_pole(2.2e-3)), "filtered, forward Euler"),
    ],
    ids=["whole delay", "fraction", "delay below a sample", "bouncing", "bouncing, fraction"],
)
def test_sample_by_sample_with_care_is_the_same_walk(plant: Plant, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The careful steps look between the ticks and search every peak at once; the stretches search it afterwards."""
    arguments, blocks, start = started(plant, stable(name), 0.01)
    # The careful steps look into the last sample as well: the run ends after the peak, or at rest.
    traces, found = peaks(arguments, blocks, start, 800)
    careful_traces, careful_found = peaks(with_care(arguments, monkeypatch, plant), blocks, start, 800)
    assert found[3] < 799.0 or found[2] == 33.0
    scale = np.max(np.abs(traces))
    # Rounding alone, which the events of a bounce multiply by the stiffness over the force.
    bounces = np.any(traces[1][1:] == 0.0)
    assert bounces == (plant.payload.mass_kg == 4.0)
    np.testing.assert_allclose(careful_traces, traces, rtol=0.0, atol=(1e-9 if bounces else 1e-12) * scale)
    assert careful_found[[0, 2]] == pytest.approx(found[[0, 2]], rel=1e-9 if bounces else 1e-12)
    # A crest is flat: its moment is known to the root of what its value is.
    assert careful_found[3] == pytest.approx(found[3], abs=1e-4)


@pytest.mark.parametrize("parts", [(0, 1, 2, 3, 100, 101, SAMPLES), tuple(range(SAMPLES + 1))])
def test_a_stretch_can_be_cut_anywhere(parts: tuple[int, ...]) -> None:
    """Tick by tick or all at once: the same numbers to the last digit."""
    arguments, blocks, start = started(paper_plant(stiffness=1e5), stable("lead"), 0.01)
    for function in (step_without_events, step_three_states):
        _, whole, _, traces, found = walk(function, arguments, blocks, start, (0, SAMPLES))
        now = Moment(start.state.copy(), start.past.copy(), start.control.copy(), np.zeros(2))
        flags, pieces, peak = np.array([0, 1, 0]), np.zeros((2, SAMPLES)), np.zeros(FOUND)
        crest, forces = np.full((2, len(now.state) + 3), -1.0), Forces(30.0, 3.0)
        for span in itertools.pairwise(parts):
            results = RunResults(Traces(pieces[0], pieces[1]), peak, crest)
            reached = function(arguments, blocks, now, flags, forces, TickRange(*span, span[1]), results)
            assert reached == (span[1], span[1])
        np.testing.assert_array_equal(pieces, traces)
        np.testing.assert_array_equal(peak, found)
        for ours, theirs in zip(now[::2], whole[::2], strict=True):
            np.testing.assert_array_equal(ours, theirs)


@LAW
@given(touching_plants(), any_controllers())
def test_a_stretch_stops_at_the_sample_in_which_the_payload_leaves(
    plant: Plant, controller: AdmittanceController
) -> None:
    arguments, blocks, start = started(plant, controller, 0.05)
    tick, _, flags, traces, _ = walk(step_without_events, arguments, blocks, start, (0, SAMPLES))
    whole, _ = peaks(arguments, blocks, start)
    away = np.flatnonzero(whole[1][1:] == 0.0) + 1
    # Away for the first time at the tick after the last one of the stretch, which itself still presses.
    assert tick == (away[0] - 1 if away.size else SAMPLES)
    assert flags[1] == 1
    # One of three states runs through the scalar form.
    np.testing.assert_allclose(traces[:, :tick], whole[:, :tick], rtol=0.0, atol=1e-9 * np.max(np.abs(traces)))


@LAW
@given(touching_plants(), any_controllers())
def test_the_peaks_of_a_stretch_are_those_of_its_traces(plant: Plant, controller: AdmittanceController) -> None:
    arguments, blocks, start = started(plant, controller, 0.05)
    tick, _, _, traces, found = walk(step_without_events, arguments, blocks, start, (0, SAMPLES))
    assert found[0] == max(0.0, np.max(-traces[0][:tick], initial=0.0))
    assert found[2] == np.max(traces[1][:tick], initial=0.0)
    if found[2] > 0.0:
        assert traces[1][int(found[3])] == found[2]
