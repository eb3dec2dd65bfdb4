"""The hollow of a mesh."""

import numpy as np
import pytest

from stable_data.embedded_world.families.catalogue import asset
from stable_data.geometry.hollow import upward_hollow
from stable_data.geometry.mesh import Mesh
from tests.stable_data.importers.conversion.sources import CUP, box, revolved


def test_a_cup_holds_what_its_shape_says() -> None:
    found = upward_hollow(revolved(CUP, segments=64))
    inner = np.pi * 0.085 / 3 * (0.027**2 + 0.027 * 0.036 + 0.036**2)  # a truncated cone
    assert found.depth == pytest.approx(0.085, rel=0.1)
    assert found.volume == pytest.approx(inner, rel=0.2)
    assert found.footprint == pytest.approx(np.pi * 0.04**2, rel=0.15)


def test_a_box_holds_nothing_and_neither_does_a_cup_upside_down() -> None:
    assert upward_hollow(box(0.1, 0.1, 0.1)).volume < 1e-12
    cup = revolved(CUP)
    assert upward_hollow(Mesh(cup.vertices * (1, -1, -1), cup.faces)).volume < 1e-6


def test_what_it_holds_grows_with_the_cube_of_the_size() -> None:
    cup = revolved(CUP)
    small, large = upward_hollow(cup), upward_hollow(Mesh(cup.vertices * 3, cup.faces))
    assert large.volume == pytest.approx(27 * small.volume, rel=1e-6)


@pytest.mark.parametrize(
    ("key", "holds"), [("mug/1", True), ("bowl/0", True), ("basket/0", True), ("book/0", False), ("apple/0", False)]
)
def test_embedded_containers(key: str, holds: bool) -> None:
    mesh = asset(key).mesh
    assert (upward_hollow(mesh).volume > 0.1 * np.prod(mesh.extents)) == holds
