"""The metric card: the figures of one scene, columns of the ``scenes`` table."""

from dataclasses import dataclass, replace

from stable_data.scene import RelationKind, Scene, Stage


@dataclass(frozen=True, slots=True)
class MetricCard:
    """The figures of a scene (docs/audit.md). None is unknown.

    Attributes:
        num_objects: Objects.
        num_stacked: Objects that stand on another one.
        num_contained: Objects that are in another one.
        num_tilted: Objects tilted by more than 5 degrees.
        num_without_mesh: Objects whose mesh is missing or broken.
        num_unknown_pairs: Pairs that could not be judged.
        num_collisions: Pairs that collide deeper than 0.5 mm, of those that could be judged.
        oc: Share of pairs that collide deeper than 0.5 mm.
        oc_0mm: The same at 0 mm: the meshes touch.
        oc_1mm: At 1 mm.
        oc_10mm: At 10 mm.
        max_penetration_mm: Deepest object-object penetration.
        table_penetration_mm: Deepest object-table penetration.
        float_rate: Share of objects that float.
        max_gap_mm: The paper's largest gap.
        out_of_bounds_rate: Share of objects that leave the table or enter the restricted zone.
        clean: Nothing collides, floats, sinks or is out of bounds at 0.5 mm.
        relations_kept_on_in: Share of the on and in relations of the input that still hold; null where none held or nothing was corrected.
        relations_kept_directional: The same of the directional ones.
        move_mean_mm: Mean displacement of the objects by the correction; null where nothing was corrected.
        move_max_mm: The largest of them.
        turn_max_deg: Largest turn of an object by the correction, degrees.
        awt: Share of the objects that the instruction asks for that are there; null where it asks for nothing known.
        aws: Share of the relations that the instruction says of the start that hold; null where it says none.
        distractor_rate: Share of the objects that are not task objects; null without a task.
        engine_penetration_mm: Deepest contact at the start in the physics engine; null where it was not asked, like all that follows.
        settle_move_max_mm: Farthest that an object ever was from its start.
        settle_turn_max_deg: Farthest that an object ever was turned from its start, degrees.
        drift_mm: Farthest that an object went after the settling.
        jitter_mm: Farthest that an object was from its own mean position in the last second; what sleeps does not tremble.
        stable: Nothing moved more than 10 mm, turned more than 5 degrees or drifted 50 mm in it.
    """

    num_objects: int
    num_stacked: int | None
    num_contained: int | None
    num_tilted: int
    num_without_mesh: int
    num_unknown_pairs: int
    num_collisions: int
    oc: float | None
    oc_0mm: float | None
    oc_1mm: float | None
    oc_10mm: float | None
    max_penetration_mm: float | None
    table_penetration_mm: float
    float_rate: float | None
    max_gap_mm: float | None
    out_of_bounds_rate: float | None
    clean: bool | None
    relations_kept_on_in: float | None = None
    relations_kept_directional: float | None = None
    move_mean_mm: float | None = None
    move_max_mm: float | None = None
    turn_max_deg: float | None = None
    awt: float | None = None
    aws: float | None = None
    distractor_rate: float | None = None
    engine_penetration_mm: float | None = None
    settle_move_max_mm: float | None = None
    settle_turn_max_deg: float | None = None
    drift_mm: float | None = None
    jitter_mm: float | None = None
    stable: bool | None = None


def with_counts(card: MetricCard, scene: Scene) -> MetricCard:
    """The card with the counts that need relations and stages: stacked and contained objects, and the share of distractors.

    Args:
        card: The card of the scene.
        scene: The scene with its ``on`` and ``in`` relations and its stages.
    """
    names, stages = {o.instance for o in scene.objects}, [o.stage for o in scene.objects]
    contained, stacked = (
        {r.subject for r in scene.relations if r.kind is kind and r.target in names}
        for kind in (RelationKind.IN, RelationKind.ON)
    )
    away = None if not stages or None in stages else sum(stage is not Stage.TASK for stage in stages) / len(stages)
    return replace(card, num_stacked=len(stacked - contained), num_contained=len(contained), distractor_rate=away)
