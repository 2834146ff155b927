"""Exports to other controllers: what is written is what was certified, and one test for each of their traps."""

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.export import fzi_cartesian, ros2_control, third_party
from autotune.export import retune as retune_module
from autotune.export.export import export_controller
from autotune.export.fzi_axis import FziAxis
from autotune.export.fzi_cartesian import FziOptions
from autotune.export.retune import QuickJudge, retune
from autotune.export.ros2_axis import JOINT_DAMPING_PER_S, Ros2Axis
from autotune.export.ros2_control import Ros2Options
from autotune.export.third_party import Translation
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import AxisGains
from autotune.formats.limits import AxisLimits, Limits
from autotune.validation.bouncing import BounceSearch
from autotune.validation.law import AxisTask, LawCertificate, certify_law
from problems.design.uncertainty import Scenario
from problems.model.linear_controllers import LinearController
from problems.model.third_party_controllers import SpringAdmittance, alternates
from tests.autotune.export.peer_cases import (
    CELL,
    EASY,
    LEAD,
    PERIOD_S,
    PLAIN,
    exported,
    load_as_ros,
    parameters,
    peer_controller,
    requirements,
    task_of,
    translated,
)

LEVEL = FziOptions(orientation=(0.0, 0.0, 0.0, 1.0))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Translation:
    return exported(tmp_path_factory.mktemp("plain"), peer_controller({"x": PLAIN}, EASY), Ros2Options())


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Translation:
    return exported(tmp_path_factory.mktemp("tuned"), peer_controller({"x": LEAD}), Ros2Options())


@pytest.fixture(scope="module")
def fzi(tmp_path_factory: pytest.TempPathFactory) -> Translation:
    return exported(tmp_path_factory.mktemp("fzi"), peer_controller({"z": PLAIN}, EASY), LEVEL)


def test_gains_that_the_other_controller_can_express_are_translated(plain: Translation) -> None:
    (axis,) = plain.axes
    assert axis.tuned_because is None
    rule = parameters(plain)["admittance"]
    assert rule["mass"][0] == PLAIN.mass
    # 2 ζ √(M S) and what the joints take are the damping, to the six digits that are written.
    damping = 2.0 * rule["damping_ratio"][0] * np.sqrt(rule["mass"][0] * rule["stiffness"][0])
    damping += rule["joint_damping"] * rule["mass"][0]
    assert damping == pytest.approx(PLAIN.damping, rel=1e-5)
    # The same law but for Euler's rule and a weak spring: nearly the same peak.
    assert axis.peak_n == pytest.approx(axis.peak_before_n, rel=0.03)


def test_what_fails_without_its_lead_is_tuned_anew_and_the_price_is_reported(tuned: Translation) -> None:
    (axis,) = tuned.axes
    assert axis.tuned_because is not None
    assert "modulus_margin must be at least 0.5" in axis.tuned_because
    assert axis.peak_n > axis.peak_before_n
    more = f"{axis.peak_n - axis.peak_before_n:.1f} N more"
    own = f"{axis.peak_before_n:.1f} N with the law of the file itself"
    assert axis.price() == f"{axis.peak_n:.1f} N, {own}: {more}"
    assert more in " ".join(line.removeprefix("#").strip() for line in tuned.text.splitlines())
    assert axis.certificate.holds


def test_what_is_written_is_what_was_certified(tuned: Translation) -> None:
    written = parameters(tuned)["admittance"]
    values = {name: written[name][0] for name in ("mass", "damping_ratio", "stiffness")}
    rule = SpringAdmittance(
        **values,
        joint_damping_per_s=written["joint_damping"],
        filter_coefficient=parameters(tuned)["ft_sensor"]["filter_coefficient"],
    )
    again = certify_law(task_of(peer_controller({"x": LEAD})), rule.law(PERIOD_S))
    assert again.holds
    assert again.margins is not None
    assert tuned.axes[0].certificate.margins is not None
    assert again.margins.values == tuned.axes[0].certificate.margins.values
    assert again.worst == tuned.axes[0].certificate.worst


def test_the_search_leaves_nothing_better_in_its_box() -> None:
    """Random designs, judged by the same quick judge without its reserve, against the tuned one's certified peak."""
    task = task_of(peer_controller({"x": LEAD}))
    axis = Ros2Axis(task=task, gains=LEAD)
    values, found = retune(task, axis)
    assert found.worst is not None
    ends = tuple(
        Scenario(environment_stiffness_n_per_m=k, payload_mass_kg=16.0) for k in CELL.environment_stiffness_n_per_m
    )
    judge, rng = QuickJudge(task, ends, 0.0), np.random.default_rng(3)
    low, high = (np.log([getattr(each, end) for each in axis.variables]) for end in ("low", "high"))
    # Half of them all over the box, half of them near by.
    far, near = rng.uniform(low, high, (60, 2)), np.log(values) + rng.uniform(-0.15, 0.15, (60, 2))
    costs = [judge.cost(axis.law(tuple(point))) for point in np.exp(np.clip(np.vstack([far, near]), low, high))]
    assert min(costs) > found.worst.peak_contact_force_n * 0.995
    assert min(costs) < 1e3  # some of them are feasible


def test_nothing_is_written_where_the_other_controller_cannot_do_it(tmp_path: Path) -> None:
    source, out = tmp_path / "controller.yaml", tmp_path / "out.yaml"
    write_controller(source, peer_controller({"x": LEAD}, requirements(9e-4)))
    earlier = "# Written by autotune 0.0 for ros2_controllers admittance_controller.\n"
    out.write_text(earlier, encoding="utf-8")
    with pytest.raises(
        InfeasibleError,
        match=r"Axis x: that controller cannot do what was asked\. .*nearest that was found: mass .* misses \w+ by",
    ):
        export_controller(source, "ros2_control", out)
    assert out.read_text(encoding="utf-8") == earlier


def test_what_an_infeasible_search_misses_is_reported_whole_and_nothing_in_its_box_misses_less() -> None:
    task = task_of(peer_controller({"x": LEAD}, requirements(9e-4)))
    axis = Ros2Axis(task=task, gains=LEAD)
    with pytest.raises(InfeasibleError) as caught:
        retune(task, axis)
    shares = [float(each) for each in re.findall(r"by (\S+) %", str(caught.value))]
    # Two requirements that pull against each other are missed alike where the worse of them is least.
    assert len(shares) == 2
    assert shares[0] == pytest.approx(shares[1], abs=0.3)
    judge, rng = QuickJudge(task, retune_module._first_scenarios(task), 0.004), np.random.default_rng(4)
    numbers = re.search(r"mass (\S+), damping_ratio (\S+), stiffness (\S+);", str(caught.value))
    assert numbers is not None
    mass, ratio, stiffness = (float(each) for each in numbers.groups())
    damping = 2.0 * ratio * np.sqrt(mass * stiffness) + JOINT_DAMPING_PER_S * mass
    low, high = (np.log([getattr(each, end) for each in axis.variables]) for end in ("low", "high"))
    near = np.log([mass / damping, damping]) + rng.uniform(-0.1, 0.1, (60, 2))
    least = min(judge.cost(axis.law(tuple(point))) for point in np.exp(np.clip(near, low, high)))
    assert least > 1e9 * (1.0 + max(shares) / 100.0 - 0.002)


def test_the_law_s_own_speed_is_not_left_to_change_sign_in_every_cycle(tmp_path: Path) -> None:
    """Much damping beside little mass: the plant loads the loop so that it is stable and has every margin."""
    steep = replace(LEAD, mass=2.0, damping=4521.44, lead_s=0.03, feedback_damping_s=0.0)
    asked = {**requirements(2e-4), "modulus_margin": 0.4}
    made = exported(tmp_path, peer_controller({"x": steep}, asked), Ros2Options())
    assert made.axes[0].tuned_because is not None
    assert "sign of its speed" in made.axes[0].tuned_because
    rule = SpringAdmittance(**made.axes[0].written, joint_damping_per_s=JOINT_DAMPING_PER_S, filter_coefficient=1.0)
    # The peak wants as little mass as there may be.
    assert 0.0 <= rule.own_pole(PERIOD_S) < 1e-4
    assert made.axes[0].certificate.holds
    assert "M ≥ h·(D + J·M) keeps it from being negative" in re.sub(r"\n#\s*", " ", made.text)
    # What such a search would find without that floor has all that is asked, and is refused.
    task = task_of(peer_controller({"x": steep}, asked))
    ratio = rule.damping / (2.0 * np.sqrt(1.69275 * rule.stiffness))
    light = replace(rule, mass=1.69275, damping_ratio=float(ratio)).law(PERIOD_S)
    assert certify_law(task, light).holds
    stiff = Scenario(environment_stiffness_n_per_m=1.2e5, payload_mass_kg=16.0)
    assert QuickJudge(task, (stiff,), 0.0).cost(light) == np.inf


@pytest.mark.parametrize("coefficient", [1.0, 0.3])
def test_no_corner_of_a_search_changes_sign_in_every_cycle(coefficient: float) -> None:
    task = task_of(peer_controller({"x": PLAIN}, EASY))
    for axis in (
        Ros2Axis(task=task, gains=PLAIN, filter_coefficient=coefficient),
        Ros2Axis(task=task, gains=PLAIN, filter_coefficient=coefficient, fixed_mass=1.7),
        Ros2Axis(task=task, gains=PLAIN, filter_coefficient=coefficient, fixed_mass=0.01),
        FziAxis(task, PLAIN),
    ):
        for corner in itertools.product(*((each.low, each.high) for each in axis.variables)):
            assert not alternates(axis.law(corner))


def test_limits_that_the_other_controller_does_not_enforce_are_reported(tmp_path: Path) -> None:
    limits = Limits(
        force_n=400.0,
        torque_n_m=30.0,
        axes={"x": AxisLimits(speed=0.25, acceleration=20.0)},
        pose_speed_m_s=1.0,
        pose_speed_rad_s=2.0,
        stale_wrench_s=0.05,
        stale_pose_s=0.05,
        rest_samples=100,
        rest_force_n=5.0,
        rest_torque_n_m=1.0,
    )
    plain = peer_controller({"x": PLAIN}, EASY)
    made = exported(tmp_path, replace(plain, limits=limits), Ros2Options())
    assert any(line.startswith("limits (400 N, 30 N·m, commanded x 0.25 m/s, stale") for line in made.dropped)
    made = exported(tmp_path, replace(plain, limits=None), Ros2Options())
    assert not any(line.startswith("limits") for line in made.dropped)


def test_every_axis_that_cannot_be_done_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def impossible(task: AxisTask, _: Ros2Axis) -> None:
        raise InfeasibleError(f"nothing does for {task.axis}")

    monkeypatch.setattr(third_party, "retune", impossible)
    with pytest.raises(InfeasibleError, match=r"Axis x: .*nothing does for x\. Axis z: .*nothing does for z\."):
        exported(tmp_path, peer_controller({"x": LEAD, "z": LEAD}), Ros2Options(ros2_version="rolling"))


def test_fewer_joints_than_axes_are_refused_and_fewer_than_six_are_reported(tmp_path: Path) -> None:
    both = peer_controller({"x": PLAIN, "z": PLAIN}, EASY)
    with pytest.raises(UsageError, match=r"--joints names 1 joint \(rail\) for 2 controlled axes"):
        exported(tmp_path, both, Ros2Options(joints=("rail",)))
    made = exported(tmp_path, peer_controller({"x": PLAIN}, EASY), Ros2Options(joints=("a", "b")))
    assert "axis x: only 2 joints are named" in made.axes[0].notes[-1]


def test_the_same_file_gives_the_same_bytes(tmp_path: Path, plain: Translation) -> None:
    write_controller(tmp_path / "controller.yaml", peer_controller({"x": PLAIN}, EASY))
    again = translated(read_controller(tmp_path / "controller.yaml"), Ros2Options())
    assert again.text == plain.text


def test_numbers_have_a_point_and_no_exponent_and_keys_are_the_controllers_own(
    plain: Translation, tuned: Translation, fzi: Translation
) -> None:
    for made, known in (
        (plain, ros2_control.KNOWN_KEYS),
        (tuned, ros2_control.KNOWN_KEYS),
        (fzi, fzi_cartesian.KNOWN_KEYS),
    ):
        leaves = dict(_leaves(parameters(made)))
        assert set(leaves) <= known
        for path, value in leaves.items():
            for each in value if isinstance(value, list) else [value]:
                assert isinstance(each, bool | str | float) or path == "solver.iterations", (path, each)
        assert not re.search(r"^[^#\n]*\d[eE][+-]?\d", made.text, re.MULTILINE)


def _leaves(tree: dict[str, Any], within: str = "") -> list[tuple[str, Any]]:
    found = []
    for key, value in tree.items():
        found += _leaves(value, f"{within}{key}.") if isinstance(value, dict) else [(f"{within}{key}", value)]
    return found


def test_the_header_names_source_version_rate_and_what_was_dropped(tmp_path: Path, tuned: Translation) -> None:
    digest = write_controller(tmp_path / "controller.yaml", peer_controller({"x": LEAD}))
    message = re.sub(r"\n#\s*", " ", tuned.text)
    for part in (
        "ros2_controllers admittance_controller 4.42.0 (jazzy)",
        digest,
        "an update rate of 1250 Hz",
        "Dropped: axis x: lead K_l = 20.9 ms.",
        "Dropped: axis x: feedback damping B_fb = 5 ms.",
        "Dropped: axis x: deadband = 5 N.",
        "Dropped: sensor bias",
    ):
        assert part in message
    assert load_as_ros(tuned.text)["controller_manager"]["ros__parameters"]["update_rate"] == 1250


def test_a_rotational_axis_has_its_own_units_and_places(tmp_path: Path) -> None:
    turning = replace(CELL, drag_n_s_per_m=13.2, payload_mass_kg=(0.64, 0.64), coupling_damping_n_s_per_m=6.0)
    turning = replace(
        turning,
        coupling_stiffness_n_per_m=1.2e4,
        environment_stiffness_n_per_m=(3200.0, 4800.0),
        approach_force_n=6.0,
    )
    gains: AxisGains = replace(PLAIN, mass=0.32, damping=120.0)
    controller = peer_controller({"rz": gains}, requirements(6e-3), domain=turning)
    made = exported(tmp_path, controller, Ros2Options(return_stiffness=0.05))
    assert made.axes[0].written["mass"] == 0.32
    assert parameters(made)["admittance"]["selected_axes"] == [False] * 5 + [True]
    assert "N·m per 0.1 rad" in made.text
    assert "N·m with the law of the file itself" in re.sub(r"\n#\s*", " ", made.text)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"return_stiffness": 0.0}, "2ζ√"),
        ({"filter_coefficient": 0.0}, "above 0"),
        ({"ros2_version": "7.0.0"}, "4.0.0 to 6.x"),
        ({"ros2_version": "iron"}, "humble, jazzy, kilted, lyrical, rolling"),
        ({"ros2_version": "2.53.0"}, "2.x from 2.54.0 on"),
        ({"ros2_version": "3.9.0"}, "from 4.0.0 to 6.x"),
        ({"joints": ("a", "a")}, "each once"),
        ({"base_link": "base link"}, "is no name"),
    ],
)
def test_options_that_make_no_file_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        Ros2Options(**given)


def test_an_option_of_another_target_is_refused(tmp_path: Path) -> None:
    wrong = {"ros2_version": "jazzy", "return_stiffness": 1.0}
    refusal = "fzi_cartesian has no option --return-stiffness, --ros2-version; its options: "
    with pytest.raises(UsageError, match=refusal):
        export_controller(tmp_path / "a.yaml", "fzi_cartesian", tmp_path / "out.yaml", options=wrong)


def test_a_period_that_is_no_whole_rate_is_refused(tmp_path: Path) -> None:
    controller = peer_controller({"x": PLAIN}, EASY)
    controller = replace(
        controller, sample_time_s=7e-4, certificate=replace(controller.certificate, sample_time_s=7e-4)
    )
    with pytest.raises(UsageError, match="whole hertz"):
        exported(tmp_path, controller, Ros2Options())


def test_an_environment_with_mass_cannot_be_certified_again(tmp_path: Path) -> None:
    controller = peer_controller({"x": PLAIN}, EASY)
    certificate = replace(controller.certificate, domain={"x": replace(CELL, environment_mass_kg=2.0)})
    with pytest.raises(CertificateError, match="environment with mass"):
        exported(tmp_path, replace(controller, certificate=certificate), Ros2Options())


def test_a_rotational_axis_without_its_requirements_cannot_be_certified_again(tmp_path: Path) -> None:
    controller = peer_controller({"rz": PLAIN}, EASY)
    certificate = replace(controller.certificate, rotational_requirements=None)
    with pytest.raises(CertificateError, match="does not say what was asked"):
        exported(tmp_path, replace(controller, certificate=certificate), FziOptions())


def test_an_approach_at_a_speed_is_certified_at_that_speed(tmp_path: Path) -> None:
    """A speed goes before a force, as in `validate`; twice the speed is twice the force of a linear contact."""
    peaks = []
    for speed in (0.02, 0.04):
        controller = peer_controller({"x": PLAIN}, EASY)
        domain = replace(CELL, approach_speed_m_s=speed)
        certificate = replace(controller.certificate, domain={"x": domain})
        peaks.append(exported(tmp_path, replace(controller, certificate=certificate), Ros2Options()).axes[0].peak_n)
    assert peaks[1] == pytest.approx(2.0 * peaks[0], rel=1e-6)


def test_numbers_that_cannot_be_proved_are_a_certificate_that_does_not_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unproved(task: AxisTask, law: LinearController) -> LawCertificate:
        return replace(certify_law(task, law), missed=("not proved",), is_unproved=True)

    for module in (third_party, retune_module):
        monkeypatch.setattr(module, "certify_law", unproved)
    with pytest.raises(CertificateError, match=r"Axis x: .* cannot be proved stable"):
        exported(tmp_path, peer_controller({"x": PLAIN}, EASY), Ros2Options())


def test_what_the_other_controller_runs_must_come_to_rest_at_a_contact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def bounces(axis: str, _domain: object, law: object, _period_s: float) -> BounceSearch:
        asked.append(law)
        return BounceSearch(axis=axis, runs=1, plants=1, refusal="the contact bounces for ever")

    monkeypatch.setattr(third_party, "search_bouncing", bounces)
    with pytest.raises(CertificateError, match=r"Axis x: with what that controller runs, the contact bounces for ever"):
        exported(tmp_path, peer_controller({"x": PLAIN}, EASY), Ros2Options())
    assert isinstance(asked[0], LinearController)
    assert [path.name for path in tmp_path.iterdir()] == ["controller.yaml"]
