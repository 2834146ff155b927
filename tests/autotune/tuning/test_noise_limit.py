"""A limit of the command's noise from the robot's own jitter at rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec, RotationalSpec, read_problem
from autotune.tuning.noise_limit import jitter_notes
from autotune.tuning.problems import build_problems
from identification.errors import EstimateError
from identification.result import Identified
from problems.design.problem import NoiseLimit, Requirements
from problems.errors import ParameterError
from tests.autotune.tuning.cases import identified_plant, known, known_vector
from tests.autotune.tuning.turning import two_axes

SIGMA, PERIOD = 3e-6, 8e-4
SPEC = ProblemSpec(share_of_jitter=0.5)


def shaking(plant: Identified) -> Identified:
    """Return the plant with noise of the pose."""
    sensor = replace(
        plant.sensor,
        position_noise_rms_m=known(SIGMA, 1e-8),
        torque_noise_rms_n_m=known_vector(0.01, 0.03, 0.02),
    )
    return replace(plant, sensor=sensor)


def test_a_share_of_the_jitter_is_one_of_the_speed_that_poses_at_rest_seem_to_have() -> None:
    plant = shaking(identified_plant())
    problems = build_problems(plant, SPEC)
    limit = problems["x"].requirements.command_noise
    assert limit is not None
    assert limit.force_noise_rms_n == 0.14
    assert limit.position_noise_rms_m == SIGMA
    # Another way: poses of a robot that stands still, and the speed from each to the next.
    poses = SIGMA * np.random.default_rng(4).standard_normal(200_000)
    seeming = float(np.sqrt(np.mean((np.diff(poses) / PERIOD) ** 2)))
    assert limit.max_speed_rms_m_s == pytest.approx(0.5 * seeming, rel=0.01)
    (note,) = jitter_notes(problems, plant, SPEC)
    assert note == (
        "Axis x: the noise of the command is limited to 2.65 mm/s RMS, 0.5 of the robot's jitter at rest: "
        "√2 · 3 µm of pose noise per tick of 0.8 ms."
    )
    assert not list(jitter_notes(build_problems(plant, ProblemSpec()), plant, ProblemSpec()))


def test_the_noise_of_the_pose_counts_unless_it_is_said() -> None:
    asked = NoiseLimit(max_speed_rms_m_s=2e-3, force_noise_rms_n=0.2)
    for plant, said, counted in (
        (shaking(identified_plant()), None, SIGMA),
        (shaking(identified_plant()), 0.0, 0.0),
        (identified_plant(), None, None),
    ):
        limit = replace(asked, position_noise_rms_m=said)
        problem = build_problems(plant, ProblemSpec(requirements=Requirements(command_noise=limit)))["x"]
        assert problem.requirements.command_noise == replace(asked, position_noise_rms_m=counted)


def test_it_goes_through_the_lever_unless_the_turning_axes_say_their_own() -> None:
    plant = shaking(two_axes())
    problems = build_problems(plant, SPEC)
    limit = problems["ry"].requirements.command_noise
    assert limit is not None
    assert limit.force_noise_rms_n == 0.03
    assert limit.position_noise_rms_m == pytest.approx(SIGMA / 0.2)
    assert limit.max_speed_rms_m_s == pytest.approx(0.5 * 2.0**0.5 * SIGMA / PERIOD / 0.2, rel=1e-5)
    _, turning = jitter_notes(problems, plant, SPEC)
    assert "13.3 mrad/s RMS" in turning
    assert "a lever of 0.2 m" in turning
    own = NoiseLimit(max_speed_rms_m_s=0.02, force_noise_rms_n=0.05)
    said = replace(SPEC, rotational=RotationalSpec(requirements={"command_noise": own}))
    problems = build_problems(plant, said)
    assert problems["ry"].requirements.command_noise == replace(own, position_noise_rms_m=SIGMA / 0.2)
    assert problems["x"].requirements.command_noise is not None
    (note,) = jitter_notes(problems, plant, said)
    assert note.startswith("Axis x: ")


def test_what_cannot_be_had_is_refused() -> None:
    with pytest.raises(EstimateError, match=r"say max_speed_rms_m_s in requirements\.command_noise of problem\.yaml"):
        build_problems(identified_plant(), SPEC)
    with pytest.raises(ParameterError, match="left out where command_noise says a speed"):
        replace(SPEC, requirements=Requirements(command_noise=NoiseLimit(max_speed_rms_m_s=1e-3)))
    with pytest.raises(ParameterError, match="above 0"):
        ProblemSpec(share_of_jitter=0.0)


def test_problem_yaml_says_it(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("requirements:\n  command_noise: {share_of_jitter: 0.5}\n", encoding="utf-8")
    assert read_problem(path) == SPEC
    path.write_text("requirements:\n  command_noise: {share_of_jitter: 1, soft_n: 2}\n", encoding="utf-8")
    said = (
        r"line 2: requirements\.command_noise must be share_of_jitter alone \(soft_n and noises go with "
        r"max_speed_rms_m_s\), found share_of_jitter and soft_n\."
    )
    with pytest.raises(UsageError, match=said):
        read_problem(path)
