"""Columns of text, and lines for a width."""

import pytest
from rich.cells import cell_len

from autotune.cli._terminal import table_lines, wrap_lines

ROWS = [
    ("parameter", "value", "± std", "unit", "verdict"),
    ("payload mass", "16.205", "0.024", "kg", "identified"),
    ("K_s", "310.0", "1.2e-05", "N/mm", "weak"),
    ("inertia zz", "-", "-", "kg·m²", "unidentifiable"),
    ("peak", "67.5 to 68.6", "", "N", ""),
]

OTHERWISE = "K_s 310.2 N/mm, B_s 150.2 N·s/m, B_p 329.8 N·s/m, T_d 2.403 ms, f_b 3.182 Hz"


def test_numbers_stand_with_their_points_in_one_place_and_units_in_one_column() -> None:
    heading, *lines = table_lines(ROWS, left=(0, 3, 4), point=(1, 2))
    points = {line.index(".", 14) for line in lines[:2]}
    assert len(points) == 1
    # What is missing stands where whole numbers end.
    assert lines[2].index("-") == points.pop() - 1
    units = [line.index(unit) for line, unit in zip(lines, ("kg", "N/mm", "kg·m²"), strict=False)]
    assert len({heading.index("unit"), *units}) == 1
    assert [line.rstrip() for line in lines] == lines


def test_widths_are_those_of_a_terminal() -> None:
    assert [cell_len(text) for text in ("P̂ [kg]", "日本", "N·m²", "ω_v")] == [6, 4, 4, 3]
    lines = list(table_lines([("P̂", "x"), ("ab", "x"), ("日", "x")]))
    assert len({cell_len(line) for line in lines}) == 1


def test_control_characters_of_a_file_do_not_reach_the_terminal() -> None:
    assert "\x1b" not in "".join(table_lines([("a\x1b[31mb", "1")]))


def test_a_last_column_of_text_is_folded_in_its_place() -> None:
    rows = [("topic", "note"), ("/ft/wrench", "one two three four five six seven eight nine ten")]
    lines = list(table_lines(rows, left=(0, 1), columns=40))
    assert all(len(line) <= 40 for line in lines)
    assert len({lines[0].index("note"), lines[1].index("one"), len(lines[2]) - len(lines[2].lstrip())}) == 1
    assert " ".join(" ".join(lines[1:]).split()).startswith("/ft/wrench one two three")


def test_a_table_too_wide_is_reported_row_by_row_where_that_is_wanted() -> None:
    lines = list(table_lines(ROWS, left=(0, 3, 4), columns=40, stacks=True))
    assert lines[:3] == ["payload mass", "  value    16.205", "  ± std    0.024"]
    assert max(map(len, lines)) <= 40
    numbers = [("peak [N]", "M_a [kg]", "K_l [s]"), ("49.21", "6", "0.02")]
    assert next(table_lines(numbers, left=(), columns=12, stacks=True)) == "peak [N] 49.21"
    # Otherwise nothing is cut off, and without a width nothing is changed.
    assert list(table_lines(ROWS, columns=40)) == list(table_lines(ROWS)) == list(table_lines(ROWS, stacks=True))


def test_a_folded_line_hangs_under_its_beginning_and_keeps_numbers_with_units() -> None:
    text = "the certified set reaches from 15.8 to 16.6 kg and nothing beyond that is claimed by anyone"
    lines = wrap_lines(text, verdict="ok     ", indent="  ", columns=47)
    assert lines[0].startswith("  ok     the certified")
    assert all(line.startswith(" " * 9) for line in lines[1:])
    assert all(len(line) <= 47 for line in lines)
    assert any("16.6 kg" in line for line in lines)
    assert wrap_lines(text, verdict="ok     ") == [f"ok     {text}"]
    assert {line[:5].count(" ") for line in wrap_lines(f"   {text}", columns=47)[1:]} == {5}


@pytest.mark.parametrize("columns", [None, 40, 200])
def test_folding_loses_no_word(columns: int | None) -> None:
    text = (
        "info: 5 rests did not fit the payload's weight, 99.9995 % of it used up, /a/very/long/topic/name/indeed/it/is"
    )
    assert " ".join(" ".join(wrap_lines(text, columns=columns)).split()) == text


def test_a_last_column_without_room_beside_goes_below_its_row_or_becomes_part_of_a_block() -> None:
    rows = [("K_e [N/mm]", "peak [N]", "otherwise"), ("95.9", "52.1", "nominal"), ("144.0", "56.4", OTHERWISE)]
    below = list(table_lines(rows, left=(2,), indent="  ", columns=40, stacks=True))
    assert all(cell_len(line) <= 40 for line in below)
    assert below[:4] == ["  K_e [N/mm]  peak [N]", "      otherwise", "        95.9      52.1", "      nominal"]
    assert " ".join(line.strip() for line in below[5:]) == OTHERWISE
    block = list(table_lines(rows, left=(2,), indent="  ", columns=20, stacks=True))
    assert "    peak [N]   56.4" in block
    beside = list(table_lines(rows, left=(2,), indent="  ", columns=60, stacks=True))
    assert all(cell_len(line) <= 60 for line in beside)
    assert beside[0] == "  K_e [N/mm]  peak [N]  otherwise"
