"""Copies of a mesh have one hash."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.families.catalogue import asset
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape_hash import shape_hash

MUG, OTHER = asset("mug/0").mesh, asset("mug/1").mesh


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_size_place_turn_and_order_do_not_matter(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(MUG.vertices))
    place = np.argsort(order)
    moved = MUG.vertices @ Rotation.random(rng=rng).as_matrix().T * size + rng.normal(size=3)
    copy = Mesh(moved[order], place[MUG.faces][rng.permutation(len(MUG.faces))])
    assert shape_hash(copy) == shape_hash(MUG)


@pytest.mark.parametrize("other", [OTHER, Mesh(MUG.vertices * (1, 1, 1.05), MUG.faces), Mesh(MUG.vertices, MUG.faces[:-1])])
def test_other_shapes_have_other_hashes(other: Mesh) -> None:
    assert shape_hash(other) != shape_hash(MUG)
