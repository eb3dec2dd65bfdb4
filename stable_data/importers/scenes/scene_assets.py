"""The shapes of scene files as a source of assets: each becomes a GLB file in a temporary folder."""

import weakref
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.importers.scenes.layouts import ImportedScene, SceneAsset


class SceneAssets:
    """An :class:`~stable_data.assets.store.AssetSource` and :class:`~stable_data.assets.store.PartSource` of imported scenes.

    Attributes:
        assets: The assets, by identifier.
    """

    def __init__(self) -> None:
        self.assets: dict[str, SceneAsset] = {}
        folder = TemporaryDirectory(prefix="stable-data-assets-")
        self._folder = Path(folder.name)
        weakref.finalize(self, folder.cleanup)

    def add(self, scenes: Iterable[ImportedScene]) -> None:
        """Adds the assets of scenes; of equal ones the first stays."""
        for scene in scenes:
            for asset_id, asset in scene.assets.items():
                self.assets.setdefault(asset_id, asset)

    def asset_path(self, asset_id: str) -> Path | None:
        """Returns the GLB file of an asset, or None if there is no such asset."""
        if asset_id not in self.assets:
            return None
        path = self._folder / f"{asset_id}.glb"
        if not path.exists():
            path.write_bytes(write_glb(self.assets[asset_id].mesh))
        return path

    def parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """Returns the convex parts of an asset, in the frame of its mesh."""
        asset = self.assets.get(asset_id)
        return () if asset is None else asset.parts
