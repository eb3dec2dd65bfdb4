"""Assets from the tables of a run, for jobs that have the run folder but not the original dataset."""

import hashlib
import re
import weakref
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.physics import IS_WEIGHED, PHYSICS_COLUMNS, AssetPhysics, physics_of_row
from stable_data.assets.store import AssetStore
from stable_data.atomic_files import write_file_atomically
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, MeshError, cannot_write
from stable_data.geometry.gltf_reader import load_surfaces, texture_addresses
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface import Surface
from stable_data.json_text import quote_value
from stable_data.storage.row_groups import TableFiles, rows_from_table
from stable_data.storage.run_folder import RunFolder, Uri
from stable_data.storage.schemas import SCHEMAS, Row

_UNSEEN = ("points", "normals", "text_embedding", "sentence_embedding")
"""Large columns of ``assets`` that no file of a scene depends on."""

_SHA256 = re.compile("[0-9a-f]{64}")
_TEXTURE_BYTES = 64 * 2**20  # of recent images in memory


class RowsOfAssets:
    """The rows of a table of a run by asset; at most one row group is in memory.

    Args:
        run: The run folder.
        table: A table with the column ``asset_id``, one row for each asset.
        without: Columns that are not read.
        group_of: The row group of each asset; None reads it.

    Raises:
        ConfigError: The run has no such table, or it cannot be read.
    """

    def __init__(
        self, run: RunFolder, table: str, without: Collection[str] = (), group_of: Mapping[str, int] | None = None
    ) -> None:
        self._group_of = _groups(run, table) if group_of is None else group_of
        self._files = TableFiles(run.uri, table, [name for name in SCHEMAS[table].names if name not in without])
        self._read: tuple[int, pa.Table] | None = None
        self._fingerprints: dict[str, tuple[str, Sequence[str]]] = {}

    def row(self, asset_id: str) -> Row | None:
        """Returns the row of an asset; None if it has none.

        Raises:
            ConfigError: The table can no longer be read.
        """
        if asset_id not in self._group_of:
            return None
        rows = self._rows_of(self._group_of[asset_id])
        return rows_from_table(rows.filter(pc.equal(rows["asset_id"], asset_id)).slice(0, 1))[0]

    def fingerprint(self, asset_id: str) -> tuple[str, Sequence[str]]:
        """Returns a hash of the row of an asset, empty if it has none, and the images that its look names.

        All rows of its row group are hashed at once.

        Raises:
            ConfigError: As :meth:`row`.
        """
        if asset_id in self._group_of and asset_id not in self._fingerprints:
            rows = self._rows_of(self._group_of[asset_id])
            for k, name in enumerate(rows["asset_id"].to_pylist()):
                look = rows["look"][k].as_py() if "look" in rows.column_names else None
                self._fingerprints.setdefault(name, (_content_hash(rows.take([k])), tuple(texture_addresses(look))))
        return self._fingerprints.get(asset_id, ("", ()))

    def _rows_of(self, group: int) -> pa.Table:
        if self._read is None or self._read[0] != group:
            self._read = group, self._files.read([group])
        return self._read[1]


def _content_hash(rows: pa.Table) -> str:
    """A hash of rows and of the names and types of their columns."""
    sink, plain = pa.BufferOutputStream(), rows.replace_schema_metadata(None)
    with pa.ipc.new_stream(sink, plain.schema) as stream:
        stream.write_table(plain)
    return hashlib.sha256(sink.getvalue()).hexdigest()


def _groups(run: RunFolder, table: str) -> dict[str, int]:
    """The row group of each asset in a table."""
    names = TableFiles(run.uri, table, ["asset_id"])
    return {asset_id: group for group in range(len(names.groups)) for asset_id in names.read([group])["asset_id"].to_pylist()}


class RunAssets:
    """An :class:`~stable_data.assets.store.AssetSource` for the table ``meshes``: its GLBs as files, named by their hash.

    The first request for a file writes the files of its row group; existing files, such as those of another process, are used.
    A file is returned only after its hash is verified, and a GLB whose hash differs from that of its row is never written, so
    runs of any origin can share the folder. At most one row group of the table is in memory. The class is also a
    :class:`~stable_data.assets.store.PartSource` with the convex parts of the table, and a
    :class:`~stable_data.assets.store.LookSource` with its looks and the images of the table ``textures``, and a
    :class:`~stable_data.assets.store.PhysicsSource` with the masses of the table ``assets``, whose small columns are read on the
    first request, and a :class:`~stable_data.assets.store.StoredSource`.

    Args:
        run: The run folder.
        files: Local folder for the files.

    Raises:
        ConfigError: The run has no table ``meshes``, the table cannot be read, or the folder cannot be written.
    """

    def __init__(self, run: RunFolder, files: Path) -> None:
        self._uri, self._files = run.uri, files
        self._names = TableFiles(run.uri, "meshes", ["asset_id", "sha256"])
        self._meshes = TableFiles(run.uri, "meshes", ["asset_id", "glb", "sha256"])
        self._group_of: dict[str, int] = {}
        self._content_of: dict[str, str] = {}
        self._hashed: set[str] = set()
        for group in range(len(self._names.groups)):
            rows = self._names.read([group])
            for asset_id, sha256 in zip(rows["asset_id"].to_pylist(), rows["sha256"].to_pylist(), strict=True):
                if not isinstance(asset_id, str) or not _SHA256.fullmatch(sha256 or ""):
                    found = f"meshes: asset_id is {quote_value(asset_id)} and sha256 is {quote_value(sha256)}"
                    raise ConfigError(
                        f"{found}, expected a name and 64 hex digits; preprocess the dataset again", "table_invalid"
                    )
                self._group_of[asset_id], self._content_of[asset_id] = group, sha256
        self._rows = RowsOfAssets(run, "meshes", ("glb",), self._group_of)
        self._textures = RunTextures(run)
        try:
            files.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(str(files), error) from error

    def asset_ids(self) -> Set[str]:
        """The assets that have a mesh."""
        return self._content_of.keys()

    def is_stored(self, asset_id: str) -> bool:
        """Returns whether the run has a mesh of an asset: it was repaired before it was stored."""
        return asset_id in self._content_of

    def sha256(self, asset_id: str) -> str | None:
        """Returns the hash of an asset's GLB that its row states; None if the run has no mesh of it."""
        return self._content_of.get(asset_id)

    def asset_path(self, asset_id: str) -> Path | None:
        """Returns the repaired mesh of an asset as a GLB file, or None if the run has no mesh of it.

        Raises:
            ConfigError: The table can no longer be read, or the file cannot be written.
            MeshError: The GLB of the row does not have the hash of the row (``mesh_differs``).
        """
        if asset_id not in self._content_of:
            return None
        sha256 = self._content_of[asset_id]
        path = self._path(sha256)
        if sha256 not in self._hashed:
            if _digest(path) != sha256:
                self._place(self._group_of[asset_id], sha256)
            if _digest(path) != sha256:
                found = f"the glb in table meshes does not have the hash {quote_value(sha256)} that its row states"
                raise MeshError(f"asset {asset_id}: {found}; preprocess the dataset again", "mesh_differs")
            self._hashed.add(sha256)
        return path

    def parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """Returns the convex parts of an asset, in the frame and unit of its mesh; empty if the run has none.

        Raises:
            ConfigError: The table can no longer be read.
            MeshError: A part is no mesh (``parts_invalid``).
        """
        row = self._rows.row(asset_id)
        return tuple(_part(part, asset_id) for part in (row["parts"] if row is not None else None) or ())

    def physics(self, asset_id: str) -> AssetPhysics | None:
        """Returns mass and friction of an asset; None if the run does not know them.

        Raises:
            ConfigError: The table ``assets`` cannot be read.
        """
        rows, number_of = self._physics
        number = number_of.get(asset_id)
        return None if number is None else physics_of_row(rows.slice(number, 1).to_pylist()[0])

    @cached_property
    def _physics(self) -> tuple[pa.Table, dict[str, int]]:
        """The rows of the table ``assets`` that state a mass with its origin, and the number of each asset among them."""
        columns, run = ["asset_id", *PHYSICS_COLUMNS], RunFolder(self._uri)  # not that of a process before a fork
        if not run.files("assets"):
            return SCHEMAS["assets"].empty_table().select(columns), {}
        rows = run.table("assets", columns, IS_WEIGHED)
        return rows, {asset_id: number for number, asset_id in enumerate(rows["asset_id"].to_pylist())}

    def look(self, asset_id: str) -> list[Surface]:
        """Returns the surfaces that are seen of an asset, in the frame and unit of its mesh; empty if the run has no look of it.

        Raises:
            ConfigError: The table can no longer be read.
            MeshError: The look violates the format, or the run lacks one of its textures (``texture_missing``).
        """
        row = self._rows.row(asset_id)
        look = None if row is None else row["look"]
        return [] if look is None else load_surfaces(look, asset_id, textures=self._textures.image)

    def textures(self, asset_id: str) -> list[Row]:
        """Returns the rows of the table ``textures`` that the look of an asset names, as far as the run has them.

        Raises:
            ConfigError: The table can no longer be read.
        """
        row = self._rows.row(asset_id)
        names = () if row is None else texture_addresses(row["look"])
        return [found for name in names if (found := self._textures.row(name)) is not None]

    def fingerprint(self, asset_id: str) -> str:
        """Returns a hash of the rows of an asset in ``assets`` and ``meshes``, with the images that its look names.

        The hash that a row states stands for its GLB; where the GLB has another one, the asset has no mesh, and another fingerprint.

        Raises:
            ConfigError: A table can no longer be read, or the file of the mesh cannot be written.
        """
        try:
            self.asset_path(asset_id)
            is_refused = False
        except MeshError:
            is_refused = True
        content, images = self._rows.fingerprint(asset_id)
        described = "" if self._described is None else self._described.fingerprint(asset_id)[0]
        known = [name for name in images if self._textures.row(name) is not None]  # a look without its image is not shown
        return content_id(content, described, known, is_refused)

    @cached_property
    def _described(self) -> RowsOfAssets | None:
        run = RunFolder(self._uri)  # not that of a process before a fork
        return RowsOfAssets(run, "assets", _UNSEEN) if run.files("assets") else None

    def row(self, asset_id: str) -> Row | None:
        """Returns the row of an asset in the table ``meshes``; None if it has none.

        Raises:
            ConfigError: The table can no longer be read.
            MeshError: As :meth:`asset_path`.
        """
        row, path = self._rows.row(asset_id), self.asset_path(asset_id)
        return None if row is None or path is None else row | {"glb": path.read_bytes()}

    def _path(self, sha256: str) -> Path:
        return self._files / f"{sha256}.glb"

    def _place(self, group: int, wanted: str) -> None:
        """Atomically writes the file ``wanted`` and all missing files of a row group, if their content has the stated hash."""
        rows = self._meshes.read([group])
        try:
            for glb, sha256 in zip(rows["glb"], rows["sha256"].to_pylist(), strict=True):
                content = glb.as_buffer()
                is_due = content is not None and (sha256 == wanted or not self._path(sha256).exists())
                if is_due and hashlib.sha256(content).hexdigest() == sha256:
                    write_file_atomically(self._path(sha256), content)
        except OSError as error:
            raise cannot_write(str(self._files), error) from error


def _part(row: Row | None, asset_id: str) -> Mesh:
    """A convex part of the table; the programs that use it do not check its indices."""
    try:
        given = row or {}
        part = Mesh(np.array(given["vertices"], np.float64).reshape(-1, 3), np.array(given["faces"], np.int64).reshape(-1, 3))
        is_valid = len(part.faces) > 0 and part.faces.min() >= 0 and part.faces.max() < len(part.vertices)
        if is_valid and np.isfinite(part.vertices).all():
            return part
        reason = "an index outside of its vertices, or a number that is not finite"
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
    message = f"asset {asset_id}: a convex part in table meshes cannot be used ({reason:.200}); preprocess the dataset again"
    raise MeshError(message, "parts_invalid")


class RunTextures:
    """The table ``textures`` of a run; at most one row group and some images are in memory. A run may lack the table.

    Args:
        run: The run folder.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._recent: OrderedDict[str, Row] = OrderedDict()
        self._read: tuple[int, pa.Table] | None = None  # a row group and its rows

    @cached_property
    def _files(self) -> TableFiles | None:
        run = RunFolder(self._run.uri)  # not that of a process before a fork
        return TableFiles(run.uri, "textures", None) if run.files("textures") else None

    @cached_property
    def _group_of(self) -> dict[str, int]:
        """The row group of each image; the first of those that have it."""
        if self._files is None:
            return {}
        names = TableFiles(self._run.uri, "textures", ["sha256"])
        found: dict[str, int] = {}
        for group in range(len(names.groups)):
            for sha256 in names.read([group])["sha256"].to_pylist():
                found.setdefault(sha256, group)
        return found

    def row(self, sha256: str) -> Row | None:
        """Returns the row of an image; None if the run has none, or if its image does not have the hash of the row.

        Raises:
            ConfigError: The table can no longer be read.
        """
        if sha256 not in self._recent:
            if self._files is None or sha256 not in self._group_of:
                return None
            group = self._group_of[sha256]
            if self._read is None or self._read[0] != group:
                self._read = group, self._files.read([group])
            rows = self._read[1]
            for row in rows_from_table(rows.filter(pc.equal(rows["sha256"], sha256)).slice(0, 1)):
                if row["image"] is None or hashlib.sha256(row["image"]).hexdigest() != sha256:
                    del self._group_of[sha256]  # it is not looked at again
                    return None
                self._recent[sha256] = row
        self._recent.move_to_end(sha256)
        found = self._recent[sha256]
        while len(self._recent) > 1 and sum(len(row["image"]) for row in self._recent.values()) > _TEXTURE_BYTES:
            self._recent.popitem(last=False)
        return found

    def image(self, sha256: str) -> bytes | None:
        """Returns the content of an image file; None as :meth:`row`."""
        row = self.row(sha256)
        return None if row is None else bytes(row["image"])


def _digest(path: Path) -> str | None:
    """Computes the SHA-256 of a file; None if it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return None


def run_store(run: Uri) -> AssetStore:
    """Opens the assets of a run; their files are in a temporary folder that is deleted with the store.

    Args:
        run: Folder or URI of the run.

    Raises:
        ConfigError: As :class:`RunAssets`.
    """
    files = TemporaryDirectory(prefix="stable-data-")
    store = AssetStore(RunAssets(RunFolder(run), Path(files.name)))
    weakref.finalize(store, files.cleanup)
    return store


def run_annotations(run: RunFolder) -> Mapping[str, AssetAnnotation]:
    """Returns asset id -> annotation from the table ``assets`` of a run.

    Raises:
        ConfigError: The run has no such table, or the table cannot be read.
    """
    return _RunAnnotations(run)


class _RunAnnotations(Mapping[str, AssetAnnotation]):
    """The annotations of a run, each made when it is asked for, because those of a large library need much memory."""

    def __init__(self, run: RunFolder) -> None:
        columns = ["asset_id", "category", "description", "caption", "licence", "source", "extents", "mass", "is_container"]
        columns += ["author", "source_url", "typical_scale", "resting_tilts"]
        table = run.table("assets", columns)
        self._columns = {name: table[name].to_pylist() for name in columns}
        self._place = {asset_id: k for k, asset_id in enumerate(self._columns["asset_id"])}

    def __getitem__(self, asset_id: str) -> AssetAnnotation:
        place = self._place[asset_id]
        return _annotation({name: values[place] for name, values in self._columns.items()})

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)


def _entries(values: object, count: int) -> list[float | None]:
    """The numbers of a list of a stated length; unknown ones for any other value, which ``stable-data verify`` names as damage."""
    return values if isinstance(values, list) and len(values) == count else [None] * count


def _annotation(row: dict[str, object]) -> AssetAnnotation:
    mass, tilts = row["mass"], row["resting_tilts"]
    x, y, z = _entries(row["extents"], 3)
    i, j, k = _entries(row["typical_scale"], 3)
    first = tilts[0] if isinstance(tilts, list) and tilts else None
    a, b, c, d = _entries(first["tilt_quat_xyzw"] if isinstance(first, dict) else None, 4)
    return AssetAnnotation(
        str(row["asset_id"]),
        category=str(row["category"] or ""),
        description=str(row["description"] or ""),
        caption=str(row["caption"] or ""),
        source=str(row["source"] or ""),
        mass=mass if isinstance(mass, float) else None,
        is_container=row["is_container"] if isinstance(row["is_container"], bool) else None,
        extents_z_up=None if x is None or y is None or z is None else (x, y, z),
        typical_scale=None if i is None or j is None or k is None else (i, j, k),
        resting_tilt=None if a is None or b is None or c is None or d is None else (a, b, c, d),
        raw={name: row[name] for name in ("licence", "author", "source_url") if row[name]},
    )
