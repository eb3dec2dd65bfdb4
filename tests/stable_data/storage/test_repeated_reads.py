"""What an object store cuts off is read again: a file whose reads fail, and a store that tears its answers."""

import os
from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq
import pytest

from benchmarks.faults.faulty_store import FaultyStore, Rates
from benchmarks.faults.s3_server import CREDENTIALS
from stable_data.errors import cannot_read
from stable_data.storage import repeated_reads
from stable_data.storage.repeated_reads import with_repeated_reads
from stable_data.storage.run_folder import RunFolder

ROWS = pa.table({"number": range(2000), "words": [f"{n} words" for n in range(2000)]})
TORN = "AWS Error INTERNAL_FAILURE during GetObject operation: Failed to flush response stream (eof: 0, bad: 1)"


class TornFile:
    """A file of which some reads fail after they have moved its position."""

    def __init__(self, file: pa.NativeFile, store: "TornStore") -> None:
        self._file, self._store = file, store

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, size: int | None = None) -> bytes:
        found: bytes = self._file.read(size)
        self._store.fail()
        return found

    def read_buffer(self, size: int | None = None) -> pa.Buffer:
        found = self._file.read_buffer(size)
        self._store.fail()
        return found


class TornStore:
    """Local files, of which some reads in a row fail, then one succeeds."""

    def __init__(self, in_a_row: int) -> None:
        self._files, self._in_a_row = pafs.LocalFileSystem(), in_a_row
        self.num_reads = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._files, name)

    def fail(self) -> None:
        self.num_reads += 1
        if self.num_reads % (self._in_a_row + 1):
            raise OSError(TORN)

    def open_input_file(self, path: str) -> TornFile:
        return TornFile(self._files.open_input_file(path), self)


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeated_reads, "_PAUSES", (0.0, 0.0, 0.0))


@pytest.fixture
def path(tmp_path: Path) -> str:
    pq.write_table(ROWS, tmp_path / "rows.parquet", row_group_size=500)
    return str(tmp_path / "rows.parquet")


@pytest.mark.parametrize("in_a_row", [1, 3])
@pytest.mark.parametrize("pre_buffer", [False, True])
def test_what_is_cut_off_is_read_again_from_where_it_began(path: str, in_a_row: int, pre_buffer: bool) -> None:
    store = TornStore(in_a_row)
    files = with_repeated_reads(store)
    assert [info.path for info in files.get_file_info(pafs.FileSelector(str(Path(path).parent)))] == [path]
    assert files.get_file_info(path).size == Path(path).stat().st_size
    assert pq.read_table(path, filesystem=files, pre_buffer=pre_buffer).equals(ROWS)
    with files.open_input_stream(path) as stream:
        assert stream.read(100) + stream.read() == Path(path).read_bytes()
    assert store.num_reads > in_a_row


def test_what_stays_cut_off_is_an_error(path: str) -> None:
    store = TornStore(4)
    with pytest.raises(OSError, match="Failed to flush"):
        with_repeated_reads(store).open_input_file(path).read(100)
    assert store.num_reads == 4


def test_a_store_that_fails_is_not_taken_for_a_damaged_file() -> None:
    found = str(cannot_read("s3://bucket/run", "bucket/run/scenes/part-00.parquet", OSError(TORN)))
    assert "check the network and the store, then run again" in found
    here = str(cannot_read("/data/run", "/data/run/scenes/part-00.parquet", OSError("Input/output error")))
    assert here.endswith("; if it exists, delete it and run the job that wrote it again")


def test_all_else_is_that_of_the_store(tmp_path: Path) -> None:
    files = with_repeated_reads(pafs.LocalFileSystem())
    assert files.type_name == "py::local"
    assert files == with_repeated_reads(pafs.LocalFileSystem()) != with_repeated_reads(pafs.SubTreeFileSystem("/", files))
    here = str(tmp_path)
    files.create_dir(f"{here}/a/b", recursive=True)
    with files.open_output_stream(f"{here}/a/b/c") as stream:
        stream.write(b"content")
    files.copy_file(f"{here}/a/b/c", f"{here}/d")
    files.move(f"{here}/d", f"{here}/e")
    files.delete_file(f"{here}/a/b/c")
    assert [p.name for p in sorted(tmp_path.rglob("*"))] == ["a", "b", "e"]
    assert (tmp_path / "e").read_bytes() == b"content"
    files.delete_dir_contents(f"{here}/a")
    files.delete_dir(f"{here}/a")
    assert [p.name for p in tmp_path.iterdir()] == ["e"]


@pytest.mark.slow  # two servers
def test_a_table_of_a_store_that_tears_its_answers_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    store = FaultyStore(tmp_path, 1, Rates(failed=0.05, slow=0.0, torn=0.2))
    try:
        calm = RunFolder(store.calm_uri("run"))
        for k in range(60):
            rows = [{"id": "a", "step": "read", "code": "x", "message": os.urandom(3000).hex()} for _ in range(40)]
            calm.write_shard("warnings", f"{k:02}", rows)
        assert RunFolder(store.uri("run")).count_values("warnings", ["code"]) == {"code": Counter(x=2400)}
        assert store.counts()["torn"] > 10
    finally:
        store.close()
