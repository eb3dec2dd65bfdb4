"""Raw layouts get their assets: from libraries in order, the first that has a match serving."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from models.text_encoder import load_default
from pipelines.edit_assets import resting_on
from pipelines.scene_source import FolderSource, mesh_cache
from stable_data.asset_library import AssetLibrary, library_of_folder, library_of_run
from stable_data.asset_scoring import RetrievalSettings
from stable_data.errors import Notice
from stable_data.mesatask.library import AssetAnnotation, AssetFolder
from stable_data.mesatask.writing import LAYOUT_FOLDER
from stable_data.retrieval import Match, Query, Retriever, Unmatched
from stable_data.scene import Scene
from stable_data.shards import RunFolder, content_id
from stable_data.substitution import with_assets
from stable_data.synth.library import embedded_library
from stable_data.table_assets import TableAssets

STEP = "assets"
"""The step that this module's notices name."""


@dataclass(frozen=True, slots=True)
class _Place:
    """A library and what lies behind it.

    Attributes:
        library: Its catalogue.
        meshes: Its meshes.
        annotation: What is known of an asset of it.
    """

    library: AssetLibrary
    meshes: Callable[[str], Path | None]
    annotation: Callable[[str], AssetAnnotation]


class AssetShelf:
    """Libraries in order, with their meshes; an asset that two have is the earlier one's.

    Args:
        places: Folders in the MesaTask-10K format (layouts may be missing), or runs with the tables ``assets`` and ``meshes``; the
            embedded world's library where there are none, made where it is missing.

    Attributes:
        libraries: The catalogues, not encoded.

    Raises:
        ConfigError: One cannot be read, or holds nothing that can be used.
    """

    def __init__(self, places: Sequence[str] = ()) -> None:
        twice = {name for name, count in Counter(map(_name, places)).items() if count > 1}
        opened = [_opened(place, place if _name(place) in twice else _name(place)) for place in places] or [_embedded()]
        self._of: dict[str, _Place] = {}
        libraries = []
        for place in opened:
            own = tuple(a for a in place.library.assets if a.asset_id not in self._of)
            self._of |= dict.fromkeys((a.asset_id for a in own), place)
            if own:
                libraries.append(replace(place.library, assets=own))
        self.libraries = tuple(libraries)
        self._extents = {a.asset_id: a.extents for library in libraries for a in library.assets}

    @property
    def fingerprints(self) -> dict[str, str]:
        """What each catalogue says, by its name."""
        return {
            x.name: content_id([(a.asset_id, a.words, a.category, a.licence, str(a.tilts)) for a in x.assets])
            for x in self.libraries
        }

    def retriever(self, settings: RetrievalSettings | None = None) -> Retriever:
        """Finds assets in the libraries, whose words are encoded where they were not before."""
        encoder = load_default()
        cache = _cache() / "text" / f"{encoder.fingerprint}.parquet"
        return Retriever([library.embedded(encoder, cache) for library in self.libraries], encoder, settings)

    def asset_path(self, asset_id: str) -> Path | None:
        """The asset's GLB, or None where there is none."""
        place = self._of.get(asset_id)
        return None if place is None else place.meshes(asset_id)

    def annotation(self, asset_id: str) -> AssetAnnotation:
        """What is known of an asset of the libraries, its box included."""
        found = self._of[asset_id].annotation(asset_id)
        return found if found.extents_z_up is not None else replace(found, extents_z_up=self._extents[asset_id])


@dataclass(frozen=True, slots=True)
class Furnished:
    """A layout whose objects have assets.

    Attributes:
        scene: The layout; objects without a match are left out, and so is what rests on them.
        unmatched: Why there is no asset, by instance.
        notices: What was left out, and what about a choice deserves a look.
    """

    scene: Scene
    unmatched: Mapping[str, Unmatched]
    notices: tuple[Notice, ...] = ()


def furnish(scenes: Sequence[Scene], retriever: Retriever, seed: int = 0) -> list[Furnished]:
    """Layouts with an asset for each object that one is found for, all of them asked for at once.

    Within a layout equal words and sizes get equal assets. The underside of a thing stays at its height, and what rests on a thing
    comes with it.

    Args:
        scenes: The layouts, staged, with supports.
        retriever: Finds assets.
        seed: Decides among assets that are as good.
    """
    asked = [(k, o) for k, scene in enumerate(scenes) for o in scene.objects]
    answers = retriever.retrieve([Query(o.description, o.size, o.category, scenes[k].scene_id) for k, o in asked], seed)
    matches: list[dict[str, Match]] = [{} for _ in scenes]
    unmatched: list[dict[str, Unmatched]] = [{} for _ in scenes]
    for (k, o), answer in zip(asked, answers, strict=True):
        if isinstance(answer, Match):
            matches[k][o.instance] = answer
        else:
            unmatched[k][o.instance] = answer
    return [_furnished(*parts) for parts in zip(scenes, matches, unmatched, strict=True)]


def _furnished(scene: Scene, matches: Mapping[str, Match], unmatched: Mapping[str, Unmatched]) -> Furnished:
    gone = resting_on(scene, set(unmatched)) if unmatched else set()
    kept = [o for o in scene.objects if o.instance not in gone]
    notices = []
    for name in sorted(gone):
        why = f"no asset: {unmatched[name].reason}" if name in unmatched else "what it rests on is left out"
        code = "asset_unmatched" if name in unmatched else "carrier_left_out"
        notices.append(Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {name} is left out; {why}"))
    notices += [
        Notice(scene.scene_id, STEP, "not_stretched", f"{scene.scene_id}: {o.instance} {note}")
        for o in kept
        if (note := matches[o.instance].note)
    ]
    objects = with_assets(kept, {o.instance: matches[o.instance] for o in kept})
    return Furnished(replace(scene, objects=objects), unmatched, tuple(notices))


def _cache() -> Path:
    return mesh_cache().parent


def _name(place: str) -> str:
    return Path(place).name or place


def _opened(place: str, name: str) -> _Place:
    if "://" in place or RunFolder(place).files("assets"):
        run = RunFolder(place)
        return _Place(
            library_of_run(run, name), TableAssets(run, mesh_cache()).asset_path, _annotations_of_run(run).__getitem__
        )
    root = Path(place).expanduser().resolve()
    shown = FolderSource(root).first_scenes() if (root / LAYOUT_FOLDER).is_dir() else ()
    return _of_folder(root, library_of_folder(root, name, scenes=shown))


def _embedded() -> _Place:
    return _of_folder(*embedded_library(_cache()))


def _of_folder(root: Path, library: AssetLibrary) -> _Place:
    folder = AssetFolder(root)
    return _Place(library, folder.path, folder.annotation)


def _annotations_of_run(run: RunFolder) -> dict[str, AssetAnnotation]:
    """What a run's table ``assets`` says, as annotations."""
    columns = ["asset_id", "category", "description", "caption", "source", "mass", "is_container", "licence"]
    return {
        row["asset_id"]: AssetAnnotation(
            row["asset_id"],
            row["category"] or "",
            row["description"] or "",
            row["caption"] or "",
            row["source"] or "",
            row["mass"],
            row["is_container"],
            raw={"licence": row["licence"]} if row["licence"] else {},
        )
        for row in run.table("assets", columns).to_pylist()
    }
