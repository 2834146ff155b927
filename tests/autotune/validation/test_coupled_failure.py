"""What refuses several axes together, in words."""

from dataclasses import replace

import pytest

from autotune.validation.coupled_failure import CoupledFailure

GROWS = CoupledFailure(group=("x", "ry"), axis="ry", mode_hz=7.6543, radius=1.0012344, where="at M_p 12 kg")


@pytest.mark.parametrize(
    ("group", "together"), [(("x",), "x"), (("x", "ry"), "x and ry"), (("x", "y", "rz"), "x, y and rz")]
)
def test_a_failure_names_the_axes_the_plant_and_the_mode(group: tuple[str, ...], together: str) -> None:
    grows = replace(GROWS, group=group)
    assert grows.message() == (
        f"{together} act on each other through the payload and are unstable together at M_p 12 kg: a mode at 7.65 Hz "
        "grows (largest |z| 1.001234), in which ry moves most"
    )
    assert replace(grows, bounces=True).message() == (
        f"{together} together bounce for ever at M_p 12 kg; ry moves most, at 7.65 Hz"
    )
    assert replace(grows, modulus=(0.31234, 0.4)).message() == (
        f"{together} together have a smallest singular value of I + L of 0.312 at M_p 12 kg, at 7.65 Hz, and 0.4 is "
        "asked (axes_together.min_modulus)"
    )
