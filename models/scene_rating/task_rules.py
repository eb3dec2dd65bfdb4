"""The rules of the criterion "Consistency with Task": required objects, stated relations, stated looks."""

import re
from collections.abc import Iterable, Iterator, Sequence

from models.scene_rating.fault import Fault, listed, score_by, unknown
from models.scene_rating.rating_case import AuditedScene
from models.scene_rating.task_reader import TaskReader
from models.semantic_reasoner.edit_planning.candidates import adjectives_of
from models.semantic_reasoner.engines.registry import EMBEDDED
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter, InterpretedInstruction
from stable_data.assets.annotation import category_of
from stable_data.instructions.naming import LOOK_WORDS, shows_look
from stable_data.metrics.alignment import Alignment
from stable_data.metrics.matching import candidates
from stable_data.rating.rating import CriterionScore
from stable_data.scene import Relation

_RELATIONS, _LOOKS = 0.6, 0.4  # severity if no stated relation holds, and if every stated look is another one


def further_categories(categories: Iterable[str]) -> list[str]:
    """Returns those of some categories that the embedded world does not have, sorted.

    Raises:
        ConfigError: The statistics of the embedded engine cannot be read.
    """
    return sorted({*categories} - CategoryStatistics.load(EMBEDDED).categories.keys())


def interpreter_for(categories: Iterable[str]) -> InstructionInterpreter:
    """Returns an interpreter of instructions that knows some categories beside those of the embedded world.

    Raises:
        ConfigError: The weights of the reader, or the statistics of the embedded engine, cannot be read.
    """
    from models.text_encoder import load_default

    known = CategoryStatistics.load(EMBEDDED)
    more = CategoryStatistics.of_names(further_categories(categories))
    statistics = CategoryStatistics({**known.categories, **more.categories}, known.words, known.tables)
    return InstructionInterpreter(statistics, load_default())


class TaskRules:
    """Judges whether a scene is one in which its task can begin.

    The required objects are those that the instruction names, as it is read; task objects that the task info names and that the
    scene lacks count too. The stated relations are those of the reading too, between the objects for which the most of them hold. A
    look is a word for a colour, material, pattern or shape before a noun.

    Args:
        reader: Reads the tasks of scenes.
    """

    def __init__(self, reader: TaskReader) -> None:
        self._reader = reader

    def __call__(self, case: AuditedScene) -> CriterionScore:
        """Returns the score; unknown without an instruction, or if it names no known object."""
        meant = self._reader.meaning(case)
        if meant is None:
            return unknown("the scene has no instruction")
        found = self._reader.alignment(case)
        if found is None:
            return unknown("no object that the instruction names is known")
        named = () if case.scene.task is None else case.scene.task.task_objects
        there = {o.instance for o in case.scene.objects}
        faults = list(_missing_objects(found, [name for name in named if name not in there], len(named)))
        checked = [f"{len(found.matches)} of {len(found.reference.required)} required objects are there"]
        broken, total = found.broken, len(found.reference.entailed)
        if broken is None:
            return unknown("too many objects are alike to tell whether the stated relations hold")
        if total:
            checked.append(f"{total - len(broken)} of {total} stated relations hold")
        if broken:
            faults.append(Fault(_RELATIONS * len(broken) / total, f"does not hold: {_relations_in_words(broken, found)}"))
        looks = list(self._looks(case, meant))
        wrong = [words for words, is_shown in looks if is_shown is False]
        known = sum(is_shown is not None for _, is_shown in looks)
        if known:
            checked.append(f"{known - len(wrong)} of {known} stated looks are there")
        if wrong:
            faults.append(Fault(_LOOKS * len(wrong) / known, f"no {listed(wrong)}"))
        unread = [o.words for o in meant.reading.unknown]
        left_out = [f"unknown words ({listed(unread)})"] if unread else []
        left_out += [f"looks that no description states ({len(looks) - known})"] if known < len(looks) else []
        return score_by(faults, checked, left_out)

    def _looks(self, case: AuditedScene, meant: InterpretedInstruction) -> Iterator[tuple[str, bool | None]]:
        """Each stated look with its noun, and whether an object that the noun may mean shows it; None if that is unknown."""
        if meant.reference is None:
            return
        allowed = candidates(meant.reference.required, case.scene.movable)
        for number, one in enumerate(meant.reading.objects):
            for word in adjectives_of(one) if str(number) in allowed else ():
                if word in LOOK_WORDS:
                    shown = [shows_look(case.scene[name].description, word) for name in allowed[str(number)]]
                    if shown:  # else the object is missing, which is a fault of its own
                        yield one.words, True if True in shown else None if None in shown else False


def _missing_objects(found: Alignment, absent: Sequence[str], num_named: int) -> Iterator[Fault]:
    share, missing = found.awt, [str(r) for r in found.missing]
    if absent and 1 - len(absent) / num_named <= share:
        share, missing = 1 - len(absent) / num_named, [category_of(name).replace("_", " ") for name in absent]
    if missing:
        yield Fault(1 - share, f"missing: {listed(missing)}")


def _relations_in_words(broken: Sequence[Relation], found: Alignment) -> str:
    names = {r.instance: str(r) for r in found.reference.required}
    return listed([re.sub(r"[^\s,]+", lambda word: names.get(word[0], word[0]), str(relation)) for relation in broken])
