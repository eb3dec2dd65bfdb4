"""All targets by name."""

from benchmarks.fuzzing.cases import Target
from benchmarks.fuzzing.targets import datasets, episodes, imports, meshes, replies, runs, scene_files, texts, weights

_MODULES = (datasets, meshes, texts, replies, imports, scene_files, runs, episodes, weights)

TARGETS: dict[str, Target] = {target.name: target for module in _MODULES for target in module.TARGETS}
"""The targets by name."""
