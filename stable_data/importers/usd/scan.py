"""What each layer of a folder says by itself, found in a process of its own: USD's parser may end it."""

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from stable_data.errors import MeshError
from stable_data.importers.boundary import Boundary
from stable_data.importers.usd.layers import LayerLoader, layer_names, quiet_usd
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, SETTING, FileLimits, at_most, memory_limited

_MOST_ANSWER = 16 * 2**20  # bytes
_MEMORY_OF_BYTE = 64  # of a file; USD makes room for what a file states before it looks whether the file has it


@dataclass(frozen=True, slots=True)
class LayerFacts:
    """What a layer says by itself.

    Attributes:
        has_default: Whether it has a default prim.
        num_roots: Root prims that it defines.
        parts: The layers that it is composed of, relative to the folder, as far as they exist.
        files: Its other files, likewise.
    """

    has_default: bool
    num_roots: int
    parts: tuple[str, ...]
    files: tuple[str, ...]

    @classmethod
    def of(cls, boundary: Boundary, path: str) -> "LayerFacts":
        """Parses a layer, without those that it names.

        Raises:
            MeshError: It cannot be read.
        """
        from pxr import Sdf

        loader = LayerLoader(boundary)
        place = loader.place(path)
        with quiet_usd(path):
            layer = loader.opened(place)
            parts, others = layer_names(layer)
            num_roots = sum(prim.specifier == Sdf.SpecifierDef for prim in layer.rootPrims)
            has_default = bool(layer.defaultPrim)
        if place.member:
            return cls(True, num_roots, (), ())
        found: tuple[list[str], list[str]] = [], []
        for names, known in zip((parts, others), found, strict=True):
            for name in names:
                try:
                    known.append(loader.resolve(name, place).path)
                except MeshError:
                    continue
        return cls(has_default, num_roots, tuple(found[0]), tuple(found[1]))


class LayerScanner:
    """Looks at the layers of a folder in a process of its own; a layer that ends it or takes too long costs that layer alone.

    Args:
        root: The folder.
    """

    def __init__(self, root: Boundary) -> None:
        self._root = root
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "LayerScanner":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def __call__(self, path: str) -> LayerFacts:
        """Returns what a layer says.

        Args:
            path: Relative to the folder.

        Raises:
            MeshError: It cannot be read.
        """
        process = self._process = self._process or self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(path).encode() + b"\n")
            process.stdin.flush()
            ready = wait([process.stdout.fileno()], LIMITS.item.max_scan_seconds)
            line = process.stdout.readline(_MOST_ANSWER) if ready else None
        except OSError:
            line = b""
        if not line or not line.endswith(b"\n"):
            self._stop()
            found = f"was not read in {LIMITS.item.max_scan_seconds} s (item.max_scan_seconds in {SETTING})"
            if line is not None:
                _, most = _memory(self._root.root / path)
                found = f"ends the process that reads it, perhaps because it needs more memory: it has {most}"
            raise MeshError(f"{quote_value(path)} {found}, expected a layer of USD; export it again", "model_unreadable")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise MeshError(answer["error"], answer["code"])
        return LayerFacts(answer["has_default"], answer["num_roots"], tuple(answer["parts"]), tuple(answer["files"]))

    def _started(self) -> subprocess.Popen[bytes]:
        limits = json.dumps(asdict(self._root.limits))
        # -P: Python would look for modules in the current folder first, which may be the source folder.
        command = [
            sys.executable,
            "-P",
            "-c",
            f"from {__name__} import answer_paths; answer_paths()",
            str(self._root.root),
            limits,
        ]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        )

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def answer_paths() -> None:
    """Answers each path of standard input with what its layer says; the command's arguments are the folder and its limits."""
    root, limits = Path(sys.argv[1]), FileLimits(**json.loads(sys.argv[2]))
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries may print
    import_module("pxr.Sdf")  # its memory is not that of a layer
    for line in sys.stdin.buffer:
        path = json.loads(line)
        num_bytes, most = _memory(root / path)
        try:
            with memory_limited(num_bytes):
                answer = asdict(LayerFacts.of(Boundary(root, limits), path))
        except MeshError as error:
            answer = {"error": str(error), "code": error.code}
        except MemoryError:
            found = f"{quote_value(path)} needs more memory, expected {most}; is it hostile?"
            answer = {"error": found, "code": "file_too_large"}
        answers.write(json.dumps(answer).encode() + b"\n")
        answers.flush()


def _memory(file: Path) -> tuple[int, str]:
    """The memory that may be used for a layer, bytes, and how an error says it."""
    try:
        size = file.stat().st_size
    except OSError:
        size = 0
    of_layer = LIMITS.item.max_scan_memory_bytes + _MEMORY_OF_BYTE * size
    if of_layer < LIMITS.item.max_memory_bytes:
        most = at_most(LIMITS.item, "max_scan_memory_bytes", "bytes")
        return of_layer, f"{most} and {_MEMORY_OF_BYTE} for each byte of the file"
    return LIMITS.item.max_memory_bytes, at_most(LIMITS.item, "max_memory_bytes", "bytes")
