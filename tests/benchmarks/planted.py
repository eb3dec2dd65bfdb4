"""Targets with planted faults, for the tests of the fuzzer: each does for one word of its input what no reader may do."""

import ctypes
import os
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.mutation.odd_values import OUTSIDE
from benchmarks.fuzzing.watching import FalsePass
from stable_data.errors import ConfigError, MeshError

HONEST = b"an honest word"
_LIBRARY = ctypes.CDLL(None)


def _read(folder: Path, base: str) -> bool:
    words = (folder / "text.txt").read_bytes().split()
    if b"kept" in words:
        Path("left_behind").write_text("x")
    if b"refused" in words:
        raise ConfigError("the text is refused, expected another one", "text_refused")
    for word, act in _ACTS.items():
        if word.encode() in words:
            act(folder)
    return True


def _crash(_: Path) -> None:
    raise KeyError("planted")


def _hang(_: Path) -> None:
    end = time.process_time() + 60
    while time.process_time() < end:
        pass


def _wait(_: Path) -> None:
    threading.Event().wait()


def _end(_: Path) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def _end_late(_: Path) -> None:
    end = time.process_time() + 0.6
    while time.process_time() < end:
        pass
    os.kill(os.getpid(), signal.SIGSEGV)


def _eat(_: Path) -> None:
    np.empty(3 * 2**30, np.uint8)


def _eat_in_secret(_: Path) -> None:
    try:
        np.empty(2**45, np.uint8)  # refused; the reader makes a refusal of it
    except MemoryError as error:
        raise MeshError("too large, expected less", "mesh_too_large") from error


def _open_outside(folder: Path) -> None:
    (folder / ".." / "outside" / "picture.png").read_bytes()


def _open_outside_natively(_: Path) -> None:
    handle = _LIBRARY.open(f"{OUTSIDE}/mesh.stl".encode(), os.O_RDONLY)
    _LIBRARY.close(handle)


def _open_in_secret(_: Path) -> None:
    with suppress(BaseException):  # a reader could swallow everything
        Path("/etc/passwd").read_bytes()


def _change_input(folder: Path) -> None:
    (folder / "text.txt").write_bytes(b"changed")


def _start(_: Path) -> None:
    subprocess.run(["true"], check=False)


def _run_code(folder: Path) -> None:
    eval((folder / "text.txt").read_text() and "1 + 1")  # noqa: S307 - the fault


def _pass(_: Path) -> None:
    raise FalsePass("clean is True, but a figure is nan")


def _say_too_much(_: Path) -> None:
    error = ConfigError("a short text", "text_refused")
    error.args = ("x" * 100_000,)  # errors cut what they are made with
    raise error


def _say_nothing(_: Path) -> None:
    raise ConfigError("no code")


_ACTS = {
    "crash": _crash,
    "hang": _hang,
    "wait": _wait,
    "end": _end,
    "end_late": _end_late,
    "eat": _eat,
    "eat_in_secret": _eat_in_secret,
    "open_outside": _open_outside,
    "open_natively": _open_outside_natively,
    "open_in_secret": _open_in_secret,
    "change_input": _change_input,
    "start": _start,
    "run_code": _run_code,
    "pass": _pass,
    "say_too_much": _say_too_much,
    "say_nothing": _say_nothing,
}


def _bases() -> list[Base]:
    return [Base("honest", {"text.txt": HONEST})]


def _read_well(folder: Path, base: str) -> bool:
    return bool((folder / "text.txt").read_bytes())


_READ: list[str] = []


def _read_once_outside(folder: Path, base: str) -> bool:
    """Opens a file elsewhere for the fifth input of a process alone, as if another process had opened it."""
    _READ.append(base)
    if len(_READ) == 5:
        _open_outside_natively(folder)
    return True


def _read_in_a_state(folder: Path, base: str) -> bool:
    """Crashes for the fifth input of a process alone, whatever that is."""
    _READ.append(base)
    if len(_READ) == 5:
        raise KeyError("planted")
    return True


def _spared(folder: Path, base: str) -> bool:
    """As users are protected: a text that crashes the reader, or fills its memory, is refused by a look at it first."""
    if {b"crash", b"eat"} & set((folder / "text.txt").read_bytes().split()):
        raise ConfigError("the text is refused, expected another one", "text_refused")
    return _read(folder, base)


TARGETS = {
    target.name: target
    for target in (
        Target("planted", 3, _bases, _read, ("crash", "refused", "say_nothing", "end"), block=40),
        Target("calm", 1, _bases, _read_well, block=40),
        Target("spared", 1, _bases, _read, block=40, read_apart=_spared),
        Target("ending", 1, _bases, _read, ("end",), block=40, read_apart=_spared),
        Target("eating_alone", 1, _bases, _read, ("eat",), block=40, read_apart=_spared),
        Target("eating", 1, _bases, _read, ("eat",), block=40, read_apart=_read),
        Target("ending_late", 1, _bases, _read, ("end_late",), block=40),
        Target("hanging", 1, _bases, _read, ("hang",), block=40),
        Target("in_a_state", 1, _bases, _read_in_a_state, block=40),
        Target("beside_others", 1, _bases, _read_once_outside, block=40),
        Target("dishonest", 1, _bases, lambda folder, base: False),
    )
}
"""The targets of the tests."""

MENDED = {"planted": Target("planted", 3, _bases, _read_well, TARGETS["planted"].words, block=40)}
"""The planted target after all faults were mended."""
