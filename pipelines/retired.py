"""Verbs and options that are gone: a command line that has one is answered with one line that says what to write instead."""

from typing import Any

from typer.core import TyperGroup

from stable_data.cli import with_clear_errors
from stable_data.errors import ConfigError

RETIRED = {
    "propose": (
        "python -m pipelines generate --instruction TEXT --table TYPE --size W D --out RUN (or --tasks FILE); for layouts that are not "
        "corrected add --set corrects=never --set accept=, then stable-data export RUN OUT --format mesatask"
    ),
    "generate --one-shot": "python -m pipelines generate --set schedule=whole",
}
"""What to write instead, by ``VERB`` or ``VERB --option``. A verb is also the name of its table in a file of settings."""


class CommandGroup(TyperGroup):
    """The verbs of a command line; names that are gone are refused before any option is read."""

    @with_clear_errors
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that words ask for, see the base class.

        Raises:
            typer.Exit: With status 2, where the verb or one of its options is gone.
        """
        verb, *words = args
        for name in (verb, *(f"{verb} {word.partition('=')[0]}" for word in words)):
            if name in RETIRED:
                raise ConfigError(f"{name} is retired; write {RETIRED[name]}", "retired")
        return super().resolve_command(ctx, args)
