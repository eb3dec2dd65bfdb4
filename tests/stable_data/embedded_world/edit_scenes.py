"""Rows of ``scenes`` of the embedded world, made without a run."""

from dataclasses import replace

from stable_data.embedded_world.scenes import EmbeddedScene, graph_of, make_scene
from stable_data.embedded_world.settling import audit
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_row


def row_of(made: EmbeddedScene, split: str = "train") -> Row:
    """What preprocess would write of a scene, as far as edits ask for it."""
    judged = audit(made.scene, made.placed)
    graph = graph_of(made.scene, judged, made.placed)
    objects = tuple(replace(o, support=graph.nodes[o.instance]["support"]) for o in made.scene.objects)
    return scene_row(replace(made.scene, objects=objects)) | {"split": split, "verdicts": judged.rows()["verdicts"]}


def made_scenes(*numbers: int, seed: int = 8) -> list[EmbeddedScene]:
    """Scenes of a set."""
    return [make_scene(number, seed=seed) for number in numbers]
