"""What the engine moves of a clean scene is put where it stays, or named."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from models.physics_corrector.certify import CertificationResult, Certifier, CertifyOptions, CorrectionStatus, certify
from models.physics_corrector.stabilization.settle_repair import repair_settling
from models.physics_corrector.stabilization.settle_trial import SettleTrial
from stable_data.errors import SceneError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.relations_kept import relations_kept
from stable_data.scene import RelationKind, Scene
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.settling import RigidBody, settle
from tests.models.physics_corrector.certify.things import bowl, box, cylinder, laid, mesh_shape

DEFAULT = CertifyOptions()
WALL, BOOK, CUP = box(0.1, 0.1, 0.1), box(0.2, 0.2, 0.03), cylinder(0.04, 0.1)


def tilted(angle: float = 0.35) -> Shape:
    """A brick on one of its edges."""
    mesh = trimesh.creation.box((0.04, 0.04, 0.06))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 1, 0)))
    return mesh_shape(mesh)


def solid(shape: Shape) -> Mesh:
    return Mesh(shape.vertices, shape.faces)


def bodies(scene: Scene, shapes: list[Shape], **parts: Shape) -> list[RigidBody]:
    """Each object as its own hull, or as the part that is said, in its frame."""
    return [
        RigidBody(o.instance, (solid(parts.get(o.instance, shape)),), 0.2, o.position, o.yaw)
        for o, shape in zip(scene.objects, shapes, strict=True)
    ]


def settled(scene: Scene, shapes: list[Shape], seen: list[RigidBody], options: CertifyOptions = DEFAULT) -> CertificationResult:
    certifier = Certifier(scene, shapes, options)
    return repair_settling(certifier, certifier.certify(), seen)


def half(shape: Shape) -> Shape:
    """What of a box is left of its middle."""
    vertices = shape.vertices.copy()
    vertices[vertices[:, 0] > 0, 0] = 0.0
    return Shape(vertices, shape.faces)


def test_what_stays_is_handed_back_as_it_is() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", BOOK, 0.6, 0.3, 0.0), ("c", WALL, 0.6, 0.3, 0.03))
    result = settled(scene, shapes, bodies(scene, shapes))
    assert result.scene is scene
    assert result.unsteady == ()


def test_nothing_is_said_of_rest_where_nobody_asks() -> None:
    scene, shapes = laid(("a", tilted(), 0.4, 0.3, 0.0))
    result = certify(scene, shapes)
    assert result.scene is scene
    assert result.unsteady is None


def test_what_falls_alone_leans_on_its_neighbour() -> None:
    scene, shapes = laid(("brick", tilted(), 0.3, 0.3, 0.0), ("wall", WALL, 0.45, 0.3, 0.0))
    assert certify(scene, shapes).scene is scene
    assert settle(bodies(scene, shapes), scene.table).stable is False
    result = settled(scene, shapes, bodies(scene, shapes))
    assert result.scene is not None
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.unsteady == ()
    assert settle(bodies(result.scene, shapes), scene.table).stable is True
    assert audit_scene(result.scene, shapes).card().clean
    assert result.scene["wall"] is scene["wall"]
    assert result.scene["brick"].tilt_quat_xyzw == scene["brick"].tilt_quat_xyzw


def test_what_falls_with_nothing_to_lean_on_is_named() -> None:
    scene, shapes = laid(("brick", tilted(), 0.3, 0.3, 0.0))
    result = settled(scene, shapes, bodies(scene, shapes))
    assert result.scene is scene
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.unsteady == ("brick",)


def test_what_is_fixed_is_named_and_not_moved() -> None:
    scene, shapes = laid(("brick", tilted(), 0.3, 0.3, 0.0), ("wall", WALL, 0.45, 0.3, 0.0))
    result = settled(scene, shapes, bodies(scene, shapes), CertifyOptions(fixed=frozenset({"brick"})))
    assert result.scene is scene
    assert result.unsteady == ("brick",)


def test_a_carrier_carries_where_the_engine_knows_it() -> None:
    scene, shapes = laid(
        ("book", BOOK, 0.4, 0.3, 0.0),
        ("cup", CUP, 0.44, 0.3, 0.03),
        ("spoon", box(0.02, 0.02, 0.01), 0.44, 0.3, 0.13),
        relations=(("cup", RelationKind.ON, "book"), ("spoon", RelationKind.ON, "cup")),
    )
    seen = bodies(scene, shapes, book=half(BOOK))
    result = settled(scene, shapes, seen)
    assert result.scene is not None
    assert result.unsteady == ()
    assert audit_scene(result.scene, shapes).card().clean
    assert result.scene["cup"].position[0] < 0.4
    assert result.scene["cup"].position[2] == pytest.approx(scene["cup"].position[2], abs=1e-3)
    apart = np.subtract(result.scene["spoon"].position, result.scene["cup"].position)
    assert np.allclose(apart, np.subtract(scene["spoon"].position, scene["cup"].position), atol=2e-3)


@pytest.mark.parametrize("is_meant", [True, False])
def test_what_the_engine_leaves_no_room_for_leaves_its_carrier_only_where_nobody_means_it_there(is_meant: bool) -> None:
    """The engine knows nothing of the book's other half, nor of one that is wide enough to stand on."""
    sliver = Shape(BOOK.vertices * (0.02, 0.02, 1.0), BOOK.faces)
    relations = (("cup", RelationKind.ON, "book"),) if is_meant else ()
    scene, shapes = laid(("book", BOOK, 0.3, 0.3, 0.0), ("cup", CUP, 0.36, 0.3, 0.03), relations=relations)
    fixed = RigidBody("book", (solid(sliver),), 50.0, scene["book"].position, movable=False)
    seen = [fixed, bodies(scene, shapes)[1]]
    result = settled(scene, shapes, seen)
    assert result.scene is not None
    assert audit_scene(result.scene, shapes).card().clean
    bottom = result.scene["cup"].position[2] - 0.05
    assert bottom == pytest.approx(0.03 if is_meant else 0.0, abs=1e-3)
    assert ("cup" in (result.unsteady or ())) is is_meant


def test_what_is_deep_in_a_container_that_the_engine_takes_for_solid_stays_and_is_named() -> None:
    scene, shapes = laid(("bowl", bowl(), 0.4, 0.3, 0.0), ("dice", box(0.02, 0.02, 0.02), 0.4, 0.3, 0.004))
    result = settled(scene, shapes, bodies(scene, shapes))
    assert result.scene is not None
    assert result.unsteady  # the one throws the other out
    assert audit_scene(result.scene, shapes).card().clean
    assert result.scene["dice"].position[2] < 0.04


def test_an_engine_that_cannot_be_asked_says_nothing() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0))
    flat = Mesh(CUP.vertices * (1.0, 1.0, 0.0), CUP.faces)
    result = settled(scene, shapes, [RigidBody("a", (flat,), 1.0, scene["a"].position)])
    assert result.scene is scene
    assert result.unsteady is None
    assert "MuJoCo cannot simulate it" in result.reason


def test_bodies_of_other_objects_are_refused() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.6, 0.3, 0.0))
    with pytest.raises(SceneError, match="bodies"):
        settled(scene, shapes, bodies(scene, shapes)[::-1])


def test_the_same_comes_out_every_time() -> None:
    scene, shapes = laid(("brick", tilted(), 0.3, 0.3, 0.0), ("wall", WALL, 0.45, 0.35, 0.0))
    first, second = (settled(scene, shapes, bodies(scene, shapes)).scene for _ in range(2))
    assert first == second


def test_certify_alone_does_not_load_the_engine() -> None:
    code = "import sys, models.physics_corrector.certify; print(*sys.modules)"
    root = Path(__file__).resolve().parents[4]
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root).stdout.split()
    assert "mujoco" not in loaded


def test_a_trial_lets_go_of_what_is_free_alone() -> None:
    scene, shapes = laid(("held", WALL, 0.2, 0.3, 0.3), ("falls", CUP, 0.2, 0.3, 0.45), ("stands", CUP, 0.6, 0.3, 0.0))
    poses = scene.poses()
    trial = SettleTrial(bodies(scene, shapes), poses, [1, 2], [0], scene.table)
    assert trial.stays(poses, 1.0, 0.01, 5.0).tolist() == [False, True]
    assert not trial.all_stay(poses, 1.0, 0.01, 5.0)
    ended = trial.outcome(poses, 1.0)
    assert ended[0, 2] == pytest.approx(0.45, abs=2e-3)  # on what is held in the air
    assert ended[1] == pytest.approx(poses[2], abs=2e-3)
    turned = np.add(poses, (0.0, 0.0, 0.0, 2.5))
    assert trial.outcome(turned, 0.1)[1, 3] == pytest.approx(2.5, abs=1e-2)


@pytest.mark.parametrize(("seconds", "moved"), [(0.5, [True, False]), (0.01, [True, True])])
def test_a_trial_that_diverges_blames_what_had_moved_before(
    seconds: float, moved: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the others would have stayed is not known; where nothing had moved, any may be to blame."""
    scene, shapes = laid(("falls", CUP, 0.2, 0.3, 0.4), ("stands", CUP, 0.6, 0.3, 0.0))
    poses, step = scene.poses(), mujoco.mj_step

    def diverge(model: Any, data: Any, nstep: int) -> None:
        step(model, data, nstep=nstep)
        if data.time > seconds:
            data.qpos[:] = np.nan

    monkeypatch.setattr(mujoco, "mj_step", diverge)
    trial = SettleTrial(bodies(scene, shapes), poses, [0, 1], [], scene.table)
    stays, moves = trial.judge(poses, 4.0, 0.01, 5.0)
    assert stays.tolist() == trial.stays(poses, 4.0, 0.01, 5.0).tolist() == [False, False]
    assert moves.tolist() == moved
    assert not trial.all_stay(poses, 4.0, 0.01, 5.0)


def test_what_leans_keeps_its_relations_where_it_can() -> None:
    """The side of the wall that is nearest would take the brick from left of the cup to in front of it."""
    scene, shapes = laid(("brick", tilted(), 0.3, 0.3, 0.0), ("wall", WALL, 0.402, 0.303, 0.0), ("cup", CUP, 0.5, 0.488, 0.0))
    result = settled(scene, shapes, bodies(scene, shapes))
    assert result.scene is not None
    assert result.unsteady == ()
    kept = relations_kept(scene, result.scene, shapes)
    assert kept.directional_held == kept.directional_kept == 3
