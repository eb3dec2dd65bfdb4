"""The files of a MuJoCo model: found by a scan of its XML before MuJoCo reads anything, so that no other file is read.

MuJoCo itself reads includes and meshes from any place of the disk. Here the XML is scanned first; each file that it names must lie
in the source folder. The model is then compiled from copies of these files in a folder of its own.
"""

import posixpath
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

from stable_data.errors import MeshError
from stable_data.importers.boundary import LONGEST_PATH, Boundary
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, FileLimits, at_most, is_out_of_memory, memory_limited

if TYPE_CHECKING:
    import mujoco  # takes long to import

_PNG = b"\x89PNG\r\n\x1a\n"
_COPYING = frozenset({"replicate", "composite", "flexcomp"})
FILE_ATTRIBUTES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of an element that name files."""

_FOLDERS_OF = {
    "mesh": ("meshdir", "assetdir"),
    "skin": ("meshdir", "assetdir"),
    "hfield": ("meshdir", "assetdir"),
    "flexcomp": ("meshdir", "assetdir"),
    "texture": ("texturedir", "assetdir"),
}


def file_reference(element: str, file: str, compiler: Mapping[str, str]) -> str:
    """Returns the name of a file as MuJoCo looks for it from the folder of the model.

    Args:
        element: The element that names it, such as ``mesh``.
        file: The name in the element.
        compiler: The attributes of ``compiler``, which may state a directory for the element.
    """
    name = file.replace("\\", "/")
    if compiler.get("strippath", "").lower() == "true":
        name = PurePosixPath(name).name
    folder = next((compiler[key] for key in _FOLDERS_OF.get(element, ()) if compiler.get(key)), "")
    return f"{folder}/{name}" if folder and not name.startswith("/") else name


def check_names(path: str, names: Collection[tuple[str, str]], compiler: Mapping[str, str], limits: FileLimits) -> None:
    """Refuses a model that names very many files, each of which is looked for, or that puts a very long directory before each name.

    Args:
        path: The model.
        names: Elements, such as ``mesh``, with the names of files in them, each once.
        compiler: The attributes of ``compiler``.
        limits: The limit on the number of files.

    Raises:
        MeshError: ``file_too_large`` or ``model_unreadable``.
    """
    if len(names) > limits.max_files:
        found = f"{quote_value(path)} names {len(names):,} files"
        raise MeshError(f"{found}, expected {at_most(limits, 'max_files')}; simplify it", "file_too_large")
    for key in sorted({key for keys in _FOLDERS_OF.values() for key in keys}):
        if len(compiler.get(key, "")) > LONGEST_PATH:
            found = f"{quote_value(path)} has a {key} of {len(compiler[key]):,} characters"
            raise MeshError(f"{found}, expected a path of at most {LONGEST_PATH:,}; correct it", "model_unreadable")


@dataclass(frozen=True, slots=True)
class StartTag:
    """A start tag of an XML file.

    Attributes:
        name: The element.
        attributes: Its attributes.
        offset: The byte at which it begins.
        parent: Index of the element that contains it; -1 for the root.
    """

    name: str
    attributes: Mapping[str, str]
    offset: int
    parent: int


@dataclass(frozen=True, slots=True, eq=False)
class ModelFiles:
    """All files of a model.

    Attributes:
        path: The main file, relative to the source folder.
        contents: Path, relative to the source folder and as MuJoCo looks for it -> content.
        elements: The elements of the main file and of what it includes, in the order in which MuJoCo reads them.
    """

    path: str
    contents: Mapping[str, bytes]
    elements: Sequence["Element"]

    @contextmanager
    def placed(self, changed: Mapping[str, bytes] | None = None) -> Iterator[Path]:
        """Copies the files to a temporary folder.

        Args:
            changed: Path -> content of files that replace those of the model.

        Yields:
            The main file; the folder ends with the context.
        """
        with TemporaryDirectory(prefix="stable-data-model-") as folder:
            for path, content in {**self.contents, **(changed or {})}.items():
                place = Path(folder, path)
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)
            yield Path(folder, self.path)


@dataclass(frozen=True, slots=True)
class Element:
    """An element of a model whose includes are replaced by what they include.

    Attributes:
        path: The file that has it.
        tag: Its start tag.
        parent: Index of the element that contains it, in the list of all; -1 for the root.
    """

    path: str
    tag: StartTag
    parent: int


def merged_elements(
    path: str, tags: Mapping[str, tuple[StartTag, ...]], included: Mapping[tuple[str, int], str]
) -> list[Element]:
    """Lists the elements of a model in the order in which MuJoCo reads them.

    Args:
        path: The main file.
        tags: Path of each XML file -> its start tags.
        included: File and index of each include -> the file that it includes.
    """
    found: list[Element] = []

    def add(document: str, above: int) -> None:
        number: dict[int, int] = {-1: above}
        for k, tag in enumerate(tags[document]):
            if k == 0 and document != path:
                number[0] = above  # the root of an included file is no element of the model
            elif (document, k) in included:
                number[k] = number[tag.parent]  # of what stands within it, which MuJoCo refuses
                add(included[document, k], number[tag.parent])
            else:
                number[k] = len(found)
                found.append(Element(document, tag, number[tag.parent]))

    add(path, -1)
    return found


@dataclass(slots=True)
class _Scan:
    boundary: Boundary
    contents: dict[str, bytes] = field(default_factory=dict)
    tags: dict[str, tuple[StartTag, ...]] = field(default_factory=dict)
    included: dict[tuple[str, int], str] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)  # a model that is attached -> its elements with their copies
    files: dict[str, bytes] = field(default_factory=dict)  # by where they lie; several names may mean one
    num_bytes: int = 0  # of contents, which are written to a folder one by one
    num_elements: int = 0  # of all models, with what they include


def collect_files(boundary: Boundary, path: str) -> ModelFiles:
    """Finds all files of a model, and reads them.

    Args:
        boundary: The source folder.
        path: The main file, relative to it.

    Raises:
        MeshError: A file cannot be read (``model_unreadable``), is missing (``include_missing``, ``file_missing``), lies outside of the
            folder (``path_outside``) or is too large (``file_too_large``), or files include each other (``cyclic_reference``).
    """
    scan = _Scan(boundary)
    elements, _ = _collect_model(scan, path, ())
    return ModelFiles(path, scan.contents, elements)


@contextmanager
def load_spec(boundary: Boundary, path: str) -> Iterator["mujoco.MjSpec"]:
    """Reads a model; nothing outside of the folder is read. The description can be compiled within the context.

    Args:
        boundary: The source folder.
        path: The main file, relative to it.

    Yields:
        The description, a ``mujoco.MjSpec``.

    Raises:
        MeshError: As :func:`collect_files`; or MuJoCo refuses the model (``model_unreadable``).
    """
    with collect_files(boundary, path).placed() as place:
        yield read_spec(place, path)


def read_spec(place: Path, path: str) -> "mujoco.MjSpec":
    """Reads the description of a model whose files were placed.

    Args:
        place: Its main file.
        path: The name of the file in messages.

    Raises:
        MeshError: As :func:`compile_model`.
    """
    from stable_data.simulation.mujoco_import import mujoco

    with _refusals(path):
        return mujoco.MjSpec.from_file(str(place))


def compile_model(spec: "mujoco.MjSpec", path: str) -> "mujoco.MjModel":
    """Compiles a description.

    Raises:
        MeshError: MuJoCo refuses the model (``model_unreadable``), or it needs too much memory (``file_too_large``).
    """
    with _refusals(path):
        return spec.compile()


@contextmanager
def _refusals(path: str) -> Iterator[None]:
    """Bounds the memory of MuJoCo, and turns its errors into that of a model which it refuses."""
    from stable_data.simulation.mujoco_import import mujoco, without_log_file

    try:
        with without_log_file(), memory_limited(LIMITS.scene_file.max_memory_bytes):
            yield
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        if is_out_of_memory(error):
            most = at_most(LIMITS.scene_file, "max_memory_bytes", "bytes")
            raise MeshError(
                f"{path}: MuJoCo needs more memory for it, expected {most}; make it smaller", "file_too_large"
            ) from error
        raise refused_model(path, error) from error


def refused_model(path: str, error: Exception) -> MeshError:
    """The error that MuJoCo refuses a model."""
    found = " ".join(str(error).split())[:300]
    if "unknown exception" in found:  # its own words ask to report it to its authors, whatever the file states
        found = "it does not say why; sizes in it may be too large"
    return MeshError(
        f"{path}: MuJoCo refuses the model ({found}), expected one that it compiles; repair it", "model_unreadable"
    )


def _num_copied(path: str, elements: Sequence[Element], attached: int) -> int:
    """Counts the elements of a model with the copies that others make of them; refuses very many out of a few words.

    Args:
        path: The model.
        elements: Its elements.
        attached: Elements of the largest model that it attaches, with their copies.
    """
    copies, num = [1] * len(elements), 0
    for k, element in enumerate(elements):
        count = 1
        for word in element.tag.attributes.get("count", "").split() if element.tag.name in _COPYING else ():
            try:
                count *= max(1, int(float(word)))
            except (ValueError, OverflowError):
                continue  # MuJoCo refuses it
        copies[k] = count * (copies[element.parent] if element.parent >= 0 else 1)
        if copies[k] > LIMITS.model.max_copies:
            found = f"element {element.tag.name} makes {copies[k]} copies"
            raise MeshError(
                f"{element.path}: {found}, expected {at_most(LIMITS.model, 'max_copies')}; make fewer", "file_too_large"
            )
        num += copies[k] * (attached if element.tag.name == "attach" else 1)
    if num > LIMITS.model.max_elements:
        found = f"{path}: has {num} elements with their copies"
        raise MeshError(f"{found}, expected {at_most(LIMITS.model, 'max_elements')}; make fewer", "file_too_large")
    return num


def _collect_model(scan: _Scan, path: str, above: tuple[str, ...]) -> tuple[list[Element], int]:
    """Collects a model file with what it includes, then the assets that all of these name.

    Returns:
        Its elements, and their number with copies.
    """
    _collect_document(scan, path, path, set(above))
    elements = merged_elements(path, scan.tags, scan.included)
    tags = [element.tag for element in elements]
    compiler: dict[str, str] = {}
    for tag in tags:
        if tag.name == "compiler":
            compiler |= tag.attributes
    folder, attached_elements = posixpath.dirname(path), 1
    files = (
        (tag.name, name) for tag in tags for key, name in tag.attributes.items() if key in FILE_ATTRIBUTES and name.strip()
    )
    names = dict.fromkeys(files)
    check_names(path, names, compiler, scan.boundary.limits)
    for kind, name in names:
        if kind == "model":
            attached = _place(scan, path, folder, name)
            if attached in (path, *above):
                raise _read_twice(path, attached)
            if attached not in scan.counted:
                scan.counted[attached] = _collect_model(scan, attached, (*above, path))[1]
            attached_elements = max(attached_elements, scan.counted[attached])
            continue
        _place(scan, path, folder, file_reference(kind, name, compiler))
    for element in elements:
        _check_size(element)
    return elements, _num_copied(path, elements, attached_elements)


def _check_size(element: Element) -> None:
    """Refuses an element that asks for very much in a few words: MuJoCo reserves it, or fills it, while it reads the file."""
    given = element.tag.attributes
    asked: tuple[float, Any, str]
    match element.tag.name:
        case "texture":
            width, is_flat = _largest(given, "width"), given.get("type") == "2d"
            asked = width * (_largest(given, "height") if is_flat else 6 * width), LIMITS.image, "max_pixels"
        case "hfield":
            asked = 2 * _largest(given, "nrow") * _largest(given, "ncol"), LIMITS.mesh, "max_faces"
        case "mesh" if "builtin" in given:
            asked = _largest(given, "params") ** 2, LIMITS.mesh, "max_faces"
        case "size":
            asked = _largest(given, "nkey"), LIMITS.scene_file, "max_poses"
        case _:
            return
    size, group, limit = asked
    if not size <= getattr(group, limit):
        found = f"element {element.tag.name} asks for {size:,.0f} {limit.removeprefix('max_')}"
        raise MeshError(f"{element.path}: {found}, expected {at_most(group, limit)}; make it smaller", "file_too_large")


def _largest(attributes: Mapping[str, str], name: str) -> float:
    """The largest number of an attribute; 0 if there is none, which MuJoCo refuses or has a small default for."""
    numbers = [0.0]
    for word in attributes.get(name, "").split():
        with suppress(ValueError):
            numbers.append(float(word))
    return max(numbers)


def _collect_document(scan: _Scan, main: str, path: str, seen: set[str]) -> None:
    if path in seen:  # MuJoCo refuses it too
        raise _read_twice(main, path)
    seen.add(path)
    if path not in scan.tags:
        content = scan.boundary.read_bytes(path, "max_xml_bytes")
        _keep(scan, path, content)
        scan.tags[path] = start_tags(content, path)
    scan.num_elements += len(scan.tags[path])
    if scan.num_elements > LIMITS.model.max_elements:
        found = f"{path}: is one of the files that models include, which have {scan.num_elements} elements"
        raise MeshError(f"{found}, expected {at_most(LIMITS.model, 'max_elements')}; make fewer", "file_too_large")
    for k, tag in enumerate(scan.tags[path]):
        if tag.name == "include":
            name = tag.attributes.get("file", "")
            # MuJoCo looks for includes of includes beside the main file too.
            place = _place(scan, path, posixpath.dirname(main), name, is_include=True)
            scan.included[path, k] = place
            _collect_document(scan, main, place, seen)


def _place(scan: _Scan, path: str, folder: str, reference: str, *, is_include: bool = False) -> str:
    """Reads a file that a model names, and returns the path at which MuJoCo looks for it, relative to the source folder."""
    try:
        found = scan.boundary.resolve(reference, folder)
    except MeshError as error:
        code = "include_missing" if is_include and error.code == "file_missing" else error.code
        raise MeshError(f"{path}: {error}", code) from error
    place = posixpath.normpath(posixpath.join(folder, reference.replace("\\", "/")))
    if place.startswith("../") or place == "..":
        raise MeshError(f"{path}: {quote_value(reference)} leaves the folder, expected a path inside of it", "path_outside")
    if place not in scan.contents:
        if found not in scan.files:
            scan.files[found] = scan.boundary.read_bytes(found)
        content = scan.files[found]
        _keep(scan, place, content)
        if _num_pixels(content) > LIMITS.image.max_pixels:
            most = at_most(LIMITS.image, "max_pixels", "pixels")
            raise MeshError(
                f"{path}: {quote_value(reference)} has more pixels, expected {most}; make it smaller", "file_too_large"
            )
    return place


def _keep(scan: _Scan, place: str, content: bytes) -> None:
    """Keeps a file under a name. The boundary counts it once, although it is written once for each of its names."""
    if place in scan.contents:
        return
    scan.contents[place] = content
    scan.num_bytes += len(content)
    limits = scan.boundary.limits
    if len(scan.contents) > limits.max_files or scan.num_bytes > limits.max_bytes:
        found = f"is one of {len(scan.contents)} names of files with {scan.num_bytes} bytes"
        most = f"{at_most(limits, 'max_bytes', 'bytes')} in {at_most(limits, 'max_files')} files for an asset"
        raise MeshError(f"{quote_value(place)} {found}, expected {most}", "file_too_large")


def _num_pixels(content: bytes) -> int:
    """The pixels of a PNG file as MuJoCo reads them, which has no limit of its own; 0 for other files."""
    if not content.startswith(_PNG):
        return 0
    return int.from_bytes(content[16:20], "big") * int.from_bytes(content[20:24], "big")


def _read_twice(path: str, other: str) -> MeshError:
    return MeshError(f"{path}: includes {other} twice or in a circle, expected once; remove an include", "cyclic_reference")


def start_tags(content: bytes, path: str) -> tuple[StartTag, ...]:
    """Lists the start tags of an XML file.

    Args:
        content: The file.
        path: Its name in messages.

    Raises:
        MeshError: It is not XML, declares entities, or is too deep or too large (``model_unreadable``).
    """
    found: list[StartTag] = []
    stack: list[int] = []
    parser = expat.ParserCreate()

    def start(name: str, attributes: dict[str, str]) -> None:
        for limit, count in (("max_elements", len(found)), ("max_element_levels", len(stack))):
            if count >= getattr(LIMITS.model, limit):
                what = "more elements" if limit == "max_elements" else "elements that nest deeper"
                raise MeshError(f"{path}: has {what}, expected {at_most(LIMITS.model, limit)}", "model_unreadable")
        found.append(StartTag(name, attributes, parser.CurrentByteIndex, stack[-1] if stack else -1))
        stack.append(len(found) - 1)

    def end(_: str) -> None:
        stack.pop()

    def declare(name: str, *_: object) -> None:
        raise MeshError(f"{path}: declares the entity {quote_value(name)}, expected none; remove it", "model_unreadable")

    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = start, end, declare
    try:
        parser.Parse(content, True)
    except MeshError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # also an encoding that is not known
        raise MeshError(f"{path}: is not XML ({error}), expected a MuJoCo model; repair it", "model_unreadable") from error
    return tuple(found)
