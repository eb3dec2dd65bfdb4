"""The errors of the toolkit, and the notes that it keeps about things it could still use.

A message says which thing, what was found, what was expected and what to do, in one line:
``office_table_0031: object 2_desk_lamp_0 has quaternion norm 0.82, expected 1 +- 1e-3; is the file in [w, x, y, z] order?``
"""

from dataclasses import dataclass


class StableDataError(ValueError):
    """What every error of the toolkit is.

    Args:
        message: One line: which thing, what was found, what was expected, what to do.
        code: Short machine-readable reason, the ``code`` column of the ``failures`` table.
    """

    def __init__(self, message: str, code: str = "error") -> None:
        super().__init__(message)
        self.code = code

    def __reduce__(self) -> tuple[type["StableDataError"], tuple[str, str]]:
        # The default would lose the code on the way back from a Ray worker.
        return type(self), (str(self), self.code)


class SceneError(StableDataError):
    """A scene, layout or task info that cannot be used."""


class MeshError(StableDataError):
    """A mesh that cannot be used."""


class ConfigError(StableDataError):
    """A configuration, folder or command that cannot be started."""


class MissingColumnsWarning(UserWarning):
    """Warns that a run was made before some columns of its tables existed."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Something about one item that deserves a look: a row of ``warnings`` (kept) or ``failures`` (not usable).

    Attributes:
        item_id: The scene or asset.
        step: The step that noticed it, such as ``read`` or ``mesh``.
        code: Short machine-readable reason, such as ``glb_missing``.
        message: One line for a person.
    """

    item_id: str
    step: str
    code: str
    message: str


def cannot_write(where: str, error: OSError) -> ConfigError:
    """The error for a place that cannot be written."""
    reason = error.strerror or str(error)
    return ConfigError(
        f"{where}: cannot be written ({reason}); free space or choose a writable folder, then run again",
        "output_unwritable",
    )


def cannot_read(where: str, path: str, error: Exception) -> ConfigError:
    """The error for a shard that is no Parquet any more."""
    reason = str(error).strip().partition("\n")[0]
    return ConfigError(
        f"{where}: {path} cannot be read ({reason}), expected a Parquet file of this run; "
        "if it exists, delete it and run the job that wrote it again",
        "shard_unreadable",
    )
