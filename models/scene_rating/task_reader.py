"""The task of a scene as judges by rules take it: by its instruction, and not by the names that whoever made the scene attached.

So the same scene with the same instruction has the same task objects and relations, whichever system made it.
"""

from models.scene_rating.rating_case import AuditedScene
from models.semantic_reasoner.language.interpreter import InstructionInterpreter, InterpretedInstruction
from stable_data.metrics.alignment import Alignment


class TaskReader:
    """Finds what the instruction of a scene requires, and which objects of the scene it is about.

    Args:
        interpret: Interprets instructions.
    """

    def __init__(self, interpret: InstructionInterpreter) -> None:
        self._interpret = interpret
        self._last: tuple[AuditedScene, Alignment | None] | None = None  # the rules of several criteria ask for the same scene

    def meaning(self, case: AuditedScene) -> InterpretedInstruction | None:
        """Returns what the instruction means; None for a scene without one."""
        task = case.scene.task
        return self._interpret(task.task) if task is not None and task.task.strip() else None

    def alignment(self, case: AuditedScene) -> Alignment | None:
        """Compares the scene with its instruction, in the way in which the most relations hold; None if it names no known object."""
        if self._last is None or self._last[0] is not case:
            meant = self.meaning(case)
            self._last = case, None if meant is None or meant.reference is None else case.align(meant.reference)
        return self._last[1]

    def task_objects(self, case: AuditedScene) -> frozenset[str]:
        """Returns the instances that the instruction is about; none if it names no known object."""
        found = self.alignment(case)
        return frozenset() if found is None else frozenset(name for _, name in found.matches)
