"""An object's geometry: at its scale and tilt, fitted where the scale is missing or wrong, a box where the mesh is."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets import ASPECT_STEP, AssetStore, aspect_of, aspect_steps, fitted_scale
from stable_data.errors import MeshError
from stable_data.export.glb import write_glb
from stable_data.mesh import Mesh
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.shape import Shape
from tests.scenes import box

ON_ITS_SIDE: QuatXyzw = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
BLOCK = SceneObject("1_block_0", "block", (0.5, 0.5, 0.1), 0.0, (0.1, 0.2, 0.4), asset_id="block", scale=(0.1, 0.1, 0.1))

lengths = st.floats(0.01, 3.0)
right_angles = st.sampled_from([tuple(r.as_quat().tolist()) for r in Rotation.create_group("O")])


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


def test_a_fit_that_would_flatten_the_mesh_is_uniform() -> None:
    mesh = Mesh(box(1, 1, 1).vertices, box(1, 1, 1).faces)
    scale = fitted_scale(mesh, UPRIGHT, (0.1, 0.1, 0.001))
    assert scale == pytest.approx((0.1, 0.1, 0.1))
