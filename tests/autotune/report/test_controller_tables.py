"""Tables of a controller: the collision response beside the contacts without it."""

from dataclasses import replace

from autotune.formats.controller_record import CollisionSettings
from autotune.formats.limits import CollisionResponse
from autotune.report.axis_design import axis_designs
from autotune.report.controller_tables import gains_table
from autotune.report.strategy_chart import response_table
from tests.autotune.formats.samples import make_controller


def test_peaks_with_the_response_stand_beside_those_without() -> None:
    plain = make_controller(("x",))
    predicted = plain.predicted["x"]
    softest = replace(predicted.scenarios[-1], peak_contact_force_n=40.0, peak_sensor_force_n=38.0)
    worst = replace(softest, name="worst", environment_stiffness_n_per_m=3e5)
    both = replace(plain, predicted={"x": replace(predicted, with_collision_response=(softest, worst))})
    (design,) = axis_designs(both)
    table = response_table(design)
    assert table is not None
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["softest: foam", "44.2 N", "40.0 N", "41.0 N", "38.0 N"],
        ["worst", "", "40.0 N", "", "38.0 N"],
    ]
    assert gains_table(both).caption.endswith("collision response reset at 150 N")


def test_without_a_response_nothing_is_reported_of_one() -> None:
    plain = make_controller(("x",))
    (design,) = axis_designs(plain)
    assert response_table(design) is None
    none = replace(plain, collision=CollisionSettings(response=CollisionResponse.NONE, threshold_n=None))
    assert "collision" not in gains_table(none).caption
