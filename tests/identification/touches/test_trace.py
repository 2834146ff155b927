import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import EstimateError
from identification.touches.trace import identify_trace
from problems.arrays import FloatArray

H_S = 1e-3
TIME_S = np.arange(1500) * H_S
DEPTH_M = np.asarray(0.01 * (1.0 - np.exp(-TIME_S / 0.2)))
SPRING_N_PER_M = 3000.0
BLOW_S = 0.03


def blow(force_n: float) -> FloatArray:
    """Half a sine of 30 ms from the contact on, and a payload that then leaves the surface until 0.12 s."""
    sine = force_n * np.sin(np.pi * TIME_S / BLOW_S) * (TIME_S < BLOW_S)
    off = (TIME_S >= BLOW_S) & (TIME_S < 0.12)
    return np.asarray(sine - SPRING_N_PER_M * DEPTH_M * off)


@given(stiffness=st.floats(1e3, 1e6))
@settings(max_examples=20, deadline=None)
def test_a_spring_is_found_to_rounding(stiffness: float) -> None:
    contact = identify_trace(DEPTH_M, stiffness * DEPTH_M, H_S)
    assert contact.secant_n_per_m == pytest.approx(stiffness, rel=1e-12)
    assert contact.hold_secant_n_per_m == pytest.approx(stiffness, rel=1e-12)
    assert contact.peak_force_n == pytest.approx(stiffness * DEPTH_M[-1], rel=1e-12)
    assert contact.spike is None
    # The last sample below 5 % of the peak lies less than 5 % of the depth away from the beginning.
    assert 0.0 <= contact.touch_m <= 0.05 * DEPTH_M[-1]


def test_the_secant_minimises_the_squares_of_the_loaded_samples() -> None:
    force = SPRING_N_PER_M * DEPTH_M + 3.0 * np.sin(2.0 * np.pi * 14.0 * TIME_S) * np.exp(-TIME_S / 0.3)
    contact = identify_trace(DEPTH_M, force, H_S)
    loaded = force > 0.2 * np.max(force)
    expected = np.linalg.lstsq(DEPTH_M[loaded, None], force[loaded], rcond=None)[0][0]
    assert contact.secant_n_per_m == pytest.approx(expected, rel=1e-9)
    assert abs(contact.secant_n_per_m - SPRING_N_PER_M) < 3.0 * contact.secant_std_n_per_m


def test_a_blow_is_noticed_and_leaves_the_secant_alone() -> None:
    contact = identify_trace(DEPTH_M, SPRING_N_PER_M * DEPTH_M + blow(40.0), H_S)
    assert contact.spike is not None
    # The spring adds 4.2 N at the end of the blow to the sine's 40 N in its middle.
    assert contact.spike.force_n == pytest.approx(40.0 + SPRING_N_PER_M * 0.01 * (1.0 - np.exp(-0.015 / 0.2)), abs=0.3)
    # ∫ sin = 2/π of the duration; the end of the blow, below half of its force, is not counted: 1 − cos(5π/6) of 2.
    assert contact.spike.impulse_n_s == pytest.approx(40.0 * BLOW_S * 2.0 / np.pi, rel=0.1)
    # 30 ms of half a sine weigh x·F = 0.03 N·m·s at most beside x²·k = 0.3.
    assert contact.secant_n_per_m == pytest.approx(SPRING_N_PER_M, rel=0.02)


@pytest.mark.parametrize(("force_n", "is_blow"), [(4.0, False), (12.0, True)])
def test_a_swing_below_twice_the_spring_is_no_blow(force_n: float, is_blow: bool) -> None:
    """It comes where the spring has 8 N, before half of the way, and the payload leaves the surface behind it."""
    late = TIME_S - 0.05
    swing = force_n * np.sin(np.pi * late / BLOW_S) * ((late >= 0.0) & (late < BLOW_S))
    off = SPRING_N_PER_M * DEPTH_M * ((late >= BLOW_S) & (late < 0.1))
    contact = identify_trace(DEPTH_M, SPRING_N_PER_M * DEPTH_M + swing - off, H_S)
    assert (contact.spike is not None) is is_blow


def test_the_hold_is_where_it_was_held_and_not_the_end_of_the_trace() -> None:
    """Pressed for 1.5 s and let go for as long: the last fifth is off the surface."""
    depth = np.concatenate([DEPTH_M, DEPTH_M[::-1][::10], np.zeros(1350)])
    # Stiffer under way than at rest, by the viscous force of the approach.
    force = SPRING_N_PER_M * depth + 200.0 * np.gradient(depth, H_S) * (depth > 0.0)
    contact = identify_trace(depth, np.maximum(force, 0.0), H_S)
    # Within 5 % of the hold's depth the approach still has up to 5 % of 50 mm/s: 0.4 N of 30 N on average.
    assert contact.hold_secant_n_per_m == pytest.approx(SPRING_N_PER_M, rel=0.02)


def test_a_trace_that_only_goes_in_and_out_has_no_hold() -> None:
    depth = 0.01 * (1.0 - np.abs(np.linspace(-1.0, 1.0, 2001)))
    contact = identify_trace(depth, SPRING_N_PER_M * depth, H_S)
    assert contact.hold_secant_n_per_m is None


def test_where_the_contact_begins_is_part_of_the_deviation() -> None:
    gap = 1e-3
    force = SPRING_N_PER_M * np.maximum(DEPTH_M - gap, 0.0)
    contact = identify_trace(DEPTH_M, force, H_S)
    assert contact.touch_m == pytest.approx(gap, abs=5e-4)
    assert abs(contact.secant_n_per_m - SPRING_N_PER_M) < 2.0 * contact.secant_std_n_per_m
    assert abs(contact.loading_n_per_m - SPRING_N_PER_M) < 2.0 * contact.loading_std_n_per_m


@given(stiffness=st.floats(1e3, 1e6))
@settings(max_examples=20, deadline=None)
def test_the_loading_of_a_spring_is_the_spring(stiffness: float) -> None:
    contact = identify_trace(DEPTH_M, stiffness * DEPTH_M, H_S)
    assert contact.loading_n_per_m == pytest.approx(stiffness, rel=1e-9)


@given(kept=st.floats(0.3, 0.95), fall_s=st.floats(0.05, 0.5))
@settings(max_examples=20, deadline=None)
def test_what_relaxes_while_it_is_held_does_not_lower_the_loading(kept: float, fall_s: float) -> None:
    """Loaded in 0.1 s to 10 mm, then held while the force falls to a share: the peak is at the end of the loading."""
    depth = 0.01 * np.minimum(TIME_S / 0.1, 1.0)
    relaxing = kept + (1.0 - kept) * np.exp(-np.maximum(TIME_S - 0.1, 0.0) / fall_s)
    contact = identify_trace(depth, SPRING_N_PER_M * depth * relaxing, H_S)
    assert contact.loading_n_per_m == pytest.approx(SPRING_N_PER_M, rel=1e-3)
    assert contact.hold_secant_n_per_m is not None
    assert contact.hold_secant_n_per_m < SPRING_N_PER_M * (kept + 0.4 * (1.0 - kept))


def test_a_blow_at_the_beginning_leaves_the_loading_alone() -> None:
    contact = identify_trace(DEPTH_M, SPRING_N_PER_M * DEPTH_M + blow(40.0), H_S)
    assert contact.loading_n_per_m == pytest.approx(SPRING_N_PER_M, rel=0.02)


@pytest.mark.parametrize(
    ("displacement", "force"),
    [(DEPTH_M, -SPRING_N_PER_M * DEPTH_M), (DEPTH_M, 200.0 * DEPTH_M), (0.01 * DEPTH_M, SPRING_N_PER_M * DEPTH_M)],
    ids=["pulling", "no force", "no way"],
)
def test_what_is_no_contact_is_refused(displacement: FloatArray, force: FloatArray) -> None:
    with pytest.raises(EstimateError, match="no contact from which a stiffness can be determined"):
        identify_trace(displacement, force, H_S)
