"""Finds judges by name, asks them about a scene, and compares what they say."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import cast

from stable_data.errors import ConfigError, MeshError
from stable_data.extras import install_hint
from stable_data.judges.judge import VERDICT_OPTIONS, Judge
from stable_data.limits import is_out_of_memory
from stable_data.metrics.judge_columns import FURTHER, JUDGES, verdict_columns
from stable_data.scene import Tabletop
from stable_data.simulation.settling import PhysicsOptions, RigidBody, SettleResult, unknown_result

DISAGREE = "judges_disagree"
"""Code of the warning about a scene that one judge finds stable and another one not."""


def check_judges(judges: str, arbiter: str = "", section: str = "") -> tuple[str, ...]:
    """Reads the settings ``judges`` and ``arbiter``.

    Args:
        judges: Names of judges, joined by commas; empty for none.
        arbiter: A further judge, or empty.
        section: Name of the settings in errors, or empty.

    Returns:
        The judges, without the arbiter.

    Raises:
        ConfigError: A judge is unknown, stands there twice, or the arbiter has nothing to decide (``config_invalid``); or the package
            of one is not installed (``judge_missing``).
    """
    section = f"{section}." if section else ""
    names, further = judge_names(judges, f"{section}judges"), judge_names(arbiter, f"{section}arbiter")
    if len(further) > 1 or (further and (len(names) < 2 or further[0] in names)):
        raise ConfigError(
            f"setting {section}arbiter is {arbiter!r} and judges is {judges!r}, expected one further judge beside at least two; name "
            "another arbiter, or none",
            "config_invalid",
        )
    _check_installed([*names, *further])
    return names


def judge_names(text: str, what: str = "judges") -> tuple[str, ...]:
    """Reads names of judges, joined by commas.

    Args:
        text: Such as ``mujoco,sapien``; empty for none.
        what: Name of the setting in errors.

    Raises:
        ConfigError: A name is unknown or stands there twice (``config_invalid``).
    """
    names = tuple(name.strip() for name in text.split(",")) if text.strip() else ()
    if unknown := [name for name in names if name not in JUDGES]:
        raise ConfigError(f"setting {what} has {unknown[0]!r}, expected some of {', '.join(JUDGES)}", "config_invalid")
    if len(set(names)) < len(names):
        raise ConfigError(f"setting {what} is {text!r}, expected each judge once", "config_invalid")
    return names


def _check_installed(names: Sequence[str]) -> None:
    """Refuses judges whose package is not installed.

    Raises:
        ConfigError: See above, with the command that installs it (``judge_missing``).
    """
    for name in names:
        package = JUDGES[name].package
        if find_spec(package) is None:
            hint = install_hint(ModuleNotFoundError(name=package))
            raise ConfigError(f"judge {name} {hint}", "judge_missing")


def judge(name: str, bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = VERDICT_OPTIONS) -> SettleResult:
    """Asks one judge about a scene.

    Args:
        name: The judge, a key of ``JUDGES``.
        bodies: The objects.
        table: The table that supports them.
        options: See :class:`stable_data.judges.judge.Judge`.

    Returns:
        Its verdict; unknown, with the reason, if its package is missing, or the engine cannot load the scene or fails.
    """
    try:
        adapter = cast(Judge, import_module(f"stable_data.judges.{name}"))
        return adapter.settle(bodies, table, options)
    except MeshError as error:
        return unknown_result(bodies, str(error))
    except ModuleNotFoundError as error:
        return unknown_result(bodies, f"judge {name} {install_hint(error) or f'cannot be loaded: {error}'}")
    except Exception as error:
        if is_out_of_memory(error):
            raise
        # The engine fails for this scene, the others judge it.
        found = " ".join(str(error).split())
        return unknown_result(bodies, f"{JUDGES[name].engine} failed: {type(error).__name__}: {found}")


def ask_judges(
    names: Sequence[str],
    bodies: Sequence[RigidBody],
    table: Tabletop,
    arbiter: str = "",
    known: Mapping[str, SettleResult] | None = None,
) -> dict[str, SettleResult]:
    """Asks judges about a scene, and the arbiter if they disagree.

    Args:
        names: The judges.
        bodies: The objects.
        table: The table that supports them.
        arbiter: A further judge, which is asked only about scenes on which the others disagree; empty for none.
        known: Verdicts on the same scene that need not be asked for again, by judge.

    Returns:
        The verdicts by judge, in the given order, then that of the arbiter if it was asked.
    """
    known = known or {}
    found = {name: known[name] if name in known else judge(name, bodies, table) for name in names}
    if arbiter and arbiter not in found and disagree(found):
        found[arbiter] = judge(arbiter, bodies, table)
    return found


def disagree(verdicts: Mapping[str, SettleResult]) -> bool:
    """Whether one judge finds a scene stable and another one not; an unknown verdict is no opinion."""
    return {True, False} <= {verdict.stable for verdict in verdicts.values()}


def judge_columns(verdicts: Mapping[str, SettleResult]) -> dict[str, bool | float | None]:
    """Returns the columns of the judges other than MuJoCo, null for those that were not asked."""
    row: dict[str, bool | float | None] = {}
    for name in FURTHER:
        verdict = verdicts.get(name)
        values = (
            (None, None, None) if verdict is None else (verdict.stable, verdict.settle_move_max_mm, verdict.settle_turn_max_deg)
        )
        row |= dict(zip(verdict_columns(name), values, strict=True))
    return row


def describe(verdicts: Mapping[str, SettleResult]) -> str:
    """Returns the verdicts in one line: ``mujoco: stable; sapien: not stable (cup_0 moved 15.0 mm)``."""
    words = {True: "stable", False: "not stable", None: "unknown"}
    return "; ".join(
        f"{name}: {words[verdict.stable]}{f' ({verdict.reason})' if verdict.reason else ''}"
        for name, verdict in verdicts.items()
    )
