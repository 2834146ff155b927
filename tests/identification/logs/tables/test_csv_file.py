"""CSV: what the csv module and numpy write, and one sentence with the line for everything that is wrong."""

import csv
import math
import threading
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.tables import csv_file, text
from identification.logs.tables.layout import TableLayout
from identification.logs.tables.read import list_columns, read_table
from problems.errors import ParameterError

AB = TableLayout(columns=("a", "b"), sample_rate_hz=1000)
TIMED = TableLayout(columns=("a", "b"), time="t")


def write(path: Path, content: str | bytes, encoding: str = "utf-8") -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


@pytest.mark.parametrize(("name", "peak"), [("flex_jt_imco.csv", 34.397), ("yellow_feet_imco.csv", 55.62)])
def test_recorded_tables_are_read_as_numpy_reads_them(shared_data: Path, name: str, peak: float) -> None:
    path = shared_data / "nj60" / name
    assert list_columns(path) == ("0", "1")
    series = read_table(path, TableLayout(columns=("0", "1"), sample_rate_hz=1000))
    assert np.array_equal(series.values, np.loadtxt(path, delimiter=","))
    assert series.values[:, 1].max() == peak
    assert series.log_ns.tolist() == list(range(0, 1501 * 10**6, 10**6))
    assert (series.channel.topic, series.channel.type_name, series.channel.encoding) == (name, "csv", "table")
    assert (series.stamp_ns, series.frame_ids, series.fields) == (None, (), ("0", "1"))


def test_a_table_that_is_no_utf_8_is_read_as_western_loggers_write_it(tmp_path: Path) -> None:
    content = "# Prüfstand 3, Handführen\nt [ms];α;Winkel [°];größte Kraft\n0;1,5;90;-3\n1;2,5;91;-4\n"
    layout = TableLayout(columns=("Winkel [°]", "größte Kraft"), time="t [ms]", time_unit="ms")
    for encoding, first in (("utf-8", "α"), ("cp1252", "a")):
        path = write(tmp_path / f"{encoding}.csv", content.replace("α", first), encoding)
        assert list_columns(path) == ("t [ms]", first, "Winkel [°]", "größte Kraft")
        series = read_table(path, layout)
        assert series.values.tolist() == [[90.0, -3.0], [91.0, -4.0]]
        assert series.log_ns.tolist() == [0, 10**6]


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    rows=st.lists(st.tuples(st.integers(-(2**62), 2**62), st.floats(), st.floats()), min_size=1, max_size=30),
    style=st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", ","), ("\t", "."), ("|", ".")]),
    ending=st.sampled_from(["\n", "\r\n"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    quoted=st.booleans(),
)
def test_any_table_of_the_csv_module_is_read_as_written(
    tmp_path: Path,
    rows: list[tuple[int, float, float]],
    style: tuple[str, str],
    ending: str,
    encoding: str,
    quoted: bool,
) -> None:
    delimiter, decimal = style
    path = tmp_path / "run.csv"
    with path.open("w", encoding=encoding, newline="") as file:
        writer = csv.writer(
            file, delimiter=delimiter, lineterminator=ending, quoting=csv.QUOTE_ALL if quoted else csv.QUOTE_MINIMAL
        )
        writer.writerow(["b", "Zeit [s]", "a"])
        for ns, b, a in rows:
            seconds = f"{Decimal(ns).scaleb(-9):f}"
            writer.writerow([each.replace(".", decimal) for each in (repr(b), seconds, repr(a))])
    layout = TableLayout(columns=("a", "b"), time="Zeit [s]", decimal=decimal)
    for series in (read_table(path, layout), read_table(path, replace(layout, delimiter=delimiter))):
        assert series.log_ns.tolist() == [ns for ns, _, _ in rows]
        assert np.array_equal(series.values, np.array([[a, b] for _, b, a in rows]), equal_nan=True)


@pytest.mark.parametrize(
    ("written", "unit", "ns"),
    [
        ("1700000000.123456789", "s", 1_700_000_000_123_456_789),
        ("1700000000123.456789", "ms", 1_700_000_000_123_456_789),
        ("1700000000123456.789", "us", 1_700_000_000_123_456_789),
        ("1700000000123456789", "ns", 1_700_000_000_123_456_789),
        ("1.2345678901234567e-05", "s", 12_346),
        ("0.00000000049999999999999999999999999999999999", "s", 0),
        ("1.7e9", "s", 1_700_000_000_000_000_000),
        ("-0.0000000016", "s", -2),
    ],
)
def test_times_are_rounded_once(tmp_path: Path, written: str, unit: str, ns: int) -> None:
    path = write(tmp_path / "run.csv", f"t,a,b\n{written},1,2\n")
    assert read_table(path, replace(TIMED, time_unit=unit)).log_ns.tolist() == [ns]
    # The time may be wanted as a number too.
    series = read_table(path, TableLayout(columns=("a", "t"), time="t", time_unit=unit))
    assert (series.log_ns.tolist(), series.values[0].tolist()) == ([ns], [1.0, float(written)])


def test_empty_cells_and_lines_are_no_numbers_but_keep_their_row(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,a,b\n0,1,2\n1,,nan\n2, ,NaN\n3,inf,-Infinity\n4,5,6\n\n\n")
    found = read_table(path, TIMED).values
    expected = [[1, 2], [math.nan] * 2, [math.nan] * 2, [math.inf, -math.inf], [5, 6]]
    assert np.array_equal(found, np.array(expected, dtype=float), equal_nan=True)
    path = write(tmp_path / "run.csv", "a,b\n1,2\n\n3,4\n")
    assert np.array_equal(read_table(path, AB).values, np.array([[1, 2], [math.nan, math.nan], [3, 4]]), equal_nan=True)
    path = write(tmp_path / "run.csv", "a\n1\n\n3\n")
    assert np.array_equal(
        read_table(path, replace(AB, columns=("a",))).values, np.array([[1], [math.nan], [3]]), equal_nan=True
    )


def test_lines_before_and_among_the_rows_are_left_out_where_declared(tmp_path: Path) -> None:
    content = "made by hand, on Monday\n# t in s\n\na,b\nN,mm\n1,2\n# a pause, of 3 s\n3,4\n"
    path = write(tmp_path / "run.csv", content)
    layout = replace(AB, skip_rows=1, comment="#", header_rows=2)
    assert list_columns(path, layout) == ("a", "b")
    assert read_table(path, layout).values.tolist() == [[1, 2], [3, 4]]
    # A second line without any number holds the units; one that was declared away is a row.
    assert read_table(path, replace(layout, header_rows=None)).values.tolist() == [[1, 2], [3, 4]]
    with pytest.raises(LogError, match=r"run\.csv, line 5: column `a` holds 'N', not a number"):
        read_table(path, replace(layout, header_rows=1))
    path.write_text(content + "5,x\n")
    with pytest.raises(LogError, match=r"line 9: column `b` holds 'x'"):
        read_table(path, layout)


@pytest.mark.parametrize(
    ("second", "rows"),
    [("N,", [[1, 2], [3, 4]]), (",mm", [[1, 2], [3, 4]]), (",", [[math.nan] * 2, [1, 2], [3, 4]])],
    ids=["the second has none", "the first has none", "no units"],
)
def test_a_column_may_be_without_a_unit(tmp_path: Path, second: str, rows: list[list[float]]) -> None:
    path = write(tmp_path / "run.csv", f"a,b\n{second}\n1,2\n3,4\n")
    assert np.array_equal(read_table(path, AB).values, np.array(rows, dtype=float), equal_nan=True)


def test_a_row_of_numbers_is_no_line_of_units(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "a,b\n1.5,2\n3,4\n")
    with pytest.raises(LogError, match=r"run\.csv, line 2: `header_rows: 2` takes it for one of names or units"):
        read_table(path, replace(AB, header_rows=2))
    # Columns that are counted below their names are no data.
    counted = write(tmp_path / "counted.csv", "a,b\n1,2\n3,4\n")
    assert read_table(counted, replace(AB, header_rows=2)).values.tolist() == [[3, 4]]


def test_a_table_without_names_has_indices_and_so_have_columns_without(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "1,2\n3,4\n")
    assert list_columns(path) == ("0", "1")
    assert read_table(path, replace(AB, columns=("1",))).values.tolist() == [[2], [4]]
    assert list_columns(write(tmp_path / "pandas.csv", ",a , b\n0,1,2\n")) == ("0", "a", "b")
    found = read_table(tmp_path / "pandas.csv", TableLayout(columns=("a", "2"), time="0"))
    assert found.values.tolist() == [[1, 2]]
    assert list_columns(path, replace(AB, header_rows=1)) == ("1", "2")


def test_a_semicolon_separates_where_commas_are_decimal_marks(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "0,5;1,25\n1,5;2,25\n")
    layout = TableLayout(columns=("0", "1"), sample_rate_hz=1000, decimal=",")
    assert read_table(path, layout).values.tolist() == [[0.5, 1.25], [1.5, 2.25]]
    with pytest.raises(LogError, match=r"line 1: column `0` holds '0,5', a number with a decimal comma"):
        read_table(path, replace(layout, decimal="."))


def test_columns_that_are_not_wanted_may_hold_anything(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", 't,note,a,b\n0,"x, y",1,2\n1,NaN;,3,4\n')
    assert read_table(path, TIMED).values.tolist() == [[1, 2], [3, 4]]
    assert read_table(path, replace(TIMED, columns=())).values.shape == (2, 0)
    assert read_table(path, replace(AB, columns=())).log_ns.tolist() == [0, 10**6]


def test_spaces_may_separate_where_they_are_single(tmp_path: Path) -> None:
    path = write(tmp_path / "run.txt", "1.5 2\n3 4\n")
    assert read_table(path, replace(AB, columns=("0", "1"))).values.tolist() == [[1.5, 2], [3, 4]]
    with pytest.raises(LogError, match=r"line 2: 2 column\(s\) are expected, found 3"):
        read_table(write(path, "1.5 2\n3  4\n"), replace(AB, columns=("0", "1")))


@given(
    since_us=st.lists(st.integers(0, 7 * 10**15), min_size=1, max_size=9),
    between=st.sampled_from(" T"),
    zone=st.sampled_from(["", "Z", "+00:00"]),
)
def test_dates_are_times_since_1970(
    tmp_path_factory: pytest.TempPathFactory, since_us: list[int], between: str, zone: str
) -> None:
    dates = [str(np.datetime64(us, "us")).replace("T", between) + zone for us in since_us]
    rows = "".join(f"{date},1,2\n" for date in dates)
    path = write(tmp_path_factory.mktemp("dates") / "run.csv", f"t,a,b\n{rows}")
    assert read_table(path, TIMED).log_ns.tolist() == [1000 * us for us in since_us]
    # As a number it counts in s, and where nobody uses it, it may stay text.
    seconds = read_table(path, replace(AB, columns=("t",))).values[:, 0]
    assert seconds == pytest.approx([us / 1e6 for us in since_us])
    assert len(read_table(path, replace(AB, columns=())).values) == len(since_us)


WRONG: dict[str, tuple[str | bytes, TableLayout, str]] = {
    "empty": ("", AB, "is empty (0 bytes)"),
    "blank": ("\n\n \n", AB, "holds no line of a table"),
    "no rows": ("a,b\n", AB, "holds the names of columns but no row"),
    "too few": ("a,b\n1,2\n3\n5,6\n", AB, "line 3: 2 column(s) are expected, found 1"),
    "too many": ("a,b\n1,2\n3,4,5\n", AB, "line 3: 2 column(s) are expected, found 3"),
    "text": ("a,b\n1,2\n3,off\n", AB, "line 3: column `b` holds 'off', not a number"),
    "boolean": ("a,b\n1,True\n", AB, "line 2: column `b` holds 'True'"),
    "hexadecimal": ("a,b\n1,0x10\n", AB, "line 2: column `b` holds '0x10'"),
    "underscore": ("a,b\n1,1_000\n", AB, "line 2: column `b` holds '1_000'"),
    "unit": ("a,b\n1,5 N\n", AB, "line 2: column `b` holds '5 N'"),
    "decimal comma": (
        "a;b\n1,5;2\n",
        replace(AB, decimal="."),
        "line 2: column `a` holds '1,5', a number with a decimal comma; declare",
    ),
    "both decimal marks": (
        "a;b\n1,5;2.5\n",
        AB,
        "line 2: column `a` holds '1,5', a number with a decimal comma; declare",
    ),
    "a word in the first row": ("a,b\n1,x\n2,3\n", AB, "line 2: column `b` holds 'x'"),
    "decimal comma and comma": ("a,b\n1,5,2,0\n", AB, "if commas are decimal marks, export with another delimiter"),
    "decimal point": ("a;b\n1.5;2\n", replace(AB, decimal=","), "decimal point where a comma is declared"),
    "mixed": ("a,b\n1,2\n3;4\n", AB, "line 3: it is separated by ';', the table by ','"),
    "no column": ("a,c\n1,2\n", AB, "has no column `b`; its columns are: a, c."),
    "no index": ("1,2\n", replace(AB, columns=("2",)), "has no column `2`; its columns are: 0, 1."),
    "two columns": ("a,b,b\n1,2,3\n", AB, "has 2 columns named `b` (counted from 0: 1, 2)"),
    "cut within a row": ("a,b\n1,2\n3,4\n5", AB, "line 4: 2 column(s) are expected, found 1"),
    "cut within a number": ("a,b\n1,2\n3,4\n5,6.1", AB, "line 4: the last line has no end, so it may be cut off"),
    "no time": ("t,a,b\n0,1,2\n,3,4\n", TIMED, "line 3: the time `t` is missing"),
    "time NaN": ("t,a,b\n0,1,2\nnan,3,4\n", TIMED, "line 3: the time `t` is missing"),
    "time text": ("t,a,b\n0,1,2\n12:30,3,4\n", TIMED, "line 3: column `t` holds '12:30', not a number"),
    "no date": (
        "t,a,b\n2026-11-22 10:00:00,1,2\n10:00:01,3,4\n",
        TIMED,
        "line 3: column `t` holds '10:00:01', no date and",
    ),
    "time infinite": ("t,a,b\n0,1,2\ninf,3,4\n", TIMED, "line 3: column `t` holds 'inf', no time within 292 years"),
    "time too large": ("t,a,b\n0,1,2\n1e11,3,4\n", TIMED, "line 3: column `t` holds '1e11', no time within 292 years"),
    "blank line": ("t,a,b\n0,1,2\n\n2,3,4\n", TIMED, "line 3: the time `t` is missing"),
    "no such time": ("t,a,b\n0,1,2\n", replace(TIMED, time="time"), "has no column `time`; its columns are: t, a, b."),
    "undeclared time": ("t,a,b\n0,1,2\n", TableLayout(columns=("a",)), "name its time column (`time`, of t, a, b)"),
    "latin beside a control character": ("a,b\n1,2\n# ü\x01\n".encode("latin-1"), AB, "is not text in utf-8"),
    "cut off within a character": ("a,b\n1,2\n# ü".encode()[:-1] + b"\n", replace(AB, encoding="utf-8"), "is not text"),
    "odd utf-16": ("a,b\n1,2\n".encode("utf-16")[:-1], AB, "is not text in utf-16"),
    "unknown encoding": ("a,b\n1,2\n", replace(AB, encoding="klingon"), "unknown encoding: klingon"),
    "binary": (bytes(range(256)) * 20, AB, "is not text in utf-8"),
    "endless line": ("1," * 2**20, AB, "line 1: longer than 1048576 characters"),
    "open quote": ('a,b\n1,"2\n3,4\n', AB, "line 2: "),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_reported_in_one_sentence(tmp_path: Path, name: str) -> None:
    content, layout, complaint = WRONG[name]
    path = write(tmp_path / "run.csv", content)
    with pytest.raises(LogError) as caught:
        read_table(path, layout)
    message = str(caught.value)
    assert message.startswith("run.csv")
    assert complaint in message
    assert "\n" not in message
    assert message.endswith(".")


def test_a_fault_far_behind_is_reported_with_its_line(tmp_path: Path) -> None:
    lines = [f"{index},{index / 7!r}" for index in range(200_000)]
    lines[150_000] = "150000,0.5.5"
    path = write(tmp_path / "run.csv", "\n".join(["a,b", *lines, ""]))
    with pytest.raises(LogError, match=r"line 150002: column `b` holds '0\.5\.5', not a number"):
        read_table(path, AB)
    lines[150_000] = "150000,0.5"
    path = write(tmp_path / "run.csv", "\n".join(["a,b", *lines, ""]))
    assert read_table(path, AB).values[-1].tolist() == [199_999, 199_999 / 7]


def test_blocks_may_end_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run.csv", "a,b\r\n1,2\r\n\r\n33,44\r\n\r\n\r\n", "utf-8")
    for size in range(1, 24):
        monkeypatch.setattr(text, "_BLOCK_CHARACTERS", size)
        found = read_table(path, AB).values
        assert np.array_equal(found, np.array([[1, 2], [math.nan] * 2, [33, 44]]), equal_nan=True)


def test_only_wanted_columns_are_kept_in_memory(tmp_path: Path) -> None:
    values = np.random.default_rng(3).normal(size=(40_000, 30))
    path = tmp_path / "run.csv"
    np.savetxt(path, values, delimiter=",", fmt="%.17g")
    layout = TableLayout(columns=("3", "17"), sample_rate_hz=100)
    read_table(path, layout)
    tracemalloc.start()
    found = read_table(path, layout)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.array_equal(found.values, values[:, [3, 17]])
    # The file has 24 MB; Arrow reads up to 32 blocks of 256 KiB ahead.
    assert peak < 12 * 2**20 + 3 * (found.values.nbytes + found.log_ns.nbytes)


@pytest.mark.parametrize(
    "changes",
    [
        {"time_unit": "min"}, {"sample_rate_hz": 0.0}, {"sample_rate_hz": math.nan}, {"sample_rate_hz": -1.0},
        {"time": "t"}, {"decimal": ";"}, {"delimiter": ",", "decimal": ","}, {"delimiter": "ab"}, {"delimiter": "\n"},
        {"delimiter": "5"}, {"comment": "\n"}, {"skip_rows": -1}, {"header_rows": 10**6},
    ],
)  # fmt: skip
def test_a_layout_that_cannot_be_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ParameterError):
        replace(AB, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("delimiter", [";", "\t", "|"])
def test_decimal_commas_are_found_out(tmp_path: Path, delimiter: str) -> None:
    content = "a;b\n1,5;-2\n3;4,25e-1\n".replace(";", delimiter)
    assert read_table(write(tmp_path / "run.csv", content), AB).values.tolist() == [[1.5, -2.0], [3.0, 0.425]]


def test_columns_between_blanks_may_have_names(tmp_path: Path) -> None:
    assert read_table(write(tmp_path / "run.txt", "a b\n1 2\n3 4\n"), AB).values.tolist() == [[1, 2], [3, 4]]


def test_arrow_holds_no_python_object_that_a_thread_of_its_own_could_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a release at the end of a process that refused a table aborted it: rows are read by the caller alone."""
    readers = set()
    plain = text.row_blocks

    def watched(of: text.Text) -> Iterator[bytes]:
        for block in plain(of):
            readers.add(threading.get_ident())
            yield block

    monkeypatch.setattr(csv_file, "row_blocks", watched)
    monkeypatch.setattr("pyarrow.PythonFile", None)
    rows = [f"{row},{-row}\n" for row in range(60_000)]
    path = write(tmp_path / "t.csv", "a,b\n" + "".join(rows))
    assert np.array_equal(read_table(path, AB).values, np.outer(np.arange(60_000.0), [1.0, -1.0]))
    with pytest.raises(LogError, match=r"line 60002: column `b` holds 'x'"):
        read_table(write(tmp_path / "bad.csv", path.read_text() + "1,x\n"), AB)
    assert readers == {threading.get_ident()}


@pytest.mark.parametrize("separator", [",", ";"])
def test_lines_before_the_names_of_columns_are_found_out(tmp_path: Path, separator: str) -> None:
    rows = "a,b\n" + "".join(f"{row},{-row}\n" for row in range(5))
    path = write(tmp_path / "t.csv", "Export of run 7\nmade by logger v2\n" + rows.replace(",", separator))
    assert list_columns(path) == ("a", "b")
    assert read_table(path, AB).values[:, 0].tolist() == [0, 1, 2, 3, 4]
    # A line of names that is too short is no preamble: the rows below it hold no names.
    short = write(tmp_path / "short.csv", "a\n1,2\n3,4\n5,6\n")
    with pytest.raises(LogError, match="expected"):
        read_table(short, TableLayout(columns=("a",), sample_rate_hz=1000))
