"""What the record of axes together says in words."""

from dataclasses import replace

import pytest

from autotune.formats.coupled_record import CoupledBody, CoupledCertificate, PointContact

TOUCH = PointContact(
    point_m=(0.1, 0.0, 0.25),
    environment_stiffness_n_per_m=1e5,
    payload_mass_kg=16.0,
    peak_contact_force_n=60.0,
    time_of_peak_s=0.02,
    largest_ratio=1.2,
    leaves=0.0,
)
TOGETHER = CoupledCertificate(
    axes=("x", "ry"),
    body=CoupledBody(mass_kg=16.0, com_m=(0.0, 0.0, 0.1), inertia_kg_m2={}, held={}),
    groups=(("x", "ry"),),
    coupling=0.5,
    uncoupled=0.02,
    neglected=0.0,
    modulus=0.6,
    modulus_hz=12.0,
    modulus_apart=0.7,
    disk=0.5,
    spectral_radius=0.99,
    loops={},
    points={},
    method="swept",
)


def touching(*points: PointContact) -> str:
    _, line = replace(TOGETHER, points={"z": points}).sentences()
    return line


@pytest.mark.parametrize(
    ("ratio", "said"), [(1.2, ": up to 20 % harder than"), (0.9, ": at least 10 % gentler than"), (1.0, "gentler")]
)
def test_a_touch_is_harder_or_gentler_than_in_line_with_the_sensor(ratio: float, said: str) -> None:
    gentle = replace(TOUCH, largest_ratio=0.5, point_m=(0.0, 0.0, 0.0))
    line = touching(replace(TOUCH, largest_ratio=ratio), gentle)
    assert said in line
    assert "touching with 2 points" in line
    assert "at (0.1, 0, 0.25) m" in line


def test_how_often_the_payload_leaves_the_surface_is_said_where_it_does() -> None:
    for leaves in (1.0, 3.0):
        line = touching(TOUCH, replace(TOUCH, leaves=leaves))
        assert f"; the payload leaves the surface up to {leaves:g} times; simulated" in line
    line = touching(TOUCH, TOUCH)
    assert "leaves" not in line


def test_axes_that_hardly_act_on_each_other_keep_all_but_what_is_neglected() -> None:
    body = replace(TOGETHER.body, missing=("inertia about z",))
    apart = replace(TOGETHER, axes=("x", "y"), body=body, groups=(("x",), ("y",)), coupling=0.01, neglected=0.1)
    first, last = apart.sentences()
    assert "x, y hardly act on each other (coupling 0.01); |1 + L| at least 0.54 with all loops closed" in first
    assert last.endswith("not known, and left out: inertia about z")
