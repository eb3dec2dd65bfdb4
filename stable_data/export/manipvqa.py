"""Exports scenes as a detection task in the form of ManipVQA: where is the handle of an object in a picture?

The paper's appendix on ManipVQA labels the handles of kettles and forks by hand. Here they follow from the parts of which the embedded
assets are made, drawn from the camera of the picture, so that a box is that of the pixels that are seen.
"""

import io
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from PIL import Image

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.embedded_world.handles import handle_of, is_of_handle
from stable_data.geometry.mesh import Mesh
from stable_data.rotations import rotate_xy
from stable_data.scene import Scene
from stable_data.simulation.render import View
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.segmentation import segment_scene
from stable_data.simulation.views import draw_geometry

SIZE = 640
"""Width and height of the pictures, pixels; square ones need no padding, on which the conventions of detectors differ."""

MIN_VISIBLE = 0.5
"""Smallest share of the pixels of a handle that nothing hides, for a question about it."""

MIN_PIXELS = 50
"""Fewest pixels of such a handle."""

QUESTIONS_FILE = "manipvqa.json"
"""The questions and answers of all scenes."""

ABOUT = f"""Pictures (`images/<scene>.png`, {SIZE} x {SIZE}, perspective view) and the handles in them. `{QUESTIONS_FILE}` has a
question and an answer for each, in the form of ManipVQA: the box as [left, top, right, bottom], shares of the picture. A handle is asked
for if it is the only one of its category in the picture, {MIN_VISIBLE:.0%} of it is visible and it has {MIN_PIXELS} pixels.
`boxes/<scene>.json` has all handles, in pixels, with the share that is visible. Handles are known of assets of the embedded world.
`stable-data score-boxes` scores the answers of a detector."""

_VIEW: View = "perspective"


PixelBox: TypeAlias = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class HandleBox:
    """The visible part of a handle in a picture.

    Attributes:
        instance: The object.
        category: Its category.
        box: Left, top, right, bottom of its visible pixels, pixels; right and bottom are beyond the last pixel.
        whole: The same of the whole object.
        pixels: Number of its visible pixels.
        visible: These as a share of its pixels if nothing else were there.
    """

    instance: str
    category: str
    box: PixelBox
    whole: PixelBox
    pixels: int
    visible: float

    @property
    def is_clear(self) -> bool:
        """Whether enough of it is visible to ask for it."""
        return self.visible >= MIN_VISIBLE and self.pixels >= MIN_PIXELS


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene that is written last: if it exists, the scene is exported."""
    return out / "boxes" / f"{safe_file_name(scene.scene_id)}.json"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, see :class:`~stable_data.export.formats.ExportFormat`."""
    scene = geometry.scene
    image = f"images/{safe_file_name(scene.scene_id)}.png"
    stream = io.BytesIO()
    Image.fromarray(draw_geometry(geometry, (SIZE, SIZE), _VIEW)).save(stream, "png")
    for folder in ("images", "boxes"):
        (out / folder).mkdir(exist_ok=True)
    write_file_atomically(out / image, stream.getvalue())
    content = {"scene_id": scene.scene_id, "image": image, "handles": [asdict(found) for found in handle_boxes(geometry)]}
    write_file_atomically(scene_path(scene, out), (json.dumps(content, indent=1) + "\n").encode())


def finish(out: Path) -> str | None:
    """Writes the questions of all scenes; returns a warning if there are none."""
    contents = [json.loads(path.read_text("utf-8")) for path in sorted((out / "boxes").glob("*.json"))]
    questions = [asked for content in contents for asked in _questions(content)]
    write_file_atomically(out / QUESTIONS_FILE, (json.dumps(questions, indent=1) + "\n").encode())
    if questions:
        return None
    count = sum(len(content["handles"]) for content in contents)
    why = (
        f"of the {count} handles that are seen, none is the only one of its category in its picture, {MIN_VISIBLE:.0%} visible and of "
        f"{MIN_PIXELS} pixels"
        if count
        else "no handle is seen; handles are known of assets of the embedded world alone, such as mugs, kettles and forks"
    )
    return f"{QUESTIONS_FILE} has 0 questions about {len(contents)} pictures: {why}"


def handle_boxes(geometry: SceneGeometry, size: int = SIZE) -> Iterator[HandleBox]:
    """Yields the handles that are seen in the picture of a scene.

    Args:
        geometry: The scene.
        size: Width and height of the picture, pixels.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    surfaces, owners = list[Mesh](), list[int]()
    for k, (o, shape) in enumerate(zip(geometry.scene.objects, geometry.shapes, strict=True)):
        handle = handle_of(o) if geometry.meshes[k] is not None else ()
        own = Mesh(shape.vertices, shape.faces)
        is_handle = is_of_handle(own, handle)
        placed = np.column_stack([rotate_xy(own.vertices[:, :2], o.yaw), own.vertices[:, 2]]) + o.position
        surfaces.append(Mesh(placed, own.faces[~is_handle]))
        owners.append(-1)
        if is_handle.any():
            surfaces.append(Mesh(placed, own.faces[is_handle]))
            owners.append(k)
    handles = [n for n, owner in enumerate(owners) if owner >= 0]
    if not handles:
        return
    seen = segment_scene(geometry, surfaces, size=(size, size), view=_VIEW)
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    for n in handles:
        is_seen = seen == n
        if not is_seen.any():
            continue
        alone = segment_scene(
            geometry, [s if m == n else nothing for m, s in enumerate(surfaces)], size=(size, size), view=_VIEW
        )
        o, count = geometry.scene.objects[owners[n]], int(is_seen.sum())
        whole = _box_of(is_seen | (seen == n - 1))  # the rest of the object is the surface before
        yield HandleBox(o.instance, o.category, _box_of(is_seen), whole, count, count / max(1, int((alone == n).sum())))


def question_about(category: str) -> str:
    """Returns the question about the handle of an object, as ManipVQA words it."""
    name = category.replace("_", " ")
    article = "an" if name[0] in "aeiou" else "a"
    return f"Please provide the bounding box coordinate of the region this sentence describes: handle of {article} {name}"


def _questions(content: dict[str, Any]) -> Iterator[dict[str, Any]]:
    handles = [HandleBox(**found) for found in content["handles"]]
    count = Counter(found.category for found in handles)
    for found in handles:
        if found.is_clear and count[found.category] == 1:
            answer = ", ".join(f"{value / SIZE:.3f}" for value in found.box)
            said = ({"from": "human", "value": question_about(found.category)}, {"from": "gpt", "value": f"[{answer}]"})
            size = {"width": SIZE, "height": SIZE}  # by which boxes in pixels are read
            yield {"image": content["image"], **size, "category": found.category, "conversations": list(said)}


def _box_of(is_seen: npt.NDArray[np.bool_]) -> PixelBox:
    rows, columns = np.nonzero(is_seen)
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1
