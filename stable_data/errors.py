"""The errors of the toolkit, and the notices about items that could still be used.

A message is one line: which item, what was found, what was expected and what to do:
``office_table_0031: object 2_desk_lamp_0 has quaternion norm 0.82, expected 1 +- 1e-3; is the file in [w, x, y, z] order?``
"""

import re
from dataclasses import dataclass

_MOST_TEXT, _END = 2000, 500  # characters of a message, and of its end if it is cut
_MOST_QUOTED, _MARKUP = 1000, re.compile(r"[\\`*\[\]<>#|!~&]")
_CUT = " ... "


def short_line(text: str) -> str:
    """Returns a message as one line of a bounded length: what it quotes may come from anywhere.

    A longer one keeps its beginning and its end, which says what was expected.
    """
    line = one_line(text)
    return line if len(line) <= _MOST_TEXT else line[: _MOST_TEXT - _END - len(_CUT)] + _CUT + line[-_END:]


def one_line(text: str) -> str:
    """Returns text that a terminal can show on one line: other characters, such as those that move its cursor, are escaped.

    A message may quote names from files, and a name may contain anything.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def failure_line(item_id: str | None, message: str) -> str:
    """Returns why an item is lost, on one line of bounded length; a row of others may have no id, or one of any length."""
    name, message = short_line(str(item_id)), " ".join(message.split())
    return short_line(message if message.startswith(name) else f"{name}: {message}")


def plain_markdown(text: str) -> str:
    """Returns text from outside as a Markdown page shows it: on one line, of bounded length, none of it markup."""
    shown = one_line(" ".join(text.split()))
    shown = shown if len(shown) <= _MOST_QUOTED else f"{shown[:_MOST_QUOTED]}…"
    return _MARKUP.sub(lambda found: f"\\{found[0]}", shown)


class StableDataError(ValueError):
    """The base class of all errors of the toolkit.

    Args:
        message: One line: which item, what was found, what was expected, what to do. What cannot be printed is escaped, and a very
            long message is cut.
        code: Short machine-readable reason, the ``code`` column of the ``failures`` table.
    """

    def __init__(self, message: str, code: str = "error") -> None:
        super().__init__(short_line(message))
        self.code = code

    def __reduce__(self) -> tuple[type["StableDataError"], tuple[str, str]]:
        # The default pickling would lose the code on the way back from a Ray worker.
        return type(self), (str(self), self.code)


class SceneError(StableDataError):
    """A scene, layout or task info that cannot be used."""


class MeshError(StableDataError):
    """A mesh that cannot be used."""


class ConfigError(StableDataError):
    """A configuration, folder or command that cannot be started."""


class GoalError(StableDataError):
    """A goal that cannot be compiled, reached or read.

    Codes: ``no_task``, ``no_goal``, ``goal_not_checkable``, ``goal_unresolved``, ``goal_true_at_start``, ``no_free_place``,
    ``goal_invalid``.
    """


class MissingColumnsWarning(UserWarning):
    """Warns that a run was made before some columns of its tables existed."""


@dataclass(frozen=True, slots=True)
class Notice:
    """A remark about one item: a row of ``warnings`` (the item was used) or ``failures`` (it could not be used).

    Attributes:
        item_id: The scene or asset.
        step: The step that made the remark, such as ``read`` or ``mesh``.
        code: Short machine-readable reason, such as ``glb_missing``.
        message: One line for the user. What cannot be printed is escaped, and a very long message is cut.
    """

    item_id: str
    step: str
    code: str
    message: str

    def __post_init__(self) -> None:
        """Escapes what cannot be printed, and cuts what is very long."""
        object.__setattr__(self, "message", short_line(self.message))


def cannot_write(where: str, error: OSError) -> ConfigError:
    """Returns the error for a folder or file that cannot be written."""
    reason = error.strerror or str(error)
    return ConfigError(
        f"{where}: cannot be written ({reason}); free space or choose a writable folder, then run again", "output_unwritable"
    )


def cannot_read(where: str, path: str, error: Exception) -> ConfigError:
    """Returns the error for a shard that is not a readable Parquet file.

    Raises:
        MemoryError: It is the error, which says nothing about the file.
    """
    if isinstance(error, MemoryError):
        raise error
    reason = str(error).strip().partition("\n")[0]
    remedy = "delete it and run the job that wrote it again"
    if "://" in where and isinstance(error, OSError):  # the store has failed; the file may be as it was written
        remedy = f"check the network and the store, then run again; only if the file itself is damaged, {remedy}"
    else:
        remedy = f"if it exists, {remedy}"
    return ConfigError(
        f"{where}: {path} cannot be read ({reason}), expected a Parquet file of this run; {remedy}", "shard_unreadable"
    )
