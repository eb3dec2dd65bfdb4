"""Processes of this machine: who has started whom, which ones work on a shard, and what they use."""

import os
import signal
import subprocess
from collections.abc import Iterable


def below(roots: Iterable[int]) -> dict[int, str]:
    """Returns processes and all that they have started, with their command lines."""
    listing = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True).stdout
    processes = [(int(pid), int(ppid), args) for pid, ppid, args in (x.split(maxsplit=2) for x in listing.splitlines()[1:])]
    found, size = set(roots), 0
    while len(found) > size:
        size = len(found)
        found |= {pid for pid, parent, _ in processes if parent in found}
    return {pid: args for pid, _, args in processes if pid in found}


def busy_workers(roots: Iterable[int]) -> list[int]:
    """Returns Ray's workers below some processes that work on a shard."""
    return sorted(pid for pid, args in below(roots).items() if args.startswith("ray::_call"))


def kill(processes: Iterable[int]) -> None:
    """Kills processes at once; some may have ended already."""
    for process in processes:
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            continue
