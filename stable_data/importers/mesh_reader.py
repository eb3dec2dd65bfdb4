"""Reads folders of mesh files: by a manifest, by a preset, or every mesh file."""

from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any, cast

import numpy as np

from stable_data.errors import ConfigError, Notice
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary, asset_id_of, renamed_notice
from stable_data.importers.formats.mesh_file import MeshFile
from stable_data.importers.mesh_entries import MeshEntry, manifest_entries
from stable_data.importers.mesh_files import AXES, files_beside, read_mesh_file, transformed, z_up
from stable_data.importers.mesh_presets import plain_meshes, preset_meshes
from stable_data.importers.source import Axis, GivenInertial, GivenLicence, ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.stated_licences import LicenceFiles, author_of_copyright, licence_of_field, licences_of_file
from stable_data.json_text import is_unicode, quote_value
from stable_data.scene import Vec3

_USUAL_UP: dict[str, Axis] = {".obj": "y", ".dae": "y"}  # of files that do not say it; z for the others, scans and prints


class MeshReader:
    """Reads GLB, glTF, OBJ, DAE, STL and PLY files.

    The upward axis is that of the manifest, the options, the preset or the format (glTF: y; COLLADA as stated), in this order;
    without one, y for OBJ and z for STL and PLY, and ``is_upright`` is false. The unit is that of the manifest, the options, the
    preset or COLLADA's; that of glTF counts as unknown, because most kits do not keep to metres.
    """

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the meshes; see :class:`stable_data.importers.source.Reader`."""
        if options.manifest and options.preset:
            raise ConfigError("a manifest and a preset are given, expected one of them", "options_conflict")
        if options.up and options.front and options.up[-1] == options.front[-1]:
            raise ConfigError("up and front are one axis, expected two", "options_conflict")
        ids, licences, files = AssetIds(), LicenceFiles(root), dict[str, tuple[str, ...]]()
        if options.manifest:
            found: Iterator[tuple[str, str, MeshEntry] | Notice] = manifest_entries(
                Boundary(root.root, root.limits), options.manifest
            )
        else:
            found = preset_meshes(root, options.preset) if options.preset else plain_meshes(root)
        for item in found:
            yield item if isinstance(item, Notice) else _ref(root, *item, ids, licences, files)

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads a mesh file; see :class:`stable_data.importers.source.Reader`."""
        entry = cast(MeshEntry, ref.entry)
        file, notices = read_mesh_file(root, ref.path, ref.asset_id, max_faces=options.max_faces)
        up, is_upright = _up(entry, options, file, ref.path)
        turn = z_up(up)
        front = _front(entry, options, up)
        size = entry.get("size_m")
        renamed = renamed_notice(ref.asset_id, entry["name"]) if ref.asset_id == asset_id_of(entry["name"]) else None
        more = [] if renamed is None else [renamed]
        if "ignored" in entry:
            message = f"the manifest has columns that are not known: {entry['ignored']}; they are left out"
            more.append(Notice(ref.asset_id, "find", "columns_ignored", message))
        return SourceAsset(
            ref.asset_id,
            entry["name"],
            transformed(file.surfaces, turn),
            unit_m=_unit_m(entry, options, file),
            size_m=None if size is None else (size[0], size[1], size[2]),
            is_upright=is_upright,
            front=front,
            inertial=GivenInertial(entry["mass"]) if "mass" in entry else None,
            category=entry.get("category", ""),
            description=entry.get("description", ""),
            tags=tuple(entry.get("tags", ())),
            author=entry.get("author", "") or file.author or author_of_copyright(file.copyright),
            url=entry.get("url", ""),
            source_set=entry.get("set", ""),
            licences=_licences(root, entry, file, ref.path),
            notices=(*more, *notices),
        )


def _ref(
    root: Boundary,
    path: str,
    wanted_id: str,
    entry: MeshEntry,
    ids: AssetIds,
    licences: LicenceFiles,
    files: dict[str, tuple[str, ...]],
) -> SourceRef | Notice:
    """A mesh file as an item, with the files beside it; ``files`` keeps these, as rows of a manifest may name one mesh again."""
    if not is_unicode(path):
        message = f"{quote_value(path)}: the name is no UTF-8, expected letters; rename the file"
        return Notice(asset_id_of(path), "find", "name_not_unicode", message)
    if wanted_id:
        asset_id = asset_id_of(wanted_id)
        if not ids.claim(asset_id):
            message = f"asset {asset_id}: {path} has an identifier that another asset has, expected one of its own; change it"
            return Notice(asset_id, "find", "asset_duplicate", message)
    else:
        asset_id = ids.of_path(entry["name"], path)
    licence = licences.nearest(path)
    if licence is not None:
        entry["licence_file"] = licence
    if path not in files:
        files[path] = tuple(dict.fromkeys((path, *files_beside(root, path), *((licence,) if licence is not None else ()))))
    return SourceRef(asset_id, path, files[path], cast(dict[str, Any], entry))


def _first(stated: str, chosen: str, options: ReaderOptions) -> str:
    """The value of a manifest or else of the options; but options come before what a preset says."""
    return (stated or chosen) if options.manifest else (chosen or stated)


def _up(entry: MeshEntry, options: ReaderOptions, file: MeshFile, path: str) -> tuple[Axis, bool]:
    """The upward axis of a file, and whether something says it."""
    axis = _first(entry.get("up", ""), options.up, options) or file.up
    return (cast(Axis, axis), True) if axis else (_USUAL_UP.get(PurePosixPath(path).suffix.lower(), "z"), False)


def _unit_m(entry: MeshEntry, options: ReaderOptions, file: MeshFile) -> float | None:
    """Metres for each unit; None if nothing says it."""
    stated, chosen = entry.get("unit_m", 0.0), options.unit_m
    return ((stated or chosen) if options.manifest else (chosen or stated)) or file.unit_m


def _front(entry: MeshEntry, options: ReaderOptions, up: Axis) -> Vec3 | None:
    """The front in the frame of the surfaces; None if it is not stated, or is the upward axis itself."""
    axis = _first(entry.get("front", ""), options.front, options)
    if not axis or axis[-1] == up[-1]:
        return None
    x, y, z = (z_up(up)[:3, :3] @ np.array(AXES[axis])).tolist()
    return (x + 0.0, y + 0.0, z + 0.0)  # no minus zeros


def _licences(root: Boundary, entry: MeshEntry, file: MeshFile, path: str) -> tuple[GivenLicence, ...]:
    """All statements, the most specific first."""
    found = []
    if entry.get("licence"):
        found.append(GivenLicence(entry["licence"][:1000], entry.get("licence_where", "")))
    inside = (licence_of_field(text, PurePosixPath(path).name) for text in (file.licence, file.copyright))
    found += [licence for licence in inside if licence is not None]
    if "licence_file" in entry:
        found += licences_of_file(root, entry["licence_file"])
    return tuple(found)


READER = MeshReader()
