"""A Ray cluster on this machine whose nodes and whose head can be lost."""

import os
import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from ray.cluster_utils import Cluster

from benchmarks.faults.processes import below, busy_workers, children, kill

_ABSENT_SECONDS = 20.0  # longest time until another node replaces a killed one
_MOST_HEADS = 5  # tries to start one


class Nodes:
    """A Ray cluster on this machine: a head that runs no shard, and nodes of one core each. Its processes have the environment of this one.

    Args:
        count: Number of nodes besides the head.
    """

    def __init__(self, count: int = 3) -> None:
        self._count, self._added = count, 0
        self._absent: list[float] = []
        self._start()

    @property
    def address(self) -> str:
        """The address of the cluster for a driver; another one after the head was lost."""
        return str(self._cluster.address)

    def busy(self) -> list[int]:
        """Returns the processes that work on a shard."""
        return busy_workers(_raylet(node) for node in self._cluster.worker_nodes)

    def lose(self, busy: Collection[int], rng: np.random.Generator) -> bool:
        """Kills all processes of a node that has one of some busy workers at once; returns whether there was one."""
        nodes = sorted((node for node in self._cluster.worker_nodes if below([_raylet(node)]).keys() & set(busy)), key=_raylet)
        if not nodes:
            return False
        node = nodes[int(rng.integers(len(nodes)))]
        kill(below([_raylet(node)]))
        self._cluster.remove_node(node, allow_graceful=False)
        _delete(node.get_runtime_env_dir_path())
        self._absent.append(time.monotonic() + float(rng.uniform(0, _ABSENT_SECONDS)))
        return True

    def lose_head(self) -> None:
        """Kills all processes of the head at once; the nodes stay until :meth:`start_again`."""
        kill(below(_processes(self._cluster.head_node)))

    def start_again(self) -> None:
        """Replaces the cluster by a new one."""
        self.close()
        self._start()

    def restore(self) -> None:
        """Adds the nodes that are due to replace killed ones; one that does not join in Ray's time, on a busy machine, is due again."""
        due = [moment for moment in self._absent if moment <= time.monotonic()]
        self._absent = [moment for moment in self._absent if moment not in due]
        for _ in due:
            if not self._add():
                self._absent.append(time.monotonic())

    def close(self) -> None:
        """Ends all processes of the cluster."""
        nodes = [node for node in (*self._cluster.worker_nodes, self._cluster.head_node) if node is not None]
        kill(below(pid for node in nodes for pid in _processes(node)))
        with suppress(Exception):  # a head that is killed answers nothing
            self._cluster.shutdown()
        for node in nodes:
            _delete(node.get_runtime_env_dir_path())

    def _start(self) -> None:
        self._cluster = Cluster()
        tries = 1
        while not _is_started(lambda: self._cluster.add_node(num_cpus=0)):
            tries += 1
            if tries > _MOST_HEADS:
                raise RuntimeError(f"no head of a Ray cluster could be started in {_MOST_HEADS} tries")
            self._cluster = Cluster()
        self._absent = [time.monotonic()] * self._count
        self.restore()

    def _add(self) -> bool:
        """Adds a node; returns False if it did not join."""
        self._added += 1
        before = set(self._cluster.worker_nodes)
        # A node deletes what it has unpacked, so nodes on one machine must not share it.
        name = f"resources_of_node_{self._added}"
        is_there = _is_started(lambda: self._cluster.add_node(num_cpus=1, runtime_env_dir_name=name))
        if not is_there:
            self._cluster.worker_nodes = before
            _delete(Path(self._cluster.head_node.get_session_dir_path()) / name)
        return is_there


def _is_started(start: Callable[[], object]) -> bool:
    """Starts a node; kills what it has started if it fails, which Ray tells by errors of several types."""
    before = children(os.getpid())
    try:
        start()
    except Exception as error:  # noqa: BLE001 - Ray raises plain exceptions
        print(f"a node did not join and is started again: {error}", file=sys.stderr)
        kill(below(children(os.getpid()) - before))
        return False
    return True


def _delete(resources: str | Path) -> None:
    """Deletes what a lost node has unpacked, tens of megabytes: nobody else does."""
    shutil.rmtree(resources, ignore_errors=True)


def _raylet(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)


def _processes(node: Any) -> Iterator[int]:
    return (int(one.process.pid) for some in node.all_processes.values() for one in some)
