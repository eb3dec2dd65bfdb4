"""The five criteria of the paper's GPT-score (stable_paper.tex, appendix, Metrics), and the range of their scores.

This is the one place with the criteria: prompts, rules, columns and tables follow from :data:`CRITERIA`.
"""

from dataclasses import dataclass

LOWEST, HIGHEST, STEP = 1.0, 10.0, 0.5
"""The range of a score, and the difference of two neighbouring scores that a language model may give."""


@dataclass(frozen=True, slots=True)
class Criterion:
    """A criterion that scenes are rated by.

    Attributes:
        key: Its abbreviation in the paper's tables, in small letters: the name of its column.
        name: Its name.
        judged: What is judged, sentences.
        worst: What the lowest score means, a sentence.
        best: What the highest score means, a sentence.
    """

    key: str
    name: str
    judged: str
    worst: str
    best: str


CONSISTENCY = Criterion(
    "cwt",
    "Consistency with Task",
    "Whether the scene is one in which the task can begin: every object that the task names or needs is there, in the stated number "
    "and with the stated attributes, and what the task says about the places of things holds before it is begun. The other objects "
    "suit the environment.",
    "The objects of the task are missing, or the scene belongs to another task.",
    "Every object, attribute and place that the task names is there, and the rest suits it.",
)

SIZES = Criterion(
    "osr",
    "Object Size Reasonableness",
    "Whether each object has a size that real things of its kind have, beside the other objects and beside the table.",
    "Sizes contradict each other, such as a cup as large as the table.",
    "Every size is that of a real thing of this kind.",
)

PLACEMENT = Criterion(
    "ppi",
    "Placement Plausibility & Intersections",
    "Whether each object rests where a real one would stay: on the table, on another object or in one. Objects do not pass through "
    "each other or the table, do not float and do not reach over the edge so far that they would fall.",
    "Many objects pass through each other, float or hang over the edge.",
    "Everything rests, and nothing passes through anything.",
)

LAYOUT = Criterion(
    "lcr",
    "Layout Coherence & Realism",
    "Whether a person would arrange this table so: things that are used together are together and on a fitting kind of table, what "
    "has a front faces the person at the front edge, what is used is within reach, and the table is neither heaped up in one place "
    "nor scattered without order.",
    "The arrangement looks random.",
    "The arrangement could be a photograph of a table in use.",
)

VISIBILITY = Criterion(
    "ov",
    "Object Visibility",
    "Whether the objects can be seen and told apart in the two pictures, above all those of the task: nothing important is hidden "
    "behind, under or in something else, or outside the picture.",
    "The objects of the task cannot be seen.",
    "Every object can be seen and told apart.",
)

CRITERIA: tuple[Criterion, ...] = (CONSISTENCY, SIZES, PLACEMENT, LAYOUT, VISIBILITY)
"""The criteria, in the order of the paper's table."""

KEYS: tuple[str, ...] = tuple(criterion.key for criterion in CRITERIA)
"""Their keys."""
