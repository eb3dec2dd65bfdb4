"""Compiles the goals of the scenes of a run, and tells how many compile, by kind, and why the others do not."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

from stable_data.assets.run_assets import run_annotations, run_store
from stable_data.errors import GoalError, StableDataError
from stable_data.scene import Scene
from stable_data.storage.row_groups import TableFiles, row_slices
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry, known_containers
from stable_data.tasks.goal import Goal

UNUSABLE = "scene_unusable"
"""Reason of a scene that cannot be read, or whose geometry cannot."""

_REASONS = {
    "no_task": "the scene has no task",
    "no_goal": "the task info states no goal, or the instruction was not understood as one",
    "goal_not_checkable": "no state of the scene shows that the task is done",
    "goal_unresolved": "an object of the goal is missing or ambiguous",
    "goal_true_at_start": "the goal holds at the start",
    UNUSABLE: "the scene or its geometry cannot be read",
}


@dataclass(frozen=True, slots=True)
class SceneGoal:
    """What became of the goal of one scene.

    Attributes:
        scene: The scene; None if its row is none of a scene.
        goal: Its goal; None if it does not compile.
        code: Why it does not, or empty.
        message: The same in one line, or empty.
    """

    scene: Scene | None
    goal: Goal | None
    code: str = ""
    message: str = ""


def run_goals(run: RunFolder, where: str | None = None, limit: int | None = None) -> Iterator[SceneGoal]:
    """Compiles the goals of the scenes of a run, in the order of its files.

    Args:
        run: The run, with the tables ``scenes``, ``assets`` and ``meshes``.
        where: A condition on ``scenes``; None: all.
        limit: Most scenes; None: all.

    Raises:
        ConfigError: A table is missing or cannot be read, or ``where`` is no condition.
    """
    files = TableFiles(run.uri, "scenes", None, where=where)
    store, annotations = run_store(run.uri), run_annotations(run)
    rows = (row for group in range(len(files.groups)) for part in row_slices(files.read([group])) for row in part.to_pylist())
    for row in islice(rows, limit):
        scene = None
        try:
            scene = scene_from_row(row)
            scene, shapes, _ = store.resolved(scene)
            geometry = TaskGeometry(scene, tuple(shapes), known_containers(scene, annotations))
            yield SceneGoal(scene, compile_goal(geometry))
        except GoalError as error:
            yield SceneGoal(scene, None, error.code, str(error))
        except StableDataError as error:
            yield SceneGoal(scene, None, UNUSABLE, str(error))


def goals_table(found: Iterable[SceneGoal]) -> str:
    """Returns a table of text: goals by kind, then tasks without a goal by reason, each with its share of all."""
    found = list(found)
    kinds = Counter(str(f.goal.kind) for f in found if f.goal is not None)
    codes = Counter(f.code for f in found if f.goal is None)
    rows = [("goals", sum(kinds.values()), ""), *((f"  {kind}", count, "") for kind, count in kinds.most_common())]
    rows += [("without a goal", sum(codes.values()), "")]
    rows += [(f"  {code}", count, _REASONS.get(code, "")) for code, count in codes.most_common()]
    width = max(len(name) for name, _, _ in rows)
    total = max(1, len(found))
    return "\n".join(f"{name:<{width}}  {count:>7}  {count / total:>6.1%}  {why}".rstrip() for name, count, why in rows)
