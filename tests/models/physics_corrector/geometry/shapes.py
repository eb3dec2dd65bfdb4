"""Shapes whose distances are known, as assets with grids; each is made once for all tests."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, ShapeTensors
from stable_data.assets.store import AssetStore
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.scene import UPRIGHT, QuatXyzw, Rectangle, Scene, SceneObject, Tabletop, Vec3
from tests.scenes import ball, bowl, box, cup, sheet

RADIUS, SIDE = 0.05, 0.1
SHAPES = {
    "ball": ball(RADIUS, 4),
    "cube": box(SIDE, SIDE, SIDE),
    "plate": box(0.2, 0.16, 0.01),
    "bowl": bowl(0.08, 0.006),
    "cup": cup(0.04, 0.1, 0.005),
    "cloth": sheet(0.2, 0.1),
}


class Folder:
    """Assets as files of a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def asset_path(self, asset_id: str) -> Path | None:
        path = self.root / f"{asset_id}.glb"
        return path if path.is_file() else None


@cache
def store() -> AssetStore:
    """The shapes as assets of one metre a mesh unit."""
    with TemporaryDirectory() as name:
        for asset_id, shape in SHAPES.items():
            (Path(name) / f"{asset_id}.glb").write_bytes(write_glb(Mesh(shape.vertices, shape.faces)))
        assets = AssetStore(Folder(Path(name)))
        for asset_id in SHAPES:
            assets.asset(asset_id)  # what was read once is kept
    return assets


@cache
def table() -> ShapeCollector:
    """Where the shapes of all tests are collected."""
    return ShapeCollector(store(), num_surface=512, num_bottom=64)


def thing(
    name: str,
    pose: tuple[float, float, float, float],
    *,
    scale: Vec3 = (1.0, 1.0, 1.0),
    tilt: QuatXyzw = UPRIGHT,
    support: str | None = None,
) -> SceneObject:
    """An object: ``<asset>`` or ``<asset>_<n>``, at x, y, z in metres and yaw in radians."""
    asset_id = name.split("_")[0]
    mesh = Mesh(SHAPES[asset_id].vertices, SHAPES[asset_id].faces)
    x, y, z = Shape.from_mesh(mesh, scale, tilt).size.tolist()
    return SceneObject(name, asset_id, pose[:3], pose[3], (x, y, z), asset_id, scale, tilt, support=support)


def scene(*objects: SceneObject, zone: Rectangle | None = None) -> Scene:
    """A scene on a table of 1 m x 0.8 m."""
    return Scene("built", Tabletop("office_table", (1.0, 0.8), zone), objects)


def batch_of(
    scenes: Sequence[Scene], *, is_fixed: Callable[[SceneObject], bool] | None = None, num_slots: int = 0
) -> tuple[LayoutBatch, ShapeTensors]:
    """Scenes with the geometry of their shapes."""
    batch = LayoutBatch.from_scenes(scenes, table(), is_fixed=is_fixed, num_slots=num_slots)
    return batch, table().geometry()
