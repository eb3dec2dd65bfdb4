"""What the refinement reads of an object depends on the object alone."""

import pytest
import torch

from models.physics_corrector.refinement.contact_shapes import ContactShapeCache, ContactShapes
from stable_data.assets.contact_grids import ContactGrids
from stable_data.scene import Scene
from tests.models.physics_corrector.geometry.shapes import SHAPES, scene, store, thing
from tests.models.physics_corrector.refinement.layouts import shapes_of

GRIDS = ContactGrids()


def at(factor: float, name: str) -> Scene:
    return scene(thing(name, (0.5, 0.4, 0.1, 0.0), scale=(factor, factor, 0.7 * factor)))


def read(cache: ContactShapeCache, of: Scene) -> ContactShapes:
    return cache.shapes_of([of], [shapes_of(of)])[0]


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_the_size_at_which_an_asset_was_first_needed_changes_no_bit(name: str) -> None:
    """Opposite corners of a round outline are equally far out but for rounding."""
    wanted = read(ContactShapeCache(store(), GRIDS), at(1.0, name))
    for first in (1.137, 0.83, 0.311):
        cache = ContactShapeCache(store(), GRIDS)
        cache.make(at(first, name), shapes_of(at(first, name)))
        found = read(cache, at(1.0, name))
        for part in ("outline", "middle", "samples"):
            assert torch.equal(getattr(found, part), getattr(wanted, part)), part
        assert torch.equal(found.tensors.unit_from_yaw, wanted.tensors.unit_from_yaw)


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_lengths_grow_with_the_object(name: str) -> None:
    cache = ContactShapeCache(store(), GRIDS)
    small, large = (read(cache, at(factor, name)) for factor in (0.83, 1.66))
    for part in ("outline", "middle", "samples"):
        assert torch.allclose(2 * getattr(small, part), getattr(large, part), atol=1e-6)
    (shape,) = shapes_of(at(0.83, name))
    assert small.outline.amax((0, 1)).tolist() == pytest.approx(shape.footprint.max(axis=0).tolist(), abs=1e-6)
