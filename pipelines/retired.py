"""Retired verbs, options and settings, each with one line that names the replacement."""

from typing import Any

from typer.core import TyperGroup

from stable_data.commands.command_line import with_clear_errors
from stable_data.errors import ConfigError

_WAITS = "the openai client chooses the waits: set engine.http.tries and engine.http.total_s"
_CHECK = "it is a constant of models/semantic_reasoner/replies/checks.py; leave it out"

RETIRED = {
    "propose": (
        "write python -m pipelines generate --instruction TEXT --table TYPE --size W D --out RUN (or --tasks FILE); for layouts "
        "that are not corrected add --set corrects=never --set accept=, then stable-data export RUN OUT --format mesatask"
    ),
    "generate --one-shot": "write python -m pipelines generate --set schedule=whole",
    "engine.http.connect_s": "the time limit of a connection is 10 seconds; set engine.http.read_s and engine.http.total_s",
    "engine.http.first_wait_s": _WAITS,
    "engine.http.longest_wait_s": _WAITS,
    "engine.http.give_up_after": (
        "a short question tells whether the endpoint is down: set engine.http.tries and engine.http.rest_s"
    ),
    "engine.http.sends_form": "the form is sent as response_format: engine.http.extra has further fields",
    "reasoner.checks.sunk_cm": _CHECK,
    "reasoner.checks.size_slack": _CHECK,
    "reasoner.checks.rare_size_slack": _CHECK,
    "reasoner.checks.rare": _CHECK,
    "reasoner.checks.unusual": _CHECK,
    "reasoner.checks.crowding": _CHECK,
}
"""What to write instead, by ``VERB``, ``VERB --option`` or the dotted key of a setting.

A verb is also the name of its table in a file of settings; a key is the same in every job that had it."""


class CommandGroup(TyperGroup):
    """The verbs of a command line; retired names are refused before any option is read."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Finds the command for the arguments, see the base class.

        Raises:
            typer.Exit: With status 2, if the verb or one of its options is retired.
        """
        _refuse_retired(*args)
        return super().resolve_command(ctx, args)


@with_clear_errors
def _refuse_retired(verb: str, *words: str) -> None:
    for name in (verb, *(f"{verb} {word.partition('=')[0]}" for word in words)):
        if name in RETIRED:
            raise ConfigError(f"{name} is retired; {RETIRED[name]}", "retired")
