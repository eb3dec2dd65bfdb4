"""Shards in a run folder: whole or not there, one run at a time, on disk and on an object store."""

import errno
import itertools
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks.faults.s3_server import Application
from stable_data.cli import app
from stable_data.commands.command_line import NOT_STARTED
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, cannot_write
from stable_data.storage import run_folder
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from tests.bounds import limit
from tests.object_store import object_store
from tests.stable_data.verification.editing import small_run

CHECKOUT = Path(__file__).parents[3]
HOLD = """
import sys, time
from stable_data.storage.run_folder import RunFolder
with RunFolder(sys.argv[1]).locked():
    print("held", flush=True)
    time.sleep(60)
"""


def warnings(*ids: str, words: int = 1) -> list[dict[str, Any]]:
    return [{"id": i, "step": "read", "code": "glb_missing", "message": f"{i} " * words} for i in ids]


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder(str(tmp_path / "run"))


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with object_store() as uri:
        yield uri


def test_rows_come_back_in_the_order_of_the_files(run: RunFolder) -> None:
    names = ["00", "0f", "a1"]
    for name in reversed(names):
        run.write_shard("warnings", name, warnings(f"{name}-a", f"{name}-b"))
    assert run.shard_ids("warnings") == set(names)
    table = run.table("warnings")
    assert table.schema.equals(SCHEMAS["warnings"])
    assert table["id"].to_pylist() == [f"{name}-{row}" for name in names for row in "ab"]
    assert run.table("warnings", ["code"]).column_names == ["code"]


def test_a_table_of_many_files_is_read_some_at_a_time(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "_FILES_AT_ONCE", 3)
    names = [f"{number:02x}" for number in range(8)]
    for name in names:
        run.write_shard("warnings", name, warnings(name))
    opened: list[int] = []
    dataset = ds.dataset

    def noted(files: list[str], **options: Any) -> Any:
        opened.append(len(files))
        return dataset(files, **options)

    monkeypatch.setattr(ds, "dataset", noted)
    assert [row["id"] for batch in run.batches("warnings") for row in batch.to_pylist()] == names
    assert opened == [8, 3, 3, 2]  # the first says what is there
    assert run.table("warnings", ["id"])["id"].to_pylist() == names
    assert run.table("warnings", where=pc.field("id") > "05")["id"].to_pylist() == ["06", "07"]
    assert run.num_rows("warnings") == 8
    Path(run.files("warnings")[6]).write_bytes(b"PAR1 no more")
    with pytest.raises(ConfigError, match=r"part-06\.parquet cannot be read"):
        run.num_rows("warnings")


def test_a_shard_without_rows_is_complete_too(run: RunFolder) -> None:
    run.write_shard("warnings", "00", [])
    assert run.shard_ids("warnings") == {"00"}
    assert run.table("warnings").num_rows == 0
    assert pq.read_metadata(run.files("warnings")[0]).num_row_groups == 0


def test_the_same_rows_give_the_same_bytes(run: RunFolder) -> None:
    contents = []
    for _ in range(2):
        run.write_shard("warnings", "00", warnings("a", "b"))
        contents.append(run.read_bytes("warnings/part-00.parquet"))
    assert contents[0] == contents[1]


def test_the_id_is_the_content() -> None:
    assert content_id("scenes", {"b": 1, "a": [1.5, "ü"]}) == content_id("scenes", {"a": [1.5, "ü"], "b": 1})
    assert content_id("scenes", 1) == "765954f6762f5878"  # must never change: resuming rests on it
    assert content_id("scenes", 1) != content_id("scenes", "1") != content_id("scenes1")


@given(st.lists(st.text(), max_size=3), st.lists(st.text(), max_size=3))
def test_different_parts_have_different_ids(first: list[str], second: list[str]) -> None:
    assert (content_id(*first) == content_id(*second)) == (first == second)


def test_what_is_not_a_shard_is_not_listed(run: RunFolder) -> None:
    run.write_shard("warnings", "00", warnings("a"))
    folder = Path(run.root) / "warnings"
    for name in (".part-01.parquet.tmp-abc", "part-02.parquet.tmp-abc", "notes.parquet", "part-03.csv"):
        (folder / name).write_bytes(b"half")
    assert run.shard_ids("warnings") == {"00"}
    assert run.table("warnings")["id"].to_pylist() == ["a"]


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir])
def test_what_is_no_file_is_refused_as_a_shard(make: Callable[[Path], None], run: RunFolder) -> None:
    """A reader of a named pipe waits for ever."""
    run.write_shard("warnings", "00", warnings("a"))
    place = Path(run.root) / "warnings" / "part-01.parquet"
    make(place)
    readers = (run.table, run.num_rows, run.files, run.shard_ids, run.file_stamps, lambda t: list(run.batches(t)))
    for read in readers:
        with pytest.raises(ConfigError, match=r"part-01\.parquet: is no regular file") as caught:
            read("warnings")
        assert caught.value.code == "shard_not_a_file"
    assert run.tables() == ["warnings"]


@pytest.mark.parametrize("command", [["inspect"], ["query", "clean"], ["upgrade"]])
def test_a_command_that_reads_a_run_with_a_named_pipe_ends(command: list[str], tmp_path: Path) -> None:
    name, *more = command
    run = small_run(tmp_path)
    place = next((run / "scenes").glob("part-*"))
    place.unlink()
    os.mkfifo(place)
    done = CliRunner().invoke(app, [name, str(run), *more])
    assert done.exit_code == NOT_STARTED
    assert "is no regular file" in done.stderr


def test_a_shard_may_be_a_link_to_a_file(run: RunFolder) -> None:
    """As a cache of a dataset hub has them."""
    run.write_shard("warnings", "00", warnings("a"))
    place = Path(run.files("warnings")[0])
    place.symlink_to(place.rename(place.parent.with_name("blob")))
    assert run.table("warnings")["id"].to_pylist() == ["a"]


def test_a_killed_write_leaves_no_shard(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def die_halfway(path: Path, content: bytes) -> None:
        path.write_bytes(content[: len(content) // 2])
        raise KeyboardInterrupt  # like a kill: nothing is tidied up

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "_write_local", die_halfway)
        with pytest.raises(KeyboardInterrupt):
            run.write_shard("warnings", "00", warnings("a"))
    [left] = (Path(run.root) / "warnings").iterdir()
    assert run.shard_ids("warnings") == set()
    with run.locked():
        assert not left.exists()


def test_stale_files_are_removed_beside_the_manifest_too(run: RunFolder) -> None:
    run.write_bytes("manifest.json", b"{}")
    run.write_bytes("report/index.html", b"")
    stale = [Path(run.root) / ".manifest.json.tmp-1", Path(run.root) / "report/.index.html.tmp-2"]
    for path in stale:
        path.touch()
    with run.locked():
        assert not any(path.exists() for path in stale)
        assert run.read_bytes("manifest.json") == b"{}"
        assert run.read_bytes("report/index.html") == b""


def test_a_large_shard_lies_in_several_files(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "MAX_BYTES", 2000)
    ids = [f"scene-{i:03}" for i in range(150)]
    run.write_shard("warnings", "00", warnings(*ids, words=9))
    files = run.files("warnings")
    assert len(files) > 10
    assert all(pq.read_table(path).nbytes <= 2000 for path in files)
    assert run.shard_ids("warnings") == {"00"}
    assert run.table("warnings")["id"].to_pylist() == ids  # in their order, though there are more than ten files


def test_one_row_larger_than_a_file_is_kept_whole(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "MAX_BYTES", 100)
    run.write_shard("warnings", "00", warnings("a", "b", words=200))
    assert len(run.files("warnings")) == 2


def test_a_shard_whose_first_file_is_missing_is_not_there(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "MAX_BYTES", 2000)
    writes = itertools.count()
    write = RunFolder.write_bytes

    def die_at_the_third(self: RunFolder, name: str, content: bytes) -> None:
        if next(writes) == 2:
            raise KeyboardInterrupt
        write(self, name, content)

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write_bytes", die_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            run.write_shard("warnings", "00", warnings(*map(str, range(150)), words=9))
    assert run.shard_ids("warnings") == set()
    assert run.files("warnings") == []  # what a reader sees is whole shards


def test_a_second_process_is_refused_until_the_first_is_killed(run: RunFolder) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLD, run.uri], stdout=subprocess.PIPE, cwd=CHECKOUT, text=True)
    assert holder.stdout is not None
    with holder.stdout:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(ConfigError, match="another run is writing to this folder") as caught, run.locked():
            pytest.fail("two runs hold one folder")
        assert caught.value.code == "locked"
        holder.send_signal(signal.SIGKILL)
        assert holder.wait(10) == -signal.SIGKILL
    with run.locked():
        pass


def _hold(run: RunFolder) -> None:
    with run.locked():
        pytest.fail("locked what cannot be written")


@pytest.mark.parametrize("attempt", [lambda run: run.make("scenes"), lambda run: run.write_bytes("a", b""), _hold])
def test_a_file_in_place_of_a_folder_is_reported(attempt: Callable[[RunFolder], None], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/run.* cannot be written .*; free space or choose") as caught:
        attempt(RunFolder(str(tmp_path / "file" / "run")))
    assert caught.value.code == "output_unwritable"


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_a_folder_without_permission_is_reported() -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        RunFolder("/proc/stable-data").write_shard("warnings", "00", warnings("a"))


def test_a_full_disk_is_reported_and_leaves_nothing(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    run.write_shard("warnings", "00", warnings("a"))

    def fill(path: Path, content: bytes) -> None:
        path.write_bytes(content[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run_folder, "_write_local", fill)
    with pytest.raises(
        ConfigError, match=r"part-01.parquet: cannot be written \(No space left on device\); free space"
    ) as caught:
        run.write_shard("warnings", "01", warnings("b"))
    assert caught.value.code == "output_unwritable"
    assert [path.name for path in (Path(run.root) / "warnings").iterdir()] == ["part-00.parquet"]
    assert run.table("warnings")["id"].to_pylist() == ["a"]


def test_an_error_without_a_reason_of_the_system_says_its_own() -> None:
    assert "(lost connection)" in str(cannot_write("s3://bucket/run", OSError("lost connection")))


def test_a_missing_table_is_reported_with_those_there_are(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match=r"no table scenes, expected a folder of part-.*samples") as caught:
        run.dataset("scenes")
    assert caught.value.code == "table_missing"


def test_a_table_of_another_version_is_refused(run: RunFolder) -> None:
    run.make("warnings")
    old = SCHEMAS["warnings"].with_metadata({"stable_data.version": "0"})
    pq.write_table(pa.Table.from_pylist(warnings("a"), schema=old), f"{run.root}/warnings/part-00.parquet")
    with pytest.raises(ConfigError, match="written as table version 0") as caught:
        run.table("warnings")
    assert caught.value.code == "table_version"


def test_a_broken_shard_is_reported(run: RunFolder) -> None:
    run.write_bytes("warnings/part-00.parquet", b"not Parquet at all")
    with pytest.raises(ConfigError, match=r"part-00.parquet cannot be read .*delete it") as caught:
        run.table("warnings")
    assert caught.value.code == "shard_unreadable"


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _garbled(content: bytes) -> bytes:
    """The pages overwritten; the footer, and with it the number of rows, is whole."""
    return content[:8] + bytes(64) + content[72:]


@pytest.mark.parametrize("damage", [_cut, _garbled, lambda _: b""])
def test_a_damaged_shard_behind_a_whole_one_is_named(run: RunFolder, damage: Callable[[bytes], bytes]) -> None:
    run.write_shard("warnings", "00", warnings("a"))
    run.write_shard("warnings", "01", warnings(*map(str, range(99))))
    path = Path(run.root) / "warnings" / "part-01.parquet"
    path.write_bytes(damage(path.read_bytes()))
    attempts: list[Callable[[], object]] = [lambda: run.table("warnings"), lambda: list(run.batches("warnings", ["id"]))]
    if damage is not _garbled:
        attempts.append(lambda: run.num_rows("warnings"))
    for attempt in attempts:
        with pytest.raises(ConfigError, match=r"part-01.parquet cannot be read .*delete it") as caught:
            attempt()
        assert caught.value.code == "shard_unreadable"
        assert "\n" not in str(caught.value)


def _bomb(run: RunFolder) -> Path:
    """A file of some kilobytes whose rows take 400 MB: one long message, stored once."""
    run.make("warnings")
    path = Path(run.root) / "warnings" / "part-00.parquet"
    rows = pa.Table.from_pylist(warnings("a"), schema=SCHEMAS["warnings"])
    rows = rows.set_column(3, SCHEMAS["warnings"].field("message"), pa.array(["x" * 10**5]))
    pq.write_table(pa.concat_tables([rows] * 4000), path, compression="zstd")
    return path


@pytest.mark.parametrize(
    "read",
    [
        lambda run: run.table("warnings"),
        lambda run: run.table("warnings", where=pc.field("id") == "a"),
        lambda run: run.table("warnings", {"length": pc.utf8_length(pc.field("message"))}),
        lambda run: TableFiles(run.uri, "warnings", None).read([0]),
        lambda run: TableFiles(run.uri, "warnings", None, where="message != 'y'"),
    ],
)
def test_a_small_file_that_takes_much_memory_is_refused(
    read: Callable[[RunFolder], object], run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _bomb(run)
    assert path.stat().st_size < 10**4
    limit(monkeypatch, "table", max_decoded_bytes=2 * 10**6)
    before = pa.total_allocated_bytes()
    with pytest.raises(ConfigError, match=r"part-00.parquet: needs more memory, expected at most 2,000,000 bytes") as caught:
        read(run)
    assert caught.value.code == "shard_too_big"
    assert "\n" not in str(caught.value)
    assert pa.total_allocated_bytes() < before + 10**7
    assert run.table("warnings", ["id"]).num_rows == 4000
    rows, most = 0, 0
    for batch in run.batches("warnings"):  # as a stream it can be read
        rows += batch.num_rows
        most = max(most, pa.total_allocated_bytes())
    assert rows == 4000
    assert most < before + 10**7
    assert [batch.to_pydict() for batch in run.batches("warnings", ["id"], pc.field("id") == "b")] == []


def test_tables_are_those_of_an_arrow_dataset(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a file lacks a column, has several row groups, or is decoded a row at a time."""
    for shard in range(3):
        run.write_shard("warnings", f"0{shard}", warnings(*(f"{shard}-{k}" for k in range(1500))))
    path = Path(run.root) / "warnings" / "part-01.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["step"]), path)
    columns = {"n": pc.utf8_length(pc.field("id")), "step": pc.field("step")}
    for _ in range(2):
        for wanted in (None, ["code", "id"], columns):
            for where in (None, (pc.field("id") > "1") & (pc.field("message") != "x"), pc.field("id") == "none"):
                expected = run.dataset("warnings").to_table(wanted, filter=where)
                assert run.table("warnings", wanted, where).equals(expected, check_metadata=True)
        limit(monkeypatch, "table", max_decoded_bytes=10**5)


@pytest.mark.parametrize("attempt", [lambda run: run.read_bytes("manifest.json"), lambda run: run.files("warnings")])
def test_a_store_that_does_not_answer_is_reported(run: RunFolder, attempt: Callable[[RunFolder], object]) -> None:
    class Silent:
        def get_file_info(self, _: object) -> None:
            raise OSError("AWS Error NETWORK_CONNECTION: could not connect\nmore")

    run.filesystem = Silent()
    with pytest.raises(ConfigError, match=r"cannot be read \(AWS Error .*connect\), .*check the address") as caught:
        attempt(run)
    assert caught.value.code == "output_unreadable"


def test_rows_are_counted_and_chosen(run: RunFolder) -> None:
    run.write_shard("warnings", "00", warnings("a", "b"))
    run.write_shard("warnings", "01", warnings("c"))
    assert run.num_rows("warnings") == 3
    assert run.table("warnings", ["id"], pc.field("id") > "a")["id"].to_pylist() == ["b", "c"]


@pytest.mark.parametrize("uri", ["nowhere://bucket/run", "s3://", "://"])
def test_an_address_that_nothing_takes_is_refused(uri: str) -> None:
    with pytest.raises(ConfigError, match="expected a local path or an s3:// or gs:// URI") as caught:
        RunFolder(uri)
    assert caught.value.code == "output_invalid"


def test_a_file_uri_is_the_same_folder(run: RunFolder) -> None:
    run.write_shard("warnings", "00", warnings("a"))
    same = RunFolder(f"file://{run.root}")
    assert same.is_local
    assert same.files("warnings") == run.files("warnings")


def test_a_run_folder_travels_to_workers(run: RunFolder) -> None:
    run.write_bytes("manifest.json", b"{}")
    assert pickle.loads(pickle.dumps(run)).read_bytes("manifest.json") == b"{}"
    assert run.read_bytes("none.json") is None


def test_an_object_store_holds_the_same(bucket: str, run: RunFolder) -> None:
    remote = RunFolder(bucket)
    assert not remote.is_local
    for folder in (remote, run):
        with folder.locked():
            folder.write_shard("warnings", "00", warnings("a", "b"))
            folder.write_shard("warnings", "01", warnings("c"))
            folder.write_bytes("manifest.json", b"{}")
    assert remote.shard_ids("warnings") == run.shard_ids("warnings") == {"00", "01"}
    assert remote.table("warnings").equals(run.table("warnings"))
    assert remote.read_bytes("warnings/part-00.parquet") == run.read_bytes("warnings/part-00.parquet")
    assert pickle.loads(pickle.dumps(remote)).read_bytes("manifest.json") == b"{}"
    assert remote.read_bytes("none.json") is None


def test_an_object_store_without_the_bucket_is_reported(bucket: str) -> None:
    with pytest.raises(ConfigError, match=r"s3://not-scenes.* cannot be written") as caught:
        RunFolder(bucket.replace("s3://", "s3://not-")).write_bytes("manifest.json", b"{}")
    assert caught.value.code == "output_unwritable"
    with pytest.raises(ConfigError, match="no table scenes"):
        RunFolder(bucket).dataset("scenes")


@pytest.mark.parametrize("read", [lambda run: run.num_rows("warnings"), lambda run: run.table("warnings", ["id"]).num_rows])
def test_files_of_an_object_store_are_read_at_the_same_time(read: Callable[[RunFolder], int]) -> None:
    now, most, lock = 0, 0, threading.Lock()

    def slowed(application: Application) -> Application:
        def answer(environ: dict[str, Any], start: Any) -> Any:
            nonlocal now, most
            if environ["REQUEST_METHOD"] != "GET":
                return application(environ, start)
            with lock:
                now += 1
                most = max(most, now)
            time.sleep(0.1)
            with lock:
                now -= 1
            return application(environ, start)

        return answer

    with object_store(slowed) as uri:
        run = RunFolder(uri)
        for k in range(8):
            run.write_shard("warnings", f"{k:02}", warnings(f"{k}-a", f"{k}-b"))
        most = 0
        assert read(run) == 16
    assert most > 2
