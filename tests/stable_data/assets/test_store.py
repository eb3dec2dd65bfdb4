"""An object's geometry: at its scale and tilt, fitted where the scale is missing or wrong, a box where the mesh is."""

import contextlib
import errno
import math
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore, fitted_scale
from stable_data.errors import MeshError, SceneError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.aspects import ASPECT_STEP, aspect_of, aspect_steps
from stable_data.geometry.shape import Shape
from stable_data.mesatask import PositionConvention
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from tests.bounds import limit
from tests.scenes import ball, bowl, box, sheet

ON_ITS_SIDE: QuatXyzw = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
BLOCK = SceneObject("1_block_0", "block", (0.5, 0.5, 0.1), 0.0, (0.1, 0.2, 0.4), asset_id="block", scale=(0.1, 0.1, 0.1))

lengths = st.floats(0.01, 3.0)
right_angles = st.sampled_from([tuple(r.as_quat().tolist()) for r in Rotation.create_group("O")])


def tilted_about(axes: str, degrees: float | tuple[float, ...]) -> QuatXyzw:
    """A tilt by Euler angles."""
    x, y, z, w = Rotation.from_euler(axes, degrees, degrees=True).as_quat().tolist()
    return x, y, z, w


class Folder:
    """Assets as files of a folder; remembers what was asked for."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.asked: list[str] = []

    def asset_path(self, asset_id: str) -> Path | None:
        self.asked.append(asset_id)
        path = self.root / f"{asset_id}.glb"
        return path if path.is_file() else None


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    for name, size in (("block", (1.0, 2.0, 4.0)), ("cube", (1.0, 1.0, 1.0))):
        shape = box(*size)
        (tmp_path / f"{name}.glb").write_bytes(write_glb(Mesh(shape.vertices, shape.faces)))
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    return Folder(tmp_path)


@pytest.fixture
def store(folder: Folder) -> AssetStore:
    return AssetStore(folder)


def test_an_object_has_its_mesh_at_its_scale(store: AssetStore) -> None:
    shape, notices = store.shape(BLOCK)
    assert shape.size == pytest.approx(BLOCK.size)
    assert shape.is_exact
    assert notices == ()


def test_an_object_has_its_mesh_at_its_tilt(store: AssetStore) -> None:
    shape, notices = store.shape(replace(BLOCK, tilt_quat_xyzw=ON_ITS_SIDE, size=(0.1, 0.4, 0.2)))
    assert shape.size == pytest.approx((0.1, 0.4, 0.2))
    assert notices == ()


def test_a_missing_scale_fits_the_mesh_to_the_size(store: AssetStore) -> None:
    shape, notices = store.shape(replace(BLOCK, scale=None, size=(0.2, 0.1, 0.3)))
    assert shape.size == pytest.approx((0.2, 0.1, 0.3))
    assert shape.is_exact
    assert notices == ()


def test_a_mesh_of_another_size_is_fitted_and_noticed(store: AssetStore) -> None:
    shape, (notice,) = store.shape(replace(BLOCK, size=(0.1, 0.2, 0.5)))
    assert shape.size == pytest.approx((0.1, 0.2, 0.5))
    assert (notice.item_id, notice.step, notice.code) == ("1_block_0", "mesh", "asset_differs")
    assert "10.0x20.0x40.0 cm, expected 10.0x20.0x50.0 cm" in notice.message


def test_a_size_that_nothing_fits_is_a_box_and_noticed(store: AssetStore) -> None:
    thin = replace(BLOCK, scale=None, size=(0.1, 0.0, 0.0))
    shape, (notice,) = store.shape(thin)
    assert not shape.is_exact
    assert shape.size == pytest.approx(thin.size)
    assert notice.code == "asset_does_not_fit"
    assert "fitted to its size is 2.5x5.0x10.0 cm, expected 10.0x0.0x0.0 cm" in notice.message


def test_a_tilted_mesh_without_a_scale_is_fitted_by_one_factor(store: AssetStore) -> None:
    leaning = tilted_about("zx", (45, 30))
    size = Shape.from_mesh(store.asset("block").mesh, (0.1, 0.1, 0.1), leaning).size
    x, y, z = size.tolist()
    shape, notices = store.shape(replace(BLOCK, tilt_quat_xyzw=leaning, scale=None, size=(x, y, z)))
    assert shape.is_exact
    assert shape.size == pytest.approx(size)
    assert notices == ()


def test_what_is_resolved_has_the_scale_that_its_shape_has(store: AssetStore) -> None:
    objects = (
        replace(BLOCK, instance="as it is"),
        replace(BLOCK, instance="without a scale", scale=None, size=(0.2, 0.1, 0.3)),
        replace(BLOCK, instance="another mesh", size=(0.1, 0.2, 0.5), source={"scale_factor": [10, 10, 10]}),
        replace(BLOCK, instance="does not fit", size=(0.1, 0.0, 0.0)),
        replace(BLOCK, instance="no mesh", asset_id="absent"),
    )
    scene, shapes, notices = store.resolved(Scene("s", Tabletop("desk", (1.0, 1.0)), objects))
    assert [o.instance for o in scene.objects] == [o.instance for o in objects]
    assert scene.objects[0] is objects[0]
    assert scene.objects[1].scale == pytest.approx((0.2, 0.05, 0.075))
    assert scene.objects[2].scale == pytest.approx((0.1, 0.1, 0.125))
    assert scene.objects[2].source == {"scale_factor": [10, 10, 10]}
    assert [o.scale for o in scene.objects[3:]] == [None, BLOCK.scale]
    assert [s.is_exact for s in shapes] == [True, True, True, False, False]
    assert [n.code for n in notices] == ["asset_differs", "asset_differs", "asset_does_not_fit", "glb_missing"]
    again, same, _ = store.resolved(scene)
    assert again == scene
    assert [s.size.tolist() for s in same] == [s.size.tolist() for s in shapes]


def test_what_is_resolved_stands_where_its_box_stands(store: AssetStore, folder: Folder) -> None:
    corners = np.array([[-1.0, -1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    wedge = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    (folder.root / "wedge.glb").write_bytes(write_glb(wedge))
    tilt = tilted_about("y", -45)
    x, y, z = Shape.from_mesh(wedge, (0.1, 0.1, 0.1), tilt).size.tolist()
    leaning = replace(BLOCK, asset_id="wedge", tilt_quat_xyzw=tilt, size=(x, y, z), position=(0.5, 0.5, 0.1 * math.sqrt(2)))
    objects = (
        leaning,
        replace(leaning, instance="without a scale", scale=None),
        replace(leaning, instance="no mesh", asset_id="absent"),
        replace(BLOCK, instance="on its side", asset_id="absent", tilt_quat_xyzw=ON_ITS_SIDE),
    )
    scene = Scene("s", Tabletop("desk", (1.0, 1.0)), objects)
    moved, _, notices = store.resolved(scene, PositionConvention.MESH_CENTRE)
    assert [o.position[2] for o in moved.objects[:2]] == pytest.approx([0.05 * math.sqrt(2)] * 2)
    assert [o.position for o in moved.objects[2:]] == [o.position for o in objects[2:]]
    assert [n.code for n in notices] == ["glb_missing", "position_unknown", "glb_missing"]
    assert notices[1].message.startswith("object no mesh: ")
    assert [o.position for o in store.resolved(scene)[0].objects] == [o.position for o in objects]


@pytest.mark.parametrize("size", [(0.102, 0.2, 0.4), (0.1, 0.2, 0.407)])
def test_rounding_of_the_size_is_let_pass(store: AssetStore, size: Vec3) -> None:
    shape, notices = store.shape(replace(BLOCK, size=size))
    assert shape.size == pytest.approx(BLOCK.size)
    assert notices == ()


@pytest.mark.parametrize(("asset", "code"), [("absent", "glb_missing"), ("broken", "glb_truncated")])
def test_a_box_stands_in_for_a_mesh_that_cannot_be_used(store: AssetStore, asset: str, code: str) -> None:
    shape, (notice,) = store.shape(replace(BLOCK, asset_id=asset))
    assert not shape.is_exact
    assert shape.size == pytest.approx(BLOCK.size)
    assert notice.code == code
    assert "unknown" in notice.message


def test_a_box_stands_in_silently_where_the_scene_names_no_asset(store: AssetStore) -> None:
    shape, notices = store.shape(replace(BLOCK, asset_id=None))
    assert not shape.is_exact
    assert notices == ()


def test_shapes_come_in_the_scenes_order_with_its_id_on_notices(store: AssetStore) -> None:
    objects = (replace(BLOCK, instance="b", asset_id="absent"), replace(BLOCK, instance="a"))
    shapes, (notice,) = store.shapes(Scene("s", Tabletop("desk", (1.0, 1.0)), objects))
    assert [s.is_exact for s in shapes] == [False, True]
    assert notice.item_id == "s"
    assert "object b" in notice.message


def test_a_mesh_is_read_and_a_shape_computed_once(store: AssetStore, folder: Folder) -> None:
    shape, _ = store.shape(BLOCK)
    again, _ = store.shape(replace(BLOCK, instance="2_block_1", position=(0.1, 0.1, 0.1), yaw=1.0))
    assert again is shape
    assert folder.asked == ["block"]


def test_an_error_is_remembered(store: AssetStore, folder: Folder) -> None:
    for _ in range(2):
        with pytest.raises(MeshError, match="asset absent: no GLB file"):
            store.asset("absent")
    assert folder.asked == ["absent"]


def test_a_remembered_error_lets_go_of_the_file(store: AssetStore, folder: Folder) -> None:
    head = struct.pack("<5I", 0x46546C67, 2, 20, 4 << 20, 0x4E4F534A)
    (folder.root / "invalid.glb").write_bytes(head + b"{" + b" " * ((4 << 20) - 1))
    tracemalloc.start()
    try:
        with contextlib.suppress(MeshError):
            store.asset("invalid")
        assert tracemalloc.get_traced_memory()[0] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_file_that_vanishes_is_a_mesh_that_is_missing(store: AssetStore, folder: Folder) -> None:
    folder.asset_path = lambda asset_id: folder.root / "gone.glb"  # type: ignore[method-assign]
    shape, (notice,) = store.shape(BLOCK)
    assert not shape.is_exact
    assert notice.code == "glb_unreadable"


class FailsOnce(type(Path())):  # type: ignore[misc]
    """A file whose first read fails as a disk or a network does."""

    reads = 0

    def read_bytes(self) -> bytes:
        type(self).reads += 1
        if type(self).reads == 1:
            raise OSError(errno.EIO, "Input/output error")
        return bytes(super().read_bytes())


def test_a_read_that_fails_once_costs_the_asset_nothing_afterwards(
    store: AssetStore, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FailsOnce, "reads", 0)
    folder.asset_path = lambda asset_id: FailsOnce(folder.root / f"{asset_id}.glb")  # type: ignore[method-assign]
    shape, (notice,) = store.shape(BLOCK)
    assert (shape.is_exact, notice.code) == (False, "glb_unreadable")
    assert "Input/output error" in notice.message
    shape, notices = store.shape(BLOCK)
    assert (shape.is_exact, notices) == (True, ())
    assert store.mesh_of(BLOCK) is store.mesh_of(BLOCK)
    assert FailsOnce.reads == 2


def test_what_is_broken_behind_a_read_that_fails_once_is_a_fault(
    store: AssetStore, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FailsOnce, "reads", 0)
    folder.asset_path = lambda asset_id: FailsOnce(folder.root / f"{asset_id}.glb")  # type: ignore[method-assign]
    assert store.fault_of("broken") is None  # not known yet
    fault = store.fault_of("broken")
    assert fault is not None
    assert "broken" in fault
    assert store.fault_of("broken") == fault
    assert FailsOnce.reads == 2


def test_convex_parts_that_cannot_be_read_for_now_are_not_made_otherwise(
    store: AssetStore, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FailsOnce, "reads", 0)
    part = box(1.0, 2.0, 4.0)
    solid = Mesh(part.vertices, part.faces)
    (folder.root / "block.glb").write_bytes(write_glb(solid, parts=[solid]))
    folder.asset_path = lambda asset_id: FailsOnce(folder.root / f"{asset_id}.glb")  # type: ignore[method-assign]
    with pytest.raises(MeshError, match="Input/output error"):
        store.colliders("block")
    assert len(store.colliders("block")) == 1


def test_a_repair_that_fails_once_is_tried_again(store: AssetStore, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("stable_data.assets.store.repair_mesh", Mock(side_effect=KeyError))
        with pytest.raises(MeshError, match="KeyError") as caught:
            store.asset("block")
    assert caught.value.code == "unexpected"
    with monkeypatch.context() as patch:
        patch.setattr("stable_data.assets.store.repair_mesh", Mock(side_effect=MemoryError))
        with pytest.raises(MemoryError):
            store.asset("block")
    assert store.asset("block") is store.asset("block")


def test_what_exceeds_the_memory_is_computed_again(folder: Folder) -> None:
    store = AssetStore(folder, max_bytes=500)
    for name in ("block", "cube", "block"):
        store.asset(name)
    assert folder.asked == ["block", "cube", "block"]


def test_scales_of_nearly_one_aspect_share_a_grid(store: AssetStore) -> None:
    assert store.grid("cube", (0.1, 0.1, 0.1)) is store.grid("cube", (0.3, 0.301, 0.299))
    assert store.grid("cube", (0.1, 0.1, 0.1)) is not store.grid("cube", (0.1, 0.1, 0.12))


@given(st.tuples(lengths, lengths, lengths), lengths)
def test_an_aspect_is_within_half_a_step_and_blind_to_size(scale: Vec3, factor: float) -> None:
    aspect = np.array(aspect_of(aspect_steps(scale)))
    exact = np.array(scale) / max(scale)
    assert aspect.max() == 1.0
    assert np.abs(np.log(aspect / exact)).max() <= ASPECT_STEP / 2 + 1e-9
    x, y, z = (factor * s for s in scale)
    assert np.abs(np.subtract(aspect_steps(scale), aspect_steps((x, y, z)))).max() <= 1  # rounding of a half


@given(st.tuples(lengths, lengths, lengths), st.tuples(lengths, lengths, lengths), right_angles)
def test_a_mesh_tilted_by_right_angles_fits_exactly(extents: Vec3, size: Vec3, tilt: QuatXyzw) -> None:
    if max(size) / min(size) * max(extents) / min(extents) > 19:  # flatter is refused, see below
        return
    mesh = Mesh(box(*extents).vertices, box(*extents).faces)
    assert Shape.from_mesh(mesh, fitted_scale(mesh, tilt, size), tilt).size == pytest.approx(size, rel=1e-6)


def test_a_flat_mesh_fits_along_the_axes_that_it_has() -> None:
    flat = Mesh(sheet(2.0, 1.0).vertices, sheet(2.0, 1.0).faces)
    assert fitted_scale(flat, UPRIGHT, (0.2, 0.3, 0.0)) == pytest.approx((0.1, 0.3, 0.2))
    assert fitted_scale(flat, ON_ITS_SIDE, (0.2, 0.0, 0.3)) == pytest.approx((0.1, 0.3, 0.2))


@given(st.sampled_from([box(1, 2, 4), bowl(1, 0.1), ball(1)]), lengths, st.floats(-180, 180), st.floats(-180, 180))
def test_a_mesh_at_any_tilt_fits_what_one_factor_makes_of_it(made: Shape, factor: float, roll: float, pitch: float) -> None:
    mesh = Mesh(made.vertices, made.faces)
    tilt = tilted_about("xy", (roll, pitch))
    x, y, z = (factor * Shape.from_mesh(mesh, (1.0, 1.0, 1.0), tilt).size).tolist()
    assert Shape.from_mesh(mesh, fitted_scale(mesh, tilt, (x, y, z)), tilt).size == pytest.approx((x, y, z), rel=1e-6)


def test_a_fit_that_would_flatten_the_mesh_is_uniform() -> None:
    mesh = Mesh(box(1, 1, 1).vertices, box(1, 1, 1).faces)
    scale = fitted_scale(mesh, UPRIGHT, (0.1, 0.1, 0.001))
    assert scale == pytest.approx((0.1, 0.1, 0.1))


def test_a_scene_of_too_many_vertices_is_refused(store: AssetStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its objects may all have one mesh, of which each has a copy at its pose."""
    objects = tuple(replace(BLOCK, instance=f"{k}_block_0") for k in range(3))
    scene = Scene("scene", Tabletop("desk", (1.2, 0.6)), objects)
    num = 3 * len(store.shape(BLOCK)[0].vertices)
    limit(monkeypatch, "work", max_scene_corners=num)
    store.resolved(scene)
    limit(monkeypatch, "work", max_scene_corners=num - 1)
    with pytest.raises(SceneError, match=f"scene: its meshes have more vertices, expected at most {num - 1} ") as caught:
        store.resolved(scene)
    assert caught.value.code == "scene_too_big"
