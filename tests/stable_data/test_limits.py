"""The limits: their names and values, how they are changed, what a message says, and the bound on memory."""

import gc
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn
from weakref import ref

import mujoco
import numpy as np
import pyarrow as pa
import pytest

from stable_data import limits
from stable_data.errors import ConfigError, MeshError, cannot_read
from stable_data.importers.mjcf.reader import _compile
from stable_data.judges.registry import judge
from stable_data.limits import (
    LIMITS,
    SETTING,
    ImageLimits,
    Limits,
    at_most,
    is_out_of_memory,
    list_limits,
    memory_limited,
    read_limits,
)
from stable_data.mesatask.convention_detection import position_convention
from stable_data.robot.acting.rollout import _call
from stable_data.scene import Tabletop


def test_every_limit_has_a_positive_default_and_says_what_it_limits() -> None:
    limits = list_limits()
    assert len(limits) == len({one.name for one in limits}) > 70
    assert [one.name for one in limits if not one.meaning.endswith(".") or one.default <= 0] == []
    assert all(is_dataclass(getattr(LIMITS, group.name)) for group in fields(LIMITS))


ROOT = Path(__file__).parents[2]


def test_every_limit_is_used_in_the_code() -> None:
    """In a module that names its group, its class, or what reads files with it."""
    code = [path.read_text("utf-8") for name in ("stable_data", "models", "pipelines") for path in (ROOT / name).rglob("*.py")]
    words = [set(re.findall(r"LIMITS\.\w+|\w+", text)) for text in code if "class ItemLimits" not in text]
    for one in list_limits():
        owners = {
            f"LIMITS.{one.group}",
            type(getattr(LIMITS, one.group)).__name__,
            *({"Boundary"} if one.group == "file" else ()),
        }
        assert any(owners & found and one.name.partition(".")[2] in found for found in words), one.name


def test_groups_are_told_apart() -> None:
    """Of ``max_bytes`` alone nobody knows of what."""
    about = {one.group: one.about for one in list_limits()}
    assert len(set(about.values())) == len(about) == len(fields(LIMITS))
    assert all(text.endswith(".") for text in about.values())


def test_limits_are_changed_by_their_names() -> None:
    limits = read_limits(" mesh.max_faces=5_000_000,layout.max_reach = 2.5 ,")
    assert (limits.mesh.max_faces, limits.layout.max_reach) == (5_000_000, 2.5)
    assert limits.changed() == {"mesh.max_faces": 5_000_000, "layout.max_reach": 2.5}
    assert limits.gltf_scene == Limits().gltf_scene
    assert read_limits("") == Limits()


@pytest.mark.parametrize(
    "text",
    [
        "mesh.max_faces",
        "mesh.max_faces=",
        "mesh.max_faces=0",
        "mesh.max_faces=-1",
        "mesh.max_faces=1.5",
        "mesh.max_faces=nan",
        "mesh.max_faces=" + "9" * 5000,
        "mesh.max_faces=١",
        "layout.max_reach=inf",
        "layout.max_reach=.",
        "mesh=1",
        "max_faces=1",
        "mesh.max_faces=1\x1b[31m",
        "x" * 10_000,
    ],
)
def test_what_is_no_limit_ends_the_command_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match=f"{SETTING}: ") as caught:
        read_limits(text)
    assert caught.value.code == "limits_invalid"
    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


def test_a_message_names_the_limit_and_its_setting() -> None:
    assert at_most(LIMITS.mesh, "max_faces", "faces") == f"at most 1,000,000 faces (mesh.max_faces in {SETTING})"
    assert at_most(LIMITS.layout, "max_reach", "m") == f"at most 10 m (layout.max_reach in {SETTING})"
    assert at_most(ImageLimits(max_scans=7), "max_scans") == "at most 7 (max_scans)"  # chosen by a caller
    assert at_most(replace(LIMITS.mesh, max_faces=7), "max_nodes").endswith(f"(mesh.max_nodes in {SETTING})")


def test_the_variable_holds_for_a_command() -> None:
    command = [sys.executable, "-m", "stable_data", "limits"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, SETTING: "json.max_levels=7"}, check=True)
    assert "\njson: JSON of any kind.\n" in done.stdout
    assert "json.max_levels = 7 (default 64)\n    Nesting of lists and objects" in done.stdout


@pytest.mark.parametrize(
    "program",
    [
        "stable_data limits",
        "pipelines --help",
        *(
            pytest.param(f"{name} --help", marks=pytest.mark.slow)
            for name in ("models.picture_features", "models.point_encoder.pretrain", "models.scene_rating.usual_layouts")
        ),
    ],
)
def test_wrong_limits_end_every_program_in_one_line(program: str) -> None:
    command = [sys.executable, "-m", *program.split()]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, SETTING: "json.levels=7"}, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: {SETTING}: 'json.levels=7' names no limit")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")
def test_memory_is_bounded_in_the_body_alone() -> None:
    code = """
import numpy as np
from stable_data.limits import memory_limited
for allocate in (lambda: np.ones(2**28, np.uint8), lambda: bytearray(2**28), lambda: "x" * 2**28):
    with memory_limited(2**26):
        np.ones(2**24, np.uint8)
        try:
            allocate()
            print("allocated")
        except MemoryError:
            print("refused")
    allocate()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["refused"] * 3


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")
def test_what_a_body_may_allocate_does_not_depend_on_those_before() -> None:
    code = """
import numpy as np
from stable_data.limits import memory_limited
kept = []
for size in (200, 200, 300, 300, 200):
    with memory_limited(2**28):
        try:
            blocks = [np.ones(100_000, np.uint8) for _ in range(10 * size)]
            kept += blocks[::100]  # what lies between is free again, but stays with the process
            print("allocated")
        except MemoryError:
            print("refused")
    blocks = None
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["allocated"] * 2 + ["refused"] * 2 + ["allocated"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc has the bound")
def test_large_arrays_leave_no_gaps_in_the_heap() -> None:
    code = """
import sys
import numpy as np
from stable_data.limits import MIB, map_large_arrays, resident_memory
if sys.argv[1] == "mapped":
    map_large_arrays()
np.ones(2**25 - 2**16, np.uint8)  # from now on glibc takes such arrays from its heap, if it may
before, kept, arrays = resident_memory(), [], []
for _ in range(16):
    arrays.append(np.ones(2**23, np.uint8))
    kept.append(bytes(100_000))
del arrays
print((resident_memory() - before) // MIB)
"""
    kept = [int(subprocess.check_output([sys.executable, "-c", code, how])) for how in ("mapped", "default")]
    assert kept[0] < 8  # MB
    assert kept[1] > 100  # else this test shows nothing


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")
def test_what_arrow_keeps_is_not_taken_from_a_body() -> None:
    code = """
import ctypes
import numpy as np
import pyarrow as pa
from stable_data.limits import memory_limited
with memory_limited(2**28):
    pass
buffers = [pa.allocate_buffer(2**20) for _ in range(600)]
for buffer in buffers:
    ctypes.memset(buffer.address, 1, buffer.size)
del buffers, buffer
with memory_limited(2**28):
    np.ones(2**27, np.uint8)
print("allocated")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "allocated\n"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")
def test_a_reader_with_too_little_memory_does_not_call_its_file_broken() -> None:
    code = """
import io
import numpy as np
from PIL import Image
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.images import decode_images
from stable_data.geometry.mesh import Mesh
from stable_data.importers.boundary import Boundary
from stable_data.importers.mesh_files import read_mesh_file
from stable_data.limits import memory_limited
from pathlib import Path
from tempfile import TemporaryDirectory

corners = np.random.default_rng(0).normal(size=(900_000, 3))
glb, file = write_glb(Mesh(corners, np.arange(900_000).reshape(-1, 3))), io.BytesIO()
Image.new("RGB", (6000, 6000)).save(file, "PNG")
record = np.zeros(300_000, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
record["corners"] = corners.reshape(-1, 3, 3)
with TemporaryDirectory() as folder:
    (Path(folder) / "a.stl").write_bytes(bytes(80) + np.uint32(len(record)).tobytes() + record.tobytes())
    corners = record = None
    for read in (
        lambda: load_glb(glb, "mug"),
        lambda: decode_images({0: file.getvalue()}, "mug", side=1024, has_alpha=False),
        lambda: read_mesh_file(Boundary(Path(folder)), "a.stl", "mug", max_faces=10**6),
    ):
        for limit in (2**34, 2**24):
            try:
                with memory_limited(limit):
                    read()
                print("read")
            except Exception as error:
                print(type(error).__name__)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["read", "MemoryError"] * 3


TORCH = "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried to allocate 268435456 bytes"


def _fail(error: Exception) -> Callable[..., NoReturn]:
    def fail(*_: object, **__: object) -> NoReturn:
        raise error

    return fail


def _detect_convention() -> None:
    dataset: Any = SimpleNamespace(scene_ids=("a",), read=_fail(MemoryError()))
    position_convention(dataset, dataset)


def _settle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.judges.registry.import_module", lambda _: SimpleNamespace(settle=_fail(MemoryError())))
    judge("mujoco", (), Tabletop("desk", (1.0, 1.0)))


def test_mujoco_has_none_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.importers.mjcf.reader._Shapes.of", _fail(mujoco.FatalError("Could not allocate memory")))
    with pytest.raises(MemoryError), memory_limited(2**34):
        _compile(SimpleNamespace(), "a.xml")  # type: ignore[arg-type]


def _compile_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.importers.mjcf.reader._Shapes.of", _fail(MemoryError()))
    _compile(SimpleNamespace(), "a.xml")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "use",
    [
        lambda _: _detect_convention(),
        _settle,
        _compile_model,
        lambda _: _call("policy", "act", _fail(MemoryError())),
        lambda _: _raise_cannot_read(),
    ],
)
def test_what_reports_other_errors_lets_those_of_memory_through(
    use: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(MemoryError):
        use(monkeypatch)


def _raise_cannot_read() -> None:
    error = pa.ArrowMemoryError("malloc of size 2147483648 failed")
    raise cannot_read("run", "part-0.parquet", error) from error


def test_torch_has_no_error_of_its_own_for_memory() -> None:
    with pytest.raises(RuntimeError, match="alloc_cpu"):
        _call("policy", "act", _fail(RuntimeError(TORCH)))
    assert not is_out_of_memory(MeshError("the file says: cannot allocate memory", "model_unreadable"))
    with pytest.raises(MemoryError, match="alloc_cpu"), memory_limited(2**34):
        raise RuntimeError(TORCH)
    with pytest.raises(RuntimeError, match="another"), memory_limited(2**34):
        raise RuntimeError("another")


def test_a_bound_that_is_far_away_changes_nothing() -> None:
    with memory_limited(2**34), memory_limited(2**33):
        assert np.ones(2**20).sum() == 2**20


class Ring:
    """Refers to itself, so that only a collection frees it."""

    def __init__(self) -> None:
        self.ring = self


def test_rings_are_freed_between_batches_but_not_at_each_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, is_freed = [1000.0, 1059.0, 1061.0], []
    monkeypatch.setattr(limits, "monotonic", lambda: clock.pop(0))
    monkeypatch.setattr(limits, "_next_collection", 0.0)
    gc.disable()
    try:
        while clock:
            ring = ref(Ring())
            limits.release_free_memory()
            is_freed.append(ring() is None)
    finally:
        gc.enable()
    assert is_freed == [True, False, True]
