"""Layouts of folders in which sets of meshes are shipped."""

import itertools
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any, TypeAlias

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.importers.boundary import Boundary
from stable_data.importers.mesh_entries import MeshEntry, number_of, words_of
from stable_data.importers.mesh_files import SUFFIXES
from stable_data.json_text import json_value
from stable_data.limits import LIMITS, at_most

Found: TypeAlias = tuple[str, str, MeshEntry]
"""A mesh file, relative to the folder, the identifier that the set gives it (empty for none), and what is known about it."""

_GENERIC = re.compile(
    r"^(?:(?:non)?textured(?:_simple)?|model(?:s|_normalized)?|mesh(?:es)?|scene|objects?|visuals?|source|poisson|tsdf|google_\d+k|gltf|"
    r"glb|obj|stl|ply|dae|assets?)$",
    re.IGNORECASE,
)
_YCB_FOLDER = re.compile(r"^\d{3}(?:-[a-z])?_")
_SCANS = ("google_16k", "google_64k", "google_512k", "tsdf", "poisson")
_PROPERTY = re.compile(r"^([A-Za-z]{1,40})(?:#(\d{1,6}))?[ \t]*=([^\r\n]*)", re.MULTILINE)
_UNICODE_ESCAPE = re.compile(r"\\u([0-9a-fA-F]{4})")


def plain_meshes(root: Boundary) -> Iterator[Found]:
    """Every mesh file of a folder; of several formats of one name in one folder the first of ``SUFFIXES``.

    Where the name says nothing, as ``textured`` or ``scene``, that of a folder counts.
    """
    for path in _best_formats(root):
        yield path, "", MeshEntry(name=_name_of(path))


def _best_formats(root: Boundary) -> Iterator[str]:
    folder, waiting = PurePosixPath("/"), dict[str, str]()
    for path in root.files(SUFFIXES):
        place = PurePosixPath(path)
        if place.parent != folder:
            yield from waiting.values()
            folder, waiting = place.parent, {}
        stem = place.stem.casefold()
        other = waiting.get(stem)
        if other is None or _rank(place) < _rank(PurePosixPath(other)):
            waiting[stem] = path
    yield from waiting.values()


def _rank(path: PurePosixPath) -> int:
    return SUFFIXES.index(path.suffix.lower())


def _name_of(path: str) -> str:
    """The first name that says something: of the file, or of a folder above it."""
    place = PurePosixPath(path)
    return next(
        (name for name in (place.stem, *(p.name for p in place.parents)) if name and not _GENERIC.match(name)), place.stem
    )


def _objaverse(root: Boundary) -> Iterator[Found]:
    """``glbs/000-xxx/UID.glb`` with ``metadata/000-xxx.json.gz`` or ``annotations.json.gz``, and ``lvis-annotations.json.gz``.

    y up, not metric. The licence is that of each object, as Sketchfab writes it (``by``, ``by-nc-sa``, …).
    """
    categories: dict[str, str] = {}
    for name, uids in _metadata(root, "lvis-annotations.json").items():
        categories |= {str(uid): name.replace("_", " ") for uid in (uids if isinstance(uids, list) else [])}
    shared = _metadata(root, "annotations.json")
    chunk, known = "", dict[str, Any]()
    for path in root.files((".glb",)):
        place = PurePosixPath(path)
        if place.parent.name != chunk:
            chunk = place.parent.name
            known = _metadata(root, f"metadata/{chunk}.json") or shared
        record = known.get(place.stem)
        yield (
            path,
            place.stem,
            _sketchfab_entry(record if isinstance(record, dict) else {}, categories.get(place.stem), place.stem),
        )


def _sketchfab_entry(record: Mapping[str, Any], category: str | None, uid: str) -> MeshEntry:
    entry = MeshEntry(name=str(record.get("name") or uid), set="Objaverse", up="y")
    if category:
        entry["category"] = category
    if isinstance(record.get("description"), str):
        entry["description"] = " ".join(record["description"].split())[:2000]
    lists = [value for key in ("tags", "categories") if isinstance(value := record.get(key), list)]
    names = [item.get("name") if isinstance(item, dict) else item for values in lists for item in values]
    entry["tags"] = words_of([name for name in names if name])
    if record.get("license"):
        entry |= MeshEntry(licence=str(record["license"]), licence_where="annotations of Objaverse")
    user = record.get("user")
    if isinstance(user, dict):
        entry["author"] = str(user.get("displayName") or user.get("username") or "")
    entry["url"] = str(record.get("viewerUrl") or record.get("uri") or "")
    return entry


def _graspnet_infinite(root: Boundary) -> Iterator[Found]:
    """``CATEGORY/UID.glb`` with a record ``CATEGORY/UID.json``: licence, author and the factor to metres; y up."""
    for path in root.files((".glb",)):
        place = PurePosixPath(path)
        record = _metadata(root, place.with_suffix(".json").as_posix())
        plain = {re.sub(r"[^a-z]", "", str(key).lower()): value for key, value in record.items()}

        def first(*names: str, plain: Mapping[str, Any] = plain) -> Any:
            return next((plain[name] for name in names if plain.get(name) not in (None, "")), None)

        category = str(first("lviscategory", "lvislabel", "lvis", "category") or place.parent.name)
        entry = MeshEntry(
            name=str(first("name", "title") or place.stem), category=category.replace("_", " "), set="GraspNet-Infinite", up="y"
        )
        if licence := first("license", "licence"):
            entry |= MeshEntry(licence=str(licence), licence_where=place.with_suffix(".json").name)
        if author := first("author", "user", "creator"):
            entry["author"] = str(author)
        if url := first("url", "viewerurl", "source"):
            entry["url"] = str(url)
        unit_m = number_of(first("scaletometers", "scaletometres", "scaletom", "scalefactor", "scale"))
        if unit_m is not None and 0 < unit_m < math.inf:
            entry["unit_m"] = unit_m
        yield path, place.stem, entry


def _graspnet(root: Boundary) -> Iterator[Found]:
    """``models/NNN/textured.obj`` of GraspNet-1Billion; metres, z up."""
    for path in root.files((".obj",)):
        place = PurePosixPath(path)
        if place.stem.lower() == "textured" and re.fullmatch(r"\d+", place.parent.name):
            yield path, "", MeshEntry(name=place.parent.name, set="GraspNet", up="z", unit_m=1.0)


def _ycb(root: Boundary) -> Iterator[Found]:
    """``NNN_NAME/google_16k/textured.obj`` (or ``.dae``, ``.glb``); of several scans the first of ``_SCANS``; metres, z up."""

    def owner(path: str) -> str:
        return next((part for part in reversed(PurePosixPath(path).parts[:-1]) if _YCB_FOLDER.match(part)), "")

    def rank(path: str) -> tuple[int, bool]:
        place = PurePosixPath(path)
        scans = [_SCANS.index(part) for part in place.parts if part in _SCANS]
        return min(scans, default=len(_SCANS)), not place.stem.lower().startswith("textured")

    for name, paths in itertools.groupby(_best_formats(root), owner):
        scans = [path for path in paths if PurePosixPath(path).stem.lower().removeprefix("non").startswith("textured")]
        if name and scans:
            words = _YCB_FOLDER.sub("", name).replace("_", " ")
            yield min(scans, key=rank), name, MeshEntry(name=name, category=words, set="YCB", up="z", unit_m=1.0)


def _kaykit(root: Boundary) -> Iterator[Found]:
    """A kit with a folder ``gltf``; y up, not metric; the licence is that of ``LICENSE.txt``."""
    for path in _best_formats(root):
        place = PurePosixPath(path)
        if place.suffix.lower() in (".gltf", ".glb") and "gltf" in (part.lower() for part in place.parts[:-1]):
            yield (
                path,
                "",
                MeshEntry(name=place.stem, set="KayKit", author="Kay Lousberg", url="https://www.kaylousberg.com", up="y"),
            )


def _sweethome3d(root: Boundary) -> Iterator[Found]:
    """``PluginFurnitureCatalog.properties`` of an unpacked ``.sh3f`` of Sweet Home 3D; y up, sizes in centimetres."""
    for path in root.files((".properties",)):
        place = PurePosixPath(path)
        if place.name != "PluginFurnitureCatalog.properties":
            continue
        text = Boundary(root.root, root.limits).read_bytes(path, "max_catalogue_bytes").decode("latin-1")
        items: dict[int, dict[str, str]] = {}
        title = ""
        for key, number, value in _PROPERTY.findall(text):
            plain = _UNICODE_ESCAPE.sub(lambda match: chr(int(match[1], 16)), value).strip()
            if number:
                items.setdefault(int(number), {})[key] = plain
            elif key == "name":
                title = plain
        for item in items.values():
            try:
                model = root.resolve(item.get("model", "").lstrip("/"), place.parent.as_posix())
            except MeshError:
                continue
            if PurePosixPath(model).suffix.lower() in SUFFIXES and item.get("doorOrWindow") != "true":
                yield model, item.get("id", ""), _furniture_entry(item, title)


def _furniture_entry(item: Mapping[str, str], title: str) -> MeshEntry:
    entry = MeshEntry(name=item.get("name", ""), set=title, author=item.get("creator", ""))
    entry["tags"] = words_of(f"{item.get('category', '')},{item.get('tags', '')}")
    sides = [number_of(item.get(side, "")) for side in ("width", "depth", "height")]
    size = [0.01 * side for side in sides if side is not None and side > 0]
    if "modelRotation" not in item:  # else the file is turned before it has this size
        entry["up"] = "y"
        if len(size) == 3:
            entry["size_m"] = size
    return entry


PRESETS: Mapping[str, Callable[[Boundary], Iterator[Found]]] = {
    "objaverse": _objaverse,
    "graspnet_infinite": _graspnet_infinite,
    "graspnet": _graspnet,
    "ycb": _ycb,
    "kaykit": _kaykit,
    "sweethome3d": _sweethome3d,
}
"""Presets by name."""


def preset_meshes(root: Boundary, preset: str) -> Iterator[Found | Notice]:
    """Lists the assets of a known layout.

    Raises:
        ConfigError: ``unknown_preset``, or ``preset_misfit``: the folder holds no asset in this layout.
    """
    if preset not in PRESETS:
        raise ConfigError(f"there is no preset {preset!r}, expected one of {', '.join(PRESETS)}", "unknown_preset")
    found = PRESETS[preset](root)
    first = next(found, None)
    if first is None:
        layout = " ".join((PRESETS[preset].__doc__ or "").split())
        raise ConfigError(f"{root.root}: holds no asset in the layout of {preset}: {layout}", "preset_misfit")
    yield first
    yield from found


def _metadata(root: Boundary, path: str) -> dict[str, Any]:
    """The JSON object of a file or of its ``.gz``, of limited size; empty if there is none.

    Raises:
        ConfigError: ``metadata_unreadable``.
    """
    own = Boundary(root.root, root.limits)
    for name in (path, f"{path}.gz"):
        try:
            content = own.read_bytes(own.resolve(name))
        except MeshError:
            continue
        try:
            if name.endswith(".gz"):
                unpacking = zlib.decompressobj(wbits=31)
                content = unpacking.decompress(content, LIMITS.file.max_metadata_bytes + 1)
            if len(content) > LIMITS.file.max_metadata_bytes:
                raise ValueError(f"is larger, expected {at_most(LIMITS.file, 'max_metadata_bytes', 'bytes')}")
            document = json_value(content.decode())
        except (ValueError, zlib.error) as error:
            raise ConfigError(
                f"{name}: cannot be read ({error}), expected a JSON object of annotations", "metadata_unreadable"
            ) from error
        if isinstance(document, dict):
            return document
    return {}
