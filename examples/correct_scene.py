"""Corrects one scene of a folder in the MesaTask-10K format until the exact audit finds it clean.

python -m examples.correct_scene FOLDER SCENE_ID
"""

import sys
from pathlib import Path

import stable_data as sd
from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.learned_flow import load_flow


def main(folder: Path, scene_id: str) -> None:
    """Prints what the correction did to each object.

    Args:
        folder: It holds Layout_info, Asset_annotation.json and Assets_library.
        scene_id: Name of the scene's folder.
    """
    dataset = sd.MesaTaskDataset(folder)
    scene, _ = dataset.read(scene_id)
    [correction] = PhysicsCorrector(load_flow()).correct([scene], sd.AssetStore(dataset))
    print(f"{scene_id}: {correction.status} {correction.reason}")
    start = correction.start
    if correction.certified is not None:
        for o in correction.certified.objects:
            x, y, z = (1000 * (after - before) for after, before in zip(o.position, start[o.instance].position, strict=True))
            print(f"  {o.instance} moved by ({x:+.1f}, {y:+.1f}, {z:+.1f}) mm")
        for dropped in correction.dropped:
            print(f"  {dropped.instance} left out: {dropped.reason}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
