import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings

from autotune.errors import CertificateError, UsageError
from autotune.formats.canonical import checksum, dump_json, short
from autotune.formats.certificate_record import AxisMargins
from autotune.formats.controller import controller_tree, parse_controller, read_controller, write_controller
from autotune.formats.controller_record import CollisionSettings, Controller, ControllerStatus
from autotune.formats.limits import CollisionResponse
from autotune.formats.yaml12 import dump_yaml, load_yaml
from problems.errors import ParameterError
from problems.model.plant import WrenchFilter
from tests.autotune.formats.samples import DOMAIN, GAINS, MARGINS, controllers, make_controller, make_limits


def sealed(tree: dict[str, Any]) -> str:
    """Write a tree as a file whose checksum fits, so that only its content can be the reason of a refusal."""
    return dump_yaml(tree | {"checksum": checksum(tree)})


@settings(deadline=None, max_examples=40)
@given(controllers())
def test_what_is_written_is_read_back_to_the_last_bit(controller: Controller) -> None:
    tree = controller_tree(controller)
    for text in (dump_yaml(tree), dump_json(tree)):
        back = parse_controller(text, "c.yaml")
        assert back.controller == controller
        assert repr(back.controller) == repr(controller)  # tells -0.0 from 0.0
        assert back.checksum == tree["checksum"]
        assert controller_tree(back.controller) == tree


def test_a_filtered_or_late_wrench_is_part_of_the_domain_and_none_is_no_entry() -> None:
    """Files from before the entry are read as they were: no filter, and the same checksum."""
    plain = make_controller()
    assert all("wrench_filter" not in tree for tree in controller_tree(plain)["certificate"]["domain"].values())
    assert plain.certificate.domain["x"].plants.nominal.wrench_filter == WrenchFilter()
    for wrench, reported in (
        (WrenchFilter(time_constant_s=3.2e-3), {"time_constant_s": 3.2e-3}),
        (WrenchFilter(delay_s=2.4e-3), {"delay_s": 2.4e-3}),
    ):
        late = {f"wrench_{key}": (0.9 * value, 1.1 * value) for key, value in reported.items()}
        domain = replace(DOMAIN, wrench_filter=wrench, uncertain=late)
        certificate = replace(plain.certificate, domain=dict.fromkeys(plain.certificate.domain, domain))
        tree = controller_tree(replace(plain, certificate=certificate))
        assert tree["certificate"]["domain"]["rz"]["wrench_filter"] == reported
        back = parse_controller(dump_yaml(tree), "c.yaml").controller
        assert back.certificate.domain["x"].plants.nominal.wrench_filter == wrench
        assert dict(back.certificate.domain["x"].uncertain or {}) == late
        assert controller_tree(back) == tree


def test_the_file_is_what_the_tree_shows(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    digest = write_controller(path, make_controller())
    tree = load_yaml(path)
    assert tree == controller_tree(make_controller())
    assert list(tree)[-1] == "checksum"
    assert tree["checksum"] == digest == checksum(tree) == read_controller(path).checksum
    assert short(digest) == digest[:8]


def test_the_layout_of_the_file_does_not_matter(tmp_path: Path) -> None:
    tree = controller_tree(make_controller())
    turned = dict(reversed(tree.items()))
    text = dump_yaml(turned).replace("mass_kg: 16.0", "mass_kg: 16  # as weighed").replace("0.0008", "8e-4")
    assert parse_controller(text, tmp_path).checksum == tree["checksum"]


def test_a_rotational_axis_shows_its_units() -> None:
    tree = controller_tree(make_controller(("rz",)))
    domain = tree["certificate"]["domain"]["rz"]
    assert {"environment_stiffness_n_m_per_rad", "payload_inertia_kg_m2", "approach_torque_n_m"} <= set(domain)
    scenario = tree["predicted"]["rz"]["scenarios"][0]
    assert {"peak_sensor_torque_n_m", "peak_contact_torque_n_m"} <= set(scenario)
    with pytest.raises(CertificateError, match="environment_stiffness_n_per_m must be one of"):
        parse_controller(sealed(tree | {"certificate": _with_domain(tree, "rz", "environment_stiffness_n_per_m")}), "c")


def _with_domain(tree: dict[str, Any], axis: str, key: str) -> dict[str, Any]:
    certificate: dict[str, Any] = tree["certificate"]
    return certificate | {"domain": {axis: certificate["domain"][axis] | {key: [1.0, 2.0]}}}


def test_an_unvalidated_controller_is_read_only_on_demand(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    base = make_controller()
    certificate = replace(base.certificate, proved=(), margins={}, domain={})
    controller = replace(base, status=ControllerStatus.UNVALIDATED, certificate=certificate, predicted={})
    write_controller(path, controller)
    with pytest.raises(CertificateError, match=r"line 3: the controller is not validated"):
        read_controller(path)
    assert read_controller(path, allow_unvalidated=True).controller == controller
    path.write_text(path.read_text(encoding="utf-8").replace("unvalidated", "validated"), encoding="utf-8")
    with pytest.raises(CertificateError, match="checksum"):
        read_controller(path, allow_unvalidated=True)


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"controller\.yaml cannot be read: No such file"):
        read_controller(tmp_path / "controller.yaml")


def test_infinite_margins_are_stored_as_none() -> None:
    margins = AxisMargins(gain_db=math.inf, phase_deg=60.0, delay_s=math.inf, modulus=1.0, worst={})
    assert margins.gain_db is None
    assert margins.delay_s is None
    assert margins.phase_deg == 60.0


ENTRIES: dict[str, tuple[tuple[str | int, ...], object, str]] = {
    "mass": (("axes", "x", "mass"), 0.0, "axes.x.mass must be at least 0.01, found 0.0"),
    "negative mass": (("axes", "x", "mass"), -1.0, "at least 0.01, found -1.0"),
    "damping": (("axes", "x", "damping"), 0, "axes.x.damping must be at least 1"),
    "lead": (("axes", "x", "lead_s"), -0.01, "axes.x.lead_s must be at least 0"),
    "feedback damping as printed": (
        ("axes", "x", "feedback_damping_s"),
        2e-5,
        "printed in the paper, cannot be seconds",
    ),
    "feedback damping below the limit": (("axes", "x", "feedback_damping_s"), 9.9e-5, "0 or at least 1e-4 s"),
    "negative feedback damping": (("axes", "x", "feedback_damping_s"), -0.1, "0 or at least 1e-4 s"),
    "feedback damping as text": (("axes", "x", "feedback_damping_s"), "2e-2", "found the text '2e-2'"),
    "deadband type": (("axes", "x", "deadband_type"), "soft", "one of threshold, subtractive"),
    "comma": (("axes", "x", "mass"), "12,5", "a number (with a decimal point, not a comma), found the text '12,5'"),
    "flag for a number": (("axes", "x", "mass"), True, "must be a number, found true"),
    "null": (("axes", "x", "mass"), None, "must be a number, found nothing"),
    "sample time": (("sample_time_s",), 0.0, "sample_time_s must be at least 1e-05"),
    "another sample time": (("certificate", "sample_time_s"), 0.002, "the sample_time_s of the controller, 0.0008"),
    "delay": (("delay_samples",), -1, "delay_samples must be at least 0"),
    "discretization": (("discretization",), "euler", "must be one of tustin"),
    "status": (("status",), "fine", "one of validated, unvalidated"),
    "filter": (("filters", "velocity_rad_per_s"), 0.0, "at least 0.1"),
    "no threshold": (("collision", "threshold_n"), None, "collision.threshold_n must be a number, found nothing"),
    "threshold alone": (("collision", "response"), "none", "collision.threshold_n must be null, found 150.0"),
    "vector": (("payload", "com_m"), [0.0, 0.0], "payload.com_m must be at least 3 entries long"),
    "interval": (("certificate", "domain", "x", "payload_mass_kg"), [18.0, 14.0], "payload_mass_kg must be [lowest"),
    "band": (("predicted", "x", "free_space_admittance", "band_hz"), [5.0, 0.5], "band_hz must be [lowest, highest]"),
    "requirement": (("certificate", "requirements", "modulus_margin"), "0.5", "a number, true or false, {min_m_s"),
    "nothing proved": (("certificate", "proved"), [], "certificate.proved must be at least one claim"),
    "no axes": (("axes",), {}, "axes"),
    "checksum": (("checksum",), "0" * 63, "checksum must be 64 hexadecimal digits"),
    "newer version": (("version",), 2, "version must be 1, which this release reads, found 2"),
    "older version": (("version",), 0, "version must be 1, which this release reads, found 0"),
    "another format": (("format",), "autotune/identified", "format must be autotune/controller"),
    "unknown key": (("axes", "x", "stiffness"), 1.0, "axes.x.stiffness must be one of mass, damping"),
    "unknown axis": (("axes", "u"), {}, "axes.u must be one of x, y, z, rx, ry, rz, found the key u"),
}


@pytest.mark.parametrize("case", ENTRIES)
def test_an_entry_out_of_its_range_is_refused_even_with_a_fitting_checksum(case: str) -> None:
    place, value, reason = ENTRIES[case]
    tree = controller_tree(make_controller(("x",)))
    entry: Any = tree
    for part in place[:-1]:
        entry = entry[part]
    entry[place[-1]] = value
    text = dump_yaml(tree) if case == "checksum" else sealed(tree)
    with pytest.raises(CertificateError) as caught:
        parse_controller(text, "c.yaml")
    message = str(caught.value)
    assert reason in message
    assert message.startswith("c.yaml, line ")
    line = text.splitlines()[int(message.removeprefix("c.yaml, line ").partition(":")[0]) - 1]
    assert str(place[-1]) in line or case == "threshold alone"


@pytest.mark.parametrize("part", ["predicted", "domain", "margins"])
def test_a_validated_controller_shows_everything_about_every_axis(part: str) -> None:
    tree = controller_tree(make_controller(("x", "y")))
    del (tree if part == "predicted" else tree["certificate"])[part]["y"]
    with pytest.raises(CertificateError, match=rf"^c\.yaml, line \d+: .*{part} must be given for all tuned axes, x, y"):
        parse_controller(sealed(tree), "c.yaml")


def test_a_domain_shows_how_contact_is_approached() -> None:
    base = make_controller(("x",))
    certificate = replace(base.certificate, domain={"x": replace(DOMAIN, approach_force_n=None)})
    with pytest.raises(ParameterError, match="approach_force_n, approach_speed_m_s or both"):
        controller_tree(replace(base, certificate=certificate))


@pytest.mark.parametrize(
    ("name", "value"),
    [("mass", 0.0), ("damping", -1.0), ("lead_s", -0.1), ("feedback_damping_s", 2e-5), ("mass", math.inf)],
)
def test_gains_are_checked_where_they_are_made(name: str, value: float) -> None:
    changed: dict[str, Any] = {name: value}
    with pytest.raises(ParameterError) as caught:
        replace(GAINS, **changed)
    assert caught.value.name == name


def test_a_collision_response_needs_a_threshold() -> None:
    with pytest.raises(ParameterError, match="threshold_n"):
        CollisionSettings(response=CollisionResponse.STOP, threshold_n=None)


def test_a_number_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    base = make_controller(("x",))
    certificate = replace(base.certificate, margins={"x": replace(MARGINS, modulus=math.nan)})
    with pytest.raises(ParameterError, match=r"certificate\.margins\.x\.modulus must be finite"):
        write_controller(tmp_path / "controller.yaml", replace(base, certificate=certificate))
    assert list(tmp_path.iterdir()) == []


def test_limits_are_of_the_tuned_axes() -> None:
    with pytest.raises(ParameterError, match=r"limits\.axes.*all tuned axes, x, rz"):
        replace(make_controller(), limits=make_limits(("x",)))


@pytest.mark.parametrize(
    "change", [{"force_n": 0.0}, {"stale_pose_s": math.inf}, {"rest_samples": 0}, {"rest_samples": 1.5}]
)
def test_a_limit_is_a_positive_number(change: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=next(iter(change))):
        replace(make_limits(), **change)  # type: ignore[arg-type]  # one of the numbers


@pytest.mark.parametrize(
    ("where", "value"),
    [("force_n", 1e300), ("force_n", 0), ("rest_samples", 1.5), ("stale_wrench_s", 1e3), ("unknown", 1.0)],
)
def test_a_file_with_limits_that_no_cell_has_is_refused(where: str, value: float) -> None:
    tree = controller_tree(replace(make_controller(), limits=make_limits()))
    tree["limits"][where] = value
    with pytest.raises(CertificateError, match=rf"limits\.{where} must be"):
        parse_controller(sealed(tree), "c.yaml")
