"""How much of each object can be seen from the cameras of the pictures: the visible share of its silhouette.

The triangles are drawn into a depth buffer, one sample for each pixel, without OpenGL: the silhouettes of all objects and what hides
them come from one pass, and the same scene gives the same numbers on every machine. The table top and the support hide what is
behind them; a room and the board above a shelf are not drawn.
"""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.scene import FloatArray, IntArray
from stable_data.simulation.look_meshes import ObjectLook
from stable_data.simulation.render import FIELD_OF_VIEW, View, camera_pose
from stable_data.simulation.scene_geometry import SceneGeometry

PICTURE_SIZE = (256, 256)
"""Width and height of the buffer, pixels."""

_FEWEST_PIXELS = 4  # of a silhouette, below which a share of it says nothing

_TIE = 1e-4  # relative difference of depths that are the same, for surfaces in contact
_MOST_SAMPLES = 4_000_000  # of triangles that are drawn at a time


def visible_shares(geometry: SceneGeometry, view: View, size: tuple[int, int] = PICTURE_SIZE) -> FloatArray:
    """Computes which share of the silhouette of each object can be seen.

    Args:
        geometry: The scene. An object without a mesh counts as its box.
        view: The camera, as :func:`stable_data.simulation.render.render_scene` has it.
        size: Width and height of the buffer, pixels.

    Returns:
        (N,) float64, from 0 to 1; nan for an object whose silhouette has fewer than four pixels, and for fixed objects that the
        support shows, which are not drawn.
    """
    low, high = geometry.seen_bounds
    camera = _Camera(low, high, view, size, geometry)
    nearest = np.zeros(size[0] * size[1])  # the inverse depth of what is nearest
    for triangles in _surroundings(geometry):
        camera.draw(triangles, nearest)
    drawn: list[tuple[IntArray, FloatArray] | None] = []
    for k, (shape, pose) in enumerate(zip(geometry.shapes, geometry.scene.poses(), strict=True)):
        if not geometry.is_seen(k):
            drawn.append(None)
            continue
        own = np.zeros_like(nearest)
        camera.draw(shape.posed(pose)[shape.faces], own)
        pixels = np.flatnonzero(own)
        drawn.append((pixels, own[pixels]))
        nearest[pixels] = np.maximum(nearest[pixels], own[pixels])
    shares = np.full(len(drawn), np.nan)
    for k, silhouette in enumerate(drawn):
        if silhouette is not None:
            pixels, depths = silhouette
            if len(pixels) >= _FEWEST_PIXELS:
                shares[k] = float((depths >= (1 - _TIE) * nearest[pixels]).mean())
    return shares


def _surroundings(geometry: SceneGeometry) -> list[FloatArray]:
    """The triangles of the table top and of the support."""
    x, y = geometry.scene.table.size_xy
    corners = np.array([[0.0, 0.0, 0.0], [x, 0.0, 0.0], [x, y, 0.0], [0.0, y, 0.0]])
    support = geometry.support
    return [corners[[[0, 1, 2], [0, 2, 3]]], *([] if support is None else [_triangles_of(support)])]


def _triangles_of(look: ObjectLook) -> FloatArray:
    turn = Rotation.from_quat(look.tilt_quat_xyzw).as_matrix() * look.scale
    triangles = np.concatenate([surface.triangles for surface in look.surfaces])
    return np.asarray(triangles.reshape(-1, 3) @ turn.T + look.offset).reshape(-1, 3, 3)


class _Camera:
    """A camera that draws triangles into a buffer of inverse depths."""

    def __init__(self, low: FloatArray, high: FloatArray, view: View, size: tuple[int, int], geometry: SceneGeometry) -> None:
        position, quat = camera_pose(low, high, view, size, geometry.scene.table)
        self._position, self._axes = np.array(position), Rotation.from_quat(quat).as_matrix()
        self._size = size
        self._focal = size[1] / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)  # pixels

    def draw(self, triangles: FloatArray, nearest: FloatArray) -> None:
        """Draws triangles (F, 3, 3), metres, world frame, into a buffer (H · W,), which keeps the largest inverse depth."""
        seen = (triangles.reshape(-1, 3) - self._position) @ self._axes  # right, up, towards the viewer
        depth = -seen[:, 2].reshape(-1, 3)
        front = (depth > 1e-6).all(axis=1)
        if not front.any():
            return
        width, height = self._size
        flat = self._focal * seen[:, :2] / np.maximum(-seen[:, 2:], 1e-6) * (1, -1) + (width / 2, height / 2)
        corners, inverse = flat.reshape(-1, 3, 2)[front], 1 / depth[front]
        # The pixels whose centres are in the box of a triangle.
        first = np.maximum(np.ceil(corners.min(axis=1) - 0.5), 0).astype(np.int64)
        last = np.minimum(np.floor(corners.max(axis=1) - 0.5), np.array(self._size) - 1).astype(np.int64)
        spans = np.maximum(last - first + 1, 0)
        counts = spans[:, 0] * spans[:, 1]
        chosen = np.flatnonzero(counts)
        for part in np.split(chosen, np.flatnonzero(np.diff(np.cumsum(counts[chosen]) // _MOST_SAMPLES)) + 1):
            if len(part):
                self._draw(corners[part], inverse[part], first[part], spans[part], nearest)

    def _draw(self, corners: FloatArray, inverse: FloatArray, first: IntArray, spans: IntArray, nearest: FloatArray) -> None:
        counts = spans[:, 0] * spans[:, 1]
        triangle = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
        x = first[triangle, 0] + place % spans[triangle, 0]
        y = first[triangle, 1] + place // spans[triangle, 0]
        weights = _barycentric(corners[triangle], x + 0.5, y + 0.5)
        inside = (weights >= 0).all(axis=1)
        depths = (weights[inside] * inverse[triangle[inside]]).sum(axis=1)  # the inverse depth is linear in the picture
        np.maximum.at(nearest, y[inside] * self._size[0] + x[inside], depths)


def _barycentric(corners: FloatArray, x: FloatArray, y: FloatArray) -> npt.NDArray[np.float64]:
    """Weights of the corners (P, 3, 2) at points, (P, 3); negative outside, and all of them -1 for a triangle without area."""
    ax, ay, bx, by, cx, cy = corners.reshape(-1, 6).T
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    safe = np.where(np.abs(area) < 1e-12, 1.0, area)
    second = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / safe
    third = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / safe
    weights = np.stack([1 - second - third, second, third], axis=1)
    weights[np.abs(area) < 1e-12] = -1.0
    return weights
