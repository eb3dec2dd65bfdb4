"""Processes of this machine: who has started whom, which ones work on a shard, and what they use."""

import ctypes
import os
import signal
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[2]
_END_SECONDS = 60.0  # for a command to end after it is interrupted
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)


def started(command: Sequence[str], log: IO[bytes], environment: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
    """Starts a command in a session of its own, which ends with this process even if that is killed.

    Args:
        command: The command, run in the checkout.
        log: File of its output.
        environment: Its environment; None for that of this process.
    """
    return subprocess.Popen(
        command, cwd=ROOT, stdout=log, stderr=log, env=environment, start_new_session=True, preexec_fn=_prepare
    )


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell in the background ignores it, and so would the command
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # likewise where it is blocked
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)


def below(roots: Iterable[int]) -> dict[int, str]:
    """Returns processes and all that they have started, with their command lines."""
    listing = subprocess.run(["ps", "-ewwo", "pid,ppid,args"], capture_output=True, text=True, check=True).stdout
    processes = [(int(pid), int(ppid), args) for pid, ppid, args in (x.split(maxsplit=2) for x in listing.splitlines()[1:])]
    found, size = set(roots), 0
    while len(found) > size:
        size = len(found)
        found |= {pid for pid, parent, _ in processes if parent in found}
    return {pid: args for pid, _, args in processes if pid in found}


def children(process: int) -> set[int]:
    """Returns the processes that a process has started itself."""
    listing = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True).stdout
    return set(map(int, listing.split()))


def busy_workers(roots: Iterable[int]) -> list[int]:
    """Returns Ray's workers below some processes that work on a shard."""
    return sorted(pid for pid, args in below(roots).items() if args.startswith("ray::_call"))


def kill(processes: Iterable[int]) -> int:
    """Kills processes at once, of which some may have ended already; returns how many had not."""
    killed = 0
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
            killed += 1
    return killed


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends a command of :func:`started` that still runs as Ctrl-C does, so that it can be resumed; kills it if it does not end."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_END_SECONDS)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@dataclass(frozen=True, slots=True)
class Usage:
    """What some processes use.

    Attributes:
        memory_mb: Resident memory, MB; memory that processes share counts for each.
        handles: Open files, sockets and pipes.
        processes: Number of processes.
        threads: Number of their threads.
        cpu_seconds: Time of the processor so far, with that of ended children.
    """

    memory_mb: float = 0.0
    handles: int = 0
    processes: int = 0
    threads: int = 0
    cpu_seconds: float = 0.0

    def __add__(self, other: "Usage") -> "Usage":
        return Usage(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))


def usage_of(processes: Iterable[int]) -> Usage:
    """Returns what processes use together; those that have ended count nothing."""
    found = Usage()
    for process in processes:
        try:
            root = Path(f"/proc/{process}")
            status = dict(line.split(":", 1) for line in (root / "status").read_text("utf-8").splitlines())
            # The name of the process, in parentheses, may have spaces; the 12th to 15th fields after it are times.
            times = (root / "stat").read_text("utf-8").rpartition(")")[2].split()[11:15]
            handles = len(list((root / "fd").iterdir()))
        except OSError:
            continue
        memory = int(status.get("VmRSS", "0 kB").split()[0]) / 1024
        found += Usage(memory, handles, 1, int(status["Threads"]), sum(map(int, times)) / os.sysconf("SC_CLK_TCK"))
    return found
