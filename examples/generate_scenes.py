"""Generates ten scenes with the embedded reasoner, the corrector and the embedded assets, in this process.

python -m examples.generate_scenes OUT [COUNT]
"""

import sys

import stable_data as sd
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import sample_tasks


def main(out: str, count: int = 10) -> None:
    """Writes a run, and prints what was asked for and which scenes were accepted.

    Args:
        out: Folder of the run; start again to continue an interrupted run.
        count: How many tasks to sample.
    """
    tasks = sample_tasks(count, seed=0)
    generate(tasks, out, GenerateSettings(num_pictures=0), WorkerPool())  # WorkerPool(4): four processes on a local Ray
    run = sd.RunFolder(out)
    for row in run.table("scenes").to_pylist():
        scene = sd.scene_from_row(row)
        print(f"{scene.scene_id}: {len(scene.objects)} objects, {scene.task.task if scene.task else ''}")
    print(f"{run.num_rows('scenes')} of {count} scenes are clean and stable")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
