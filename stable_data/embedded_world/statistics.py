"""Statistics of a set: objects, sizes, tilts, stacking and near-duplicates, beside the known values of MesaTask-10K."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from stable_data.diversity.layout_similarity import SceneLayouts, near_duplicates
from stable_data.embedded_world.scenes import RECORD
from stable_data.scene import FloatArray, Scene

_TILTED = 1.0  # degrees
_UNEVEN = 1.02  # largest component of a scale over the smallest

MESATASK: Mapping[str, str] = MappingProxyType(
    {
        "scenes": "about 10,700",
        "assets in use": "over 12,000",
        "objects per scene, mean": "about 15",
        "objects per scene, fewest to most": "4 to 28 ¹",
        "table width, cm": "49 to 160, median 103 ¹",
        "table depth, cm": "42 to 102, median 66 ¹",
        "objects tilted by more than 1°": "20 % ¹",
        "objects scaled unevenly by more than 2 %": "16 % ¹",
    }
)
"""Known values of MesaTask-10K, from its paper; ¹: office tables only, a sample of 162."""


@dataclass(frozen=True, slots=True)
class SceneCounts:
    """The counts of one scene for the statistics.

    Attributes:
        scene_id: The scene.
        table_type: Kind of table.
        table_size: Width and depth, metres.
        categories: Categories of the objects, sorted.
        positions: Positions of the objects in the order of ``categories``, (N, 3) float64, metres.
        longest: Longest side of each object, metres.
        assets: Asset ids.
        num_tilted: Objects tilted by more than 1 degree.
        num_uneven: Objects whose scale differs between axes by more than 2 %.
        num_stacked: Objects on another object, as recorded.
        num_contained: Objects in another object, as recorded.
        depth: Length of the longest support chain, as recorded.
    """

    scene_id: str
    table_type: str
    table_size: tuple[float, float]
    categories: tuple[str, ...]
    positions: FloatArray
    longest: tuple[float, ...]
    assets: tuple[str, ...]
    num_tilted: int
    num_uneven: int
    num_stacked: int
    num_contained: int
    depth: int


def count_scene(scene: Scene) -> SceneCounts:
    """Counts a scene of the embedded world."""
    objects = sorted(scene.objects, key=lambda o: (o.category, o.position))
    record = (scene.source or {}).get(RECORD, {})
    return SceneCounts(
        scene.scene_id,
        scene.table.table_type,
        scene.table.size_xy,
        tuple(o.category for o in objects),
        np.array([o.position for o in objects]),
        tuple(max(o.size) for o in objects),
        tuple(o.asset_id or "" for o in objects),
        sum(bool(np.degrees(o.tilt_angle) > _TILTED) for o in objects),
        sum(o.scale is not None and max(o.scale) > _UNEVEN * min(o.scale) for o in objects),
        int(record.get("stacked", 0)),
        int(record.get("contained", 0)),
        int(record.get("depth", 0)),
    )


def summarise_counts(scenes: Sequence[SceneCounts]) -> dict[str, str]:
    """The statistics of a set by name, as text."""
    count = np.array([len(s.categories) for s in scenes])
    num_objects = int(count.sum())
    width, depth = 100 * np.array([s.table_size for s in scenes]).T
    longest = 100 * np.concatenate([s.longest for s in scenes])
    categories = Counter(c for s in scenes for c in s.categories)
    twins = scenes_with_duplicates(scenes)
    return {
        "scenes": f"{len(scenes):,}",
        "assets in use": f"{len({a for s in scenes for a in s.assets}):,}",
        "categories in use": f"{len(categories)}",
        "objects per scene, mean": f"{count.mean():.1f}",
        "objects per scene, fewest to most": f"{count.min()} to {count.max()}",
        "table width, cm": _range(width),
        "table depth, cm": _range(depth),
        "longest side of an object, cm": _range(longest),
        "objects tilted by more than 1°": f"{100 * sum(s.num_tilted for s in scenes) / num_objects:.0f} %",
        "objects scaled unevenly by more than 2 %": f"{100 * sum(s.num_uneven for s in scenes) / num_objects:.0f} %",
        "scenes with an object on an object": _share(s.num_stacked > 0 for s in scenes),
        "scenes with an object in an object": _share(s.num_contained > 0 for s in scenes),
        "scenes with three or more nesting levels": _share(s.depth >= 3 for s in scenes),
        "objects on or in another": f"{100 * sum(s.num_stacked + s.num_contained for s in scenes) / num_objects:.0f} %",
        "scenes with a near-duplicate": _share(s.scene_id in twins for s in scenes),
    }


def _range(values: FloatArray) -> str:
    return f"{values.min():.0f} to {values.max():.0f}, median {np.median(values):.0f}"


def _share(flags: Iterable[bool]) -> str:
    values = list(flags)
    share = 100 * sum(values) / len(values)
    return f"{share:.0f} %" if share >= 10 or share == 0 else f"{share:.2g} %"


def scenes_with_duplicates(scenes: Sequence[SceneCounts]) -> frozenset[str]:
    """Scenes that have a near-duplicate: the same categories, each object within 2 cm of its counterpart."""
    layouts = SceneLayouts.from_lists((s.table_type, s.table_size, s.categories, s.positions) for s in scenes)
    return frozenset(scenes[k].scene_id for k in np.unique(near_duplicates(layouts, share=1.0)).tolist())


_FRONT_MATTER = """---
pretty_name: A set of the embedded world
license: apache-2.0
language: en
task_categories:
- robotics
tags:
- tabletop-scenes
- simulation
- synthetic-data
size_categories:
- {size}
viewer: false
---
"""
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))
_LARGEST = "1M<n<10M"
_TEXT = """# A set of the embedded world

Tabletop scenes with parametric assets, made by `stable-data synth`. Every scene is at rest in MuJoCo, passes the exact audit, and has an
instruction whose statements are true in it. `synth.json` has the settings; scene k depends only on them and on k.

| path | content |
|---|---|
| `Layout_info/<table>/<scene>/` | `layout.json`, `task_info.json`, and `front.png` if pictures were made |
| `Assets_library/`, `Asset_annotation.json` | meshes with their convex parts (GLB), and what is known of each |
| `Edit_info/`, `edits.jsonl` | edits, if they were asked for |

The format is that of MesaTask-10K, of which nothing is in the set. Licence: Apache-2.0, for scenes, assets, texts and pictures.

## Limits

The scenes have the habits of a program, not of people: groups and themes recur, and an object stands where its rule puts it.
Categories, colours and words are those of the program. Meshes are simple and have colours in place of textures. A model that was
trained on this set alone knows nothing of scanned objects.

## Figures
"""


def dataset_card(scenes: Sequence[SceneCounts], sheet: str | None = None) -> str:
    """The dataset card, Markdown with the metadata that Hugging Face reads.

    It has the statistics beside MesaTask-10K's, tables, categories, limits and a link to a picture sheet.
    """
    size = next((name for bound, name in _SIZES if len(scenes) < bound), _LARGEST)
    lines = [_FRONT_MATTER.format(size=size), _TEXT]
    lines += ["| | this set | MesaTask-10K |", "|---|---|---|"]
    lines += [f"| {name} | {value} | {MESATASK.get(name, 'not known')} |" for name, value in summarise_counts(scenes).items()]
    lines += ["", "¹ Only office tables: a sample of 162.", ""]
    lines += ["## Kinds of table", "", "| table | scenes | objects per scene |", "|---|---|---|"]
    counts: dict[str, list[int]] = defaultdict(list)
    for scene in scenes:
        counts[scene.table_type].append(len(scene.categories))
    lines += [f"| {table_type} | {len(found)} | {np.mean(found):.1f} |" for table_type, found in sorted(counts.items())]
    lines += ["", f"![scenes of the set]({sheet})"] if sheet else []
    uses = Counter(c for s in scenes for c in s.categories)
    lines += ["", "## Categories", "", ", ".join(f"{category} {count}" for category, count in uses.most_common()), ""]
    return "\n".join(lines)
