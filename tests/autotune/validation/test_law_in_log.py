"""A command is known by its law: made by another form of the same equations, explained to rounding."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.formats.controller_record import AxisGains
from autotune.validation.log_contacts import felt, follow_law
from problems.arrays import FloatArray
from problems.contact.nonlinearities import DeadbandType
from problems.model.controller import AdmittanceController, controller_blocks, controller_step

H = 8e-4
PLAIN = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=1200.0, lead_s=0.015)
FULL = replace(PLAIN, feedback_damping_s=0.01, compensation_mass_kg=12.0)
SHAPED = replace(
    FULL,
    biquad_zero_s=0.01,
    biquad_zero_damping_ratio=0.3,
    biquad_pole_s=0.006,
    biquad_pole_damping_ratio=0.7,
)
GAINS = AxisGains(
    mass=10.0,
    damping=1200.0,
    lead_s=0.015,
    feedback_damping_s=0.0,
    deadband=5.0,
    deadband_type=DeadbandType.THRESHOLD,
)


def motion(count: int = 700) -> tuple[FloatArray, FloatArray]:
    """Return force and position of something like a contact, not of any loop."""
    time = np.arange(count) * H
    force = -6.0 - 60.0 * (time > 0.15) * (1.0 - np.exp(-(time - 0.15) / 0.03)) * (1.0 + 0.3 * np.cos(90.0 * time))
    return force, 0.4 + 0.02 * np.minimum(time, 0.2) + 1e-4 * np.sin(40.0 * time)


def commands(law: AdmittanceController, force: FloatArray, position: FloatArray, desired: float) -> FloatArray:
    """Return the commands of the state form, from a state in the middle of a motion."""
    blocks, state = controller_blocks(law, H), (0.41, 1e-4, -60.0, -7000.0, 2.0, -3.0)
    state = state if law.has_biquad else (*state[:4], 0.0, 0.0)
    sent = []
    for felt_force, place in zip(felt(GAINS, force), position, strict=True):
        command, state = controller_step(blocks, state, desired + float(felt_force), float(place))
        sent.append(command)
    return np.array(sent)


@pytest.mark.parametrize("law", [PLAIN, FULL, SHAPED], ids=["plain", "with feedback and compensation", "with a biquad"])
def test_its_own_law_explains_a_command_to_rounding(law: AdmittanceController) -> None:
    force, position = motion()
    found = follow_law(law, GAINS, H, commands(law, force, position, 30.0), position, force)
    assert found.left_share < 1e-8
    # What the filters remember at the beginning and F^d look alike for a while.
    assert found.desired_force == pytest.approx(30.0, rel=1e-4)


@pytest.mark.parametrize(
    "other",
    [
        replace(PLAIN, damping_n_s_per_m=1320.0),
        replace(PLAIN, mass_kg=20.0),
        replace(PLAIN, lead_s=0.0),
        replace(PLAIN, feedback_damping_s=0.02),
    ],
    ids=["damping", "mass", "lead", "feedback"],
)
def test_another_law_leaves_more_than_a_hundredth(other: AdmittanceController) -> None:
    force, position = motion()
    sent = commands(PLAIN, force, position, 30.0)
    assert follow_law(other, GAINS, H, sent, position, force).left_share > 0.01


def test_the_deadband_is_the_files() -> None:
    force = np.array([-20.0, -5.0, -4.0, 0.0, 5.0, 5.1])
    subtractive = replace(GAINS, deadband_type=DeadbandType.SUBTRACTIVE)
    assert felt(GAINS, force).tolist() == [-20.0, 0.0, 0.0, 0.0, 0.0, 5.1]
    assert felt(subtractive, force) == pytest.approx([-15.0, 0.0, 0.0, 0.0, 0.0, 0.1])
