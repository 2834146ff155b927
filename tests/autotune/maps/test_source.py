"""What a file tells a map."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import CertificateError, UsageError
from autotune.formats.controller import controller_tree, write_controller
from autotune.formats.identified import write_identified
from identification.errors import EstimateError
from problems.contact.transient import Approach
from problems.maps.maps import MapRequest
from tests.autotune.maps.map_cases import controller_file, identified, plan_of, read


def test_a_certificate_gives_the_middle_of_its_ranges_and_the_payload_that_is_compensated(folder: Path) -> None:
    source = read(folder / "controller.yaml")
    assert source.known["environment_stiffness"] == pytest.approx(math.sqrt(2e4 * 5e5))
    assert source.known["payload_mass"] == 16.0
    assert (source.known["drag"], source.known["coupling_damping"]) == (630.0, 120.0)
    assert source.controller is not None
    assert (source.controller.mass_kg, source.controller.feedback_damping_s) == (12.5, 2e-2)
    assert source.approach == Approach(force_n=30.0)
    assert not source.is_rotational


def test_a_rotational_axis_takes_the_middle_of_the_inertia_and_its_own_units(folder: Path) -> None:
    source = read(folder / "two.yaml", "rz")
    assert (source.is_rotational, source.known["payload_mass"]) == (True, 16.0)
    setup = plan_of(folder, "two.yaml", axis="rz")
    assert isinstance(setup.request, MapRequest)
    assert setup.unit(setup.request.x.parameter) == "N·m·s/rad"


def test_the_compensation_of_a_file_is_in_the_loop(folder: Path) -> None:
    write_controller(folder / "compensated.yaml", replace(controller_file(), compensation_mass_kg=12.0))
    controller = read(folder / "compensated.yaml").controller
    assert controller is not None
    assert controller.compensation_mass_kg == 12.0


def test_the_json_twin_is_read_as_well(folder: Path) -> None:
    (folder / "twin.json").write_text(json.dumps(controller_tree(controller_file()), indent=1) + "\n", "utf-8")
    assert read(folder / "twin.json").known == read(folder / "controller.yaml").known


def test_an_identified_plant_has_no_controller_unless_one_is_given(folder: Path) -> None:
    source = read(folder / "identified.yaml")
    assert source.controller is None
    assert source.known["environment_stiffness"] == 5e5
    given = read(folder / "identified.yaml", controller=folder / "controller.yaml")
    assert given.controller == read(folder / "controller.yaml").controller
    assert given.known == source.known


@pytest.mark.parametrize(
    ("name", "axis", "error", "message"),
    [
        ("two.yaml", None, UsageError, "holds the axes x, rz; say which one with --axis"),
        ("two.yaml", "y", UsageError, "does not hold axis y; it holds x, rz"),
        ("absent.yaml", None, UsageError, "cannot be read"),
        ("other.yaml", None, UsageError, "neither a plant nor a controller"),
        ("altered.yaml", None, CertificateError, "the file is altered"),
    ],
)
def test_a_source_that_cannot_be_used_is_refused(
    folder: Path, name: str, axis: str | None, error: type[Exception], message: str
) -> None:
    (folder / "other.yaml").write_text("bounds: {mass: [6, 6]}\n", encoding="utf-8")
    altered = (folder / "controller.yaml").read_text(encoding="utf-8").replace("12.5", "12.6")
    (folder / "altered.yaml").write_text(altered, encoding="utf-8")
    with pytest.raises(error, match=message):
        read(folder / name, axis)


def test_what_the_log_does_not_show_must_be_set(folder: Path) -> None:
    gains = ["mass=13", "damping=1000"]
    with pytest.raises(EstimateError, match=r"drag of axis x is not identified \(no free motion\); say --set drag="):
        plan_of(folder, "sample.yaml", axis="x", settings=gains)
    setup = plan_of(folder, "sample.yaml", axis="x", settings=[*gains, "drag=300"])
    assert setup.fixed["drag"] == 300.0
    # Varied, or determined by what varies, is as good as set.
    plan_of(folder, "sample.yaml", axis="x", settings=gains, x="drag=100:700")
    plan_of(folder, "sample.yaml", axis="x", settings=gains, x="payload_damping_ratio=0.01:0.3")
    with pytest.raises(EstimateError, match="payload_mass of axis rz"):
        plan_of(folder, "sample.yaml", axis="rz", settings=[*gains, "drag=300"])
    plan_of(folder, "sample.yaml", axis="rz", settings=[*gains, "drag=300", "payload_frequency_rad_per_s=100"])


def test_free_space_needs_no_environment(folder: Path) -> None:
    found = identified()
    bare = replace(found, axes={"x": replace(found.axes["x"], environments=())})
    write_identified(folder / "bare.yaml", bare, {})
    gains = ["mass=13", "damping=1000"]
    with pytest.raises(EstimateError, match="environment_stiffness of axis x"):
        plan_of(folder, "bare.yaml", settings=gains)
    setup = plan_of(folder, "bare.yaml", settings=gains, where="free_space")
    assert not [name for name in setup.fixed if name.startswith("environment")]
