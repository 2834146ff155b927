"""What is uncertain, told with units."""

from autotune.formats.units import axis_units
from autotune.scenario_text import off_nominal, scenario_text
from problems.design.uncertainty import UNCERTAIN, Scenario

_NUMBERS = (1.2e5, 16.0, 3.102e5, 150.2, 329.8, 2.0, 2.403e-3, 3.182, 0.7, 3.2e-3, 8e-4)
VALUES = dict(zip(UNCERTAIN, _NUMBERS, strict=True))


def test_every_value_has_its_symbol_and_the_unit_of_its_axis() -> None:
    told = scenario_text(Scenario(**VALUES), axis_units("x"))
    assert told == (
        "K_e 120 N/mm, M_p 16 kg, K_s 310.2 N/mm, B_s 150.2 N·s/m, B_p 329.8 N·s/m, B_e 2 N·s/m, T_d 2.403 ms, "
        "f_b 3.182 Hz, ζ_b 0.7, τ_w 3.2 ms, T_w 0.8 ms"
    )
    turned = scenario_text(Scenario(**{**VALUES, "payload_mass_kg": 0.52}), axis_units("ry"))
    assert turned.startswith("K_e 1.2e+05 N·m/rad, M_p 0.52 kg·m², K_s 3.102e+05 N·m/rad, B_s 150.2 N·m·s/rad")
    nominal = Scenario(environment_stiffness_n_per_m=2e4, payload_mass_kg=16.0)
    assert (off_nominal(nominal, axis_units("x")), scenario_text(nominal, axis_units("x"))) == (
        "",
        "K_e 20 N/mm, M_p 16 kg",
    )
