"""Instructions: tasks derived from a scene graph by templates; every statement in them is true in the scene."""

from stable_data.instructions.deriving import KINDS, NUM_PATTERNS, derive_task, task_rng
from stable_data.instructions.wording.words import type_name, type_words

__all__ = ["KINDS", "NUM_PATTERNS", "derive_task", "task_rng", "type_name", "type_words"]
