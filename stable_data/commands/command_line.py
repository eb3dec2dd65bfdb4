"""The program ``stable-data``: exit statuses, what it prints, and how its commands end."""

import os
import warnings
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any, ParamSpec, TypeVar

import typer

from stable_data.errors import MissingColumnsWarning, StableDataError, one_line
from stable_data.extras import install_hint

P = ParamSpec("P")
R = TypeVar("R")

DONE, SOME_FAILED, NOT_STARTED, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: success; some items failed and are listed; the command could not start or continue; Ctrl-C."""

DEBUG = "STABLE_DATA_DEBUG"
"""Environment variable: if it is set, an error ends a command with its traceback."""

Address = Annotated[str | None, typer.Option(help="Address of an existing Ray cluster, for example auto or ray://host:10001.")]


def echo(text: object, *, err: bool = False) -> None:
    """Prints text of any origin: characters that would act on a terminal are escaped, all but ends of lines.

    Args:
        text: The text.
        err: Whether it goes to the standard error.
    """
    typer.echo("\n".join(map(one_line, str(text).split("\n"))), err=err)


def with_clear_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Ends a command with a one-line message and status 2 if it cannot start or continue."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("once", MissingColumnsWarning)  # one line per message, however many files cause it
                warnings.showwarning = _show_warning
                return command(*args, **kwargs)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise  # an intended exit, or a closed pipe, for example by `head`
        except KeyboardInterrupt as error:
            echo("interrupted; finished files stay", err=True)
            raise typer.Exit(INTERRUPTED) from error
        except Exception as error:  # the outermost level: a traceback is shown only on request
            if os.environ.get(DEBUG):
                raise
            echo(f"error: {_error_line(error)}", err=True)
            raise typer.Exit(NOT_STARTED) from error

    return run


_default_showwarning = warnings.showwarning


def _show_warning(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
    """Shows a warning of the toolkit as one line, and any other warning as Python does."""
    if issubclass(category, MissingColumnsWarning):
        echo(f"warning: {message}", err=True)
    else:
        _default_showwarning(message, category, *rest, **more)


def _error_line(error: Exception) -> str:
    """Returns the one-line message of an error."""
    if isinstance(error, StableDataError):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and (hint := install_hint(error)):
        return f"this command {hint}"
    if isinstance(error, UnicodeEncodeError) and "\udc80" <= error.object[error.start] <= "\udcff":
        # As such halves of pairs the system gives bytes of a name that are not UTF-8; no id and no file of a run can have them.
        name = error.object[: error.start].rpartition('"')[2][-200:] + error.object[error.start :].partition('"')[0][:200]
        return f"{name!r} is not UTF-8, expected all names of folders and all options in UTF-8; rename the folder"
    found = str(error).strip().partition("\n")[0]
    return f"unexpected {type(error).__name__}: {found}; please report it with what {DEBUG}=1 shows"
