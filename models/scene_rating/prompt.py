"""The question to a language model that sees pictures, and the form of its reply.

The texts are frozen: ratings of one version are compared. :data:`PROMPT_VERSION` is a hash of them and of the form, so that a change
shows in every row.

Below each picture stands a number that the reply must repeat (:mod:`models.scene_rating.pictures`). Some endpoints drop pictures
without a word, and a reply that is bound to the form would then have scores all the same.
"""

from typing import Any

from models.semantic_reasoner.replies.json_form import JsonForm, closed_object
from models.semantic_reasoner.text.prompt import Message, check_instruction
from models.semantic_reasoner.text.reply_json import sanitise_words
from stable_data.content_id import content_id
from stable_data.rating.criteria import CRITERIA, HIGHEST, LOWEST, STEP
from stable_data.scene import Scene

NUMBERS = {"front": "number_below_front", "perspective": "number_below_perspective"}
"""Name of a picture -> key of the number that stands below it."""

_CRITERIA_TEXT = "\n\n".join(
    f'{number}. {c.name} ("{c.key}")\n{c.judged}\n{LOWEST:g}: {c.worst}\n{HIGHEST:g}: {c.best}'
    for number, c in enumerate(CRITERIA, 1)
)

SYSTEM = f"""You rate tabletop scenes that were made for robot simulation. For each scene you are given the task that a robot shall \
carry out there, the environment, and two renderings of the scene as it is BEFORE the task is begun: the first from the front, where \
the person or the robot stands, the second from the left of the front, higher. Judge what the two pictures show together.

Rate by five criteria. Each is judged by itself: a fault that belongs to one of them lowers that one only.

{_CRITERIA_TEXT}

SCORES
A score is a whole or a half number from {LOWEST:g} to {HIGHEST:g}. {HIGHEST:g} is without fault, 8 has a small fault that one has to \
look for, 6 a fault that one sees at once, 4 several of these, 2 faults all over the scene. Use the whole range. Simple materials, \
plain colours, the empty room and the quality of the rendering are no faults. What the task asks the robot to bring about does not \
hold yet, and that is no fault either.

ANSWER
One JSON object and nothing else. Below each picture stands a number of three digits: repeat both, as you read them. Then, for each \
criterion, first a rationale of one or two sentences that names the objects which decided it, then the score. If you see no pictures, \
give 0 for their numbers."""
"""The system message."""

TASK, ENVIRONMENT, TABLE = "Task: ", "\nEnvironment: ", "\nTable: "
PICTURES = "\nThe first picture is the front view, the second one the perspective view."
NO_ENVIRONMENT = "not described"


def _form() -> JsonForm:
    steps = (LOWEST + STEP * k for k in range(round((HIGHEST - LOWEST) / STEP) + 1))
    scores = [int(score) if score.is_integer() else score for score in steps]
    number: dict[str, Any] = {"type": "integer"}
    properties: dict[str, Any] = dict.fromkeys(NUMBERS.values(), number)
    for c in CRITERIA:
        properties[c.key] = closed_object({"rationale": {"type": "string"}, "score": {"type": "number", "enum": scores}})
    return JsonForm.of("rating", closed_object(properties))


FORM = _form()
"""The form of a reply."""

PROMPT_VERSION = content_id(SYSTEM, TASK, ENVIRONMENT, TABLE, PICTURES, NO_ENVIRONMENT, FORM.text)
"""Hash of all fixed texts and of the form."""


def rating_messages(scene: Scene) -> tuple[Message, ...]:
    """Returns the question about a scene, to which its two pictures belong.

    Raises:
        SceneError: The scene has no instruction, or one that is too long (``instruction_invalid``).
    """
    task = scene.task
    instruction = check_instruction("" if task is None else task.task)
    environment = sanitise_words("" if task is None else task.environment) or NO_ENVIRONMENT
    width, depth = (f"{100 * s:.0f}" for s in scene.table.size_xy)
    table = f"{sanitise_words(scene.table.table_type.replace('_', ' '))}, {width} x {depth} cm"
    user = f"{TASK}{instruction}{ENVIRONMENT}{environment}{TABLE}{table}{PICTURES}"
    return {"role": "system", "content": SYSTEM}, {"role": "user", "content": user}
