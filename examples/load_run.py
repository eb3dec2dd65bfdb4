"""Reads the clean scenes of a run with the base dependencies alone.

python -m examples.load_run RUN
"""

import sys

import stable_data as sd
from stable_data.storage.schemas import SCHEMAS


def main(place: str) -> None:
    """Prints each object of the clean scenes.

    Args:
        place: A run folder or its URI.
    """
    run = sd.RunFolder(place)
    clean = sd.parse_filter("clean and num_objects >= 2", SCHEMAS["scenes"])
    num_clean = 0
    for batch in run.batches("scenes", where=clean.expression):
        for row in batch.to_pylist():
            scene = sd.scene_from_row(row)
            num_clean += 1
            print(f"{scene.scene_id}: {scene.table.table_type}, {scene.task.task if scene.task else 'no task'}")
            for o in scene.objects:
                x, y, z = o.position  # metres; the table top is z = 0, its near-left corner the origin
                print(f"  {o.instance} at ({x:.3f}, {y:.3f}, {z:.3f}), yaw {o.yaw:.2f} rad, on {o.support}")
    print(f"{num_clean} of {run.num_rows('scenes')} scenes are clean and have two objects or more")


if __name__ == "__main__":
    main(sys.argv[1])
