"""Holodeck-Table: a language model proposes objects and relations, and a search over a grid places them.

Yang et al., "Holodeck: Language Guided Generation of 3D Embodied AI Environments", CVPR 2024, as the paper of STABLE and MesaTask use it on
tables; re-implemented from these descriptions, with prompts and code of our own. Assets are retrieved before the search, which keeps their
boxes apart. What finds no place is left out.
"""

from models.baselines.layout.drafting import Asking, Draft, Drafting, Exchanges
from models.baselines.layout.placed_layout import PlacingSystem, placed_layout
from models.baselines.layout.prompts import HOLODECK_OBJECTS, HOLODECK_RELATIONS
from models.baselines.layout.relation_checks import UNRELATED, check_relations
from models.baselines.placement.grid_search import GridSearch
from models.dual_system.algorithm1 import LoopSettings
from models.dual_system.requests import Loop
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.staged_layout import LayoutTask

_SEARCH = GridSearch()


def holodeck(
    task: LayoutTask,
    seed: int,
    settings: LoopSettings,
    interpret: InstructionInterpreter | None = None,
    drafting: Drafting | None = None,
) -> Loop:
    """Runs Holodeck-Table for one scene.

    Args:
        task: The instruction and the table.
        seed: Seed of all random choices of the scene.
        settings: As for :func:`~models.baselines.layout.placed_layout.placed_layout`.
        interpret: As for the same.
        drafting: Obtains objects and relations; None asks the language model, see :func:`draft`.
    """
    system = PlacingSystem(drafting or draft, _SEARCH, retrieves_first=True)
    return placed_layout(system, task, seed, settings, interpret)


def draft(exchanges: Exchanges) -> Asking[Draft | None]:
    """Asks for objects, then for relations; of these, the ones that cannot be used are left out."""
    objects = yield from exchanges.objects(HOLODECK_OBJECTS)
    if objects is None:
        return None
    stated = yield from exchanges.relations(HOLODECK_RELATIONS, objects)
    if stated is None:
        return None
    checked = check_relations(stated, objects)
    exchanges.faults += [fault for fault in checked.faults if fault.code != UNRELATED]  # those may stand anywhere
    return Draft(objects, checked.constraints)
