"""Convex parts: one where one is enough, hollow where the mesh is hollow, and always the same."""

import json
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import pytest
import trimesh

from stable_data.geometry.convex_decomposition import ConvexParts, convex_parts, inside_convex
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mesh import Mesh, signed_volumes
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.scene import FloatArray


def of(made: Any) -> Mesh:
    return Mesh(np.array(made.vertices), np.array(made.faces))


def cup(thickness: float = 0.1) -> Mesh:
    """A round cup of radius 1 and height 2 with a floor, closed."""
    outer = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=48)
    inner = trimesh.creation.cylinder(radius=1.0 - thickness, height=2.0, sections=48)
    inner.apply_translation([0, 0, thickness])
    return of(trimesh.boolean.difference([outer, inner], engine="manifold"))


def is_convex(part: Mesh) -> bool:
    return bool(inside_convex(part, part.vertices).all() and signed_volumes(part.triangles).sum() > 0)


def holds_ball(parts: ConvexParts, center: FloatArray, radius: float) -> bool:
    """Whether a ball touches no part."""
    ball = fcl.CollisionObject(fcl.Sphere(radius), fcl.Transform(np.asarray(center)))
    for part in parts.parts:
        faces = np.concatenate([np.full((len(part.faces), 1), 3), part.faces], axis=1).ravel()
        convex = fcl.CollisionObject(fcl.Convex(part.vertices, len(part.faces), faces), fcl.Transform())
        if fcl.collide(convex, ball, fcl.CollisionRequest(), fcl.CollisionResult()):
            return False
    return True


@pytest.mark.parametrize("mesh", [of(trimesh.creation.box((1, 2, 3))), of(trimesh.creation.icosphere(subdivisions=3))])
def test_a_convex_mesh_is_one_part_that_is_itself(mesh: Mesh) -> None:
    parts = convex_parts(mesh)
    assert parts.method == "hull"
    assert len(parts.parts) == 1
    assert max(parts.overfill_max, parts.uncovered_max) == pytest.approx(0, abs=1e-6)
    assert signed_volumes(parts.parts[0].triangles).sum() == pytest.approx(signed_volumes(mesh.triangles).sum())


def test_two_joined_boxes_become_few_exact_boxes() -> None:
    boxes = trimesh.creation.box((3, 1, 1)), trimesh.creation.box((1, 1, 3), transform=np.diag([1.0, 1, 1, 1]))
    boxes[1].apply_translation([1, 0, 1])
    parts = convex_parts(of(trimesh.boolean.union(boxes, engine="manifold")), max_parts=16)
    assert parts.method == "cuts"
    assert all(is_convex(part) for part in parts.parts)
    assert parts.overfill_max < 0.04
    assert parts.uncovered_max < 1e-6
    assert parts.hull_distance > 0.5


@pytest.mark.parametrize("unit", [0.05, 1.0, 100.0])
def test_a_cup_stays_hollow_in_any_unit(unit: float) -> None:
    mesh = cup()
    middle = 3.0 * unit * np.ones(3)
    parts = convex_parts(Mesh(mesh.vertices * unit + middle, mesh.faces))
    assert len(parts.parts) <= 32
    assert all(is_convex(part) for part in parts.parts)
    assert parts.overfill_max < 0.06 * unit < parts.hull_distance
    assert parts.uncovered_max < 1e-6 * unit
    assert holds_ball(parts, middle + unit * np.array([0, 0, 0.1]), 0.75 * unit)


def test_an_open_bowl_is_a_hollow_shell() -> None:
    ball = trimesh.creation.uv_sphere(count=[17, 32])
    lower = of(trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0], process=True))
    parts = convex_parts(lower)
    assert parts.method == "cuts"
    assert holds_ball(parts, np.array([0, 0, -0.3]), 0.5)
    assert parts.uncovered_max < 0.01


def test_a_flat_sheet_is_one_thin_part() -> None:
    square = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    parts = convex_parts(square)
    assert parts.method == "hull"
    assert is_convex(parts.parts[0])
    assert max(parts.overfill_max, parts.uncovered_max) <= 0.01


def test_a_floor_of_no_thickness_is_kept() -> None:
    ring = trimesh.boolean.difference([trimesh.creation.box((2, 2, 1)), trimesh.creation.box((1.6, 1.6, 3))], engine="manifold")
    floor = trimesh.Trimesh(
        [[-0.8, -0.8, -0.5], [0.8, -0.8, -0.5], [0.8, 0.8, -0.5], [-0.8, 0.8, -0.5]], [[0, 2, 1], [0, 3, 2]]
    )
    mesh, report, _ = repair_mesh(of(trimesh.util.concatenate([ring, floor])), "crate")
    parts = convex_parts(mesh)
    assert report.is_solid
    assert parts.uncovered_max < 1e-3
    assert not holds_ball(parts, np.array([0.0, 0.0, -0.5]), 0.05)
    assert holds_ball(parts, np.array([0.0, 0.0, 0.2]), 0.6)


def test_the_same_mesh_gives_the_same_parts() -> None:
    first, second = convex_parts(cup()), convex_parts(cup())
    assert len(first.parts) == len(second.parts)
    for a, b in zip(first.parts, second.parts, strict=True):
        assert np.array_equal(a.vertices, b.vertices)
        assert np.array_equal(a.faces, b.faces)


@pytest.mark.parametrize("max_parts", [1, 4, 12])
def test_the_budget_is_kept(max_parts: int) -> None:
    assert len(convex_parts(cup(), max_parts=max_parts).parts) <= max_parts


@pytest.mark.parametrize(("category", "radius"), [("bowl", 0.18), ("crate", 0.12), ("pot", 0.15)])
def test_a_marble_lies_in_real_containers(real_data: Path, category: str, radius: float) -> None:
    notes = json.loads((real_data / "Asset_annotation.json").read_text())
    asset_id = next(uid for uid, note in notes.items() if note["category"] == category)
    mesh, _, _ = repair_mesh(load_glb(real_data / "Assets_library" / f"{asset_id}.glb", asset_id)[0], asset_id)
    parts, extent = convex_parts(mesh), mesh.extents.max()
    assert parts.overfill_max < 0.05 * extent
    assert holds_ball(parts, np.array([0.0, 0.0, mesh.extents[2] / 2]), radius * extent)
