"""I-Design-Table: agents propose objects and a graph of relations, rules check the graph, and backtracking places the objects.

Çelen et al., "I-Design: Personalized LLM Interior Designer", 2024, as the paper of STABLE and MesaTask use it on tables; re-implemented
from these descriptions, with prompts and code of our own. Objects are placed by the sizes that the agents state, and assets are retrieved
for the finished layout, as in the original. The original stretches assets to these sizes along each axis; here the setting
``retrieval.stretch`` decides for all systems alike.
"""

from collections.abc import Sequence

from models.baselines.layout.draft import RELATIONS_FORM, RelationText, read_relations
from models.baselines.layout.drafting import UNUSABLE, Asking, Draft, Drafting, Exchanges
from models.baselines.layout.placed_layout import PlacingSystem, placed_layout
from models.baselines.layout.prompts import ARCHITECT, DESIGNER, correction_chat
from models.baselines.layout.relation_checks import check_relations
from models.baselines.placement.backtracking import Backtracking
from models.dual_system.algorithm1 import LoopSettings
from models.dual_system.requests import Loop
from models.semantic_reasoner.chat import ChatQuestion
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.reply_json import LayoutObject

MOST_ROUNDS = 3
"""How often the corrector is asked, at most; the conflicts that remain then are left out."""

_SEARCH = Backtracking()


def idesign(
    task: LayoutTask,
    seed: int,
    settings: LoopSettings,
    interpret: InstructionInterpreter | None = None,
    drafting: Drafting | None = None,
) -> Loop:
    """Runs I-Design-Table for one scene; the arguments are those of :func:`~models.baselines.layout.holodeck.holodeck`."""
    system = PlacingSystem(drafting or draft, _SEARCH, retrieves_first=False)
    return placed_layout(system, task, seed, settings, interpret)


def draft(exchanges: Exchanges) -> Asking[Draft | None]:
    """Asks the designer for objects and the architect for a graph, and the corrector while rules find conflicts in it."""
    objects = yield from exchanges.objects(DESIGNER)
    if objects is None:
        return None
    stated = yield from exchanges.relations(ARCHITECT, objects)
    if stated is None:
        return None
    best = checked = check_relations(stated, objects)
    for _ in range(MOST_ROUNDS):
        if not checked.faults:
            break
        again = yield from _corrected(exchanges, objects, stated, [fault.message for fault in checked.faults])
        if again is None and exchanges.code != UNUSABLE:
            return None  # the engine gave no answer
        if again is None:
            exchanges.failure = exchanges.code = ""  # the best graph before is used
            break
        stated, checked = again, check_relations(again, objects)
        if checked.num_related >= best.num_related:  # a correction may lose more than it mends
            best = checked
    exchanges.faults += best.faults
    return Draft(objects, best.constraints)


def _corrected(
    exchanges: Exchanges, objects: Sequence[LayoutObject], stated: Sequence[RelationText], conflicts: Sequence[str]
) -> Asking[tuple[RelationText, ...] | None]:
    found = yield from exchanges.ask(
        lambda: ChatQuestion(correction_chat(exchanges.task, objects, stated, conflicts), RELATIONS_FORM, read_relations)
    )
    assert found is None or isinstance(found, tuple)
    return found
