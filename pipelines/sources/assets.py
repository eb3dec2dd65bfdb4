"""The asset libraries of a job, searched in order, with their meshes."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path

from tqdm import tqdm

from models.text_encoder import load_default
from pipelines.preprocess.plan import file_digest
from pipelines.sources.scenes import Containers, FolderSource, mesh_cache
from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.catalog import Asset, AssetLibrary, library_of_run
from stable_data.assets.licences import is_licence_allowed, normalise_licence
from stable_data.assets.noun_fit import NounFit, noun_fit
from stable_data.assets.physics import IS_WEIGHED, PHYSICS_COLUMNS, AssetPhysics
from stable_data.assets.ranking import may_be_used
from stable_data.assets.retrieval import Retriever
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.run_assets import RowsOfAssets, RunAssets, run_annotations
from stable_data.assets.store import colliders_of
from stable_data.assets.text_embeddings import share_rows
from stable_data.content_id import content_id
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.embedded_world.library import embedded_library
from stable_data.errors import ConfigError, Notice
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface import Surface
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.mesatask.library import AssetFolder
from stable_data.mesatask.writing import LAYOUT_FOLDER
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder, absolute_uri
from stable_data.storage.schemas import Row

_CONTENT_COLUMNS = (
    *("asset_id", "parts_method", "parts_overfill_max", "parts_overfill_mean", "parts_uncovered_max", "parts_uncovered_mean"),
    *("hull_distance", "sha256"),
)
"""Columns of ``meshes`` that name the geometry of an asset. No scene depends on its look."""

REAL = "real"
"""Stands for the library of real meshes in the repository, where the place of a library is expected."""

_REAL_RUNS = Path(__file__).with_name("real_library")
_MOST_LICENCES = 5  # that a notice names
_LARGE = 1 << 25  # bytes of features that are shared by all processes: 22,000 assets


@dataclass(frozen=True, slots=True)
class _Place:
    """A library with access to its files.

    Attributes:
        library: Its catalogue, or None if no asset can be retrieved.
        asset_ids: All its assets, also those that cannot be retrieved.
        meshes: The mesh file of an asset.
        annotation: The annotation of an asset.
        contents: What names the content of each asset: the hash of its mesh, and its mass and friction if they are known. An asset
            without a mesh may have none.
        parts: The stored convex parts of an asset; empty if it stores none.
        rows: The rows of an asset in the tables ``assets`` and ``meshes``; None if the library is no run.
        physics: Mass and friction of an asset; None if they are not known.
        look: The stored surfaces that are seen of an asset; empty if it stores none.
        textures: Their rows of the table ``textures``.
        is_run: Whether the library is a run: its meshes were repaired before they were stored.
    """

    library: AssetLibrary | None
    asset_ids: Collection[str]
    meshes: Callable[[str], Path | None]
    annotation: Callable[[str], AssetAnnotation]
    contents: Callable[[], Mapping[str, object]]
    parts: Callable[[str], tuple[Mesh, ...]] = lambda _: ()
    rows: Callable[[str], tuple[Row, Row] | None] = lambda _: None
    physics: Callable[[str], AssetPhysics | None] = lambda _: None
    look: Callable[[str], Sequence[Surface]] = lambda _: ()
    textures: Callable[[str], Sequence[Row]] = lambda _: ()
    is_run: bool = False


class AssetLibraries:
    """Libraries in order, with their meshes. An asset that two libraries have is taken from the earlier one.

    Args:
        places: Folders in the MesaTask-10K format (layouts may be missing), or runs with the tables ``assets`` and ``meshes``;
            ``embedded`` is the embedded world's library, which is made if it is missing; ``real`` are the real meshes in the
            repository. Empty: the embedded library alone.
        scenes: A source of scenes whose own library is the first, before those of the places, of which there may then be none. It
            may contain no usable asset.
        offers_scenes: Whether the assets of ``scenes`` may be retrieved too.

    Attributes:
        libraries: The catalogues, not encoded.

    Raises:
        ConfigError: A library cannot be read, or contains no usable asset.
    """

    def __init__(self, places: Sequence[str] = (), *, scenes: str | None = None, offers_scenes: bool = True) -> None:
        named = [run for place in places for run in (_real_runs() if place == REAL else (place,))]
        every = (tuple(named) or (EMBEDDED,)) if scenes is None else (scenes, *(place for place in named if place != scenes))
        twice = {name for name, count in Counter(map(_name, every)).items() if count > 1}
        self._places = [
            _opened(place, place if _name(place) in twice else _name(place), may_be_empty=scenes is not None and k == 0)
            for k, place in enumerate(every)
        ]
        is_hidden = scenes is not None and not offers_scenes and scenes not in named
        if is_hidden:
            self._places[0] = _not_offered(self._places[0])
        self._offering = self._places[is_hidden:]
        self._of: dict[str, _Place] = {}
        libraries = []
        for place in self._places:
            new = {asset_id for asset_id in place.asset_ids if asset_id not in self._of}
            self._of |= dict.fromkeys(new, place)
            if place.library is not None and any(a.asset_id in new for a in place.library.assets):
                libraries.append(place.library.only(new))
        self.libraries = tuple(libraries)
        self._extents = {a.asset_id: a.extents for library in libraries for a in library.assets}

    @cached_property
    def fingerprints(self) -> dict[str, str]:
        """A hash of the annotations and meshes of each library, by its name; a run is resumed only if they are equal.

        The first call reads every GLB of a folder whole, because names, sizes and times of files do not identify their
        content. On two cores 12,000 files of 1 MB take 14 s from memory and 52 s from the disk. A run stores its own hashes.
        """
        found = {}
        for library in self.libraries:
            place = self._of[library.assets[0].asset_id]
            contents = place.contents()
            said = [(str(a), str(place.annotation(a.asset_id)), contents.get(a.asset_id)) for a in library.assets]
            found[library.name] = content_id(said)
        return found

    def retriever(self, settings: RetrievalSettings | None = None) -> Retriever:
        """A retriever over the libraries; words that are not yet in the cache are encoded."""
        encoder = load_default()
        cache = _cache() / "text" / f"{encoder.fingerprint}.parquet"
        embedded = [_shared(library.embedded(encoder, cache)) for library in self.libraries]
        return Retriever(embedded, encoder, settings)

    def serves(self, settings: RetrievalSettings) -> Callable[[str], bool]:
        """Returns whether a library other than the embedded world's has a wanted thing or a kind of it, by its category."""
        # A source of scenes that offers nothing hides no asset here, although it gives the meshes of those that it shares with a library.
        known, seen = set[str](), set[str]()
        for place in self._offering:
            assets = [] if place.library is None else [a for a in place.library.assets if a.asset_id not in seen]
            seen.update(place.asset_ids)
            if place.library is not None and place.library.name != EMBEDDED:
                known.update(a.category for a in assets if may_be_used(a, settings))
        return cache(lambda wanted: any(noun_fit(category, wanted) >= NounFit.KIND for category in known))

    def usable(self, settings: RetrievalSettings) -> dict[str, str]:
        """Returns the category, possibly empty, of each asset that may be used, by its id."""
        return {a.asset_id: a.category for library in self.libraries for a in library.assets if may_be_used(a, settings)}

    def by_category(self, settings: RetrievalSettings) -> dict[str, list[Asset]]:
        """Returns the assets that may be used, by category, sorted by id."""
        found: dict[str, list[Asset]] = {}
        for asset in sorted((a for library in self.libraries for a in library.assets), key=lambda a: a.asset_id):
            if asset.category and may_be_used(asset, settings):
                found.setdefault(asset.category, []).append(asset)
        return found

    def licence_notices(self, settings: RetrievalSettings) -> list[Notice]:
        """Returns for each library how many assets the list of licences leaves out, or without a list how many state none."""
        notices = []
        for library in self.libraries:
            offered = [asset.licence for asset in library.assets if asset.is_offered]
            barred = Counter(text or "unknown" for text in offered if not is_licence_allowed(text, settings.licences))
            unknown = sum(normalise_licence(text) is None for text in offered)
            counted = f"library {library.name}: of {len(offered)} assets"
            if barred:
                kinds = ", ".join(f"{name} ({count})" for name, count in barred.most_common(_MOST_LICENCES))
                message = (
                    f"{counted} {barred.total()} are left out, because the list of licences does not allow theirs: {kinds}"
                )
                notices.append(Notice(library.name, "licences", "licence_barred", message))
            elif unknown and settings.licences is None:
                message = (
                    f"{counted} {unknown} state no known licence; check that you may use them, or list the allowed licences"
                )
                notices.append(Notice(library.name, "licences", "licence_unknown", message))
        return notices

    @property
    def asset_ids(self) -> list[str]:
        """All assets, also those that cannot be retrieved, sorted."""
        return sorted(self._of)

    def _place_of(self, asset_id: str) -> _Place:
        """The place that lists an asset; else the first, which may have a variant of it."""
        return self._of.get(asset_id, self._places[0])

    def is_of_first(self, asset_id: str) -> bool:
        """Whether an asset is of the first library, or of none."""
        return self._place_of(asset_id) is self._places[0]

    def asset_path(self, asset_id: str) -> Path | None:
        """The asset's GLB, or None if it has none."""
        return self._place_of(asset_id).meshes(asset_id)

    def is_stored(self, asset_id: str) -> bool:
        """Whether the asset's mesh is that of a run."""
        return self._place_of(asset_id).is_run

    def parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """The convex parts of an asset that a run or the embedded world stores; empty for other libraries."""
        return self._place_of(asset_id).parts(asset_id)

    def physics(self, asset_id: str) -> AssetPhysics | None:
        """Mass and friction of an asset that a run knows; None for other libraries."""
        return self._place_of(asset_id).physics(asset_id)

    def look(self, asset_id: str) -> Sequence[Surface]:
        """The surfaces that are seen of an asset, as a run stores them; empty for other libraries."""
        return self._place_of(asset_id).look(asset_id)

    def textures(self, asset_id: str) -> Sequence[Row]:
        """The rows of the table ``textures`` that the look of an asset names; empty if its library is no run."""
        return self._place_of(asset_id).textures(asset_id)

    def rows(self, asset_id: str) -> tuple[Row, Row] | None:
        """The rows of an asset in the tables ``assets`` and ``meshes`` of its run; None if its library is no run or lacks them."""
        return self._place_of(asset_id).rows(asset_id)

    def annotation(self, asset_id: str) -> AssetAnnotation:
        """The annotation of an asset, with its box if that is known; defaults for an asset without one."""
        try:
            found = self._place_of(asset_id).annotation(asset_id)
        except KeyError:
            return AssetAnnotation(asset_id)
        return found if found.extents_z_up is not None else replace(found, extents_z_up=self._extents.get(asset_id))

    def containers(self, scene: Scene) -> Containers:
        """Which objects of a scene are containers, according to the annotations of their assets."""
        return {o.instance: None if o.asset_id is None else self.annotation(o.asset_id).is_container for o in scene.objects}


def absolute_places(places: Sequence[str]) -> tuple[str, ...]:
    """Places of libraries with absolute paths, which workers in other folders can open too."""
    return tuple(p if p in (EMBEDDED, REAL) else absolute_uri(p) for p in places)


def _real_runs() -> list[str]:
    """The runs of the library of real meshes."""
    return sorted(str(folder) for folder in _REAL_RUNS.iterdir() if folder.is_dir())


def _cache() -> Path:
    return mesh_cache().parent


def _shared(library: AssetLibrary) -> AssetLibrary:
    """A library whose features, if they are large, are in memory once for all processes."""
    rows = library.features
    return library if rows is None or rows.nbytes < _LARGE else replace(library, features=share_rows(rows, _cache() / "rows"))


def _name(place: str) -> str:
    return Path(place).name or place


def _opened(place: str, name: str, *, may_be_empty: bool) -> _Place:
    if place == EMBEDDED:
        root, library = embedded_library(_cache())
        made = _of_folder(root, lambda: library, may_be_empty=False)
        # The folder is named by a hash of the code that made it; its convex parts are exact by construction.
        of_all = dict.fromkeys((a.asset_id for a in library.assets), root.name)
        return replace(made, contents=lambda: of_all, parts=partial(_parts_of_file, made.meshes))
    if "://" in place or RunFolder(place).files("assets"):
        run = RunFolder(place)
        kept = RunAssets(run, mesh_cache())
        annotations = run_annotations(run)
        listed = _listed(partial(library_of_run, run, name), may_be_empty=may_be_empty)
        contents = partial(_contents_of_run, run)
        rows = partial(_rows_of_run, kept, cache(partial(RowsOfAssets, run, "assets")))
        own = _Place(listed, annotations.keys(), kept.asset_path, annotations.__getitem__, contents, kept.parts, rows)
        return replace(own, physics=kept.physics, look=kept.look, textures=kept.textures, is_run=True)
    root = Path(place).expanduser().resolve()
    shown = FolderSource(root).first_scenes() if (root / LAYOUT_FOLDER).is_dir() else ()
    return _of_folder(root, partial(library_of_folder, root, name, scenes=shown, keeps_sizes=True), may_be_empty=may_be_empty)


def _not_offered(place: _Place) -> _Place:
    """A library of which no asset may be retrieved."""
    if place.library is None:
        return place
    return replace(
        place, library=replace(place.library, assets=tuple(replace(a, on_table=False) for a in place.library.assets))
    )


def _listed(read: Callable[[], AssetLibrary], *, may_be_empty: bool) -> AssetLibrary | None:
    """A catalogue; None if it is empty and may be."""
    try:
        return read()
    except ConfigError as error:
        if may_be_empty and error.code == "library_empty":
            return None
        raise


def _parts_of_file(meshes: Callable[[str], Path | None], asset_id: str) -> tuple[Mesh, ...]:
    path = meshes(asset_id)
    return () if path is None else colliders_of(path, asset_id)


def _rows_of_run(kept: RunAssets, assets: Callable[[], RowsOfAssets], asset_id: str) -> tuple[Row, Row] | None:
    asset, mesh = assets().row(asset_id), kept.row(asset_id)
    return None if asset is None or mesh is None else (asset, mesh)


def _of_folder(root: Path, read: Callable[[], AssetLibrary], *, may_be_empty: bool) -> _Place:
    library, folder = _listed(read, may_be_empty=may_be_empty), AssetFolder(root)
    contents = partial(_contents_of_folder, folder)
    return _Place(library, folder.asset_ids, folder.path, folder.annotation, contents)


def _contents_of_run(run: RunFolder) -> dict[str, object]:
    """The hash of each mesh of a run with the measures of its convex parts, and mass and friction where they are known."""
    rows = run.table("meshes", _CONTENT_COLUMNS).to_pylist()
    of_mesh: dict[str, object] = {row["asset_id"]: row for row in rows}
    weighed = run.table("assets", ["asset_id", *PHYSICS_COLUMNS], IS_WEIGHED).to_pylist()
    return of_mesh | {row["asset_id"]: (row, of_mesh.get(row["asset_id"])) for row in weighed}


def _contents_of_folder(folder: AssetFolder) -> dict[str, object]:
    """The hash of each mesh of a folder; a file that several assets share is read once."""
    path_of = {asset_id: path for asset_id in folder.asset_ids if (path := folder.path(asset_id)) is not None}
    paths = sorted(set(path_of.values()))
    with ThreadPoolExecutor() as pool:  # hashing and reading release the interpreter lock
        digests = tqdm(pool.map(file_digest, paths), "meshes", len(paths), unit="file", leave=False)
        digest_of = dict(zip(paths, digests, strict=True))
    return {asset_id: digest_of[path] for asset_id, path in path_of.items()}
