"""The layers of a USD file, loaded into memory with every reference inside the source folder.

USD composes a stage from whatever files its layers name, anywhere. So each layer is opened alone, as an anonymous layer; each name of
a layer in it is resolved by the boundary, loaded in the same way and replaced by the anonymous layer; all other names of files are
replaced by keys. The stage that USD then composes names no file at all.
"""

import io
import posixpath
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import PurePosixPath
from typing import Any

from stable_data.errors import ConfigError, MeshError, StableDataError
from stable_data.extras import install_hint
from stable_data.importers.boundary import Boundary
from stable_data.importers.usd.text_layers import check_brackets
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, SETTING, at_most

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""Files that are read."""

# The exceptions of reading values of other types than the schemas demand.
_PARSE_ERRORS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
_OUT_OF_MEMORY = "std::bad_alloc"  # what USD says then
_MOST_PATH = 4096  # characters of the path of a prim, which all prims below it repeat
_MEMBER = b"PK\x01\x02"  # what the entry of a member in the list of a package begins with


@contextmanager
def quiet_usd(path: str) -> Iterator[None]:
    """Keeps the messages of USD from the terminal and turns its exceptions into errors of the toolkit.

    Raises:
        MeshError: ``model_unreadable``.
        MemoryError: USD needs more than there is.
        ConfigError: usd-core is not installed.
    """
    try:
        from pxr import Tf, UsdUtils
    except ModuleNotFoundError as error:
        raise ConfigError(f"{path}: reading USD {install_hint(error) or error}", "package_missing") from error
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except StableDataError:
        raise
    except (Tf.ErrorException, Tf.CppException, *_PARSE_ERRORS) as error:
        reason = reason_of(error)
        if _OUT_OF_MEMORY in reason:
            raise MemoryError(reason) from error
        message = f"{quote_value(path)}: USD cannot read it ({reason}), expected a layer that it reads; export it again"
        raise MeshError(message, "model_unreadable") from error
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def reason_of(error: Exception) -> str:
    """Returns what USD says, without places in its code and on this machine, at most 300 characters."""
    try:
        text = " ".join(str(error).split())
    except UnicodeDecodeError:  # it quotes the file
        text = "no text"
    return re.sub(r"(?<=['@])/\S*/", "", text.rpartition(" : ")[2])[:300]


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """Where a file lies.

    Attributes:
        path: A file of the source folder, relative to it.
        member: The name within it, if it is a package (usdz); else empty.
    """

    path: str
    member: str = ""

    def __str__(self) -> str:
        return f"{self.path}[{self.member}]" if self.member else self.path


def _refusal(name: str, found: str, expected: str, code: str) -> MeshError:
    return MeshError(f"{quote_value(name)} {found}, expected {expected}", code)


@dataclass(slots=True)
class LayerLoader:
    """Loads the layers of one asset.

    Attributes:
        boundary: Where files may lie.
        layers: The layers that were loaded.
        names: Key of each file that is no layer, as the layers have it now -> the name that stood there, and the place of the layer.
    """

    boundary: Boundary
    layers: dict[Place, Any] = field(default_factory=dict)
    names: dict[str, tuple[str, Place]] = field(default_factory=dict)
    _packages: dict[str, zipfile.ZipFile] = field(default_factory=dict)

    def load(self, path: str) -> Any:
        """Loads a file with all layers that it needs.

        Returns:
            Its layer, a ``Sdf.Layer`` that lives as long as this loader.

        Raises:
            MeshError: ``model_unreadable``, ``model_unsupported``, ``cyclic_reference``, ``mesh_too_large``, or a code of the boundary.
        """
        layer = self._load(self.place(path), ())
        check_prims(layer, path, {one.identifier: one for one in self.layers.values()})
        return layer

    def read_file(self, key: str, limit: str, group: Any) -> bytes:
        """Reads a file that is no layer.

        Args:
            key: As the layers name it now.
            limit: The limit on its size.
            group: The group of limits that has it.

        Raises:
            MeshError: A code of the boundary.
        """
        if key not in self.names:
            raise _refusal(key, "is not named by a layer", "a file of a layer", "file_missing")
        name, place = self.names[key]
        found = self.resolve(name, place)
        if not found.member:
            return self.boundary.read_bytes(found.path, limit, group)
        content = self._member(found)
        if len(content) > getattr(group, limit):
            raise _refusal(str(found), "is larger", at_most(group, limit, "bytes"), "file_too_large")
        return content

    def resolve(self, name: str, place: Place) -> Place:
        """Where a name of a layer points to.

        Raises:
            MeshError: ``path_outside``, ``file_missing``, or ``model_unsupported`` for a pattern of names.
        """
        if "<UDIM>" in name:
            raise _refusal(name, "is a pattern for several images", "the name of a file", "model_unsupported")
        file, _, member = name.removesuffix("]").partition("[") if name.endswith("]") else (name, "", "")
        if place.member:
            return self._within(name, place)
        return self.place(self.boundary.resolve(file, PurePosixPath(place.path).parent.as_posix()), member)

    def opened(self, place: Place) -> Any:
        """Opens a layer alone, without what it names.

        Raises:
            MeshError: ``model_unreadable`` or a code of the boundary.
        """
        from pxr import Sdf

        if PurePosixPath(place.member or place.path).suffix.lower() not in SUFFIXES[:3]:
            raise _refusal(str(place), "is no layer", f"a file of the kinds {', '.join(SUFFIXES)}", "model_unreadable")
        content = self._member(place) if place.member else self.boundary.read_bytes(place.path)  # counted, and not too large
        check_brackets(content, str(place))
        with quiet_usd(str(place)):
            layer = Sdf.Layer.OpenAsAnonymous(str(Place(str(self.boundary.root / place.path), place.member)))
        if layer is None:
            raise _refusal(str(place), "is no layer that USD can read", "a layer of USD; export it again", "model_unreadable")
        return layer

    def _load(self, place: Place, trail: tuple[Place, ...]) -> Any:
        from pxr import UsdUtils

        if place in trail or len(trail) > LIMITS.model.max_layer_levels:
            found = "is part of itself" if place in trail else f"is at the end of {len(trail)} layers, each within the other"
            most = at_most(LIMITS.model, "max_layer_levels", "levels")
            raise _refusal(str(place), found, f"layers without circles, {most}", "cyclic_reference")
        if place in self.layers:
            return self.layers[place]
        if len(self.layers) >= LIMITS.model.max_layers:
            most = at_most(LIMITS.model, "max_layers")
            raise _refusal(str(place), "is one of more layers", f"{most}; flatten the asset", "file_too_large")
        layer = self.opened(place)
        parts, others = layer_names(layer)
        anonymous = {name: self._load(self.resolve(name, place), (*trail, place)).identifier for name in parts}
        identifiers = {"", *anonymous.values()}
        for name in others:
            key = f"held-{len(self.names)}{PurePosixPath(name).suffix.lower()}"
            self.names[key] = name, place
            anonymous[name] = key
        with quiet_usd(str(place)):
            UsdUtils.ModifyAssetPaths(layer, lambda name: anonymous.get(name, ""))
        left = set(layer.GetCompositionAssetDependencies()) - identifiers
        if left:
            raise _refusal(
                str(place), f"names a layer that is not followed, {quote_value(min(left))}", "a reference", "model_unsupported"
            )
        self.layers[place] = layer
        return layer

    def place(self, path: str, member: str = "") -> Place:
        """A file, or the member of a package: the first one if none is named."""
        if PurePosixPath(path).suffix.lower() != ".usdz":
            if member:
                raise _refusal(f"{path}[{member}]", "is no package", "a usdz file", "file_missing")
            return Place(path)
        names = self._package(path).namelist()
        if member and member not in names:
            raise _refusal(f"{path}[{member}]", "does not exist", "a member of the package", "file_missing")
        return Place(path, member or names[0])

    def _within(self, name: str, place: Place) -> Place:
        """A name within a package, seen from one of its members, or from its root."""
        folder = PurePosixPath(place.member).parent
        for base in dict.fromkeys((folder, PurePosixPath())):
            member = posixpath.normpath((base / name.replace("\\", "/")).as_posix())
            if name.startswith("/") or ":" in name or member.startswith("../"):
                raise _refusal(name, "leaves the package", "a path inside of it", "path_outside")
            if member in self._package(place.path).namelist():
                return Place(place.path, member)
        raise _refusal(name, "does not exist", f"a member of the package {quote_value(place.path)}", "file_missing")

    def _package(self, path: str) -> zipfile.ZipFile:
        if path not in self._packages:
            content = self.boundary.read_bytes(path)
            most = f"1 to {LIMITS.model.max_members} (model.max_members in {SETTING})"
            if content.count(_MEMBER) > LIMITS.model.max_members:  # a list of millions would fill the memory
                raise _refusal(path, "has more members", most, "model_unreadable")
            try:
                package = zipfile.ZipFile(io.BytesIO(content))
            except (zipfile.BadZipFile, ValueError, OverflowError, NotImplementedError) as error:
                message = f"{quote_value(path)} is no package ({error}), expected a usdz file; export it again"
                raise MeshError(message, "model_unreadable") from error
            members = package.infolist()
            if not members:
                raise _refusal(path, "has no members", most, "model_unreadable")
            if any(member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1 for member in members):
                raise _refusal(
                    path, "has compressed or encrypted members", "a usdz file, which stores them plainly", "archive_bomb"
                )
            if sum(member.file_size for member in members) > len(content):
                raise _refusal(path, "states larger members than it has bytes", "a usdz file", "archive_bomb")
            self._packages[path] = package
        return self._packages[path]

    def _member(self, place: Place) -> bytes:
        try:
            return self._package(place.path).read(place.member)
        except (KeyError, zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
            raise MeshError(f"{quote_value(str(place))} cannot be read ({error})", "file_missing") from error


def layer_names(layer: Any) -> tuple[list[str], list[str]]:
    """Returns the names of files in a layer as they stand there: those of layers that are composed into it, and all others.

    Value clips, which change over time and are found by patterns, are removed from the layer. Names that are computed are replaced by
    what the layer's own variables make of them.
    """
    from pxr import Sdf, UsdUtils

    with_clips = list[Any]()

    def look(path: Any) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec) and spec.HasInfo("clips"):
            with_clips.append(spec)

    layer.Traverse(Sdf.Path.absoluteRootPath, look)
    for spec in with_clips:
        spec.ClearInfo("clips")
    names = dict[str, None]()

    def note(name: str) -> str:
        names[name] = None
        return name

    UsdUtils.ModifyAssetPaths(layer, note)
    parts = set(filter(None, layer.GetCompositionAssetDependencies()))  # an empty name means the layer itself
    return sorted(parts), [name for name in names if name and name not in parts]


def check_prims(layer: Any, path: str, layers: Mapping[str, Any]) -> None:
    """Refuses a layer that composes very many prims, before USD composes them: few words can ask for any number.

    Args:
        layer: The layer, a ``Sdf.Layer``.
        path: Its file, for the message.
        layers: The layers that it composes, by the names with which layers refer to each other.

    Raises:
        MeshError: ``mesh_too_large``, or ``model_unreadable`` where prims nest too deep or their paths are too long.
    """
    _PrimCount(path, layers).check(layer)


def _check_length(path: str, length: int) -> None:
    """Refuses a long path: thousands of prims below it would each take as much memory."""
    if length > _MOST_PATH:
        found = f"{quote_value(path)} composes a prim whose path has {length:,} characters"
        raise MeshError(f"{found}, expected at most {_MOST_PATH:,}; rename it", "model_unreadable")


@dataclass(slots=True)
class _PrimCount:
    """Estimates the prims of a stage, and their longest path, from above."""

    path: str
    by_name: Mapping[str, Any]
    known: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    stacks: dict[str, list[Any]] = field(default_factory=dict)

    def check(self, layer: Any) -> None:
        num = 0
        for prim in self._roots(layer):
            below, rest = self._below(layer, prim)
            num += below
            _check_length(prim, len(prim) + rest)
        if num > LIMITS.model.max_prims:
            raise self._too_many()

    def _too_many(self) -> MeshError:
        most = at_most(LIMITS.model, "max_prims")
        return MeshError(f"{quote_value(self.path)} composes more prims, expected {most}; simplify it", "mesh_too_large")

    def _stack(self, layer: Any) -> list[Any]:
        """A layer with its sublayers and theirs, each as often as it is named."""
        if layer.identifier in self.stacks:
            return self.stacks[layer.identifier]
        self.stacks[layer.identifier] = stack = [layer]
        for one in stack:
            stack += [self.by_name[name] for name in one.subLayerPaths if name in self.by_name]
            if len(stack) > LIMITS.model.max_layers:
                most = at_most(LIMITS.model, "max_layers")
                raise MeshError(f"a layer has more sublayers, expected {most}; flatten it", "mesh_too_large")
        return stack

    def _roots(self, layer: Any) -> list[str]:
        return sorted({str(prim.path) for one in self._stack(layer) for prim in one.rootPrims})

    def _below(self, layer: Any, path: str, depth: int = 0) -> tuple[int, int]:
        """Prims at and below a path of a layer with its sublayers, at most a little more than the limit; and how long their paths go on."""
        _check_length(path, len(path))
        key = layer.identifier, path
        if key in self.known:
            return self.known[key]
        if len(self.known) > 2 * LIMITS.model.max_prims:  # nearly all of them count
            raise self._too_many()
        if depth > LIMITS.model.max_prim_levels:
            most = at_most(LIMITS.model, "max_prim_levels", "levels")
            raise MeshError(f"{quote_value(path)} is nested too deep, expected {most}", "model_unreadable")
        self.known[key] = 0, 0  # a circle adds nothing
        specs = [spec for one in self._stack(layer) if (spec := one.GetPrimAtPath(path)) is not None]
        above = path.rpartition("/")[0]
        # Without a spec, what it is comes from a reference above.
        num, rest = (1, 0) if specs or not above else self._below(layer, above, depth + 1)
        for spec in specs:
            variants = [variant.primSpec for choices in spec.variantSets for variant in choices.variants]
            for part in (spec, *variants):
                children = ((layer, str(child.path), len(child.name) + 1) for child in part.nameChildren)
                targets = ((*target, 0) for target in self._targets(layer, part))
                for owner, place, length in chain(children, targets):
                    more, longer = self._below(owner, place, depth + 1)
                    num, rest = num + more, max(rest, length + longer)
        self.known[key] = min(num, LIMITS.model.max_prims + 1), rest
        return self.known[key]

    def _targets(self, layer: Any, spec: Any) -> Iterator[tuple[Any, str]]:
        for arc in (*spec.referenceList.GetAddedOrExplicitItems(), *spec.payloadList.GetAddedOrExplicitItems()):
            target = self.by_name.get(arc.assetPath) if arc.assetPath else layer
            if target is not None:
                path = str(arc.primPath) or f"/{target.defaultPrim}"
                if path != "/":
                    yield target, path
        for arc in (*spec.inheritPathList.GetAddedOrExplicitItems(), *spec.specializesList.GetAddedOrExplicitItems()):
            yield layer, str(arc)
