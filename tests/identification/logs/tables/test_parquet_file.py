"""Parquet: every type of number and time that Arrow writes, and nothing silently wrong where page checksums are."""

import datetime as dt
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # the package carries no annotations
import pyarrow.parquet as pq  # type: ignore[import-untyped]  # the package carries no annotations
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.tables.layout import TableLayout
from identification.logs.tables.read import list_columns, read_table

NS = 1_700_000_000_123_456_789
TIMED = TableLayout(columns=("a", "b"), time="t")


def write(path: Path, columns: dict[str, Any], **options: Any) -> Path:
    pq.write_table(pa.table(columns), path, **{"write_page_checksum": True, **options})
    return path


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    rows=st.lists(
        st.tuples(st.integers(-(2**63) + 1, 2**63 - 1), st.floats(), st.none() | st.floats()), min_size=1, max_size=50
    ),
    compression=st.sampled_from(["none", "snappy", "zstd", "gzip", "lz4", "brotli"]),
    version=st.sampled_from(["1.0", "2.0"]),
    dictionary=st.booleans(),
    group=st.integers(1, 60),
)
def test_any_table_is_read_as_written(
    tmp_path: Path,
    rows: list[tuple[int, float, float | None]],
    compression: str,
    version: str,
    dictionary: bool,
    group: int,
) -> None:
    t, a, b = zip(*rows, strict=True)
    path = write(
        tmp_path / "run.parquet",
        {"b": pa.array(b, pa.float64()), "note": ["x"] * len(rows), "t": pa.array(t, pa.timestamp("ns")), "a": a},
        compression=compression, data_page_version=version, use_dictionary=dictionary, row_group_size=group,
    )  # fmt: skip
    assert list_columns(path) == ("b", "note", "t", "a")
    series = read_table(path, TIMED)
    assert series.log_ns.tolist() == list(t)
    expected = np.array([[x, math.nan if y is None else y] for x, y in zip(a, b, strict=True)])
    assert np.array_equal(series.values, expected, equal_nan=True)
    assert (series.channel.topic, series.channel.type_name, series.channel.encoding) == (
        "run.parquet",
        "parquet",
        "table",
    )


SECONDS = Decimal(NS).scaleb(-9)
TIMES: dict[str, tuple[pa.Array, str, int]] = {
    "timestamp ns": (pa.array([NS], pa.timestamp("ns")), "s", NS),
    "timestamp us": (pa.array([NS // 1000], pa.timestamp("us", tz="Europe/Berlin")), "s", NS // 1000 * 1000),
    "timestamp ms": (pa.array([NS // 10**6], pa.timestamp("ms")), "s", NS // 10**6 * 10**6),
    "duration": (pa.array([NS // 1000], pa.duration("us")), "ms", NS // 1000 * 1000),
    "int64 ns": (pa.array([NS]), "ns", NS),
    "int64 us": (pa.array([NS // 1000]), "us", NS // 1000 * 1000),
    "uint64": (pa.array([NS], pa.uint64()), "ns", NS),
    "int32": (pa.array([1_700_000_000], pa.int32()), "s", 1_700_000_000 * 10**9),
    "float64": (pa.array([float(SECONDS)]), "s", round(Decimal(float(SECONDS)).scaleb(9))),
    "float32": (pa.array([0.1], pa.float32()), "s", 100_000_001),
    "decimal": (pa.array([SECONDS], pa.decimal128(38, 20)), "s", NS),
    "decimal small": (pa.array([SECONDS], pa.decimal128(19, 9)), "s", NS),
    "decimal ms": (pa.array([SECONDS * 1000], pa.decimal256(60, 30)), "ms", NS),
}


@pytest.mark.parametrize("name", TIMES)
def test_every_type_of_time_is_converted_to_the_nearest_nanosecond(tmp_path: Path, name: str) -> None:
    array, unit, ns = TIMES[name]
    path = write(tmp_path / "run.parquet", {"t": array, "a": [1.0]})
    assert read_table(path, TableLayout(columns=("a",), time="t", time_unit=unit)).log_ns.tolist() == [ns]


@pytest.mark.parametrize(
    "kind",
    [pa.int8(), pa.uint16(), pa.int32(), pa.int64(), pa.uint64(), pa.float16(), pa.float32(), pa.float64(),
     pa.decimal128(10, 2), pa.dictionary(pa.int32(), pa.float64()), pa.dictionary(pa.int8(), pa.int64())],
)  # fmt: skip
def test_every_type_of_number_is_read_with_its_gaps(tmp_path: Path, kind: pa.DataType) -> None:
    numbers = [3, None, 100]
    if pa.types.is_dictionary(kind):
        array = pa.array(numbers, kind.value_type).dictionary_encode().cast(kind)
    else:
        array = pa.array(
            [None if n is None else np.float16(n) for n in numbers] if kind == pa.float16() else numbers, kind
        )
    path = write(tmp_path / "run.parquet", {"a": array})
    found = read_table(path, TableLayout(columns=("a",), sample_rate_hz=1000.0))
    assert np.array_equal(found.values, np.array([[3.0], [math.nan], [100.0]]), equal_nan=True)
    assert found.log_ns.tolist() == [0, 10**6, 2 * 10**6]


WRONG: dict[str, tuple[dict[str, Any], TableLayout, str]] = {
    "no column": ({"t": [1], "a": [1.0]}, TIMED, "has no column `b`; its columns are: t, a."),
    "no rows": (dict.fromkeys("tab", pa.array([], pa.int64())), TIMED, "holds the names of columns but no row"),
    "text": ({"t": [1], "a": ["1.0"], "b": [1.0]}, TIMED, "Column `a` of run.parquet is of type string, it must hold"),
    "boolean": ({"t": [1], "a": [True], "b": [1.0]}, TIMED, "is of type bool"),
    "list": ({"t": [1], "a": [[1.0]], "b": [1.0]}, TIMED, "no column `a`; its columns are: t, a[0], b"),
    "texts": ({"t": [1], "a": [["x"]], "b": [1.0]}, TIMED, "is of type list<"),
    "struct": ({"t": [1], "a": [{"x": 1.0}], "b": [1.0]}, TIMED, "is of type struct<"),
    "time as text": ({"t": ["noon"], "a": [1.0], "b": [1.0]}, TIMED, "is of type string, it must hold times"),
    "date": ({"t": [dt.date(2024, 1, 1)], "a": [1.0], "b": [1.0]}, TIMED, "is of type date32[day]"),
    "no time": ({"t": [1, 2, None], "a": [1.0] * 3, "b": [1.0] * 3}, TIMED, "`t` of run.parquet has no time in row 3"),
    "time NaN": ({"t": [1.0, math.nan], "a": [1.0] * 2, "b": [1.0] * 2}, TIMED, "a time that is not finite or beyond"),
    "time in ns": ({"t": [NS], "a": [1.0], "b": [1.0]}, TIMED, "a time beyond 292 years"),
    "time uint64": ({"t": pa.array([2**63], pa.uint64()), "a": [1.0], "b": [1.0]}, TIMED, "check its time unit (s)"),
    "undeclared": ({"t": [1], "a": [1.0]}, TableLayout(columns=("a",)), "name its time column (`time`, of t, a)"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_reported_in_one_sentence(tmp_path: Path, name: str) -> None:
    columns, layout, complaint = WRONG[name]
    with pytest.raises(LogError) as caught:
        read_table(write(tmp_path / "run.parquet", columns), layout)
    assert complaint in str(caught.value)
    assert "run.parquet" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    pq.write_table(pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["a", "a"]), path)
    with pytest.raises(LogError, match="several columns of one name: a; rename them"):
        read_table(path, TableLayout(columns=("a",), sample_rate_hz=1.0))


def sound_table(path: Path, **options: Any) -> TableLayout:
    random = np.random.default_rng(4)
    columns = {"t": np.arange(3000), **{name: random.normal(size=3000) for name in "abc"}}
    write(path, columns, row_group_size=1000, compression="zstd", **options)
    return TableLayout(columns=("a", "b"), time="t", time_unit="ms")


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    layout = sound_table(path)
    data = path.read_bytes()
    for size in [4, 5, 8, 12, *range(20, len(data), len(data) // 40), len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(LogError, match=r"^run\.parquet is damaged or no Parquet file"):
            read_table(path, layout)


def test_no_flipped_bit_gives_other_values(tmp_path: Path) -> None:
    """Pages carry checksums; the footer does not, but it tells most things twice."""
    path = tmp_path / "run.parquet"
    layout = sound_table(path)
    data, sound = path.read_bytes(), read_table(path, layout)
    chooser = np.random.default_rng(11)
    refused, wrong = 0, []
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    # The start of the footer tells the types and names of the columns: every bit of it.
    flips = [(place, bit) for place in range(footer, footer + 60) for bit in range(8)]
    places = [*chooser.integers(4, footer, 250), *range(footer + 60, len(data), 9)]
    for place, bit in [*flips, *((place, int(chooser.integers(8))) for place in places)]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        try:
            found = read_table(path, layout)
        except LogError as error:
            refused += 1
            assert "\n" not in str(error)  # noqa: PT017 - flips in columns that are not read are not noticed
        else:
            if not (np.array_equal(found.values, sound.values) and np.array_equal(found.log_ns, sound.log_ns)):
                wrong.append(int(place))
    assert refused > 150
    assert wrong == []


def test_only_wanted_columns_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    layout = sound_table(path)
    data = bytearray(path.read_bytes())
    meta = pq.ParquetFile(path).metadata.row_group(1).column(3)
    at = (meta.dictionary_page_offset or meta.data_page_offset) + meta.total_compressed_size // 2
    data[at] ^= 0xFF
    path.write_bytes(data)
    assert read_table(path, layout).values.shape == (3000, 2)
    with pytest.raises(LogError, match="is damaged"):
        read_table(path, TableLayout(columns=("c",), time="t"))


def test_indices_name_columns_too(tmp_path: Path) -> None:
    path = write(tmp_path / "run.parquet", {"t": [1.0, 2.0], "a": [3.0, 4.0]})
    assert read_table(path, TableLayout(columns=("1",), time="0")).values.tolist() == [[3.0], [4.0]]
    assert read_table(path, TableLayout(time="0")).values.shape == (2, 0)
    assert read_table(path, TableLayout(sample_rate_hz=10.0)).log_ns.tolist() == [0, 10**8]


@pytest.mark.parametrize("kind", [pa.list_(pa.float64()), pa.list_(pa.float32(), 3), pa.large_list(pa.int32())])
def test_a_column_of_lists_counts_as_one_for_each_entry(tmp_path: Path, kind: Any) -> None:
    lists = pa.array([[1, 2, 3], None, [7, 8, 9]], kind)
    path = write(tmp_path / "run.parquet", {"t": [0.0, 0.1, 0.2], "q": lists, "words": [["a"], ["b"], []]})
    assert list_columns(path) == ("t", "q[0]", "q[1]", "q[2]", "words")
    values = read_table(path, TableLayout(columns=("q[2]", "q[0]"), time="t")).values
    assert np.array_equal(values, [[3.0, 1.0], [math.nan, math.nan], [9.0, 7.0]], equal_nan=True)


def test_lists_of_several_lengths_are_refused_with_the_row(tmp_path: Path) -> None:
    path = write(tmp_path / "run.parquet", {"t": [0.0, 0.1, 0.2], "q": [[1.0, 2.0], [3.0, 4.0], [5.0]]})
    layout = TableLayout(columns=("q[0]",), time="t")
    with pytest.raises(LogError, match=r"`q` of run.parquet must hold lists of one length, found 2 .* in row 3, 1;"):
        read_table(path, layout)


def test_an_entry_of_a_list_may_not_have_the_name_of_a_column(tmp_path: Path) -> None:
    path = write(tmp_path / "run.parquet", {"q": [[1.0, 2.0]], "q[1]": [3.0]})
    with pytest.raises(LogError, match=r"several columns of one name: q\[1\]"):
        list_columns(path)
