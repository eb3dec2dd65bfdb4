"""Layouts of known shapes to refine."""

from functools import cache

from models.physics_corrector.refinement.contact_shapes import ContactShapeCache
from models.physics_corrector.refinement.problem import RefinementProblem
from stable_data.assets.contact_grids import ContactGrids
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene
from tests.models.physics_corrector.geometry.shapes import store


@cache
def cache_of_shapes() -> ContactShapeCache:
    return ContactShapeCache(store(), ContactGrids())


def shapes_of(scene: Scene) -> list[Shape]:
    return store().resolved(scene)[1]


def problem_of(*scenes: Scene, fixed: frozenset[str] = frozenset()) -> RefinementProblem:
    """The problem of scenes whose present poses are the original ones."""
    shapes = [shapes_of(scene) for scene in scenes]
    return RefinementProblem.of(scenes, shapes, [fixed] * len(scenes), scenes, cache_of_shapes())
