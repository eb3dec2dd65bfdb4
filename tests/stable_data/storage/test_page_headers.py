"""Pages of Parquet files: honest ones of any writer pass, and one that states more bytes than its column is refused unread."""

from pathlib import Path
from typing import Any, cast

import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from stable_data.storage import page_headers
from stable_data.storage.page_headers import check_pages
from stable_data.storage.parquet_files import is_small, open_parquet, read_row_groups
from tests.bounds import limit

ROWS = 5000
TABLE = pa.table(
    {
        "number": [k * 7919 % 1000 for k in range(ROWS)],
        "text": ["x" * (k % 40) for k in range(ROWS)],
        "list": [[float(k)] * (k % 3) for k in range(ROWS)],
        "nested": [{"a": None if k % 5 else k, "b": b"\x00" * (k % 9)} for k in range(ROWS)],
    }
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zstd"},
        {"compression": "none", "use_dictionary": False},
        {"data_page_version": "2.0"},
        {"data_page_size": 500, "row_group_size": 900},
        {"write_page_checksum": True, "write_page_index": True},
    ],
)
def test_files_of_arrow_pass(options: dict[str, Any], tmp_path: Path) -> None:
    for table in (TABLE, TABLE.slice(0, 0)):
        pq.write_table(table, tmp_path / "file.parquet", **options)
        with open_parquet(tmp_path / "file.parquet") as file:
            assert read_row_groups(file, "file", range(file.num_row_groups)).equals(table)


def test_files_of_polars_pass(tmp_path: Path) -> None:
    frame = pl.from_arrow(TABLE)
    assert isinstance(frame, pl.DataFrame)
    frame.write_parquet(tmp_path / "file.parquet", row_group_size=700, data_page_size=900)
    with open_parquet(tmp_path / "file.parquet") as file:
        check_pages(tmp_path / "file.parquet")
        assert file.read().num_rows == ROWS


@pytest.mark.parametrize("codec", ["none", "zstd"])
def test_a_page_that_states_more_bytes_than_its_column_is_refused(codec: str, tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    pq.write_table(TABLE.select(["number"]), path, compression=codec, use_dictionary=False)
    footer = pq.read_metadata(path)
    content, start = bytearray(path.read_bytes()), footer.row_group(0).column(0).data_page_offset
    assert content[start : start + 3] == b"\x15\x00\x15"  # type, and the bytes that it needs uncompressed
    assert all(byte > 127 for byte in content[start + 3 : start + 5])
    content[start + 3 : start + 6] = b"\xfe\xff\x7f"
    path.write_bytes(content)
    with pytest.raises(
        pa.ArrowInvalid,
        match=r"number: a page states 1,048,575 bytes, expected at most what is left of those of its column, 40,",
    ):
        open_parquet(path)
    content[start + 3 : start + 6] = b"\xff\xff\x7f"
    path.write_bytes(content)
    with pytest.raises(pa.ArrowInvalid, match="states -1,048,576 bytes"):
        open_parquet(path)
    content[start : start + 20] = b"\xff" * 20
    path.write_bytes(content)
    with pytest.raises(pa.ArrowInvalid, match="its metadata cannot be read"):
        open_parquet(path)


@pytest.mark.parametrize("values", [b"\x19\xfc\xff\xff\x7f", b"\x1b" * 3, b"\x5c" * 40])
def test_a_header_of_endless_or_unknown_values_is_refused(values: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    pq.write_table(TABLE.select(["number"]), path, use_dictionary=False)
    content, start = bytearray(path.read_bytes()), pq.read_metadata(path).row_group(0).column(0).data_page_offset
    content[start : start + len(values)] = values
    path.write_bytes(content)
    with pytest.raises(pa.ArrowInvalid, match="its metadata cannot be read"):
        open_parquet(path)


@pytest.mark.parametrize(
    ("options", "values"),
    [
        ({}, [0.0] * 2_000_000),
        ({}, ["x" * 10_000] * 5000),
        ({"compression": "none"}, [b"x" * 10_000] * 5000),
        ({"use_dictionary": False, "column_encoding": "DELTA_BYTE_ARRAY"}, ["x" * 10_000] * 5000),
        ({"data_page_version": "2.0"}, [{"a": [k % 2 == 0] * 1000} for k in range(3000)]),
    ],
)
def test_equal_values_of_lists_take_their_bytes(
    options: dict[str, Any], values: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of some kilobytes, whose only row takes many megabytes."""
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"list": [values]}), path, **options)
    assert path.stat().st_size < 200_000
    limit(monkeypatch, "table", max_decoded_bytes=10_000_000)
    with pytest.raises(
        pa.ArrowInvalid, match=r"the lists of a row group may need \d\d,\d{3},\d{3} bytes, expected at most 10,000,000"
    ):
        open_parquet(path)
    limit(monkeypatch, "table", max_decoded_bytes=100_000_000)
    assert open_parquet(path).metadata.num_rows == 1


@pytest.mark.parametrize("codec", ["none", "snappy", "gzip", "brotli", "zstd", "lz4"])
def test_lists_of_different_texts_pass(codec: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each text could be as long as all that are different together; the longest one is looked for then."""
    limit(monkeypatch, "table", max_decoded_bytes=2_000_000)
    lists = [[f"{(20 * row + k) % 999:050}" for k in range(20)] for row in range(1000)]
    pq.write_table(pa.table({"list": lists}), tmp_path / "file.parquet", compression=codec)
    assert open_parquet(tmp_path / "file.parquet").read()["list"].to_pylist() == lists


def test_lists_within_lists_take_bytes_for_each_level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kind, value = pa.float64(), cast(Any, [[0.0]] * 20_000)
    for _ in range(30):
        kind = pa.list_(kind)
    for _ in range(28):
        value = [value]
    pq.write_table(pa.table({"list": pa.array([value], kind)}), tmp_path / "file.parquet")
    limit(monkeypatch, "table", max_decoded_bytes=4_000_000)
    with pytest.raises(
        pa.ArrowInvalid, match=r"the lists of a row group may need \d,\d{3},\d{3} bytes, expected at most 4,000,000"
    ):
        open_parquet(tmp_path / "file.parquet")


def test_small_lists_of_many_row_groups_are_counted_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"list": [[0.0] * 1000] * 100}), path, row_group_size=1)
    limit(monkeypatch, "table", max_decoded_bytes=1_000_000)
    [fragment] = ds.dataset(path).get_fragments()
    assert not is_small(fragment)
    limit(monkeypatch, "table", max_decoded_bytes=3_000_000)
    assert is_small(fragment)


def test_dictionaries_are_looked_at_a_limited_number_of_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Very many row groups may name the same large dictionary."""
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"list": [[f"{k:05}" for k in range(1000)]] * 10}), path, row_group_size=1)
    limit(monkeypatch, "table", max_decoded_bytes=50_000)
    check_pages(path)
    monkeypatch.setattr(page_headers, "_MOST_LOOKED_AT", 5000)
    with pytest.raises(pa.ArrowInvalid, match="the lists of a row group may need"):
        check_pages(path)


def test_more_values_than_rows_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    pq.write_table(TABLE.select(["number"]), path)
    content, rows = path.read_bytes(), b"\x16\x90\x4e"  # 5000, twice as numbers are written, after the columns of the row group
    at = content.rindex(rows)
    path.write_bytes(content[:at] + b"\x16\x82\x00" + content[at + len(rows) :])
    with pytest.raises(pa.ArrowInvalid, match="number: has 5,000 values, expected one for each of 1 rows"):
        open_parquet(path)


def test_columns_that_state_more_bytes_than_their_row_group_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    pq.write_table(TABLE.select(["number"]), path, use_dictionary=False, compression="zstd")
    group = pq.read_metadata(path).row_group(0)
    content = path.read_bytes()
    stated, varint = group.total_byte_size, bytearray()
    rest = 2 * stated
    while rest:
        varint.append(rest & 127 | (128 if rest > 127 else 0))
        rest >>= 7
    at = content.rindex(bytes(varint))  # the row group states its bytes after its columns
    path.write_bytes(content[:at] + bytes([varint[0] & 128 | 2]) + bytes(varint[1:]) + content[at + len(varint) :])
    assert pq.read_metadata(path).row_group(0).total_byte_size < stated
    with pytest.raises(pa.ArrowInvalid, match=f"but its columns state {stated:,}"):
        open_parquet(path)
