"""What an instruction says: objects, relations at the start and after the task."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MentionedObject:
    """One object that an instruction mentions.

    Attributes:
        words: The words that mention it.
        categories: Categories that it may have; none if the words are unknown.
        region: Cell of the table at the start, or empty.
        goal_region: Cell of the table after the task, or empty.
        is_filled: Whether it holds objects without a name at the start.
        is_taken: Whether it is to be picked up or used, with no place stated.
        change: In an edit ``remove``, ``add`` or ``away``, or empty.
        mentions: Ranges of characters of the text that mention it by a noun, in the order of the text.
        name: Number of its name; objects of one plural have the same.
        is_one_of_many: Whether it stands for a plural without a number, of which there may be more.
    """

    words: str
    categories: tuple[str, ...]
    region: str = ""
    goal_region: str = ""
    is_filled: bool = False
    is_taken: bool = False
    change: str = ""
    mentions: tuple[tuple[int, int], ...] = ()
    name: int = 0
    is_one_of_many: bool = False


@dataclass(frozen=True, slots=True)
class MentionedRelation:
    """A relation between two mentioned objects.

    Attributes:
        subject: Number of the subject among the objects.
        kind: ``in``, ``on``, ``left``, ``front``, ``near`` or ``between``; in an edit also ``replace``, ``style`` or ``swap``.
        target: Number of the target.
        score: Probability that the network gives it.
    """

    subject: int
    kind: str
    target: int
    score: float = 1.0


@dataclass(frozen=True, slots=True)
class InstructionReading:
    """What an instruction says.

    Attributes:
        objects: The objects of the start.
        start: Relations at the start.
        goal: Relations after the task.
        contradictions: Relations that are stated of the start too, but cannot hold together with ``start``.
    """

    objects: tuple[MentionedObject, ...]
    start: tuple[MentionedRelation, ...] = ()
    goal: tuple[MentionedRelation, ...] = ()
    contradictions: tuple[MentionedRelation, ...] = ()

    @property
    def unknown(self) -> tuple[MentionedObject, ...]:
        """The objects of no known category."""
        return tuple(o for o in self.objects if not o.categories)
