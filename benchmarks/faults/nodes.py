"""A Ray cluster on this machine whose nodes and whose head can be lost."""

import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from ray.cluster_utils import Cluster

from benchmarks.faults.processes import below, busy_workers, kill

_ABSENT_SECONDS = 20.0  # longest time until another node replaces a killed one


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
        """Adds the nodes that are due to replace killed ones."""
        due = [moment for moment in self._absent if moment <= time.monotonic()]
        self._absent = [moment for moment in self._absent if moment not in due]
        for _ in due:
            self._add()

    def close(self) -> None:
        """Ends all processes of the cluster."""
        nodes = [*self._cluster.worker_nodes, self._cluster.head_node]
        kill(below(pid for node in nodes if node is not None for pid in _processes(node)))
        with suppress(Exception):  # a head that is killed answers nothing
            self._cluster.shutdown()

    def _start(self) -> None:
        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        self._absent.clear()
        for _ in range(self._count):
            self._add()

    def _add(self) -> None:
        self._added += 1
        # A node deletes what it has unpacked, so nodes on one machine must not share it.
        self._cluster.add_node(num_cpus=1, runtime_env_dir_name=f"resources_of_node_{self._added}")


def _raylet(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)


def _processes(node: Any) -> Iterator[int]:
    return (int(one.process.pid) for some in node.all_processes.values() for one in some)
