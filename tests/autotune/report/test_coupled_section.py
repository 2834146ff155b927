"""What a report says of axes together is the record's, in units, to the right of each column's name."""

from dataclasses import replace

import pytest

from autotune.formats.coupled_record import TogetherMargins
from autotune.report.coupled_section import coupled_section
from autotune.report.page import Note, Table
from tests.autotune.formats.samples import make_controller
from tests.autotune.formats.test_coupled_record import TOGETHER, TOUCH


@pytest.mark.parametrize(("ratio", "beside"), [(1.2, "+20.0 %"), (0.9, "-10.0 %")])
def test_each_axis_has_its_margins_and_each_point_its_peak(ratio: float, beside: str) -> None:
    controller = make_controller()
    assert coupled_section(controller).blocks == ()
    loops = {"x": TogetherMargins(modulus=0.61, disk=0.52), "ry": TogetherMargins(modulus=0.71, disk=0.62)}
    points = {"z": (replace(TOUCH, largest_ratio=ratio, leaves=2.0), TOUCH)}
    together = replace(TOGETHER, loops=loops, points=points)
    section = coupled_section(replace(controller, certificate=replace(controller.certificate, coupled=together)))
    notes = [each.text for each in section.blocks if isinstance(each, Note)]
    assert notes == list(together.sentences())
    margins, touches = (each for each in section.blocks if isinstance(each, Table))
    assert [[cell.text for cell in row] for row in margins.rows] == [["x", "0.61", "0.52"], ["ry", "0.71", "0.62"]]
    assert [cell.text for cell in touches.rows[0]] == ["0.1, 0, 0.25", "60.0", beside, "2"]
    assert "Axis z" in touches.caption
    for table in (margins, touches):
        assert [cell.is_number for cell in table.heads()] == [False] + [True] * (len(table.columns) - 1)
