"""Draws scenes of a run, as on its report page: PNG files named after the scenes.

python -m examples.draw_scenes RUN OUT [SCENE ...]
"""

import sys
from pathlib import Path

from PIL import Image

from pipelines.reports.scene_pictures import draw_scene
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder

SIZE = (480, 300)  # width and height, pixels


def main(place: str, out: str, *scene_ids: str) -> None:
    """Draws the scenes.

    Args:
        place: A run folder or its URI.
        out: The folder of the pictures.
        scene_ids: The scenes; none: all.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    scenes = RunScenes(RunFolder(place), SceneSelection(scene_ids=scene_ids))
    for scene in scenes:
        picture = Image.fromarray(draw_scene(scene, scenes.store, SIZE))
        picture.quantize(256).save(folder / f"{scene.scene_id}.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
