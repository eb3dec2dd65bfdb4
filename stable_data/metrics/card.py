"""The metric card: the metrics of one scene, columns of the table ``scenes``."""

from dataclasses import dataclass, field, replace

from stable_data.scene import RelationKind, Scene


def _about(meaning: str, unit: str = "") -> dict[str, str]:
    """Metadata of a field, which become the metadata of its column (``stable_data.storage.schemas``)."""
    return {"meaning": meaning, "unit": unit}


@dataclass(frozen=True, slots=True)
class MetricCard:
    """The metrics of a scene; exact definitions are in docs/audit.md. None is unknown.

    The metadata of each field state its meaning and unit.
    """

    num_objects: int = field(metadata=_about("number of objects"))
    num_stacked: int | None = field(
        metadata=_about("number of objects that stand on another object; null where the supports are unknown")
    )
    num_contained: int | None = field(
        metadata=_about("number of objects inside another object; null where the supports are unknown")
    )
    num_tilted: int = field(metadata=_about("number of objects that are tilted by more than 5 degrees"))
    num_without_mesh: int = field(metadata=_about("number of objects whose mesh is missing or broken"))
    num_unknown_pairs: int = field(metadata=_about("number of object pairs that could not be judged"))
    num_collisions: int = field(metadata=_about("number of judged object pairs that collide deeper than 0.5 mm"))
    oc: float | None = field(metadata=_about("object collision rate: share of object pairs that collide deeper than 0.5 mm"))
    oc_0mm: float | None = field(metadata=_about("share of object pairs whose meshes touch or overlap (tolerance 0 mm)"))
    oc_1mm: float | None = field(metadata=_about("share of object pairs that collide deeper than 1 mm"))
    oc_10mm: float | None = field(metadata=_about("share of object pairs that collide deeper than 10 mm"))
    max_penetration_mm: float | None = field(metadata=_about("deepest penetration between two objects", "mm"))
    table_penetration_mm: float = field(metadata=_about("deepest penetration of an object into the table", "mm"))
    float_rate: float | None = field(metadata=_about("share of objects that float"))
    max_gap_mm: float | None = field(
        metadata=_about("largest vertical gap between an object and its support, as the paper defines it", "mm")
    )
    out_of_bounds_rate: float | None = field(
        metadata=_about("share of objects that leave the table or enter the restricted zone")
    )
    clean: bool | None = field(
        metadata=_about(
            "true where no object collides, floats, sinks into the table or is out of bounds, at a tolerance of 0.5 mm"
        )
    )
    float_gap: float | None = field(
        default=None,
        metadata=_about("share of objects that float by the paper's rule: the gap to their support is over 0.5 mm"),
    )
    oc_sdf: float | None = field(
        default=None,
        metadata=_about(
            "share of object pairs that collide by the paper's rule: a sample of the surface of one is inside the other; null where"
            " not computed"
        ),
    )
    relations_kept_on_in: float | None = field(
        default=None,
        metadata=_about(
            "share of the on and in relations of the input that still hold; null where none held or nothing was corrected"
        ),
    )
    relations_kept_directional: float | None = field(
        default=None,
        metadata=_about(
            "share of the directional relations of the input that still hold; null where none held or nothing was corrected"
        ),
    )
    move_mean_mm: float | None = field(
        default=None, metadata=_about("mean displacement of the objects by the correction; null where not corrected", "mm")
    )
    move_max_mm: float | None = field(
        default=None, metadata=_about("largest displacement of an object by the correction; null where not corrected", "mm")
    )
    turn_max_deg: float | None = field(
        default=None, metadata=_about("largest change of yaw of an object by the correction; null where not corrected", "deg")
    )
    awt: float | None = field(
        default=None,
        metadata=_about(
            "share of the objects required by the instruction, by its labels, that are in the scene; null where it has no labels"
        ),
    )
    aws: float | None = field(
        default=None,
        metadata=_about(
            "share of the relations stated by the instruction, by its labels, that hold in the scene; null where it has no labels or"
            " states none"
        ),
    )
    awt_annotated: float | None = field(
        default=None,
        metadata=_about(
            "awt where the labels are of a scene, or of the composition for which a task was drawn; null for other tasks"
        ),
    )
    aws_graph: float | None = field(
        default=None,
        metadata=_about(
            "share of the labelled scene graph between the task objects that holds; null where the labels have no graph"
        ),
    )
    awt_understood: float | None = field(
        default=None,
        metadata=_about(
            "share of the objects required by the instruction, as it was read, that are in the scene; null where it mentions no known"
            " object"
        ),
    )
    aws_understood: float | None = field(
        default=None,
        metadata=_about(
            "share of the relations stated by the instruction, as it was read, that hold in the scene; null where it states none"
        ),
    )
    read_as_labelled: bool | None = field(
        default=None,
        metadata=_about(
            "whether the instruction, as it was read, requires the objects and relations of its labels; null without labels or reading"
        ),
    )
    distractor_rate: float | None = field(
        default=None,
        metadata=_about(
            "share of the objects that match no object required by the instruction, by its labels; null where it has no labels"
        ),
    )
    engine_penetration_mm: float | None = field(
        default=None, metadata=_about("deepest contact at the start of the physics simulation; null where not simulated", "mm")
    )
    settle_move_max_mm: float | None = field(
        default=None,
        metadata=_about(
            "largest distance of an object from its start position during the simulation; null where not simulated", "mm"
        ),
    )
    settle_turn_max_deg: float | None = field(
        default=None,
        metadata=_about(
            "largest rotation of an object from its start orientation during the simulation; null where not simulated", "deg"
        ),
    )
    drift_mm: float | None = field(
        default=None,
        metadata=_about("largest displacement of an object after the settling phase; null where not simulated", "mm"),
    )
    jitter_mm: float | None = field(
        default=None,
        metadata=_about(
            "largest distance of an object from its mean position in the last second after the settling phase, or in all of that time "
            "if it was shorter, 0 for a sleeping body; null where not simulated",
            "mm",
        ),
    )
    stable: bool | None = field(
        default=None,
        metadata=_about(
            "true where no object moved more than 10 mm, turned more than 5 degrees or drifted 50 mm; null where not simulated"
        ),
    )


def add_counts(card: MetricCard, scene: Scene) -> MetricCard:
    """Adds the numbers of stacked and contained objects; the scene needs its ``on`` and ``in`` relations."""
    names = {o.instance for o in scene.movable}
    contained, stacked = (
        {r.subject for r in scene.relations if r.kind is kind and r.target in names}
        for kind in (RelationKind.IN, RelationKind.ON)
    )
    return replace(card, num_stacked=len(stacked - contained), num_contained=len(contained))
