"""Opens scene files of any format behind one interface: what they hold, their physics, and new poses in them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from stable_data.errors import MeshError, SceneError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.formats import is_gltf, is_usd
from stable_data.importers.scenes.scene_file import BodyPose, SceneFile

if TYPE_CHECKING:  # MuJoCo takes long to import
    from stable_data.importers.scenes.file_physics import BodyMotion
    from stable_data.importers.scenes.gltf_scenes import GltfScene
    from stable_data.importers.scenes.mjcf_scenes import MjcfScene


class OpenedScene(Protocol):
    """A scene file of any format."""

    @property
    def file(self) -> SceneFile:
        """What it holds."""
        ...

    @property
    def paths(self) -> tuple[str, ...]:
        """All its files, relative to the source folder."""
        ...

    def watch(self) -> Mapping[str, "BodyMotion"]:
        """How its free bodies move in its physics."""
        ...

    def moved(self, poses: Mapping[str, BodyPose]) -> tuple[Mapping[str, bytes], Mapping[str, "BodyMotion"]]:
        """Puts new poses into it.

        Args:
            poses: Name of a free body -> its new pose, in the frame of the file.

        Returns:
            The changed files, and how the free bodies move in their physics.

        Raises:
            SceneError: A pose cannot be changed.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _OpenedMjcf:
    scene: "MjcfScene"
    is_everywhere: bool

    @property
    def file(self) -> SceneFile:
        return self.scene.file

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(sorted(self.scene.files.contents))

    def watch(self) -> Mapping[str, "BodyMotion"]:
        from stable_data.importers.scenes.file_physics import watch_file

        return watch_file(self.scene)

    def moved(self, poses: Mapping[str, BodyPose]) -> tuple[Mapping[str, bytes], Mapping[str, "BodyMotion"]]:
        from stable_data.importers.scenes.file_physics import watch_file
        from stable_data.importers.scenes.mjcf_patch import patch_poses

        patched = patch_poses(self.scene, poses, is_everywhere=self.is_everywhere)
        return patched.changed, watch_file(self.scene, patched.model, patched.qpos)


@dataclass(frozen=True, slots=True, eq=False)
class _OpenedGltf:
    scene: "GltfScene"

    @property
    def file(self) -> SceneFile:
        return self.scene.file

    @property
    def paths(self) -> tuple[str, ...]:
        return self.scene.paths

    def watch(self) -> Mapping[str, "BodyMotion"]:
        from stable_data.importers.scenes.file_physics import watch_shapes

        return watch_shapes(self.file, {})

    def moved(self, poses: Mapping[str, BodyPose]) -> tuple[Mapping[str, bytes], Mapping[str, "BodyMotion"]]:
        from stable_data.importers.scenes.file_physics import watch_shapes
        from stable_data.importers.scenes.gltf_patch import patch_nodes

        return {self.file.path: patch_nodes(self.scene, poses)}, watch_shapes(self.file, poses)


def read_scene_file(boundary: Boundary, path: str, key: str = "", *, is_everywhere: bool = True) -> OpenedScene:
    """Reads a scene file.

    Args:
        boundary: The source folder.
        path: The file, relative to it.
        key: Keyframe of a MuJoCo file, see :func:`~stable_data.importers.scenes.mjcf_scenes.read_mjcf_scene`.
        is_everywhere: Whether new poses of a MuJoCo file go to all places that state the same pose; else to the place that is read.

    Raises:
        StableDataError: It cannot be read; the message names it.
    """
    try:
        return _read(boundary, path, key, is_everywhere)
    except (SceneError, MeshError) as error:
        if str(error).startswith((f"{path}:", f"{path!r}:")):
            raise
        raise type(error)(f"{path}: {error}", error.code) from error


def _read(boundary: Boundary, path: str, key: str, is_everywhere: bool) -> OpenedScene:
    if is_usd(path):
        from stable_data.importers.scenes.usd_scenes import read_usd_scene

        return read_usd_scene(boundary, path)
    if is_gltf(path):
        from stable_data.importers.scenes.gltf_scenes import read_gltf_scene

        return _OpenedGltf(read_gltf_scene(boundary, path))
    from stable_data.importers.scenes.mjcf_scenes import read_mjcf_scene

    return _OpenedMjcf(read_mjcf_scene(boundary, path, key), is_everywhere)
