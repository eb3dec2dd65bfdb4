"""What one item from outside may cost: the limits of all readers and workers, in one place.

An item is a file with all that it names, a scene, a reply, a line of a task file. A reader refuses what exceeds a limit before memory
or time is spent on it, and its message names the limit. The environment variable :data:`SETTING` changes limits, for a command and
for all its workers::

    STABLE_DATA_LIMITS="mesh.max_faces=4000000, item.max_memory_bytes=17179869184" stable-data lint DIR
"""

import ctypes
import gc
import os
import re
import resource
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import monotonic
from typing import Any

from stable_data.errors import ConfigError, StableDataError

SETTING = "STABLE_DATA_LIMITS"
"""The environment variable that changes limits: ``name=value`` pairs, joined by commas; names are ``group.field``."""

KIB, MIB, GIB = 2**10, 2**20, 2**30

_ATTRIBUTE = re.compile(r"^ {8}(\w+): (.+(?:\n {12}.+)*)", re.MULTILINE)  # of the docstring of a group


@dataclass(frozen=True, slots=True)
class ItemLimits:
    """What one item may cost a worker of a job, whatever it is. The time is the setting seconds_per_item of each job.

    Attributes:
        max_memory_bytes: Memory that a worker allocates for one item, beyond what it has already.
        max_scene_file_seconds: Time for one scene file of another project.
        max_scan_seconds: Time to list what one layer of USD names.
        max_scan_memory_bytes: Memory for that, beyond 64 bytes for each byte of the file.
    """

    max_memory_bytes: int = 8 * GIB
    max_scene_file_seconds: int = 900
    max_scan_seconds: int = 60
    max_scan_memory_bytes: int = 2 * GIB


@dataclass(frozen=True, slots=True)
class FileLimits:
    """The files of one asset or scene in a source folder.

    Attributes:
        max_file_bytes: Size of one file.
        max_bytes: Size of all files that are read for an asset.
        max_files: Number of these files, and of files that one of them names.
        max_xml_bytes: Size of an XML file: MJCF, URDF, SDFormat.
        max_nested_bytes: Size of a COLLADA or a glTF file with its JSON, which take many times their size in memory.
        max_ascii_bytes: Size of an ASCII STL or PLY, likewise.
        max_material_bytes: Size of a file of materials (MTL).
        max_manifest_bytes: Size of a manifest of assets.
        max_catalogue_bytes: Size of a catalogue of furniture.
        max_metadata_bytes: Size of a file of annotations, after it is unpacked.
    """

    max_file_bytes: int = 512 * MIB
    max_bytes: int = 1024 * MIB
    max_files: int = 500
    max_xml_bytes: int = 8 * MIB
    max_nested_bytes: int = 64 * MIB
    max_ascii_bytes: int = 128 * MIB
    max_material_bytes: int = 8 * MIB
    max_manifest_bytes: int = 256 * MIB
    max_catalogue_bytes: int = 4 * MIB
    max_metadata_bytes: int = 512 * MIB


@dataclass(frozen=True, slots=True)
class GltfLimits:
    """A scene in a glTF file.

    Attributes:
        max_json_bytes: Size of the JSON chunk of a GLB.
        max_json_levels: Nesting of lists and objects in the JSON.
        max_nodes: Nodes of the scene.
        max_primitives: Primitives, counted once for each node that shows their mesh.
        max_corners: Vertices of those primitives, counted in the same way.
        max_faces: Triangles of those primitives, counted in the same way.
    """

    max_json_bytes: int = 16 * MIB
    max_json_levels: int = 64
    max_nodes: int = 10_000
    max_primitives: int = 20_000
    max_corners: int = 8_000_000
    max_faces: int = 8_000_000


@dataclass(frozen=True, slots=True)
class MeshLimits(GltfLimits):
    """A mesh of a library, a GLB. The size and the triangles of a glTF that is imported are limited by the groups file and model.

    Attributes:
        max_bytes: Size of the file.
        max_colliders: Convex parts in the file.
    """

    max_json_bytes: int = 4 * MIB
    max_corners: int = 3_000_000
    max_faces: int = 1_000_000
    max_bytes: int = 128 * MIB
    max_colliders: int = 1_000


@dataclass(frozen=True, slots=True)
class ModelLimits:
    """A model of another project: COLLADA, URDF, SDFormat, MJCF, USD.

    Attributes:
        max_faces: Triangles of what is seen of an asset, and of what collides (in USD: of both together); an asset with more than the
            library keeps is reduced. Also triangles, and vertices, of what collides in a scene of others, counted as often as it is shown.
        max_collider_faces: Triangles of one collider that is cut into convex parts.
        max_links: Links, joints, frames and files of a model.
        max_shapes: What is seen and what collides of a model.
        max_levels: Files within files, and models within models.
        max_frames: Frames that are relative to each other, in a row.
        max_elements: Elements of a model with what it includes, and of its copies.
        max_attributes: Attributes of these elements.
        max_element_levels: Elements within one another.
        max_nodes: Nodes of a COLLADA scene, each as often as it is shown.
        max_layers: Layers of a USD file.
        max_layer_levels: Layers within one another.
        max_prims: Prims of a composed USD stage.
        max_prim_levels: Prims within one another.
        max_bracket_levels: Brackets of a text layer of USD within one another.
        max_subsets: Parts of a USD mesh with a material of their own.
        max_members: Files in a USD package.
        max_copies: Copies that one element of MJCF makes.
    """

    max_faces: int = 12_000_000
    max_collider_faces: int = 200_000
    max_links: int = 2_000
    max_shapes: int = 2_000
    max_levels: int = 8
    max_frames: int = 100
    max_elements: int = 500_000
    max_attributes: int = 2_000_000
    max_element_levels: int = 64
    max_nodes: int = 10_000
    max_layers: int = 500
    max_layer_levels: int = 16
    max_prims: int = 100_000
    max_prim_levels: int = 200
    max_bracket_levels: int = 1_000
    max_subsets: int = 1_000
    max_members: int = 2_000
    max_copies: int = 10_000


@dataclass(frozen=True, slots=True)
class SceneFileLimits:
    """A scene file of another project.

    Attributes:
        max_free_bodies: Bodies that can move.
        max_poses: Poses that a MuJoCo file states (keyframes).
        max_memory_bytes: Memory that MuJoCo takes to read and to compile a model, and that the model reserves.
        max_steps: Steps for the time that a scene is watched.
    """

    max_free_bodies: int = 1_000
    max_poses: int = 1_000
    max_memory_bytes: int = 2 * GIB
    max_steps: int = 20_000


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """A texture or picture.

    Attributes:
        max_bytes: Size of the file.
        max_pixels: Pixels of all images that are decoded together.
        max_scans: Scans of a progressive JPEG; encoders write about 10.
    """

    max_bytes: int = 64 * MIB
    max_pixels: int = 2**27
    max_scans: int = 100


@dataclass(frozen=True, slots=True)
class JsonLimits:
    """JSON of any kind.

    Attributes:
        max_levels: Nesting of lists and objects; a layout needs 4.
        max_values: Brackets and commas; an annotated library of 12,000 assets has a tenth of it.
    """

    max_levels: int = 64
    max_values: int = 1 << 22


@dataclass(frozen=True, slots=True)
class LayoutLimits:
    """A scene in the MesaTask-10K format, and what belongs to it.

    Attributes:
        max_bytes: Size of a layout.
        max_objects: Objects of a scene.
        max_reach: Largest distance of an object from the table, and largest extent of an object, metres.
        max_task_bytes: Size of a task info.
        max_annotation_bytes: Size of the annotations of all assets.
    """

    max_bytes: int = 64 * MIB
    max_objects: int = 500
    max_reach: float = 10.0
    max_task_bytes: int = 1 * MIB
    max_annotation_bytes: int = 128 * MIB


@dataclass(frozen=True, slots=True)
class FeatureLimits:
    """A pickle of text features.

    Attributes:
        max_bytes: Size of the file, also after it is unpacked, and of all its arrays together.
        max_operations: Operations; one makes an object of up to 100 bytes.
        max_memo: Largest index of its memory, up to which the reader reserves memory.
        max_rows: Rows of features, and texts in arrays.
        max_numbers: Numbers in all rows together.
    """

    max_bytes: int = 256 * MIB
    max_operations: int = 1 << 21
    max_memo: int = 1 << 22
    max_rows: int = 1 << 20
    max_numbers: int = 1 << 26


@dataclass(frozen=True, slots=True)
class TextLimits:
    """Texts that are given to a job.

    Attributes:
        max_instruction: Characters of an instruction, and of a sentence of a goal.
        max_reply_bytes: Size of the reply of a language model; a layout of 60 objects has about 20,000 bytes.
        max_answer_bytes: Size of what an endpoint sends for one request.
        max_line: Characters of a line of a file of tasks or edits.
        max_lines: Lines of such a file, or rows if it is Parquet.
        max_config_bytes: Size of a TOML file of settings, and of a value of --set.
        max_document_bytes: Size of a JSON file of the project, such as a manifest, labels or statistics.
        max_checksum_bytes: Size of the file of checksums of a run; a line of one file has about 120 bytes.
        max_query: Characters of a condition: enough for 10,000 ids of 96 characters each.
        max_query_levels: Levels of a condition's syntax tree.
        max_query_terms: Comparisons of a condition, and operands of its `and` and `or`, together.
    """

    max_instruction: int = 2_000
    max_reply_bytes: int = 256 * KIB
    max_answer_bytes: int = 16 * MIB
    max_line: int = 1 * MIB
    max_lines: int = 1_000_000
    max_config_bytes: int = 16 * KIB
    max_document_bytes: int = 256 * MIB
    max_checksum_bytes: int = 64 * MIB
    max_query: int = 1_000_000
    max_query_levels: int = 30
    max_query_terms: int = 40_000


@dataclass(frozen=True, slots=True)
class TableLimits:
    """A Parquet file of a run.

    Attributes:
        max_decoded_bytes: Memory for its decoded content: ten times the content of a file that a job writes.
        max_pages: Pages of all columns, which may name the same ones again and again.
        max_footer_values: Values of its footer; each takes up to 100 bytes in memory.
        max_picture_side: Pixels of a side of a picture of an episode.
        max_objects: Objects of a scene.
    """

    max_decoded_bytes: int = 1 * GIB
    max_pages: int = 300_000
    max_footer_values: int = 5_000_000
    max_picture_side: int = 4_096
    max_objects: int = 10_000


@dataclass(frozen=True, slots=True)
class WorkLimits:
    """Work on content that is read; what exceeds it is unknown or refused.

    Attributes:
        max_audit_triangles: Work of the exact tests of one scene, in triangles: about 25 s. The fullest of 120 real ones needs 7 million.
        max_scene_corners: Vertices of the meshes of one scene; those of a mesh count for each object that has it.
        max_repair_parts: Parts of a mesh that is repaired, and its holes.
        max_repair_pairs: Pairs of parts whose boxes overlap, and pairs of a face and a hole.
        max_repair_sums: Faces that are summed for winding numbers over all points.
        max_support_faces: Triangles of furniture in which surfaces are looked for.
    """

    max_audit_triangles: int = 300_000_000
    max_scene_corners: int = 50_000_000
    max_repair_parts: int = 20_000
    max_repair_pairs: int = 1_000_000
    max_repair_sums: int = 15_000_000
    max_support_faces: int = 1_000_000


@dataclass(slots=True)
class Limits:
    """All limits, by group.

    Attributes:
        item: See :class:`ItemLimits`.
        file: See :class:`FileLimits`.
        mesh: See :class:`MeshLimits`.
        gltf_scene: See :class:`GltfLimits`.
        model: See :class:`ModelLimits`.
        scene_file: See :class:`SceneFileLimits`.
        image: See :class:`ImageLimits`.
        json: See :class:`JsonLimits`.
        layout: See :class:`LayoutLimits`.
        features: See :class:`FeatureLimits`.
        text: See :class:`TextLimits`.
        table: See :class:`TableLimits`.
        work: See :class:`WorkLimits`.
    """

    item: ItemLimits = field(default_factory=ItemLimits)
    file: FileLimits = field(default_factory=FileLimits)
    mesh: MeshLimits = field(default_factory=MeshLimits)
    gltf_scene: GltfLimits = field(default_factory=GltfLimits)
    model: ModelLimits = field(default_factory=ModelLimits)
    scene_file: SceneFileLimits = field(default_factory=SceneFileLimits)
    image: ImageLimits = field(default_factory=ImageLimits)
    json: JsonLimits = field(default_factory=JsonLimits)
    layout: LayoutLimits = field(default_factory=LayoutLimits)
    features: FeatureLimits = field(default_factory=FeatureLimits)
    text: TextLimits = field(default_factory=TextLimits)
    table: TableLimits = field(default_factory=TableLimits)
    work: WorkLimits = field(default_factory=WorkLimits)

    def values(self) -> dict[str, int | float]:
        """All limits by their names, ``group.field``."""
        groups = {one.name: getattr(self, one.name) for one in fields(self)}
        return {f"{name}.{one.name}": getattr(group, one.name) for name, group in groups.items() for one in fields(group)}

    def changed(self) -> dict[str, int | float]:
        """The limits that differ from their defaults, by name. A run that resumes must have the same."""
        defaults = Limits().values()
        return {name: value for name, value in self.values().items() if value != defaults[name]}


@dataclass(frozen=True, slots=True)
class Limit:
    """One limit.

    Attributes:
        name: Its name, ``group.field``.
        value: Its value in this process.
        default: Its default.
        meaning: What it limits.
        about: What its group is about.
    """

    name: str
    value: int | float
    default: int | float
    meaning: str
    about: str

    @property
    def group(self) -> str:
        """The name of its group."""
        return self.name.partition(".")[0]


def list_limits() -> list[Limit]:
    """Returns all limits in the order of their groups."""
    defaults, found = Limits().values(), []
    for group in fields(LIMITS):
        values = getattr(LIMITS, group.name)
        about = " ".join((type(values).__doc__ or "").partition("\n\n")[0].split())
        texts = [(kind.__doc__ or "").partition("Attributes:")[2] for kind in type(values).__mro__]  # it may extend another one
        meanings = {name: " ".join(text.split()) for name, text in _ATTRIBUTE.findall("\n".join(texts))}
        for one in fields(values):
            name = f"{group.name}.{one.name}"
            found.append(Limit(name, getattr(values, one.name), defaults[name], meanings.get(one.name, ""), about))
    return found


def read_limits(text: str) -> Limits:
    """Reads limits from a value of :data:`SETTING`; all others have their defaults.

    Raises:
        ConfigError: A limit is not known, or its value is no number above 0 (``limits_invalid``).
    """
    limits = Limits()
    known = limits.values()
    for pair in filter(None, map(str.strip, text.split(","))):
        name, _, stated = (part.strip() for part in pair.partition("="))
        if name not in known:
            raise ConfigError(
                f"{SETTING}: {pair[:80]!r} names no limit, expected pairs such as mesh.max_faces=4000000; "
                "stable-data limits lists all",
                "limits_invalid",
            )
        number = stated.replace("_", "")
        is_valid = number.isascii() and number.replace(".", "", 1).isdigit() and len(number) <= 18
        if isinstance(known[name], int):
            is_valid = is_valid and number.isdigit()
        if not is_valid or not float(number) > 0:
            what = "whole number" if isinstance(known[name], int) else "number"
            raise ConfigError(f"{SETTING}: {name} is {stated[:40]!r}, expected a {what} above 0", "limits_invalid")
        group, _, key = name.partition(".")
        changed: Any = {key: type(known[name])(number)}
        setattr(limits, group, replace(getattr(limits, group), **changed))
    return limits


def _limits_of_process() -> Limits:
    """The limits that :data:`SETTING` states; ends the program if it is wrong, because no part of it may run with other limits."""
    try:
        return read_limits(os.environ.get(SETTING, ""))
    except ConfigError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(2) from error


LIMITS = _limits_of_process()
"""The limits of this process."""


def at_most(group: Any, name: str, unit: str = "") -> str:
    """Says how much is allowed, with the name of the limit and of the setting that changes it.

    Args:
        group: A group of :data:`LIMITS`, or limits that a caller chose; of these, values of :data:`LIMITS` are named too.
        name: A field of it.
        unit: The unit, as a word of the message.

    Returns:
        Such as ``at most 1,000,000 faces (mesh.max_faces in STABLE_DATA_LIMITS)``; without the setting for a caller's own limits.
    """
    value = getattr(group, name)
    alike = {one.name: mine for one in fields(LIMITS) if type(mine := getattr(LIMITS, one.name)) is type(group)}
    own = next((known for known, mine in alike.items() if getattr(mine, name) == value), None)
    where = name if own is None else f"{own}.{name} in {SETTING}"
    number = f"{value:,}" if isinstance(value, int) else f"{value:g}"
    return f"at most {number}{unit and ' '}{unit} ({where})"


def worker_environment() -> Mapping[str, str]:
    """The environment variables that give a worker on another machine the limits of this process."""
    return {SETTING: os.environ[SETTING]} if os.environ.get(SETTING) else {}


@contextmanager
def memory_limited(num_bytes: int) -> Iterator[None]:
    """Bounds the memory that this process allocates in the body, beyond what it has already; on Linux, elsewhere nothing happens.

    The system refuses what exceeds the bound: Python and most libraries raise MemoryError, other code ends the process. Memory that
    is shared with other processes, or mapped from files, does not count, and neither does what an earlier body has freed to malloc,
    although the process keeps it: what a body may allocate does not depend on those before it. Only what Arrow keeps in its own
    pool can be used in addition, and by Arrow alone.

    Args:
        num_bytes: The bound.

    Raises:
        MemoryError: The body needs more, also in place of the error of a library that has another one for it.
    """
    used = _used_memory()
    if used is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    bounds = [bound for bound in (soft, hard, used + num_bytes) if bound != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))
    try:
        yield
    except Exception as error:
        if is_out_of_memory(error):
            raise MemoryError(str(error)) from error
        raise
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def map_large_arrays() -> None:
    """Gives each array of a mebibyte or more memory of its own, which the system gets back with the array; in this process from now on.

    Otherwise glibc takes freed arrays as a reason to raise that bound, up to 32 MiB. Arrays of many sizes then leave gaps between the
    small things in its heap: after 256 scenes the heap of a worker of ``generate`` has 1.3 GB, of which half is unused, instead of 0.5 GB.
    """
    if hasattr(_C, "mallopt"):  # of glibc
        _C.mallopt(_MMAP_THRESHOLD, MIB)


def release_free_memory() -> None:
    """Returns to the system what libraries have freed and keep, as far as they can; their addresses stay reserved.

    A long process calls it between its batches, when little is in use: small arrays of many sizes leave gaps in a heap, too. Objects that
    refer to each other in a circle are freed with it, once a minute at most: Python itself looks for them less and less often as a process
    grows, but looking takes about a second in a worker of ``generate``.
    """
    global _next_collection
    if (now := monotonic()) >= _next_collection:
        gc.collect()
        _next_collection = now + _COLLECTION_SECONDS
    arrow = sys.modules.get("pyarrow")
    if arrow is not None:
        arrow.default_memory_pool().release_unused()
    if hasattr(_C, "malloc_trim"):  # of glibc
        _C.malloc_trim(0)


def resident_memory() -> int | None:
    """The resident memory of this process, bytes; None if the system does not tell. Shared memory counts, too."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error says that memory ran out; torch and MuJoCo have no class of their own for it."""
    is_foreign = not isinstance(error, StableDataError)
    return isinstance(error, MemoryError) or (is_foreign and "allocate memory" in str(error))


def _used_memory() -> int | None:
    """What RLIMIT_DATA counts of this process, less what malloc keeps for later; bytes, None if it is unknown."""
    if not sys.platform.startswith("linux"):
        return None
    release_free_memory()
    try:
        with open("/proc/self/status", "rb") as status:  # noqa: PTH123 - called for each item
            counted = next((int(line.split()[1]) * KIB for line in status if line.startswith(b"VmData:")), None)
    except OSError:
        return None
    if counted is None or not hasattr(_C, "mallinfo2"):  # of glibc 2.33
        return counted
    _C.mallinfo2.restype = _MallocState
    return counted - int(_C.mallinfo2().fordblks)


class _MallocState(ctypes.Structure):
    """``struct mallinfo2`` of glibc; ``fordblks`` is what was freed and is used again before the system is asked for more."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    ]


_COLLECTION_SECONDS = 60.0
_next_collection = 0.0  # a moment of monotonic()

_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of mallopt(3)
_C: Any = ctypes.CDLL(None) if sys.platform.startswith("linux") else None
