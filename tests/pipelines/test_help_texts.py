"""Help texts: arguments have names and explanations of one line."""

import pytest
import typer.main
from typer.core import TyperArgument, TyperCommand, TyperGroup

from pipelines.__main__ import app as jobs
from stable_data.cli import app as library

GROUPS = (("stable-data", typer.main.get_command(library)), ("python -m pipelines", typer.main.get_command(jobs)))
COMMANDS = [
    (program, name, command)
    for program, group in GROUPS
    if isinstance(group, TyperGroup)
    for name, command in sorted(group.commands.items())
]


@pytest.mark.parametrize(("program", "name", "command"), COMMANDS, ids=[f"{p} {n}" for p, n, _ in COMMANDS])
def test_arguments_have_names_and_explanations_of_one_line(program: str, name: str, command: TyperCommand) -> None:
    for argument in (p for p in command.params if isinstance(p, TyperArgument)):
        assert argument.metavar is not None, f"{program} {name}: {argument.name}"
        assert argument.metavar == argument.metavar.upper()
        assert 0 < len(argument.help or "") <= 85, f"{program} {name}: {argument.help}"
    assert all(len(paragraph) < 130 for paragraph in (command.help or "").split("\n\n") if paragraph.startswith("Status"))
